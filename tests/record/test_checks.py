"""Recordings that can't be learned from are refused, poor ones warned of; with figures."""

from __future__ import annotations

import dataclasses
import logging
import re

import numpy as np
import pytest

from sart_toolkit import pipeline
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.cli import main
from sart_toolkit.data.records import Demonstration, Steps
from sart_toolkit.data.storage import save_annotation, save_demonstration
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import pose
from sart_toolkit.record.checks import CheckConfig, check_recording, inspect_recording


def with_rows(demonstration: Demonstration, rows, raw=None, retimed=False) -> Demonstration:
    """The demonstration with some of its steps alone, in the order of `rows`."""
    rows = np.asarray(rows)
    old = demonstration.steps
    arrays = {f.name: getattr(old, f.name) for f in dataclasses.fields(Steps)}
    cameras = {
        name: dataclasses.replace(camera, rgb=camera.rgb[rows], depth=camera.depth[rows])
        for name, camera in arrays.pop("cameras").items()
    }
    times = demonstration.timestamps[rows]
    return dataclasses.replace(
        demonstration,
        steps=Steps(cameras=cameras, **{name: array[rows] for name, array in arrays.items()}),
        timestamps=np.arange(len(rows)) / 10 if retimed else times,
        body_Ts_world={k: Ts[rows] for k, Ts in demonstration.body_Ts_world.items()},
        success=demonstration.success[rows],
        touching=tuple(demonstration.touching[t] for t in rows),
        raw_commands=demonstration.raw_commands[: 3 * (len(rows) - 1)] if raw is None else raw,
        states=(),
    )


def with_steps(demonstration: Demonstration, **changes) -> Demonstration:
    arrays = {f.name: getattr(demonstration.steps, f.name) for f in dataclasses.fields(Steps)}
    return dataclasses.replace(demonstration, steps=Steps(**{**arrays, **changes}))


@pytest.fixture(scope="module")
def robot(peg_model):
    return peg_model.spec


@pytest.fixture(scope="module")
def gapped(peg_demonstration):
    """Twelve frames were dropped."""
    n = len(peg_demonstration)
    return with_rows(peg_demonstration, [t for t in range(n) if not 8 <= t < 20])


def test_what_the_scripted_operator_records_is_faultless(peg_demonstration, robot):
    assert inspect_recording(peg_demonstration, robot) == dataclasses.replace(
        inspect_recording(peg_demonstration, robot), problems=(), warnings=()
    )
    check_recording(peg_demonstration, robot)


def test_dropped_frames_are_refused_with_their_number_place_and_the_action_they_would_train(
    gapped, robot
):
    commanded = gapped.steps.commanded_Ts_world_tool[:, :3, 3]
    far = 1e3 * np.linalg.norm(commanded[8] - commanded[7])
    assert far > 60
    expected = (
        rf"12 frames are missing between t=0\.7 s and 2\.0 s; an action of {far:.0f} mm would"
    )
    with pytest.raises(InvalidInput, match=expected):
        check_recording(gapped, robot)


def test_dropped_frames_are_found_by_the_jump_where_time_was_written_anew(peg_demonstration, robot):
    n = len(peg_demonstration)
    rows = [t for t in range(n) if not 8 <= t < 20]
    found = inspect_recording(with_rows(peg_demonstration, rows, retimed=True), robot)
    assert any(re.match(r"the tool moves by \d+ mm and \d+ deg between t=0\.7", p)
               for p in found.problems)  # fmt: skip
    # And by the commands that were given meanwhile, however slowly it moved.
    raw = peg_demonstration.raw_commands
    still = with_rows(peg_demonstration, [*range(30), *range(33, n)], raw, retimed=True)
    (problem,) = inspect_recording(still, robot).problems
    assert problem == (
        f"was steered for {3 * (n - 1)} control periods, its {n - 3} steps are of {3 * (n - 4)}: "
        "3 frames are missing"
    )


@pytest.mark.parametrize("step", [0.0, -0.1])
def test_time_that_does_not_advance_is_refused(peg_demonstration, robot, step):
    times = np.array(peg_demonstration.timestamps)
    times[5:] += step - 0.1
    with pytest.raises(InvalidInput, match=r"time doesn't advance between steps 4 and 5: 0\.400 s"):
        check_recording(dataclasses.replace(peg_demonstration, timestamps=times), robot)


def test_another_rate_than_the_recording_s_is_one_problem(peg_demonstration, robot):
    slow = dataclasses.replace(peg_demonstration, timestamps=2 * peg_demonstration.timestamps)
    (problem,) = inspect_recording(slow, robot).problems
    assert problem == "its steps are 0.2 s apart, the recording's rate says 0.1 s"


def test_uneven_time_is_warned_of(peg_demonstration, robot, caplog):
    times = np.array(peg_demonstration.timestamps)
    times[5] += 0.02
    uneven = dataclasses.replace(peg_demonstration, timestamps=times)
    with caplog.at_level(logging.WARNING):
        check_recording(uneven, robot, name="mine.h5")
    assert (
        "mine.h5: time advances unevenly: by 0.080 to 0.120 s at 2 of "
        f"{len(peg_demonstration) - 1} steps, expected 0.100 s"
    ) in caplog.text


@pytest.mark.parametrize("n", [2, 10])
def test_a_recording_too_short_to_rejoin_is_refused(peg_demonstration, robot, n):
    with pytest.raises(InvalidInput, match=f"has {n} steps, {(n - 1) / 10:.1f} s at 10 Hz"):
        check_recording(with_rows(peg_demonstration, range(n)), robot)


