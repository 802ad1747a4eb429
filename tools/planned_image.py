"""Draws `docs/images/planned.png`: straight and planned segments where a wall stands in a ball.

`python tools/planned_image.py [--out PNG]` prints one JSON object. The same poses are drawn by
both strategies, in peg-in-hole's scene with a wall; each way that is drawn in full is certified.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.metadata
import json
import statistics
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.planner import SegmentPlanner
from sart_toolkit.backends import get_backend, make_backend
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.data.records import Annotation, Demonstration, PrecisionSphere
from sart_toolkit.data.sampling import SamplingConfig
from sart_toolkit.errors import MotionRejected, SartError, Unreachable
from sart_toolkit.poses import Array, pose
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import SessionConfig, record_demonstration
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import CameraSpec, Shape, look_at
from sart_toolkit.scenes.spec import Body
from sart_toolkit.tasks.peg_in_hole import PegInHole
from sart_toolkit.tasks.task import Placement

_DRAWS = 60
_RADIUS = 0.18
_HIGHER = 0.125
_SIZE, _SUPERSAMPLED = 900, 2
_POINTS = 120
_REJECTED, _PLANNED, _STRAIGHT, _POSE = "#d62728", "#0057b8", "#007a5a", "#444444"
_WALL = (0.78, 0.40, 0.32, 1.0)
_CAMERA = CameraSpec(
    "stage",
    "world",
    look_at(np.array([1.25, 0.10, 0.80]), np.array([0.50, 0.02, 0.285]), np.array([0, 0, 1.0])),
    fov_y_deg=32.0,
    near=0.05,
    far=6.0,
)


class WalledPegInHole(PegInHole):
    """Peg-in-hole from higher up, beside a wall.

    Goal, randomisation and success test are peg-in-hole's. The wall is 24 cm long, 2 cm thick and
    36 cm high, 9 cm beside the hole's axis.
    """

    name = "walled_peg_in_hole"
    scene = dataclasses.replace(
        PegInHole.scene,
        bodies=(
            *PegInHole.scene.bodies,
            Body(
                "wall",
                (Shape("box", (0.24, 0.02, 0.36), rgba=_WALL),),
                pose([0.5, 0.09, 0.18]),
            ),
        ),
        cameras=(_CAMERA,),
    )

    @staticmethod
    def _start() -> Array:
        T = PegInHole._start()
        T[2, 3] += _HIGHER
        return T


class _Draw(NamedTuple):
    """What became of one sampled pose: the tool's way there `(n, 3)` [m], or why there is none."""

    p_sampled: Array
    way: Array | None
    reason: str
    straight: bool
    seconds: float


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of drawing the image."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/images/planned.png"), help="PNG")
    parser.add_argument("--draws", type=int, default=_DRAWS, help="sampled poses")
    options = parser.parse_args(arguments)
    try:
        figures = _draw_image(options.out, options.draws)
    except SartError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(json.dumps(figures))
    return 0


