"""Images of a run, each as the bytes of one PNG: film strip, spheres and paths, curves.

They are drawn on matplotlib's Agg canvas, without pyplot, in a light or a dark theme.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, get_args

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from mpl_toolkits.mplot3d.art3d import Line3DCollection  # type: ignore[import-untyped]
from PIL import Image as PillowImage
from PIL import ImageDraw

from sart_toolkit.data.records import Annotation, Demonstration, Episode, Image, PrecisionSphere
from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.poses import Array, check_array, frozen
from sart_toolkit.report.video import OUTCOME_COLOURS, Outcome, font

Theme = Literal["light", "dark"]
Paths = Literal["measured", "commanded"]

# Okabe and Ito's palette, less black and yellow: distinct for colour-blind viewers.
SPHERE_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
_INK = {"light": "#1f2430", "dark": "#e7eaf0"}
_FAINT = {"light": "#c9ced8", "dark": "#49505e"}
_PAPER = {"light": "#ffffff", "dark": "#1b1f27"}
_OUTCOMES: dict[Theme, dict[Outcome, str]] = {
    "light": OUTCOME_COLOURS,
    "dark": {"success": "#3ecf9f", "failure": "#ff9a57"},
}
_ACCENT = {"light": "#0063b1", "dark": "#6cb6ff"}


def sphere_colour(index: int) -> str:
    """The colour, as `#rrggbb`, of a sphere in every image and table."""
    return SPHERE_COLOURS[index % len(SPHERE_COLOURS)]


# --- film strip ---------------------------------------------------------------------------------


def film_strip(
    demonstration: Demonstration, camera: str = "wrist", n: int = 8, size: int = 240
) -> bytes:
    """PNG bytes of n camera images side by side, evenly over the demonstration, with their times.

    Args:
        demonstration: where the images come from; its first and last step are always among them.
        camera: whose images.
        n: how many, at least 2; at most one a step is drawn.
        size: height of each image [pixel].

    Raises:
        UnknownName: the demonstration has no such camera.
        InvalidInput: n < 2, or size < 32.
    """
    cameras = demonstration.steps.cameras
    if camera not in cameras:
        raise unknown_name("camera", camera, cameras)
    if n < 2:
        raise InvalidInput(f"n: expected at least 2 images, got {n}")
    if size < 32:
        raise InvalidInput(f"size: expected at least 32 pixels, got {size}")
    rgb = cameras[camera].rgb
    chosen = np.linspace(0, len(rgb) - 1, min(n, len(rgb))).round().astype(int)
    width, gap, footer = round(size * rgb.shape[2] / rgb.shape[1]), size // 30, size // 6
    strip = PillowImage.new(
        "RGB", (gap + len(chosen) * (width + gap), size + footer + gap), "#15181d"
    )
    draw, text = ImageDraw.Draw(strip), font(max(9, round(0.6 * footer)))
    start = demonstration.timestamps[0]
    for i, t in enumerate(chosen):
        image = PillowImage.fromarray(rgb[t])
        left = gap + i * (width + gap)
        strip.paste(image.resize((width, size), PillowImage.Resampling.LANCZOS), (left, gap))
        label = f"{demonstration.timestamps[t] - start:.1f} s"
        at = (left + width / 2, gap + size + footer / 2)
        draw.text(at, label, fill="#f2f4f7", font=text, anchor="mm")
    stream = io.BytesIO()
    strip.save(stream, "png", optimize=True)
    return stream.getvalue()


def montage(images: Sequence[Image], captions: Sequence[str], columns: int = 3) -> bytes:
    """PNG bytes of images in rows, each with a caption below it.

    Args:
        images: uint8 `(H, W, 3)` each, at least one; each is shown as wide as the first.
        captions: for each image, cut where there is no room.
        columns: how many images beside each other.

    Raises:
        InvalidInput: there are no images, or not as many captions.
    """
    if not images or len(images) != len(captions):
        raise InvalidInput(
            f"images: expected at least one and a caption for each, got {len(images)} images and "
            f"{len(captions)} captions"
        )
    width = images[0].shape[1]
    size = (width, max(round(image.shape[0] * width / image.shape[1]) for image in images))
    columns, gap, footer = min(columns, len(images)), 6, 20
    rows = -(-len(images) // columns)
    sheet = PillowImage.new(
        "RGB", (gap + columns * (width + gap), gap + rows * (size[1] + footer + gap)), "#15181d"
    )
    draw, text = ImageDraw.Draw(sheet), font(12)
    for i, (image, words) in enumerate(zip(images, captions, strict=True)):
        left = gap + i % columns * (width + gap)
        top = gap + i // columns * (size[1] + footer + gap)
        pillow = PillowImage.fromarray(np.ascontiguousarray(image))
        scaled = pillow.resize((width, round(image.shape[0] * width / image.shape[1])))
        sheet.paste(scaled, (left, top))
        while text.getlength(words) > width:
            words = words[:-2].rstrip(" ,…") + "…"
        draw.text((left, top + size[1] + footer / 2), words, fill="#f2f4f7", font=text, anchor="lm")
    stream = io.BytesIO()
    sheet.save(stream, "png", optimize=True)
    return stream.getvalue()


# --- spheres and paths --------------------------------------------------------------------------


@dataclass(frozen=True)
class SegmentPath:
    """The tool's way along one augmented segment of a sphere.

    `positions (n, 3)` [m] in the world frame, the sampled one first.
    """

    sphere: int
    positions: Array

    def __post_init__(self) -> None:
        positions = check_array("positions", self.positions, (None, 3))
        object.__setattr__(self, "positions", frozen(positions))


def segment_paths(episodes: Iterable[Episode], which: Paths = "measured") -> list[SegmentPath]:
    """The tool path of each episode's augmented segment, as measured or as commanded.

    Raises:
        InvalidInput: `which` is neither.
    """
    if which not in get_args(Paths):
        raise InvalidInput(f"which: expected 'measured' or 'commanded', got {which!r}")
    paths = []
    for episode in episodes:
        steps = episode.steps
        Ts = steps.measured_Ts_world_tool if which == "measured" else steps.commanded_Ts_world_tool
        paths.append(SegmentPath(episode.provenance.sphere, Ts[:, :3, 3]))
    return paths


def scene_image(
    demonstration: Demonstration,
    annotation: Annotation | None = None,
    paths: Sequence[SegmentPath] = (),
    theme: Theme = "light",
) -> bytes:
    """PNG bytes of two parallel views of the tool's demonstrated path, its spheres and segments.

    Args:
        demonstration: its measured tool path is drawn, with its start and end.
        annotation: whose precision spheres are drawn, if any.
        paths: augmented segments, drawn in the colour of their sphere.
        theme: `light` or `dark`.

    Raises:
        InvalidInput: a path names a sphere that the annotation lacks, or theme is unknown.
    """
    spheres = annotation.spheres if annotation is not None else ()
    for path in paths:
        if not 0 <= path.sphere < len(spheres):
            raise InvalidInput(
                f"paths: one belongs to sphere {path.sphere}, the annotation has {len(spheres)};"
                " pass the annotation that the segments were made from"
            )
    demonstrated = demonstration.steps.measured_Ts_world_tool[:, :3, 3]
    views = _choose_views(demonstrated, spheres, paths)
    with _figure((11.0, 5.6), theme) as figure:
        for column, view in enumerate(views):
            axes: Any = figure.add_axes((0.5 * column, 0.0, 0.5, 1.0), projection="3d")
            _frame_box(axes, view, theme)
            toward = _view_direction(view.elevation_deg, view.azimuth_deg)
            for i in view.spheres:
                _draw_sphere(axes, spheres[i].T_world_key[:3, 3], spheres[i].radius, i, toward)
                _draw_paths(axes, [p.positions for p in paths if p.sphere == i], i)
            _draw_demonstration(axes, demonstrated, theme)
        _finish_views(figure, views, _legend_rows(spheres, paths, theme))
        return _png(figure, tight=True)


@dataclass(frozen=True)
class _View:
    """A parallel view of the box `middle` +- `half` [m], with the spheres to draw in it."""

    title: str
    elevation_deg: float
    azimuth_deg: float
    middle: Array
    half: Array
    spheres: Sequence[int]


def _choose_views(
    demonstrated: Array, spheres: Sequence[PrecisionSphere], paths: Sequence[SegmentPath]
) -> tuple[_View, _View]:
    """The whole from the side, and either the spheres too small to see there or the whole again."""
    everyone = range(len(spheres))
    whole = _box(demonstrated, spheres, [path.positions for path in paths])
    side = _View("from the side", 16.0, -60.0, *whole, everyone)
    small = [i for i in everyone if spheres[i].radius < 0.1 * float(whole[1].max())]
    if small:
        number = "sphere" if len(small) == 1 else "spheres"
        title = f"close-up of {number} {', '.join(map(str, small))}"
        box = _box(np.empty((0, 3)), [spheres[i] for i in small], [])
        return side, _View(title, 16.0, -60.0, *box, small)
    return side, _View("from above", 48.0, 30.0, *whole, everyone)


def _box(
    demonstrated: Array, spheres: Sequence[PrecisionSphere], paths: Sequence[Array]
) -> tuple[Array, Array]:
    centres = np.array([s.T_world_key[:3, 3] for s in spheres]).reshape(-1, 3)
    radii = np.array([s.radius for s in spheres]).reshape(-1, 1)
    everything = np.concatenate([demonstrated, centres - radii, centres + radii, *paths])
    low, high = everything.min(axis=0), everything.max(axis=0)
    # A flat box can't be drawn: give each side at least a tenth of the longest.
    least = max(0.1 * float((high - low).max()), 1e-3)
    return (low + high) / 2, np.maximum(high - low, least) / 2 * 1.04


def _view_direction(elevation_deg: float, azimuth_deg: float) -> Array:
    e, a = np.radians([elevation_deg, azimuth_deg])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def _frame_box(axes: Any, view: _View, theme: Theme) -> None:
    middle, half = view.middle, view.half
    axes.set_proj_type("ortho")
    axes.view_init(elev=view.elevation_deg, azim=view.azimuth_deg)
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
    axes.set_zlim(middle[2] - half[2], middle[2] + half[2])
    axes.set_box_aspect(tuple(half / half.max()), zoom=1.0)
    for name, axis, length in zip("xyz", (axes.xaxis, axes.yaxis, axes.zaxis), half, strict=True):
        # Fewer ticks on a short side, or their labels run into each other.
        axis.set_major_locator(MaxNLocator(max(2, round(5 * length / half.max()))))
        axis.set_pane_color(matplotlib.colors.to_rgba(_FAINT[theme], 0.12))
        axis.label.set_text(f"{name} [m]")
    axes.tick_params(labelsize=8, pad=1)
    axes.tick_params(axis="z", pad=5)


def _draw_sphere(axes: Any, centre: Array, radius: float, index: int, toward: Array) -> None:
    longitude, latitude = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, np.pi, 13))
    axes.plot_surface(
        centre[0] + radius * np.sin(latitude) * np.cos(longitude),
        centre[1] + radius * np.sin(latitude) * np.sin(longitude),
        centre[2] + radius * np.cos(latitude),
        color=sphere_colour(index),
        alpha=0.1,
        linewidth=0,
        shade=False,
    )
    # In a parallel view a sphere's outline is the circle in the plane that faces the viewer.
    across = np.cross(toward, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    up = np.cross(across, toward)
    turn = np.linspace(0, 2 * np.pi, 73)[:, None]
    outline = centre + radius * (np.cos(turn) * across + np.sin(turn) * up)
    axes.plot(*outline.T, color=sphere_colour(index), linewidth=1.3, alpha=0.8)


def _draw_paths(axes: Any, segments: list[Array], index: int) -> None:
    if not segments:
        return
    colour = sphere_colour(index)
    alpha = float(np.clip(8.0 / len(segments), 0.15, 0.75))
    axes.add_collection3d(
        Line3DCollection(segments, colors=colour, linewidths=0.9, alpha=alpha), autolim=False
    )
    starts = np.array([segment[0] for segment in segments])
    axes.plot(*starts.T, "o", color=colour, markersize=3, markeredgewidth=0)


def _draw_demonstration(axes: Any, demonstrated: Array, theme: Theme) -> None:
    ink = _INK[theme]
    ends = {"color": ink, "mec": ink, "mew": 1.8, "zorder": 11, "axlim_clip": True}
    axes.plot(*demonstrated.T, color=ink, linewidth=2.2, zorder=10, axlim_clip=True)
    axes.plot(*demonstrated[:1].T, "o", markersize=8, **{**ends, "color": _PAPER[theme]})
    axes.plot(*demonstrated[-1:].T, "s", markersize=6, **ends)


def _legend_rows(
    spheres: Sequence[PrecisionSphere], paths: Sequence[SegmentPath], theme: Theme
) -> list[list[Line2D]]:
    ink, paper = _INK[theme], _PAPER[theme]
    shown = [
        Line2D([], [], color=ink, linewidth=2.2, label="demonstration"),
        Line2D([], [], color=paper, marker="o", mec=ink, mew=1.8, ms=8, ls="", label="tool start"),
        Line2D([], [], color=ink, marker="s", ms=7, ls="", label="tool end"),
    ]
    balls = []
    for i, sphere in enumerate(spheres):
        count = sum(path.sphere == i for path in paths)
        label = f"sphere {i}: {1e3 * sphere.radius:.0f} mm" + (f", {count} paths" if paths else "")
        balls.append(Line2D([], [], color=sphere_colour(i), marker="o", ms=3, label=label))
    return [shown, *(balls[at : at + 4] for at in range(0, len(balls), 4))]


def _finish_views(figure: Figure, views: Sequence[_View], rows: list[list[Line2D]]) -> None:
    """Titles just above and legend just below what the views fill, which hangs on the scene."""
    figure.draw_without_rendering()
    width, height = figure.bbox.size
    boxes: list[Any] = [axes.get_tightbbox() for axes in figure.axes]
    for view, box in zip(views, boxes, strict=True):
        at = (0.5 * (box.x0 + box.x1) / width, box.y1 / height + 0.02)
        figure.text(*at, view.title, ha="center", va="bottom", weight="bold")
    bottom = min(box.y0 for box in boxes) / height
    for i, row in enumerate(rows):
        figure.legend(
            handles=row,
            loc="upper center",
            bbox_to_anchor=(0.5, bottom - 0.045 * i),
            ncols=len(row),
            frameon=False,
        )


# --- curves and placements ----------------------------------------------------------------------


def training_curve(
    epochs: Sequence[float], losses: Sequence[float], theme: Theme = "light"
) -> bytes:
    """PNG bytes of the training loss over epochs, on a logarithmic scale.

    Args:
        epochs: `(n,)`, at least one.
        losses: `(n,)`, each > 0.
        theme: `light` or `dark`.

    Raises:
        InvalidInput: empty, lengths differ, not finite, a loss <= 0, or an unknown theme.
    """
    x = check_array("epochs", epochs, (None,))
    y = check_array("losses", losses, (len(x),))
    if len(x) == 0:
        raise InvalidInput("epochs: the training curve is empty; train for at least one epoch")
    if (y <= 0).any():
        raise InvalidInput(f"losses: a logarithmic scale needs values > 0, got {y.min():g}")
    with _figure((7.0, 3.2), theme) as figure:
        axes = figure.add_subplot()
        marker = "o" if len(x) <= 15 else ""
        axes.semilogy(x, y, color=_ACCENT[theme], linewidth=2, marker=marker, markersize=4)
        axes.annotate(
            f"{y[-1]:.2g}", (x[-1], y[-1]), (6, 0), textcoords="offset points", va="center"
        )
        axes.set_xlabel("epoch")
        axes.set_ylabel("training loss")
        axes.xaxis.set_major_locator(MaxNLocator(9, integer=True))
        decades = float(np.log10(y.max() / y.min()))
        marks = (1,) if decades > 2.5 else (1, 2, 5) if decades > 0.7 else range(1, 10)
        axes.yaxis.set_major_locator(LogLocator(subs=tuple(marks)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda loss, _: f"{loss:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.margins(x=0.03, y=0.12)
        _quiet(axes)
        figure.tight_layout()
        return _png(figure)


@dataclass(frozen=True)
class Rate:
    """A success rate of a row and column: its Wilson interval, and the rates of single seeds."""

    row: str
    column: str
    rate: float
    low: float
    high: float
    units: tuple[float, ...]


def rates_image(rates: Sequence[Rate], across: str, theme: Theme = "light") -> bytes:
    """PNG bytes of success rates: a curve for each row if columns are numbers, else groups of dots.

    Bars are Wilson intervals, small marks the rates of single seeds.

    Args:
        rates: at least one.
        across: what columns are.
        theme: `light` or `dark`.

    Raises:
        InvalidInput: there are none, or an unknown theme.
    """
    if not rates:
        raise InvalidInput("rates: expected at least one; evaluate a cell")
    rows = list(dict.fromkeys(rate.row for rate in rates))
    columns = list(dict.fromkeys(rate.column for rate in rates))
    numbers = all(column.isdecimal() for column in columns) and len(columns) > 1
    series = rows if numbers else columns
    with _figure((7.6, 3.6), theme) as figure:
        axes = figure.add_subplot()
        for k, name in enumerate(series):
            shown = [rate for rate in rates if (rate.row if numbers else rate.column) == name]
            offset = 0.7 * ((k + 0.5) / len(series) - 0.5)
            x = np.array(
                [float(rate.column) if numbers else rows.index(rate.row) + offset for rate in shown]
            )
            y = np.array([100 * rate.rate for rate in shown])
            ends = np.array([[100 * rate.low, 100 * rate.high] for rate in shown]).T
            colour = sphere_colour(k)
            axes.errorbar(
                x, y, np.maximum(np.abs(ends - y), 0), color=colour, marker="o", markersize=5,
                capsize=2.5, linewidth=1.8, linestyle="-" if numbers else "", label=name,
            )  # fmt: skip
            for at, rate in zip(x, shown, strict=True):
                each = [100 * unit for unit in rate.units]
                axes.plot([at] * len(each), each, color=colour, marker="_", alpha=0.6, linestyle="")
        if numbers:
            axes.set_xscale("log")
            axes.set_xticks([float(c) for c in columns], columns)
            axes.xaxis.set_minor_formatter(NullFormatter())
        else:
            axes.set_xticks(range(len(rows)), rows, rotation=20 if len(rows) > 3 else 0)
            axes.set_xlim(-0.6, len(rows) - 0.4)
        axes.set_xlabel(across if numbers else "")
        axes.set_ylabel("success [%]")
        axes.set_ylim(-4, 104)
        _quiet(axes)
        axes.legend(frameon=False, bbox_to_anchor=(1.01, 1), loc="upper left")
        figure.tight_layout()
        return _png(figure, tight=True)


def placement_image(
    placements: Sequence[Mapping[str, Mapping[str, float]]],
    outcomes: Sequence[Outcome],
    demonstrated: Mapping[str, Mapping[str, float]] | None = None,
    theme: Theme = "light",
) -> bytes:
    """PNG bytes of a top view of where each object stood, by outcome; one panel for each object.

    Args:
        placements: for each episode the objects' `x`, `y` [m] and, where it has one, `yaw_deg`.
        outcomes: for each episode `success` or `failure`.
        demonstrated: where the objects stood in the demonstration; left out if unknown.
        theme: `light` or `dark`.

    Raises:
        InvalidInput: none, lengths differ, an unknown outcome or theme, or an object without x, y.
    """
    if len(placements) != len(outcomes) or not placements:
        raise InvalidInput(
            f"placements: expected one for each outcome and at least one, got {len(placements)}"
            f" placements and {len(outcomes)} outcomes"
        )
    for outcome in outcomes:
        if outcome not in OUTCOME_COLOURS:
            raise InvalidInput(f"outcomes: expected 'success' or 'failure', got {outcome!r}")
    names = sorted({name for placement in placements for name in placement})
    if not names:
        raise InvalidInput("placements: no object is named; give {'name': {'x': m, 'y': m}}")
    with _figure((4.9 * len(names), 4.9), theme) as figure:
        for column, name in enumerate(names):
            rows = [
                (*_xy_yaw(placement[name], name), outcome)
                for placement, outcome in zip(placements, outcomes, strict=True)
                if name in placement
            ]
            axes = figure.add_subplot(1, len(names), column + 1)
            shown = (demonstrated or {}).get(name)
            _draw_placements(axes, rows, _xy_yaw(shown, name) if shown else None, theme)
            axes.set_xlabel(f"{name} x [m]")
            axes.set_ylabel(f"{name} y [m]")
            _quiet(axes)
        figure.tight_layout()
        return _png(figure)


def _xy_yaw(placement: Mapping[str, float], name: str) -> tuple[float, float, float]:
    """x [m], y [m] and yaw [rad]."""
    try:
        x, y, yaw_deg = placement["x"], placement["y"], placement.get("yaw_deg", 0.0)
    except KeyError as error:
        raise InvalidInput(f"placements: {name!r} has no {error}; give x and y [m]") from error
    x, y, yaw = check_array(f"placement of {name!r}", (x, y, np.radians(yaw_deg)), (3,))
    return float(x), float(y), float(yaw)


def _draw_placements(
    axes: Any,
    rows: list[tuple[float, float, float, Outcome]],
    shown: tuple[float, float, float] | None,
    theme: Theme,
) -> None:
    turned = np.ptp([yaw for _, _, yaw, _ in rows]) > 1e-3
    markers: tuple[tuple[Outcome, str, int], ...] = (("success", "o", 34), ("failure", "X", 62))
    for outcome, marker, size in markers:
        x, y, yaw = np.array([row[:3] for row in rows if row[3] == outcome]).reshape(-1, 3).T
        style: Any = {"color": _OUTCOMES[theme][outcome], "linewidths": 0}
        axes.scatter(
            x, y, s=size, marker=marker, alpha=0.9, zorder=3, label=f"{outcome} ({len(x)})",
            **style,
        )  # fmt: skip
        if turned:
            axes.quiver(
                x, y, np.cos(yaw), np.sin(yaw), angles="xy", scale=18, width=0.005, zorder=2,
                headwidth=0, headlength=0, headaxislength=0, **style,
            )  # fmt: skip
    if shown is not None:
        axes.scatter(
            *shown[:2], s=150, marker="*", facecolor=_PAPER[theme], edgecolor=_INK[theme],
            linewidths=1.3, label="demonstration", zorder=4,
        )  # fmt: skip
    points = np.array([row[:2] for row in (*rows, *([shown] if shown else []))])
    low, high = points.min(axis=0), points.max(axis=0)
    half = max(1e-3, 0.6 * float((high - low).max()))
    (left, bottom), (right, top) = (low + high) / 2 - half, (low + high) / 2 + half
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.legend(
        loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False,
        handletextpad=0.2, columnspacing=1.2,
    )  # fmt: skip


# --- shared by the figures ----------------------------------------------------------------------


@contextmanager
def _figure(size: tuple[float, float], theme: Theme) -> Iterator[Figure]:
    """A figure [inch] to draw in, with the theme's colours, whatever the caller's own settings."""
    if theme not in get_args(Theme):
        raise InvalidInput(f"theme: expected 'light' or 'dark', got {theme!r}")
    ink, faint, paper = _INK[theme], _FAINT[theme], _PAPER[theme]
    style: Any = dict.fromkeys(
        ("text.color", "axes.labelcolor", "axes.titlecolor", "xtick.color", "ytick.color"), ink
    )
    style |= {"axes.facecolor": paper, "axes.edgecolor": faint, "grid.color": faint}
    style |= {"font.family": "DejaVu Sans", "font.size": 9.5, "grid.linewidth": 0.6}
    defaults: Any = {k: v for k, v in matplotlib.rcParamsDefault.items() if k != "backend"}
    with matplotlib.rc_context({**defaults, **style}):
        figure = Figure(figsize=size, facecolor=paper)
        FigureCanvasAgg(figure)
        yield figure


def _quiet(axes: Any) -> None:
    axes.grid(True, which="major")
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _png(figure: Figure, tight: bool = False) -> bytes:
    drawn = io.BytesIO()
    figure.savefig(
        drawn, format="png", dpi=144, bbox_inches="tight" if tight else None, pad_inches=0.1
    )
    # Without the alpha channel, which is full everywhere, a quarter smaller.
    stream = io.BytesIO()
    with PillowImage.open(drawn) as image:
        image.convert("RGB").save(stream, "png", optimize=True)
    return stream.getvalue()
