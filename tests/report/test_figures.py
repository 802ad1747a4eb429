from __future__ import annotations

import dataclasses
import io
import subprocess
import sys
from typing import Any

import matplotlib
import numpy as np
import pytest
from PIL import Image as PillowImage

from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.records import Annotation, Demonstration, Image
from sart_toolkit.errors import InvalidInput, UnknownName
from sart_toolkit.report.figures import (
    SPHERE_COLOURS,
    Rate,
    SegmentPath,
    film_strip,
    montage,
    placement_image,
    rates_image,
    scene_image,
    segment_paths,
    sphere_colour,
    training_curve,
)

PLACES = [{"block": {"x": 0.01 * k, "y": -0.02 * k, "yaw_deg": 9.0 * k}} for k in range(4)]
OUTCOMES: list[Any] = ["success", "success", "failure", "success"]


def pixels(png: bytes) -> Image:
    assert png.startswith(b"\x89PNG")
    return np.asarray(PillowImage.open(io.BytesIO(png)).convert("RGB"))


def shows(png: bytes, colour: str) -> bool:
    """Whether some pixel has exactly a colour `#rrggbb`."""
    wanted = [int(colour[at : at + 2], 16) for at in (1, 3, 5)]
    return bool((pixels(png) == wanted).all(axis=2).any())


def test_film_strip_shows_first_and_last_image(demonstration: Demonstration) -> None:
    rgb = demonstration.steps.cameras["wrist"].rgb
    strip = pixels(film_strip(demonstration, n=5, size=48))
    assert strip.shape[0] > 48 and strip.shape[1] == 1 + 5 * 49
    assert (strip[1:49, 1:49] == rgb[0]).all()
    assert (strip[1:49, -49:-1] == rgb[-1]).all()