def _draw_image(out: Path, draws: int) -> dict[str, Any]:
    task = WalledPegInHole()
    robot = get_robot(task.robot)
    backend = make_backend("pybullet", robot, task.scene)
    model = RobotModel(robot, task.scene.held)
    operator = ScriptedOperator(
        task.plan(task.initial_state(model, Placement())), np.random.default_rng(0)
    )
    demonstration = record_demonstration(
        backend, task, model, operator, seed=0, config=SessionConfig(cameras=())
    )
    T_key = demonstration.steps.measured_Ts_world_tool[0]
    annotation = Annotation((PrecisionSphere(0, T_key, _RADIUS),), demonstration.content_hash())
    world = ExactWorld(demonstration, robot, task.scene)
    planners = {
        name: SegmentPlanner(
            world,
            annotation,
            AugmentConfig(strategy=name, sampling=SamplingConfig("area"), cameras=()),
        )
        for name in ("sart", "sart_planned")
    }
    outcomes = {
        name: [_outcome(planner, k) for k in range(draws)] for name, planner in planners.items()
    }
    t_star = planners["sart"].proposal(0, 0)[0].t_star
    backend.restore(demonstration.states[t_star])
    view = backend.observe(("stage",), _SIZE * _SUPERSAMPLED).cameras["stage"]
    backend.close()
    rgb = np.asarray(Image.fromarray(view.rgb).resize((_SIZE, _SIZE), Image.Resampling.LANCZOS))
    depth = np.asarray(view.depth[::_SUPERSAMPLED, ::_SUPERSAMPLED], float)
    out.parent.mkdir(parents=True, exist_ok=True)
    _compose(rgb, depth, demonstration, t_star, outcomes).savefig(out, dpi=100)
    Image.open(out).convert("P", palette=Image.Palette.ADAPTIVE, colors=256).save(
        out, optimize=True
    )
    seconds = [d.seconds for d in outcomes["sart_planned"] if d.way is not None and not d.straight]
    return {
        "draws": draws,
        "kept": {name: sum(d.way is not None for d in each) for name, each in outcomes.items()},
        "planned": len(seconds),
        "planning_seconds": {
            "median": round(statistics.median(seconds or [0.0]), 3),
            "max": round(max(seconds, default=0.0), 3),
        },
        "rejected": {
            name: dict(Counter(d.reason for d in each if d.way is None).most_common())
            for name, each in outcomes.items()
        },
        "versions": {
            name: importlib.metadata.version(name)
            for name in ("sart_toolkit", "ompl", "coal", "pin", "pybullet")
        },
        "image": str(out),
    }


def _outcome(planner: SegmentPlanner, k: int) -> _Draw:
    proposal, rng = planner.proposal(0, k)
    p_sampled = proposal.T_world_sampled[:3, 3]
    started = time.perf_counter()
    try:
        motion, certificate = planner.plan(proposal, rng, get_backend("pybullet").tracking_error)
    except Unreachable:
        return _Draw(p_sampled, None, "out of reach", False, time.perf_counter() - started)
    except MotionRejected as error:
        reason = str(error).partition(":")[0]
        return _Draw(p_sampled, None, reason, False, time.perf_counter() - started)
    seconds = time.perf_counter() - started
    certificate.check_free()
    fk = planner.world.kinematics.fk
    way = np.array([fk(q)[:3, 3] for q in motion.path.positions(np.linspace(0, 1, _POINTS))])
    line = way[0] + np.linspace(0, 1, _POINTS)[:, None] * (way[-1] - way[0])
    straight = bool(np.linalg.norm(way - line, axis=1).max() < 1e-3)
    return _Draw(p_sampled, way, "", straight, seconds)


def _pixels(points: Array) -> tuple[Array, Array]:
    """Pixels `(n, 2)` and depths `(n,)` [m] of points `(n, 3)` in the world."""
    T = _CAMERA.T_frame_camera
    local = (points - T[:3, 3]) @ T[:3, :3]
    pixels = local @ _CAMERA.intrinsics(_SIZE, _SIZE).T
    return pixels[:, :2] / pixels[:, 2:], local[:, 2]


def _sphere_outline(centre: Array, radius: float) -> Array:
    """The circle `(n, 3)` on which a sphere's outline lies, as the camera sees it."""
    away = _CAMERA.T_frame_camera[:3, 3] - centre
    d = float(np.linalg.norm(away))
    n = away / d
    u = np.cross(n, [0, 0, 1.0])
    u /= np.linalg.norm(u)
    angle = np.linspace(0, 2 * np.pi, 181)[:, None]
    around = np.cos(angle) * u + np.sin(angle) * np.cross(n, u)
    return centre + n * radius**2 / d + radius * np.sqrt(1 - (radius / d) ** 2) * around


def _draw_line(axes: Any, line: Array) -> None:
    pixels, _ = _pixels(line)
    axes.plot(*pixels.T, color=_REJECTED, lw=1.6, ls=(0, (4, 2.5)), alpha=0.85)


