"""Draws `docs/images/concepts/NAME.png`, one for each equation of `docs/concepts.md`.

    python tools/concept_images.py [NAME ...]

What is sampled, allocated and estimated comes from the functions that do so in the toolkit; the
scenes are made up.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from sart_toolkit.augment.allocation import allocate
from sart_toolkit.data.records import ROTATION_PER_METRE, PrecisionSphere
from sart_toolkit.data.sampling import SamplingConfig, sample_pose
from sart_toolkit.evaluate.statistics import wilson_interval
from sart_toolkit.poses import Array, angle_between
from sart_toolkit.report.figures import sphere_colour

_SIZE_INCHES, _DPI = (5.6, 3.0), 130
_INK, _SOFT, _BLUE, _RED, _GREEN, _YELLOW = (
    "#2b2f38", "#8a93a3", "#0072b2", "#d55e00", "#009e73", "#f0c000",
)  # fmt: skip


def _plain(axes: Axes, x: tuple[float, float], y: tuple[float, float]) -> None:
    axes.set_aspect("equal")
    axes.set_xlim(*x)
    axes.set_ylim(*y)
    axes.set_axis_off()


def _turned(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _frame(axes: Axes, at: Array, angle: float, size: float = 0.09, **style: float) -> None:
    for axis, colour in zip(_turned(angle).T, (_RED, _GREEN), strict=True):
        axes.plot(*np.stack([at, at + size * axis]).T, color=colour, lw=2, **style)


def _tool(axes: Axes, at: Array, angle: float, alpha: float = 1.0, colour: str = _INK) -> None:
    """A gripper seen from the side: at angle 0 its fingers point down, to `at`."""
    outline = np.array(
        [[-0.05, 0.0], [-0.05, 0.12], [-0.03, 0.12], [-0.03, 0.2], [0.03, 0.2], [0.03, 0.12],
         [0.05, 0.12], [0.05, 0.0], [0.03, 0.0], [0.03, 0.08], [-0.03, 0.08], [-0.03, 0.0]]
    )  # fmt: skip
    axes.add_patch(
        Polygon(outline @ _turned(angle).T + at, fc=colour, ec="none", alpha=alpha, zorder=4)
    )


def _arrow(axes: Axes, a: Sequence[float], b: Sequence[float], both: bool = True) -> None:
    style = {"arrowstyle": "<->" if both else "->", "color": _INK, "lw": 1.1}
    axes.annotate("", xy=b, xytext=a, arrowprops={**style, "shrinkA": 0, "shrinkB": 0}, zorder=7)


def _say(axes: Axes, x: float, y: float, text: str, colour: str = _INK, **more: str) -> None:
    axes.text(x, y, text, color=colour, fontsize=10, **{"ha": "center", "va": "center", **more})


def _way(n: int = 120) -> Array:
    """A demonstrated path `(n, 2)` over and down."""
    s = np.linspace(0.0, 1.0, n)[:, None]
    start, above, goal = (np.array(p) for p in ([-1.0, 0.45], [0.55, 0.75], [0.5, -0.5]))
    return (1 - s) ** 2 * start + 2 * s * (1 - s) * above + s**2 * goal


def _outside(way: Array, key: int, radius: float) -> int:
    """The first waypoint after `key` outside the sphere about it."""
    return key + int(np.argmax(np.linalg.norm(way[key:] - way[key], axis=1) > radius))


def draw_action(figure: Figure) -> None:
    """The action between two commanded tool poses."""
    axes = figure.add_axes((0, 0, 1, 1))
    _plain(axes, (-1.15, 0.85), (-0.25, 0.82))
    way = _way(40)[4:32:6]
    angles = [0.5, 0.35, 0.1, -0.3, -0.8]
    axes.plot(*_way().T, color=_SOFT, lw=1.2)
    for t, (p, angle) in enumerate(zip(way, angles, strict=True)):
        _frame(axes, p, angle, 0.16)
        _say(axes, p[0], p[1] - 0.09, f"$t{f'+{t - 2}' if t > 2 else (t - 2) or ''}$")
    axes.annotate(
        "", xy=way[3] + [0, 0.24], xytext=way[2] + [0, 0.22],
        arrowprops={"arrowstyle": "->", "color": _BLUE, "lw": 2, "connectionstyle": "arc3,rad=-.3"},
    )  # fmt: skip
    _say(axes, 0.03, 0.71, "action $a_t$", _BLUE)


def draw_sphere(figure: Figure) -> None:
    """A precision sphere and tool poses on it."""
    axes = figure.add_axes((0, 0, 1, 1))
    _plain(axes, (-1.45, 1.2), (-0.5, 0.92))
    way, rng = _way(), np.random.default_rng(1)
    axes.plot(*way.T, color=_INK, lw=1.6)
    key = way[30]
    axes.add_patch(Circle(key, 0.34, fc=_BLUE, alpha=0.14, lw=0))
    axes.add_patch(Circle(key, 0.34, fill=False, ec=_BLUE, lw=1.4))
    for angle in rng.uniform(0, 2 * np.pi, 7):
        at = key + 0.34 * np.array([np.cos(angle), np.sin(angle)])
        _tool(axes, at, rng.uniform(-0.6, 0.6), 0.22, _BLUE)
    _tool(axes, key, 0.0)
    _arrow(axes, key, key + [0.34 * np.cos(-0.7), 0.34 * np.sin(-0.7)], both=False)
    _say(axes, key[0] + 0.2, key[1] - 0.1, "$r_i$")
    _say(axes, key[0] - 0.02, key[1] - 0.07, "$c_i$", ha="right")
    _say(axes, -1.4, 0.36, "demonstration", ha="left")


def draw_radius_by_distance(figure: Figure) -> None:
    """What a moved and turned part takes of a distance."""
    axes = figure.add_axes((0, 0, 1, 1))
    _plain(axes, (-0.42, 1.6), (-0.42, 0.66))
    r, rho, angle = 0.2, 0.52, 0.42
    part = np.array([[-0.06, -0.05], [0.5, -0.05], [0.5, 0.1], [-0.06, 0.1]])
    axes.add_patch(Polygon(part, fc=_INK, alpha=0.85))
    axes.add_patch(Polygon(part @ _turned(angle).T + [r, 0], fc=_BLUE, alpha=0.35))
    axes.add_patch(Circle((0, 0), r, fill=False, ec=_BLUE, lw=1.2, ls="--"))
    axes.plot([0], [0], "o", color="white", mec=_INK, ms=6, zorder=6)
    _say(axes, -0.05, -0.13, "tool")
    far = np.array([0.5, 0.1])
    axes.plot([0, far[0]], [0, far[1]], color=_YELLOW, lw=1.4)
    _say(axes, 0.27, 0.0, r"$\rho$", _YELLOW)
    axes.add_patch(Polygon([[1.4, -0.4], [1.7, -0.4], [1.7, 0.64], [1.4, 0.64]], fc=_RED))
    _say(axes, 1.5, 0.12, "obstacle", "white", rotation="vertical")
    _arrow(axes, (0.5, -0.2), (1.4, -0.2))
    _say(axes, 0.95, -0.26, "$d$")
    for a, b, y, text in (
        (0.5, 0.5 + r, 0.44, "$r$"),
        (0.5 + r, 0.5 + r + 2 * rho * np.sin(angle / 2), 0.44, r"$2\rho\,\sin(\nu_r r/2)$"),
        (0.5 + r + 2 * rho * np.sin(angle / 2), 1.4, 0.44, "margin"),
    ):
        _arrow(axes, (a, y), (b, y))
        _say(axes, (a + b) / 2, y + 0.07 * (1 if text[0] == "$" else -1), text)
    axes.plot([0.5, 0.5], [0.1, 0.47], color=_SOFT, lw=0.8, ls=":")


def draw_radius_by_plane(figure: Figure) -> None:
    """A peg that turns above a surface."""
    axes = figure.add_axes((0, 0, 1, 1))
    _plain(axes, (-0.8, 0.8), (-0.48, 0.36))
    axes.add_patch(Polygon([[-1, -0.5], [1, -0.5], [1, -0.33], [-1, -0.33]], fc=_RED))
    _say(axes, -0.6, -0.41, "obstacle", "white")
    corner = np.array([0.06, -0.18])
    peg = np.array([[-0.06, 0.1], [0.06, 0.1], corner, [-0.06, -0.18]])
    for angle, alpha in ((0.45, 0.2), (-0.45, 0.2), (0.0, 0.9)):
        turned = _turned(angle)
        _tool(axes, np.zeros(2), angle, alpha)
        axes.add_patch(Polygon(peg @ turned.T, fc=_INK if alpha > 0.5 else _BLUE, alpha=alpha))
    arc = np.linspace(-0.45, 0.45, 40)
    swept = np.stack([_turned(a) @ corner for a in arc])
    axes.plot(*swept.T, color=_BLUE, lw=1.6)
    axes.plot([-0.75, 0.75], [-0.33, -0.33], color=_INK, lw=1.0, ls="--")
    axes.plot([0, 0], [0, 0], "o", color="white", mec=_INK, ms=5, zorder=6)
    axes.plot([0, corner[0]], [0, corner[1]], color=_YELLOW, lw=1.5, zorder=6)
    _say(axes, 0.14, -0.06, "$x$", _YELLOW)
    _arrow(axes, (0.5, 0.0), (0.5, -0.33))
    _say(axes, 0.54, -0.16, "$h$", ha="left")
    axes.plot([0, 0.52], [0, 0], color=_SOFT, lw=0.8, ls=":")
    _arrow(axes, (-0.5, 0.0), (-0.5, -0.3), both=False)
    _say(axes, -0.56, -0.15, "$n$")
    _say(axes, 0.0, 0.31, "turning by up to $\\nu_r r$ hardly lowers the tip")


def draw_position(figure: Figure) -> None:
    """Positions on a sphere by both distributions."""
    sphere = PrecisionSphere(0, np.eye(4), 1.0)
    for i, (name, title) in enumerate(
        (("paper", r"paper: $\varphi \sim U[0, \pi]$"),
         ("area", r"area: $\cos\varphi \sim U[-1, 1]$"))
    ):  # fmt: skip
        axes = figure.add_axes((0.5 * i, 0.0, 0.5, 0.88))
        _plain(axes, (-1.25, 1.25), (-1.12, 1.12))
        rng = np.random.default_rng(5)
        points = np.stack(
            [sample_pose(sphere, rng, SamplingConfig(name))[:3, 3] for _ in range(900)]
        )
        near = points[points[:, 1] < 0]
        axes.add_patch(Circle((0, 0), 1, fc=_BLUE, alpha=0.08, ec=_BLUE))
        axes.plot(near[:, 0], near[:, 2], ".", color=_BLUE, ms=3.2)
        axes.set_title(title, fontsize=10, color=_INK)


def draw_rotation(figure: Figure) -> None:
    """Turned tools, and how often each angle is drawn."""
    rng, radius = np.random.default_rng(2), 0.15
    sphere = PrecisionSphere(0, np.eye(4), radius)
    Ts = [sample_pose(sphere, rng, SamplingConfig()) for _ in range(4000)]
    angles = np.rad2deg([angle_between(np.eye(3), T[:3, :3]) for T in Ts])
    axes = figure.add_axes((0.0, 0.0, 0.42, 1.0))
    _plain(axes, (-0.13, 0.13), (-0.06, 0.26))
    for T in Ts[:9]:
        _tool(axes, np.zeros(2), float(np.arctan2(T[0, 2], T[2, 2])), 0.18, _BLUE)
    _tool(axes, np.zeros(2), 0.0)
    axes = figure.add_axes((0.5, 0.2, 0.46, 0.7))
    axes.hist(angles, bins=18, color=_BLUE, alpha=0.75)
    axes.axvline(np.rad2deg(ROTATION_PER_METRE * radius), color=_RED, lw=1.6)
    axes.set_xlabel(r"angle of $\Delta R$ [deg] for $r_i$ = 15 cm", fontsize=9)
    axes.set_yticks([])
    axes.text(
        np.rad2deg(ROTATION_PER_METRE * radius), axes.get_ylim()[1], r" $\nu_r r_i$",
        color=_RED, va="top", ha="right", fontsize=10,
    )  # fmt: skip
    axes.spines[["left", "right", "top"]].set_visible(False)


def draw_convergence(figure: Figure) -> None:
    """The first waypoint outside a sphere."""
    axes = figure.add_axes((0, 0, 1, 1))
    _plain(axes, (-1.45, 1.2), (-0.53, 0.89))
    way = _way(22)
    axes.plot(*way.T, "-", color=_INK, lw=1.2)
    axes.plot(*way.T, "o", color=_INK, ms=3.5)
    key, radius = 6, 0.36
    axes.add_patch(Circle(way[key], radius, fc=_BLUE, alpha=0.14, ec=_BLUE))
    t_star = _outside(way, key, radius)
    axes.plot(*way[key], "o", color=_BLUE, ms=9)
    axes.plot(*way[t_star], "o", color="white", mec=_RED, ms=10, mew=2)
    _say(axes, way[key][0], way[key][1] - 0.11, "$t_i$", _BLUE)
    _say(axes, way[t_star][0] + 0.09, way[t_star][1] + 0.09, "$t^*$", _RED)


def draw_trajectory(figure: Figure) -> None:
    """Segments back to the demonstration, and what follows."""
    axes = figure.add_axes((0, 0, 1, 1))
    _plain(axes, (-1.45, 1.2), (-0.53, 0.89))
    way, key, radius = _way(), 30, 0.36
    t_star = _outside(way, key, radius)
    axes.plot(*way.T, color=_INK, lw=1.2)
    axes.plot(*way[t_star:].T, color=_YELLOW, lw=8, alpha=0.8, zorder=0)
    axes.add_patch(Circle(way[key], radius, fc=_BLUE, alpha=0.12, ec=_BLUE))
    for angle in (1.9, 2.9, 4.0, 4.9):
        at = way[key] + radius * np.array([np.cos(angle), np.sin(angle)])
        axes.annotate(
            "", xy=way[t_star], xytext=at,
            arrowprops={"arrowstyle": "->", "color": _BLUE, "lw": 1.5, "shrinkA": 0},
        )  # fmt: skip
        axes.plot(*at, "o", color=_BLUE, ms=6)
    axes.plot(*way[t_star], "o", color="white", mec=_RED, ms=9, mew=2, zorder=6)
    _say(axes, way[t_star][0] + 0.09, way[t_star][1] + 0.08, "$t^*$", _RED)
    _say(axes, -0.62, 0.03, r"$\tau_{aug}$", _BLUE)
    _say(axes, 0.62, -0.05, "demonstration\nfrom $t^*$ to $T$", ha="left")


def draw_spline(figure: Figure) -> None:
    """Goals of a joint, and the targets that it is sent."""
    axes = figure.add_axes((0.1, 0.2, 0.86, 0.72))
    goals = np.array([0, 0, 0, 0, 1, 2, 3, 4, 4, 2.6, 2.6, 2.6, 2.6], float)
    basis = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
    powers = np.linspace(0, 1, 9)[:, None] ** np.arange(4)
    sent = [(k + powers[:, 1], powers @ basis @ goals[k - 3 : k + 1]) for k in range(3, 13)]
    axes.step(range(13), goals, where="post", color=_SOFT, lw=1.0)
    axes.plot(goals, "o", color=_RED, label="joint goals, 30 Hz")
    axes.plot(
        np.concatenate([t for t, _ in sent]), np.concatenate([q for _, q in sent]), ".-",
        color=_BLUE, ms=4, lw=1, label="targets sent, 240 Hz",
    )  # fmt: skip
    axes.set_xlabel("control periods", fontsize=9)
    axes.set_ylabel("a joint", fontsize=9)
    axes.set_yticks([])
    axes.legend(frameon=False, fontsize=9, loc="upper left")
    axes.spines[["right", "top"]].set_visible(False)


def _gap(s: Array) -> Array:
    return 0.34 + 0.24 * np.cos(2.4 * np.pi * s) + 0.1 * s


def _clear_intervals(a: float, b: float, rate: float, margin: float) -> list[tuple[float, float]]:
    if (_gap(np.array(a)) + _gap(np.array(b)) - rate * (b - a)) / 2 >= margin:
        return [(a, b)]
    middle = (a + b) / 2
    parts = ((a, middle), (middle, b))
    return [found for part in parts for found in _clear_intervals(*part, rate, margin)]


def draw_certificate(figure: Figure) -> None:
    """What the distances at a few places prove of a whole path."""
    axes = figure.add_axes((0.1, 0.2, 0.86, 0.74))
    s, rate, margin = np.linspace(0, 1, 300), 2.1, 0.03
    axes.plot(s, _gap(s), color=_INK, lw=1.6, label="distance of a pair of bodies")
    axes.axhline(margin, color=_RED, lw=1.4, label="margin")
    for i, (a, b) in enumerate(_clear_intervals(0.0, 1.0, rate, margin)):
        x = np.linspace(a, b, 60)
        ends = _gap(np.array([a, b]))
        bound = np.maximum(ends[0] - rate * (x - a), ends[1] - rate * (b - x))
        axes.fill_between(
            x, 0, bound, color=_BLUE, alpha=0.25, lw=0, label=None if i else "proved to be free"
        )
        axes.plot([a, b], ends, "o", color=_BLUE, ms=4)
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 0.86)
    axes.set_xlabel("along the path: dots are the distances that were computed", fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.legend(frameon=False, fontsize=9, loc="upper center", ncol=3)
    axes.spines[["right", "top"]].set_visible(False)


def draw_motion_bound(figure: Figure) -> None:
    """A point's way between two configurations of an arm."""
    axes = figure.add_axes((0, 0, 1, 1))
    _plain(axes, (-0.35, 2.2), (-0.12, 1.27))

    def arm(q: Array) -> Array:
        elbow = np.array([np.cos(q[0]), np.sin(q[0])])
        return np.stack([[0, 0], elbow, elbow + 0.9 * np.array([np.cos(q.sum()), np.sin(q.sum())])])

    a, b = np.array([1.15, -1.1]), np.array([0.45, -0.25])
    for q, alpha in ((a, 0.9), (b, 0.9), ((a + b) / 2, 0.2)):
        axes.plot(*arm(q).T, "o-", color=_INK, lw=5, ms=7, alpha=alpha, solid_capstyle="round")
    tips = np.stack([arm(a + u * (b - a))[-1] for u in np.linspace(0, 1, 60)])
    axes.plot(*tips.T, color=_BLUE, lw=2)
    axes.plot(*tips[[0, -1]].T, color=_RED, lw=1.4, ls="--")
    axes.plot(*tips[[0, -1]].T, "o", color=_RED, ms=7, zorder=6)
    _say(axes, tips[0][0] + 0.06, tips[0][1] + 0.08, "$a$", _RED)
    _say(axes, tips[-1][0] + 0.08, tips[-1][1], "$b$", _RED)
    _say(axes, 1.72, 1.12, "a point's way,\nno longer than $\\mu$", _BLUE)
    _arrow(axes, (0.02, -0.07), (tips[-1][0], -0.07))
    _say(axes, 0.9, -0.02, "$R_j$")


