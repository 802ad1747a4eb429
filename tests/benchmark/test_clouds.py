"""The comparison of radii from images and from the scene counts what it finds."""

import functools

import numpy as np
import pytest

from sart_toolkit.backends import make_backend
from sart_toolkit.benchmark import clouds
from sart_toolkit.benchmark.cells import Cell
from sart_toolkit.benchmark.clouds import _on_robot, benchmark_clouds
from sart_toolkit.robots import get_robot
from sart_toolkit.tasks import get_task


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    task = get_task("peg_in_hole")
    make = functools.partial(make_backend, "pybullet", get_robot(task.robot), task.scene, 96)
    seen = []
    out = tmp_path_factory.mktemp("cloud") / "cloud.json"
    found = benchmark_clouds(
        [Cell(task, "pybullet", make)], 0, out, progress=lambda *counts: seen.append(counts)
    )
    assert seen == [(1, 1)]
    return found


def test_radii_of_both_sources_stand_side_by_side(compared):
    row = compared["cells"]["peg_in_hole/pybullet"]
    assert compared["total"]["n_spheres"] == len(row["spheres"]) == row["n_spheres_exact"] >= 2
    shares = sorted(sphere["cloud"] / sphere["exact"] for sphere in row["spheres"])
    assert shares[0] <= row["median_share"] <= shares[-1]
    assert row["largest_excess_mm"] == pytest.approx(
        max(1e3 * (sphere["cloud"] - sphere["exact"]) for sphere in row["spheres"])
    )
    assert row["spheres"][0]["cloud_limited_by"] == "peg / cloud"
    assert row["seconds_exact"] > 0 and row["seconds_cloud"] > 0


def test_the_cloud_s_points_lie_on_true_surfaces(compared):
    errors = compared["cells"]["peg_in_hole/pybullet"]["surface_errors"]
    assert errors["points"] > 1000
    assert errors["median_mm"] <= errors["p95_mm"] <= errors["max_mm"]
    assert errors["median_mm"] < 3 and errors["p95_mm"] < 8
    assert errors["on_robot"] == 0


def test_a_point_on_the_robot_is_counted(peg_demonstration, peg_world):
    Ts = peg_demonstration.steps.measured_Ts_world_tool[:, :3, 3]
    points = np.array([Ts[0], Ts[-1], [0.0, 2.0, 0.0]])
    assert _on_robot(points, peg_world, range(len(Ts))) == 2
    assert _on_robot(points, peg_world, range(1)) == 1


def test_interrupted_it_keeps_the_cells_that_were_finished(
    make_cell, peg_task, tmp_path, monkeypatch
):
    cells = [make_cell(peg_task), make_cell(get_task("lid_closing"))]
    ran = []

    def row(cell, seed):
        ran.append(cell.name)
        if len(ran) == 2:
            raise KeyboardInterrupt
        return {"spheres": [{"cloud": 1.0 + len(cell.name), "exact": 2.0}], "seed": seed}

    monkeypatch.setattr(clouds, "_compared", row)
    with pytest.raises(KeyboardInterrupt):
        benchmark_clouds(cells, 0, tmp_path / "c.json")
    again = benchmark_clouds(cells, 0, tmp_path / "c.json")
    assert ran == [cells[0].name, cells[1].name, cells[1].name]
    assert again == benchmark_clouds(cells, 0, tmp_path / "whole.json")