def _draw_way(axes: Any, draw: _Draw, depth: Array) -> None:
    """A kept way as seen: faint where something stands before it."""
    assert draw.way is not None
    pixels, far = _pixels(draw.way)
    at = np.clip(pixels.round().astype(int), 0, _SIZE - 1)
    hidden = depth[at[:, 1], at[:, 0]] < far - 0.004
    pieces = np.stack([pixels[:-1], pixels[1:]], 1)
    covered = hidden[:-1] & hidden[1:]
    colour, width = (_STRAIGHT, 1.2) if draw.straight else (_PLANNED, 2.4)
    if not draw.straight:
        axes.add_collection(LineCollection(pieces[~covered], colors="white", lw=width + 1.8))
    for which, alpha in ((covered, 0.28), (~covered, 0.95)):
        axes.add_collection(LineCollection(pieces[which], colors=colour, alpha=alpha, lw=width))
    axes.plot(*pixels[-1], "o", color=colour, ms=6.5, mec="white", mew=0.8)


def _compose(
    rgb: Array,
    depth: Array,
    demonstration: Demonstration,
    t_star: int,
    outcomes: dict[str, list[_Draw]],
) -> Figure:
    figure = Figure(figsize=(2 * _SIZE / 100 + 0.3, _SIZE / 100 + 1.75), facecolor="white")
    FigureCanvasAgg(figure)
    Ts = demonstration.steps.measured_Ts_world_tool
    p_key, p_star = Ts[0, :3, 3], Ts[t_star, :3, 3]
    draws = len(outcomes["sart"])
    width, height = figure.get_size_inches()
    share = _SIZE / 100 / height
    for i, (name, each) in enumerate(outcomes.items()):
        axes: Any = figure.add_axes((
            (0.1 + i * (_SIZE / 100 + 0.1)) / width, 0.95 / height, _SIZE / 100 / width, share,
        ))  # fmt: skip
        axes.imshow(rgb, interpolation="none")
        axes.set_xlim(-0.5, _SIZE - 0.5)
        axes.set_ylim(_SIZE - 0.5, -0.5)
        axes.set_axis_off()
        outline, _ = _pixels(_sphere_outline(p_key, _RADIUS))
        axes.plot(*outline.T, color="white", lw=3.2, alpha=0.8)
        axes.plot(*outline.T, color="black", lw=1.3)
        for draw in each:
            if draw.way is None:
                if name == "sart":
                    _draw_line(axes, np.array([p_star, draw.p_sampled]))
                (at,), _ = _pixels(draw.p_sampled[None])
                axes.plot(*at, "x", color=_REJECTED, ms=8, mew=2.2)
        for draw in sorted(each, key=lambda d: not d.straight):
            if draw.way is not None:
                _draw_way(axes, draw, depth)
        (at,), _ = _pixels(p_star[None])
        axes.plot(*at, "*", color="#ffd21f", mec="black", mew=1.2, ms=24, zorder=9)
        (at,), _ = _pixels(np.array([[0.62, 0.10, 0.12]]))
        axes.text(*at, "wall", fontsize=17, color="white", rotation=90, ha="center", va="center")
        kept = sum(draw.way is not None for draw in each)
        collide = sum(draw.reason.startswith("sampled pose too close") for draw in each)
        title = {
            "sart": "only straight lines, or none",
            "sart_planned": f"bent where need be; {collide} poses themselves collide",
        }[name]
        axes.set_title(
            f"{name}: {kept} of {draws} sampled poses kept\n{title}", fontsize=18, pad=10
        )
    rows = [
        Line2D([], [], ls="", marker="*", ms=20, color="#ffd21f", mec="black", label="start, t*"),
        Line2D([], [], color="black", lw=1.5, label=f"sphere, r = {_RADIUS * 100:.0f} cm"),
        Line2D([], [], color=_STRAIGHT, lw=2, marker="o", label="straight, certified"),
        Line2D([], [], color=_PLANNED, lw=3, marker="o", label="planned, certified"),
        Line2D(
            [],
            [],
            color=_REJECTED,
            lw=2,
            ls="--",
            marker="x",
            mew=2,
            label="line rejected: collides",
        ),
        Line2D(
            [], [], color=_REJECTED, ls="", marker="x", mew=2, ms=9, label="pose rejected: collides"
        ),
    ]
    figure.legend(handles=rows, loc="lower center", ncols=6, fontsize=16, frameon=False,
                  bbox_to_anchor=(0.5, 0.0))  # fmt: skip
    return figure


if __name__ == "__main__":
    sys.exit(main())
