"""The benchmark of segments counts honestly, resumes, and finds faults that are planted."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.executors import Attempt, RestoreExecutor
from sart_toolkit.backends import make_backend
from sart_toolkit.backends.interface import CommandSent
from sart_toolkit.backends.pybullet import PyBulletBackend
from sart_toolkit.benchmark import segments
from sart_toolkit.benchmark.cells import Cell
from sart_toolkit.benchmark.limits import SentTargets
from sart_toolkit.benchmark.segments import SegmentsConfig, benchmark_segments
from sart_toolkit.cli import main
from sart_toolkit.collision.phases import BODY_STILLNESS
from sart_toolkit.data.manifest import AttemptKey
from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.errors import InvalidInput, Mismatch, OutputExists
from sart_toolkit.motion import timing
from sart_toolkit.poses import Array
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.peg_in_hole import PegInHole
from sart_toolkit.tasks.task import PlanStep, Task

PEG = "peg_in_hole/pybullet/0"
LID = "lid_closing/pybullet/0"


class Interrupted(Exception):
    pass


class LazyPeg(PegInHole):
    """An operator that never goes down."""

    def plan(self, state: Any) -> list[PlanStep]:
        T = super().plan(state)[0].T_world_tool
        return [PlanStep(T, state.gripper, 0.1)]


def counted(result: dict[str, Any]) -> Any:
    """The figures that depend neither on the machine's speed nor on coal's last digits."""
    rows = {
        name: {key: row[key] for key in ("spheres", "alarms", "rejections", "certified", "kept")}
        for name, row in result["cells"].items()
    }
    return json.loads(json.dumps(rows))


def test_segments_are_tallied_by_sphere_and_their_motions_checked(
    tmp_path: Path, peg_cell: Cell
) -> None:
    calls: list[tuple[int, int, int]] = []
    result = benchmark_segments(
        [peg_cell], SegmentsConfig(8), tmp_path / "out.json",
        progress=lambda *args: calls.append(args), about={"command": "sart"},
    )  # fmt: skip
    row = result["cells"][PEG]
    assert (row["attempted"], row["certified"], row["kept"], row["contacts"]) == (8, 8, 8, 0)
    assert row["ci95"][0] < 1.0 == row["kept_rate"]
    assert (row["left_path"], row["rejections"], row["alarms"]) == (0, {}, [])
    assert row["limits"]["motions_that_violate"] == 0
    for name in ("velocity", "acceleration", "jerk"):
        assert 0.01 < row["limits"]["greatest_ratio"][name] <= 1.0 + 1e-6
    assert row["limits"]["executed"] == 8 and row["limits"]["targets_sent"] > 8 * 96
    free = AugmentConfig().margin + BODY_STILLNESS
    assert row["least_clearance_mm"] >= (free + PyBulletBackend.tracking_error) * 1e3
    assert row["least_measured_clearance_mm"] >= free * 1e3 - 0.01
    assert row["deviation_mm"]["max"] <= PyBulletBackend.tracking_error * 1e3
    assert sum(sphere["attempted"] for sphere in row["spheres"]) == 8
    assert max(s["attempted"] for s in row["spheres"]) <= 1 + min(
        s["attempted"] for s in row["spheres"]
    )
    assert calls[-1] == (8, 8, 8)
    written = json.loads((tmp_path / "out.json").read_text())
    assert (written["cells"], written["command"]) == (result["cells"], "sart")
    assert [path.name for path in tmp_path.iterdir()] == ["out.json"]


def test_against_the_cloud_nothing_is_proved_of_bodies_and_nothing_touches_them(
    tmp_path: Path, peg_task: Task
) -> None:
    make = functools.partial(
        make_backend, "pybullet", get_robot(peg_task.robot), peg_task.scene, 64
    )
    config = SegmentsConfig(4, obstacles="cloud")
    result = benchmark_segments([Cell(peg_task, "pybullet", make)], config, tmp_path / "out.json")
    row = result["cells"][PEG]
    assert (row["attempted"], row["kept"], row["contacts"]) == (4, 4, 0)
    assert {sphere["limited_by"] for sphere in row["spheres"]} <= {
        "peg / cloud", "peg / cloud at waypoint 31"
    }  # fmt: skip
    assert result["config"]["obstacles"] == "cloud"


def test_contacts_and_paths_that_were_left_are_told_apart_from_other_rejections(
    tmp_path: Path, peg_cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcomes = ["contact peg / block", "left its path peg / block", "peg slipped in the grasp"]

    left = iter(outcomes)

    class Unlucky(RestoreExecutor):
        def attempt(self, key: AttemptKey) -> Attempt:
            return Attempt(key, next(left), None)

    monkeypatch.setattr(segments, "RestoreExecutor", Unlucky)
    result = benchmark_segments([peg_cell], SegmentsConfig(3), tmp_path / "out.json")
    for row in (result["total"], result["cells"][PEG]):
        assert row["rejections"] == dict.fromkeys(outcomes, 1)
        assert (row["kept"], row["contacts"], row["left_path"]) == (0, 1, 1)
        assert row["deviation_mm"] == {"median": None, "max": None}
    row = result["cells"][PEG]
    assert [(a["sphere"], a["k"], a["outcome"]) for a in row["alarms"]] == [
        (0, 0, outcomes[0]), (1, 0, outcomes[1])
    ]  # fmt: skip
    assert [sphere["rejections"] for sphere in row["spheres"]] == [{o: 1} for o in outcomes]


def test_a_timing_that_ignores_limits_is_found(
    tmp_path: Path, peg_cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = timing._timing

    def hasty(path: Any, spec: RobotSpec, duration: float) -> Any:
        names = ("velocity_limits", "acceleration_limits", "jerk_limits")
        loose = {name: 1e6 * getattr(spec, name) for name in names}
        return original(path, dataclasses.replace(spec, **loose), 0.1 * duration)

    monkeypatch.setattr(timing, "_timing", hasty)
    result = benchmark_segments([peg_cell], SegmentsConfig(1), tmp_path / "out.json")
    row = result["cells"][PEG]
    assert row["limits"]["motions_that_violate"] == 1 == len(row["alarms"])
    assert row["limits"]["greatest_ratio"]["jerk"] > 1.0


def test_interrupted_segments_go_on_where_they_were(tmp_path: Path, peg_cell: Cell) -> None:
    def stop(done: int, wanted: int, kept: int) -> None:
        if done == 3:
            raise Interrupted

    out, config = tmp_path / "out.json", SegmentsConfig(5, seeds=(1,))
    with pytest.raises(Interrupted):
        benchmark_segments([peg_cell], config, out, progress=stop)
    with pytest.raises(Mismatch, match="add --overwrite"):
        benchmark_segments([peg_cell], SegmentsConfig(5), out)
    calls: list[int] = []
    again = benchmark_segments(
        [peg_cell], config, out, progress=lambda done, *_: calls.append(done)
    )
    assert calls == [4, 5]
    whole = benchmark_segments([peg_cell], config, tmp_path / "whole.json", workers=2)
    assert counted(again) == counted(whole)
    with pytest.raises(OutputExists):
        benchmark_segments([peg_cell], config, out)


def test_tries_are_shared_by_the_cells(
    tmp_path: Path, peg_cell: Cell, make_cell: Callable[[Task], Cell]
) -> None:
    result = benchmark_segments(
        [peg_cell, make_cell(get_task("lid_closing"))], SegmentsConfig(3), tmp_path / "out.json"
    )
    assert [result["cells"][name]["attempted"] for name in (PEG, LID)] == [2, 1]
    assert result["total"]["attempted"] == 3
    with pytest.raises(InvalidInput, match="expected at least 2, got 1"):
        benchmark_segments([peg_cell], SegmentsConfig(1, seeds=(0, 1)), tmp_path / "few.json")


def test_every_seed_is_a_cell_with_a_demonstration_and_draws_of_its_own(
    tmp_path: Path, peg_cell: Cell
) -> None:
    config = SegmentsConfig(5, seeds=(101, 103))
    result = benchmark_segments([peg_cell], config, tmp_path / "out.json", workers=2)
    names = ["peg_in_hole/pybullet/101", "peg_in_hole/pybullet/103"]
    assert list(result["cells"]) == names
    assert [result["cells"][name]["attempted"] for name in names] == [3, 2]
    radii = [[s["radius"] for s in result["cells"][name]["spheres"]] for name in names]
    assert radii[0] != radii[1]
    alone = benchmark_segments([peg_cell], SegmentsConfig(2, seeds=(103,)), tmp_path / "alone.json")
    assert counted(alone)[names[1]] == counted(result)[names[1]]


def test_fingers_that_still_close_touch_nothing(
    tmp_path: Path, make_cell: Callable[[Task], Cell]
) -> None:
    """With seed 102 there was a sphere while the fingers closed, and all its segments touched."""
    result = benchmark_segments(
        [make_cell(get_task("toolbox_picking"))], SegmentsConfig(12, seeds=(102,)),
        tmp_path / "out.json",
    )  # fmt: skip
    row = result["cells"]["toolbox_picking/pybullet/102"]
    assert row["contacts"] == 0 and row["alarms"] == []
    assert row["kept"] >= 6


def test_a_demonstration_that_fails_is_refused(
    tmp_path: Path, make_cell: Callable[[Task], Cell]
) -> None:
    with pytest.raises(Mismatch, match="did not reach the goal"):
        benchmark_segments([make_cell(LazyPeg())], SegmentsConfig(1), tmp_path / "out.json")


class Told:
    """A backend that does nothing but take commands."""

    robot, rates = get_robot("ur5e_2f85"), DEFAULT_RATES

    def command(self, q: Array, gripper: float) -> CommandSent:
        return CommandSent(np.atleast_2d(q)[-1], gripper)


@pytest.mark.parametrize(
    ("order", "limits"),
    [(1, "velocity_limits"), (2, "acceleration_limits"), (3, "jerk_limits")],
)
@pytest.mark.parametrize("share", [0.9, 1.1])
def test_what_is_sent_is_held_against_each_limit(order: int, limits: str, share: float) -> None:
    """By finite differences, from how the joints moved before."""
    backend: Any = Told()
    sent = SentTargets(backend)
    limit, hz = getattr(backend.robot, limits)[2], DEFAULT_RATES.physics_hz
    q, dq = np.zeros(6), np.zeros(6)
    if order == 1:
        dq[2] = share * limit
    at = np.arange(1, 17) / hz
    rows = np.zeros((16, 6))
    rows[:, 2] = share * limit * at**order / math.factorial(order)
    rows += 0.0 if order == 1 else dq * at[:, None]
    for period in rows.reshape(2, 8, 6):
        backend.command(period, 0.0)
    found = sent.check(q, dq)
    assert found is not None and found.samples == 16
    assert found.ratios[order - 1] == pytest.approx(share, rel=0.01)
    assert (found.violations > 0) == (max(found.ratios) > 1)
    assert sent.check(q, dq) is None


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SegmentsConfig(count=0), "count: expected at least 1"),
        (lambda: SegmentsConfig(seeds=(0, -1)), "seeds: expected different whole numbers"),
        (lambda: SegmentsConfig(seeds=(3, 3)), "seeds: expected different whole numbers"),
        (lambda: SegmentsConfig(seeds=()), "seeds: expected different whole numbers"),
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
    main(["benchmark", "segments", *task, "--count", "2", "--out", str(out)])
    result = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert set(result) == {"benchmark", PEG, "all"}
    assert "2/2 kept" in result[PEG]
    with pytest.raises(SystemExit):
        main(["benchmark", "segments", *task, "--seed", "1,x", "--out", str(out), "--overwrite"])
    assert "--seed: expected whole numbers separated by commas" in capsys.readouterr().err
    assert {"command", "machine", "versions", "config"} <= set(json.loads(out.read_text()))
