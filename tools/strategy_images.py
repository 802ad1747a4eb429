"""Draws `docs/images/strategies/NAME.png` for each strategy: `python tools/strategy_images.py`.

Each image shows a demonstration made up for it, the spheres that the strategy draws from, and what
it draws: poses, straight ways back to where it rejoins, and what follows. Rotations are five times
as large as by default, to be seen. Nothing is proved or executed.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from sart_toolkit.augment import STRATEGIES, get_strategy
from sart_toolkit.augment.allocation import allocate
from sart_toolkit.augment.strategies import Strategy
from sart_toolkit.data.records import (
    ROTATION_PER_METRE,
    Annotation,
    Demonstration,
    PrecisionSphere,
    Steps,
)
from sart_toolkit.data.sampling import SamplingConfig
from sart_toolkit.poses import Array, pose

_SIZE_INCHES, _DPI = (3.0, 3.0), 130
_N, _DRAWN = 46, 24
_SAMPLING = SamplingConfig("area", 5 * ROTATION_PER_METRE)
_TICK = 0.018
# Key waypoint and radius [m]; a planner may bend round obstacles in the first.
_SPHERES = ((0, 0.075), (19, 0.045), (31, 0.022))
_PATH, _COLOURS = "#3b3b3b", ("#0072b2", "#d55e00", "#009e73")


def demonstrated(goal_x: float = 0.0) -> Demonstration:
    """A way over and down to a goal, in the plane of x and z."""
    s = np.linspace(0.0, 1.0, _N)[:, None]
    start, above, goal = (np.array(p) for p in ([-0.2, 0.16], [goal_x, 0.24], [goal_x, 0.0]))
    way = (1 - s) ** 2 * start + 2 * s * (1 - s) * above + s**2 * goal
    Ts = np.stack([pose([x, 0.0, z]) for x, z in way])
    joints, zeros = np.zeros((_N, 6)), np.zeros(_N)
    steps = Steps(joints, joints, joints, Ts, Ts, zeros, zeros, zeros, {})
    return Demonstration(
        task="drawing", task_parameters={}, robot="none", backend="none", steps=steps,
        timestamps=np.arange(_N) / 10, body_Ts_world={}, success=np.zeros(_N, bool),
        touching=((),) * _N, raw_commands=np.zeros((0, 7)), states=(), operator="nobody",
        device="none", seconds=0.0,
    )  # fmt: skip


def annotated(demonstration: Demonstration) -> Annotation:
    """The demonstration with three spheres."""
    Ts = demonstration.steps.measured_Ts_world_tool
    spheres = tuple(
        PrecisionSphere(t, Ts[t], radius, "ball" if i else "free_space")
        for i, (t, radius) in enumerate(_SPHERES)
    )
    return Annotation(spheres, demonstration.content_hash())


def draw_strategy(name: str, out: Path) -> None:
    """Write the image of the strategy of a name to the PNG `out`."""
    strategy, demonstration = get_strategy(name), demonstrated()
    figure = Figure(_SIZE_INCHES, dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    if strategy.draws:
        _draw_segments(axes, strategy, demonstration)
        _draw_path(axes, demonstration, _PATH, "-", 1.4)
    else:
        for x in np.linspace(-0.09, 0.07, 9) if strategy.n > 1 else (0.0,):
            _draw_path(axes, demonstrated(float(x)), _COLOURS[0], "-", 2.0)
    axes.set_aspect("equal")
    axes.set_xlim(-0.29, 0.11)
    axes.set_ylim(-0.11, 0.29)
    axes.plot([0.04, 0.09], [-0.095, -0.095], color=_PATH, lw=2, solid_capstyle="butt")
    axes.text(0.065, -0.09, "5 cm", ha="center", va="bottom", fontsize=8, color=_PATH)
    axes.set_axis_off()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)


def _seen(points: Array) -> Array:
    return points[..., [0, 2]]


def _draw_path(axes: Axes, demonstration: Demonstration, colour: str, ls: str, lw: float) -> None:
    path = _seen(demonstration.steps.commanded_Ts_world_tool[:, :3, 3])
    axes.plot(*path.T, color=colour, ls=ls, lw=lw, zorder=3)
    axes.plot(*path[0], "o", color=_PATH, ms=6, zorder=5)
    axes.plot(*path[-1], "s", color=_PATH, ms=6, zorder=5)


def _draw_segments(axes: Axes, strategy: Strategy, demonstration: Demonstration) -> None:
    spheres = strategy.spheres(demonstration, annotated(demonstration))
    own = len(spheres) != len(_SPHERES)
    rng = np.random.default_rng(3)
    commanded = demonstration.steps.commanded_Ts_world_tool
    shares = allocate(_DRAWN, strategy.weights(spheres, "equal"))
    first = len(commanded)
    for i, (sphere, share) in enumerate(zip(spheres, shares, strict=True)):
        colour = _COLOURS[0] if own else _COLOURS[i]
        if share:
            centre = _seen(sphere.T_world_key[:3, 3])
            alpha, lw = (0.03, 0.4) if own else (0.12, 0.8)
            axes.add_patch(Circle(centre, sphere.radius, fc=colour, alpha=alpha, lw=0, zorder=1))
            axes.add_patch(Circle(centre, sphere.radius, fill=False, ec=colour, lw=lw, zorder=2))
        for _ in range(share):
            proposal = strategy.propose(demonstration, spheres, i, rng, _SAMPLING)
            T, join = proposal.T_world_sampled, commanded[proposal.t_star]
            ends = _seen(np.stack([T[:3, 3], join[:3, 3]]))
            axes.add_collection(LineCollection([ends], colors=colour, lw=0.9, zorder=4))
            # Which way the tool points there: down, but for its rotation.
            tick = _seen(np.stack([T[:3, 3], T[:3, 3] - _TICK * T[:3, 2]]))
            axes.plot(*tick.T, color=colour, lw=1.8, zorder=4)
            axes.plot(*ends[1], "o", color="white", mec=colour, ms=4.5, mew=1.2, zorder=6)
            if proposal.merged:
                first = min(first, proposal.t_star)
    follows = _seen(commanded[first:, :3, 3])
    axes.plot(*follows.T, color="#f0c000", lw=7, alpha=0.8, zorder=0)


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw all strategies, or those named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="strategies; all if left out")
    default = Path(__file__).parents[1] / "docs" / "images" / "strategies"
    parser.add_argument("--out", type=Path, default=default, help="directory of the images")
    options = parser.parse_args(arguments)
    for name in options.names or STRATEGIES:
        draw_strategy(name, options.out / f"{name}.png")
        print(options.out / f"{name}.png")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