def draw_fingers(figure: Figure) -> None:
    """A finger's corner on its arc, and the hull of some of its places."""
    axes = figure.add_axes((0, 0, 1, 1))
    _plain(axes, (-1.15, 1.15), (0.42, 1.22))
    angles = np.linspace(0.35, np.pi - 0.35, 100)
    arc = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    axes.plot(*arc.T, color=_INK, lw=1.6)
    stops = arc[::33]
    axes.add_patch(Polygon(stops, fc=_BLUE, alpha=0.15, ec=_BLUE, lw=1.6))
    axes.plot(*stops.T, "o", color=_BLUE, ms=7)
    middle = (stops[1] + stops[2]) / 2
    _arrow(axes, middle, middle / np.linalg.norm(middle))
    _say(axes, middle[0] + 0.04, middle[1] - 0.07, r"$\leq A\,h^2/8$")
    _say(axes, 0.0, 1.12, "a corner of a finger while it closes")
    _say(axes, 0.0, 0.6, "the part: the hull of openings $h$ apart", _BLUE)


def draw_allocation(figure: Figure) -> None:
    """Trajectories allocated to spheres of some radii."""
    radii = np.array([0.20, 0.06, 0.025, 0.012, 0.008])
    for i, (title, weights) in enumerate(
        (("root", np.sqrt(radii)), ("radius", radii), ("equal", np.ones(5)))
    ):
        axes = figure.add_axes((0.04 + 0.325 * i, 0.2, 0.29, 0.64))
        given = allocate(39, weights)
        axes.bar(range(5), given, color=[sphere_colour(k) for k in range(5)])
        for k, n in enumerate(given):
            axes.text(k, n + 0.4, str(n), ha="center", fontsize=9, color=_INK)
        axes.set_xticks(range(5), [f"{1e3 * r:g}" for r in radii], fontsize=9)
        axes.set_xlabel("radius of the sphere [mm]", fontsize=9)
        axes.set_title(f"--allocation {title}", fontsize=10, family="monospace", color=_INK)
        axes.set_ylim(0, 31)
        axes.set_yticks([])
        axes.spines[["left", "right", "top"]].set_visible(False)