def test_a_recording_in_which_nothing_moves_is_refused(peg_demonstration, robot):
    still = with_rows(peg_demonstration, [0] * 30, retimed=True)
    with pytest.raises(
        InvalidInput,
        match=r"nothing moves: for 30 steps the tool stays within 0\.0 mm and 0\.0 deg",
    ):
        check_recording(still, robot)


@pytest.mark.parametrize(("at", "where"), [(0, ", at its start"), (20, ""), (-1, ", at its end")])
def test_idle_frames_are_warned_of_with_their_number_and_place(peg_demonstration, robot, at, where):
    at = at % len(peg_demonstration)
    rows = [*range(at), *[at] * 31, *range(at + 1, len(peg_demonstration))]
    found = inspect_recording(with_rows(peg_demonstration, rows, np.empty((0, 7)), True), robot)
    assert found.problems == ()
    (warning,) = found.warnings
    match = re.fullmatch(
        r"stands still for (\d+) steps, (\d\.\d) s, from t=(\d\.\d) s(.*)", warning
    )
    assert match is not None and match[4] == where
    assert 30 <= int(match[1]) <= 45 and float(match[2]) == int(match[1]) / 10


def test_a_joint_faster_than_its_limit_is_refused(peg_demonstration, robot):
    q = np.array(peg_demonstration.steps.joint_positions)
    q[20:, 5] += 0.5
    with pytest.raises(
        InvalidInput, match=r"joint wrist_3_joint moves by 0\.\d+ rad between t=1\.9 s and 2\.0 s, "
        r"by its limit it can by 0\.31 rad"
    ):  # fmt: skip
        check_recording(with_steps(peg_demonstration, joint_positions=q), robot)


def test_an_action_that_no_rollout_can_follow_is_warned_of_and_a_jump_refused(
    peg_demonstration, robot
):
    def shifted(by):
        Ts = np.array(peg_demonstration.steps.commanded_Ts_world_tool)
        Ts[20:] = pose([0, 0, by]) @ Ts[20:]
        return inspect_recording(with_steps(peg_demonstration, commanded_Ts_world_tool=Ts), robot)

    assert shifted(0.005).warnings == ()
    (warning,) = shifted(0.04).warnings
    assert "the commanded tool moves by" in warning and "leads by 20 mm and 5 deg at" in warning
    (problem,) = shifted(0.08).problems
    assert "60 mm and 15 deg are the most in a step" in problem


def test_a_bad_threshold_is_refused():
    with pytest.raises(InvalidInput, match="idle_seconds: expected a finite number > 0"):
        CheckConfig(idle_seconds=0)


# --- where it is checked ------------------------------------------------------------------------


def test_every_stage_that_reads_a_recording_refuses_one_that_lacks_frames(gapped, tmp_path, capsys):
    demo, out = tmp_path / "gapped.h5", tmp_path / "out"
    save_demonstration(demo, gapped)
    for stage in (
        lambda: pipeline.suggest(demo, out),
        lambda: pipeline.augment(demo, tmp_path / "none.json", out),
    ):
        with pytest.raises(InvalidInput, match=r"gapped\.h5: 12 frames are missing"):
            stage()
    with pytest.raises(SystemExit):
        main(["annotate", str(demo), "--suggest-all", "--no-window", "--out", str(out)])
    assert "gapped.h5: 12 frames are missing" in capsys.readouterr().err
    assert not out.exists()
    main(["info", str(demo)])
    assert "12 frames are missing" in capsys.readouterr().out


def test_a_demonstration_without_cameras_is_refused_by_name_wherever_images_are_needed(
    peg_demonstration, peg_annotation, make_peg_backend, tmp_path, capsys
):
    blind = with_steps(peg_demonstration, cameras={})
    demo, spheres, out = (tmp_path / name for name in ("blind.h5", "a.json", "out.mp4"))
    save_demonstration(demo, blind)
    annotation = dataclasses.replace(peg_annotation, demonstration_hash=blind.content_hash())
    save_annotation(spheres, annotation)
    data = augment_demonstration(
        blind, annotation, make_peg_backend, tmp_path / "data", AugmentConfig(n=2)
    )
    for argv, message in (
        (["suggest", demo, "--source", "cloud", "--out", out], "record it with one"),
        (["augment", demo, spheres, "--out", out], "holds no images; record it with a camera"),
        (["play", demo, "--out", out], "holds no images; record it with a camera"),
        (
            ["play", data.path / data.index[0].name, "--out", out],
            "holds no images; record it with a camera",
        ),
        (["train", data.path, "--out", out], "holds no images; record one with a camera"),
    ):
        with pytest.raises(SystemExit) as exit_:
            main([str(word) for word in argv])
        assert exit_.value.code == 2 and message in capsys.readouterr().err
    assert not out.exists() or not any(out.iterdir())
    main(["info", str(demo)])
    assert "cameras            none" in capsys.readouterr().out


def test_what_is_recorded_is_checked_before_it_is_saved(tmp_path, monkeypatch, gapped):
    monkeypatch.setattr("sart_toolkit.record.session.record_demonstration", lambda *_, **__: gapped)
    with pytest.raises(InvalidInput, match="12 frames are missing"):
        pipeline.record("peg_in_hole", tmp_path / "d.h5", image_size=32)
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_of_a_faulty_recording_is_not_trained_on(
    peg_dataset, monkeypatch, tmp_path, gapped
):
    monkeypatch.setattr(
        "sart_toolkit.data.dataset.Source.demonstration", property(lambda self: gapped)
    )
    with pytest.raises(InvalidInput, match="demo00: 12 frames are missing"):
        pipeline.train_policy(peg_dataset.path, tmp_path / "skill")
    assert list(tmp_path.iterdir()) == []
