"""Injects faults into an emulated cell: `python tools/faults.py --n 200 --out faults.json`.

Each time the scripted operator demonstrates peg-in-hole and, at a random moment, something goes
wrong with arm, gripper or camera. Says how soon after that the arm was sent its last target and how
soon it rested, whether a recorded step was lost, and whether the same recording can be begun again
on the cell that a person has seen to. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit import doctor
from sart_toolkit.data.records import Demonstration, library_versions
from sart_toolkit.data.storage import write_json
from sart_toolkit.errors import RobotStopped
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import (
    SessionConfig,
    SessionState,
    TeleopSession,
    record_demonstration,
)
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement
from sart_toolkit.testing.emulated import FAULTS, EmulatedBackend

# When faults happen [s] after the recording began; it takes more than four.
_EARLIEST, _LATEST = 0.2, 3.5
# For so many control periods a recording is begun again.
_AGAIN = 15
# How long [s] the arm is watched after it was stopped, at rest below this [rad/s].
_WATCHED, _REST = 1.0, 1e-6
_NO_IMAGES = SessionConfig(cameras=())


def one_fault(kind: str, moment: float, seed: int) -> dict[str, Any]:
    """What came of a fault of a kind, so long [s] after the recording began."""
    task = get_task("peg_in_hole")
    robot = get_robot(task.robot)
    model = RobotModel(robot, task.scene.held)
    state = task.initial_state(model, Placement())
    cell = type("Cell", (EmulatedBackend,), {"start": state})

    def operator() -> ScriptedOperator:
        return ScriptedOperator(task.plan(state), np.random.default_rng(seed))

    backend, kept = cell(robot, task.scene, 32), list[Demonstration]()
    world = backend.world
    fault = world.time + moment
    world.inject(kind, fault)
    try:
        record_demonstration(backend, task, model, operator(), config=_NO_IMAGES, keep=kept.append)
        said = ""
    except RobotStopped as error:
        said = str(error)
    last = world.sent[-1][0]
    rest = np.inf
    for _ in range(round(_WATCHED * world.emulation.rate_hz)):
        before = world.q.copy()
        world.advance(1 / world.emulation.rate_hz)
        if np.abs(world.q - before).max() > _REST:
            rest = np.inf
        elif not np.isfinite(rest):
            rest = world.time
    period = 1 / backend.rates.control_hz
    control = backend.cell.control
    unseen = control.silence if kind == "arm_frozen" else 0.0
    whole = int((fault - 1e-9) * backend.rates.record_hz)
    backend.close()
    again = cell(robot, task.scene, 32)
    session, hand = TeleopSession(again, task, model, config=_NO_IMAGES), operator()
    session.start()
    for _ in range(_AGAIN):
        if session.state is SessionState.RECORDING:
            session.advance(hand.read(session.observation))
    resumed = session.state is SessionState.RECORDING
    again.close()
    return {
        "kind": kind,
        "seconds": round(moment, 4),
        "stopped": bool(said),
        "last_target_ms": round(1e3 * (last - fault), 2),
        "within_a_period": bool(said) and last - fault <= period + unseen,
        "rest_ms": round(1e3 * (rest - fault), 1),
        "steps_kept": len(kept[0]) if kept else 0,
        # A step ends up to what is sent ahead, and a period, later than it was commanded.
        "steps_lost": max(0, whole - len(kept[0])) if kept else whole,
        "resumed": resumed,
    }


def main(words: Sequence[str] | None = None) -> int:
    """Inject faults and print what came of them; 1 if one of them was not dealt with."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--n", type=int, default=200, help="how many faults")
    parser.add_argument("--seed", type=int, default=0, help="of moments and hands")
    parser.add_argument("--out", type=Path, help="JSON file to write as well")
    options = parser.parse_args(words)
    rng = np.random.default_rng(options.seed)
    rows = []
    for i in range(options.n):
        kind, moment = FAULTS[i % len(FAULTS)], float(rng.uniform(_EARLIEST, _LATEST))
        rows.append(one_fault(kind, moment, i))
        print(f"{i + 1}/{options.n} {json.dumps(rows[-1])}", file=sys.stderr, flush=True)
    result = {
        "n": len(rows),
        "seed": options.seed,
        **{
            name: sum(bool(row[name]) for row in rows)
            for name in ("stopped", "within_a_period", "resumed")
        },
        "steps_lost": sum(row["steps_lost"] for row in rows),
        "latest_target_ms": {
            kind: max(row["last_target_ms"] for row in rows if row["kind"] == kind)
            for kind in dict.fromkeys(row["kind"] for row in rows)
        },
        "latest_rest_ms": max(row["rest_ms"] for row in rows),
        "faults": rows,
        "machine": doctor.machine(),
        "versions": library_versions(),
    }
    if options.out is not None:
        write_json(options.out, result)
    print(json.dumps({name: value for name, value in result.items() if name != "faults"}))
    good = all(row["within_a_period"] and row["resumed"] and not row["steps_lost"] for row in rows)
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