def draw_interval(figure: Figure) -> None:
    """Wilson's interval over the measured rate."""
    axes = figure.add_axes((0.11, 0.2, 0.86, 0.74))
    for n, colour in ((20, _SOFT), (50, _BLUE), (100, _INK)):
        counts = np.arange(n + 1)
        low, high = np.array([wilson_interval(int(k), n) for k in counts]).T
        axes.plot(100 * counts / n, 100 * low, color=colour, lw=1.6, label=f"{n} rollouts")
        axes.plot(100 * counts / n, 100 * high, color=colour, lw=1.6)
    axes.plot([0, 100], [0, 100], color=_SOFT, lw=0.8, ls=":")
    axes.set_xlabel("measured success rate [%]", fontsize=9)
    axes.set_ylabel("95 % interval [%]", fontsize=9)
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["right", "top"]].set_visible(False)


PICTURES: Mapping[str, Callable[[Figure], None]] = {
    "action": draw_action,
    "sphere": draw_sphere,
    "radius_by_distance": draw_radius_by_distance,
    "radius_by_plane": draw_radius_by_plane,
    "position": draw_position,
    "rotation": draw_rotation,
    "convergence": draw_convergence,
    "trajectory": draw_trajectory,
    "allocation": draw_allocation,
    "spline": draw_spline,
    "certificate": draw_certificate,
    "motion_bound": draw_motion_bound,
    "fingers": draw_fingers,
    "interval": draw_interval,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw all pictures, or those named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="pictures; all if left out")
    default = Path(__file__).parents[1] / "docs" / "images" / "concepts"
    parser.add_argument("--out", type=Path, default=default, help="directory of the pictures")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.names or PICTURES:
        figure = Figure(_SIZE_INCHES, dpi=_DPI, facecolor="white")
        FigureCanvasAgg(figure)
        PICTURES[name](figure)
        figure.savefig(options.out / f"{name}.png")
        print(options.out / f"{name}.png")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