def test_film_strip_takes_at_most_one_image_a_step(demonstration: Demonstration) -> None:
    n = len(demonstration)
    assert film_strip(demonstration, n=n, size=32) == film_strip(demonstration, n=10 * n, size=32)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"camera": "wirst"}, UnknownName, "unknown camera 'wirst': did you mean 'wrist'"),
        ({"n": 1}, InvalidInput, "n: expected at least 2 images, got 1"),
        ({"size": 8}, InvalidInput, "size: expected at least 32 pixels, got 8"),
    ],
)
def test_film_strip_refuses(
    demonstration: Demonstration, changes: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        film_strip(demonstration, **changes)


def test_segment_paths_are_measured_or_commanded_positions(dataset: Dataset) -> None:
    measured = segment_paths(dataset)
    commanded = segment_paths(iter(dataset), "commanded")
    assert [path.sphere for path in measured] == [e.provenance.sphere for e in dataset]
    for episode, m, c in zip(dataset, measured, commanded, strict=True):
        assert (m.positions == episode.steps.measured_Ts_world_tool[:, :3, 3]).all()
        assert (c.positions == episode.steps.commanded_Ts_world_tool[:, :3, 3]).all()
    with pytest.raises(InvalidInput, match="which: expected 'measured' or 'commanded', got 'both'"):
        segment_paths(dataset, "both")  # type: ignore[arg-type]


def test_segment_path_is_checked_and_read_only() -> None:
    with pytest.raises(InvalidInput, match=r"positions: expected shape \('n', 3\), got \(3,\)"):
        SegmentPath(0, np.zeros(3))
    with pytest.raises(ValueError, match="read-only"):
        SegmentPath(0, np.zeros((2, 3))).positions[0] = 1.0


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_scene_shows_every_sphere_in_its_colour(dataset: Dataset, theme: Any) -> None:
    png = scene_image(
        dataset.sources[0].demonstration,
        dataset.sources[0].annotation,
        segment_paths(dataset),
        theme,
    )
    for i in range(len(dataset.sources[0].annotation.spheres)):
        assert shows(png, sphere_colour(i))
    paper = pixels(png)[0, 0]
    assert (paper > 200).all() if theme == "light" else (paper < 60).all()


def test_scene_is_as_wide_as_high_for_a_sphere(dataset: Dataset) -> None:
    # Equal aspect: the outline of a sphere alone is a circle.
    sphere = dataclasses.replace(dataset.sources[0].annotation.spheres[1], radius=0.15)
    alone = Annotation((sphere,), dataset.sources[0].annotation.demonstration_hash)
    image = pixels(scene_image(dataset.sources[0].demonstration, alone))
    left = image[:, : image.shape[1] // 2].astype(int)
    tinted = left[: int(0.8 * len(left)), :, 2] - left[: int(0.8 * len(left)), :, 0] > 25
    height, width = (int(np.ptp(np.flatnonzero(tinted.any(axis=axis)))) for axis in (1, 0))
    assert height > 100
    assert width == pytest.approx(height, rel=0.02)


def test_scene_needs_neither_spheres_nor_paths(demonstration: Demonstration) -> None:
    assert pixels(scene_image(demonstration)).std() > 5


def test_scene_shows_spheres_too_small_for_the_whole_close_up(dataset: Dataset) -> None:
    first, *others = dataset.sources[0].annotation.spheres
    small = [dataclasses.replace(sphere, radius=0.004) for sphere in others]
    annotation = Annotation((first, *small), dataset.sources[0].annotation.demonstration_hash)
    png = scene_image(dataset.sources[0].demonstration, annotation, segment_paths(dataset))
    half = pixels(png)[:, pixels(png).shape[1] // 2 :].astype(int)
    # Bluish green: the third sphere's tinted disc is large although its radius is 4 mm.
    greenish = (half[..., 1] - half[..., 0] > 20) & (half[..., 1] - half[..., 2] > 5)
    assert greenish.sum() > 400


def test_scene_refuses_paths_of_another_annotation(dataset: Dataset) -> None:
    with pytest.raises(InvalidInput, match="belongs to sphere 7, the annotation has 3"):
        scene_image(
            dataset.sources[0].demonstration,
            dataset.sources[0].annotation,
            [SegmentPath(7, np.zeros((2, 3)))],
        )


def test_sphere_colours_repeat_after_the_palette() -> None:
    assert sphere_colour(len(SPHERE_COLOURS) + 1) == sphere_colour(1) == SPHERE_COLOURS[1]


@pytest.mark.parametrize(
    ("epochs", "losses"),
    [([1], [0.5]), (range(1, 41), np.geomspace(1, 1e-5, 40)), ([1, 2], [0.3, 0.3])],
)
def test_training_curve_is_drawn(epochs: Any, losses: Any) -> None:
    assert shows(training_curve(epochs, losses), "#0063b1")


@pytest.mark.parametrize(
    ("epochs", "losses", "message"),
    [
        ([], [], "the training curve is empty; train for at least one epoch"),
        ([1, 2], [0.5], r"losses: expected shape \(2,\), got \(1,\)"),
        ([1, 2], [0.5, 0.0], "losses: a logarithmic scale needs values > 0, got 0"),
        ([1, 2], [0.5, float("nan")], "losses: has NaN or infinite entries"),
    ],
)
def test_training_curve_refuses(epochs: Any, losses: Any, message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        training_curve(epochs, losses)


def test_placements_are_coloured_by_outcome() -> None:
    both = placement_image(PLACES, OUTCOMES)
    only = placement_image(PLACES, ["success"] * 4)
    assert not np.array_equal(pixels(both), pixels(only))


def test_placements_show_the_demonstration_and_each_object() -> None:
    one = placement_image(PLACES, OUTCOMES)
    marked = placement_image(PLACES, OUTCOMES, {"block": {"x": 0.0, "y": 0.0}})
    assert pixels(marked).shape == pixels(one).shape
    assert not np.array_equal(pixels(marked), pixels(one))
    two = placement_image([{**p, "cup": {"x": 0, "y": 0}} for p in PLACES], OUTCOMES)
    assert pixels(two).shape[1] // 2 == pixels(one).shape[1]


def test_one_placement_alone_is_drawn() -> None:
    assert pixels(placement_image(PLACES[:1], OUTCOMES[:1], theme="dark")).std() > 5


@pytest.mark.parametrize(
    ("places", "outcomes", "message"),
    [
        ([], [], "expected one for each outcome and at least one, got 0 placements"),
        (PLACES, OUTCOMES[:2], "got 4 placements and 2 outcomes"),
        (PLACES[:1], ["won"], "outcomes: expected 'success' or 'failure', got 'won'"),
        ([{}], ["success"], "placements: no object is named"),
        ([{"block": {"x": 0.0}}], ["success"], "placements: 'block' has no 'y'; give x and y"),
        ([{"block": {"x": 0.0, "y": float("nan")}}], ["success"], "placement of 'block': has NaN"),
    ],
)
def test_placements_refuse(places: Any, outcomes: Any, message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        placement_image(places, outcomes)


def test_unknown_theme_is_refused() -> None:
    with pytest.raises(InvalidInput, match="theme: expected 'light' or 'dark', got 'sepia'"):
        training_curve([1], [0.5], "sepia")  # type: ignore[arg-type]


def test_drawing_neither_heeds_nor_changes_the_callers_matplotlib() -> None:
    plain = training_curve([1, 2], [0.5, 0.4])
    with matplotlib.rc_context({"axes.grid": False, "font.size": 30, "lines.linewidth": 9}):
        before = dict(matplotlib.rcParams)
        assert training_curve([1, 2], [0.5, 0.4]) == plain
        assert dict(matplotlib.rcParams) == before


def test_drawing_does_without_pyplot() -> None:
    code = (
        "import sys, sart_toolkit.report.figures as p; p.training_curve([1], [1]);"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- benchmarks ---------------------------------------------------------------------------------


def test_a_montage_shows_every_image_and_cuts_long_captions() -> None:
    images = [np.full((60, 120, 3), 40 * k, np.uint8) for k in range(1, 5)]
    sheet = pixels(montage(images, ["short", "x" * 200, "", "last"], columns=3))
    assert sheet.shape == (6 + 2 * (60 + 20 + 6), 6 + 3 * (120 + 6), 3)
    for k, (top, left) in enumerate(((6, 6), (6, 132), (6, 258), (92, 6)), 1):
        assert (sheet[top : top + 60, left : left + 120] == 40 * k).all()
    # The long caption ends before the next image's begins.
    assert (sheet[66:86, 252:258] == sheet[0, 0]).all()


@pytest.mark.parametrize("captions", [[], ["a", "b"]])
def test_a_montage_without_images_or_captions_for_them_is_refused(captions: list[str]) -> None:
    images = [np.zeros((8, 8, 3), np.uint8)] if captions else []
    with pytest.raises(InvalidInput, match="images: expected at least one and a caption for each"):
        montage(images, captions)


def test_rates_are_a_curve_over_numbers_and_groups_of_dots_otherwise() -> None:
    curve = [Rate("peg", n, r, r - 0.1, r, (r,)) for n, r in (("20", 0.5), ("100", 0.9))]
    dots = [dataclasses.replace(rate, column=name) for rate, name in zip(curve, "ab", strict=True)]
    drawn = [rates_image(rates, "n") for rates in (curve, dots)]
    # One colour for the one curve; one for each column.
    assert shows(drawn[0], SPHERE_COLOURS[0]) and not shows(drawn[0], SPHERE_COLOURS[1])
    assert shows(drawn[1], SPHERE_COLOURS[0]) and shows(drawn[1], SPHERE_COLOURS[1])
    assert drawn[0] != rates_image(curve, "n", "dark")
    with pytest.raises(InvalidInput, match="rates: expected at least one"):
        rates_image([], "n")
