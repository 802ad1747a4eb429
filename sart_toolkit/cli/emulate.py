"""`sart emulate`: the file of an emulated cell."""

from __future__ import annotations

from typing import Any

from sart_toolkit import pipeline
from sart_toolkit.bringup.emulate import emulated_cell
from sart_toolkit.bringup.skeleton import write_source
from sart_toolkit.cli.arguments import Emulate
from sart_toolkit.cli.sensor import hand_eye_error
from sart_toolkit.errors import InvalidInput


def emulate_verb(args: Emulate) -> dict[str, Any]:
    """`sart emulate`."""
    if args.out.suffix != ".toml":
        raise InvalidInput(f"--out: expected a file that ends with .toml, got {args.out}")
    pipeline.check_names(task=args.task, robot=args.robot, backend=args.simulator)
    try:
        placement = [float(word) for word in args.placement.split(",")]
    except ValueError as error:
        raise InvalidInput(
            f"--placement: expected X,Y,DEG as in 0.02,-0.03,10, got {args.placement!r}"
        ) from error
    length, angle = hand_eye_error(args.hand_eye_error)
    text = emulated_cell(
        args.task,
        args.robot,
        simulator=args.simulator,
        placement=placement,
        hand=args.hand,
        image_height=args.image_height,
        sensor=args.sensor,
        hand_eye=(length * 1e3, angle),
        latency=args.latency,
        lag=args.lag,
        joint_noise=args.joint_noise,
        speed_scale=args.speed_scale,
        seed=args.seed,
    )
    write_source(text, args.out, args.overwrite)
    return {"written": str(args.out), "next": f"sart doctor --cell {args.out}"}
