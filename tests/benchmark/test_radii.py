"""The benchmark of radii counts honestly, resumes, and finds radii that are too large."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sart_toolkit.benchmark.cells import Cell
from sart_toolkit.benchmark.radii import RadiiConfig, SphereTrial, benchmark_radii
from sart_toolkit.cli import main
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.data.records import Annotation
from sart_toolkit.errors import InvalidInput, Mismatch
from sart_toolkit.robots import get_robot
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Task
from sart_toolkit.testing.closest import ClosestPoints

PEG = "peg_in_hole/pybullet"
LID = "lid_closing/pybullet"
FEW = RadiiConfig(draws=40, directed=400, growth=1.25)


class Interrupted(Exception):
    pass


@pytest.fixture(scope="module")
def trial(peg_task: Task, peg_world: ExactWorld) -> Iterator[SphereTrial]:
    with closing(ClosestPoints(get_robot(peg_task.robot), peg_task.scene)) as checker:
        yield SphereTrial(peg_world, checker, FEW)


def test_suggested_spheres_hold_no_collision_and_somewhat_larger_ones_do(
    trial: SphereTrial, peg_annotation: Annotation
) -> None:
    for sphere in peg_annotation.spheres:
        row = trial(sphere, np.random.default_rng(0))
        assert (row["draws"], row["collisions"], row["unreachable"]) == (40, 0, 0)
        # The two models agree wherever both look at the nearest pair.
        assert 0.0 < row["least_mm"] <= row["least_checked_mm"] + 0.1
        assert row["grown"]["radius"] == pytest.approx(1.25 * sphere.radius)
        assert row["grown"]["collided"] and row["grown"]["within_margin"]
        assert row["grown"]["least_mm"] < 0.0


def test_a_sphere_three_times_too_large_is_found_out(
    trial: SphereTrial, peg_annotation: Annotation
) -> None:
    for sphere in peg_annotation.spheres:
        large = dataclasses.replace(sphere, radius=3 * sphere.radius)
        row = trial(large, np.random.default_rng(0))
        assert row["collisions"] > 0 > row["least_mm"]
        assert row["least_checked_mm"] < 0.0
        seen = row["first_collisions"][0]
        assert min(seen["mm"], seen["checked_mm"]) < 0.0


def test_a_sphere_with_room_left_shows_no_collision_when_grown(
    trial: SphereTrial, peg_annotation: Annotation
) -> None:
    narrow = peg_annotation.spheres[-1]
    small = dataclasses.replace(narrow, radius=0.3 * narrow.radius)
    row = trial(small, np.random.default_rng(0))
    assert not row["grown"]["collided"] and not row["grown"]["within_margin"]
    assert (row["grown"]["draws"], row["collisions"]) == (FEW.directed, 0)


def test_only_spheres_limited_by_two_bodies_are_grown(
    trial: SphereTrial, peg_annotation: Annotation
) -> None:
    for reason in ("max_radius", "reach", "contact peg / block at waypoint 30", None):
        other = dataclasses.replace(peg_annotation.spheres[0], limited_by=reason)
        assert trial(other, np.random.default_rng(0))["grown"] is None


def test_radii_are_counted_over_cells_and_go_on_where_they_were(
    tmp_path: Path, peg_cell: Cell, make_cell: Callable[[Task], Cell]
) -> None:
    def stop(done: int, wanted: int) -> None:
        raise Interrupted

    cells, out = [peg_cell, make_cell(get_task("lid_closing"))], tmp_path / "out.json"
    run: Callable[..., dict[str, Any]] = functools.partial(benchmark_radii, cells, ClosestPoints)
    with pytest.raises(Interrupted):
        run(FEW, out, progress=stop)
    with pytest.raises(Mismatch, match="add --overwrite"):
        run(RadiiConfig(draws=41, directed=400), out)
    calls: list[tuple[int, int]] = []
    result = run(FEW, out, progress=lambda *args: calls.append(args))
    assert calls == [(2, 2)]
    assert json.loads(out.read_text())["cells"] == json.loads(json.dumps(result["cells"]))
    assert [path.name for path in tmp_path.iterdir()] == ["out.json"]
    for row in result["cells"].values():
        assert row["n_draws"] == 40 * len(row["spheres"])
        assert 0.0 < row["seconds_suggest"] < 10.0
        assert row["waypoints"] > 20
    total = result["total"]
    assert total["n_spheres"] == sum(len(row["spheres"]) for row in result["cells"].values())
    assert (total["n_collisions"], total["collisions"]["rate"]) == (0, 0.0)
    assert total["n_collided_when_grown"] == total["n_limited_by_pair"] > 3
    assert total["collided_when_grown"]["ci95"][1] == 1.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RadiiConfig(draws=0), "draws: expected at least 1"),
        (lambda: RadiiConfig(directed=0), "directed: expected at least 1"),
        (lambda: RadiiConfig(growth=0.9), "growth: expected 1 to 10"),
    ],
)
def test_bad_numbers_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        make()


def test_the_command_line_prints_a_line_for_each_cell(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.json"
    task = ["--tasks", "peg_in_hole", "--backends", "pybullet", "--workers", "1", "--json"]
    main(["benchmark", "radii", *task, "--draws", "2", "--directed", "50", "--out", str(out)])
    result = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert set(result) == {"benchmark", PEG, "all"}
    assert "0 collisions in" in result[PEG]
    assert {"command", "machine", "versions", "config"} <= set(json.loads(out.read_text()))
