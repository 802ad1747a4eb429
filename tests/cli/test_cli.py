"""The command line: verbs do their work; bad input is one line, code 2, and nothing replaced."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sart_toolkit import pipeline
from sart_toolkit.backends import BACKENDS
from sart_toolkit.cli import main
from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.records import Demonstration
from sart_toolkit.data.storage import load_demonstration, read_json_lines
from sart_toolkit.doctor import Finding, source_commit
from sart_toolkit.robots import get_robot
from sart_toolkit.scenes.appearance import Appearance, AppearanceConfig
from sart_toolkit.tasks import TASKS, get_task


def run(capsys: pytest.CaptureFixture[str], *argv: object) -> dict[str, Any]:
    """The JSON result of a verb that should succeed."""
    capsys.readouterr()
    main([*map(str, argv), "--json"])
    # PyBullet greets on stdout when it is first imported; our result is the last line.
    result: dict[str, Any] = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    return result


def error(capsys: pytest.CaptureFixture[str], *argv: object) -> str:
    """The one line on stderr of a verb that should fail with code 2."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit_:
        main([str(a) for a in argv])
    assert exit_.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("sart: error: ")
    return lines[0]


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with what `record`, `suggest` and `augment` leave."""
    out = tmp_path_factory.mktemp("chain")
    main(["record", "peg_in_hole", "--out", f"{out}/demo.h5", "--image-size", "32"])
    main(["suggest", f"{out}/demo.h5", "--out", f"{out}/annotation.json"])
    main(
        ["augment", f"{out}/demo.h5", f"{out}/annotation.json", "--out", f"{out}/data", "--n", "5"]
    )
    return out


@pytest.fixture
def _short_rollouts(monkeypatch: pytest.MonkeyPatch) -> None:
    """What has learned next to nothing need not err for long."""
    for name in TASKS:
        monkeypatch.setattr(type(get_task(name)), "horizon", 1.5)


@pytest.mark.usefixtures("_short_rollouts")
def test_whole_run_leaves_every_result_and_resumes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    argv = ["run", "peg_in_hole", "--out", out, "--n", 5, "--episodes", 1, "--epochs", 1]
    argv += ["--image-size", 48, "--workers", 1]
    first = run(capsys, *argv)
    for name in ("demo.h5", "annotation.json", "dataset", "skill", "evaluation.json"):
        assert (out / name).exists(), name
    page = (out / "report.html").read_text()
    assert "peg_in_hole" in page and "<video" in page
    assert 'data-layer="robot"' in page and "Robot and scene are not shown" not in page
    assert json.loads((out / "run.json").read_text())["commit"] == source_commit()
    evaluation = json.loads((out / "evaluation.json").read_text())
    needed = {"task", "backend", "n_episodes", "n_success", "success_rate", "ci95", "seeds"}
    assert needed | {"policy", "seconds"} <= set(evaluation)
    assert evaluation["n_episodes"] == 1
    assert first["kept"] == 4

    stamps = {p: p.stat().st_mtime_ns for p in out.rglob("*.h5")}
    (out / "evaluation.json").unlink()
    again = run(capsys, *argv)
    assert again["success"] == first["success"]
    assert stamps == {p: p.stat().st_mtime_ns for p in out.rglob("*.h5")}

    assert "another n" in error(capsys, *argv[:4], "--n", 6)
    (out / "report.html").unlink()
    assert run(capsys, "report", out)["report"] == str(out / "report.html")
    assert "peg_in_hole" in (out / "report.html").read_text()
    run(capsys, "report", out, "--out", out / "again.html")
    assert "already exists" in error(capsys, "report", out, "--out", out / "again.html")
    assert run(capsys, "info", out)["kind"] == "run"
    assert run(capsys, "info", out / "skill")["policy"] == "compact_mlp"
    config = out / "skill" / "config.json"
    config.write_text(config.read_text().replace('"policy"', '"polity"'))
    said = error(capsys, "info", out / "skill")
    assert "config.json: content differs from its hash" in said


def test_same_seed_gives_the_same_bytes(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = run(capsys, "info", chain / "data")["content_hash"]
    argv = ["augment", chain / "demo.h5", chain / "annotation.json", "--n", 5]
    assert run(capsys, *argv, "--out", tmp_path / "two", "--workers", 2)["content_hash"] == before
    other = run(capsys, *argv, "--out", tmp_path / "other", "--seed", 1)["content_hash"]
    assert other != before


def test_a_dry_run_writes_what_would_be_executed(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan.jsonl"
    argv = ["augment", chain / "demo.h5", chain / "annotation.json", "--n", 5, "--dry-run"]
    result = run(capsys, *argv, "--out", plan)
    assert result["wanted"] == result["proved"] == 4 and result["plan"] == str(plan)
    proved = [row for row in read_json_lines(plan)[1:] if row["outcome"] == "proved"]
    index = load_dataset(chain / "data").index
    assert [row["certificate"]["clearance"] for row in proved] == [e.clearance for e in index]
    assert "already exists" in error(capsys, *argv, "--out", plan)


def test_datasets_merge_split_and_are_trained_on(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["augment", chain / "demo.h5", chain / "annotation.json", "--n", 4, "--seed", 1]
    run(capsys, *argv, "--out", tmp_path / "other")
    merged = run(capsys, "merge", chain / "data", tmp_path / "other", "--out", tmp_path / "both")
    assert (merged["n_kept"], merged["n_trajectories"]) == (7, 8)
    assert run(capsys, "validate", tmp_path / "both")["episodes"] == 7
    words = ["split", tmp_path / "both", "--out", tmp_path / "parts"]
    parts = run(capsys, *words, "--parts", "train=0.7,validation=0.3")
    train, validation = tmp_path / "parts" / "train", tmp_path / "parts" / "validation"
    assert {name: part["n_kept"] for name, part in parts.items()} == {
        str(train): 5, str(validation): 2,
    }  # fmt: skip
    learned = run(
        capsys, "train", train, "--out", tmp_path / "skill", "--epochs", 1, "--image-size", 32
    )
    assert learned["trajectories"] == 6
    short = run(capsys, *words[:2], "--out", tmp_path / "short", "--n", 3)
    assert short[str(tmp_path / "short")]["n_trajectories"] == 3
    assert len(run(capsys, *words[:2], "--out", tmp_path / "each", "--by-source")) == 2
    for wrong, message in (
        ([], "expected one of parts, n and by_source; give just one"),
        (["--n", 3, "--by-source"], "give just one"),
        (["--parts", "a=0.5,b"], "such as train=0.8,validation=0.2, got 'b'"),
        (["--parts", "a=0.5,a=0.1"], "a name is there twice"),
    ):
        assert message in error(capsys, *words, *wrong)


def test_info_tells_each_kind_of_file(chain: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kinds = {
        "demo.h5": "demonstration",
        "annotation.json": "annotation",
        "data": "dataset",
        "data/episodes/demo00/sphere00_k00000.h5": "episode",
    }
    for name, kind in kinds.items():
        said = run(capsys, "info", chain / name)
        assert said["kind"] == kind and said["hash_checked"]
    said = run(capsys, "info", chain / "demo.h5")
    assert "seconds_spent" not in said, "no person spent any"
    assert said["success"] is True and said["goal_held_seconds"] >= 1.0
    main(["info", str(chain / "demo.h5")])
    assert "peg_in_hole" in capsys.readouterr().out
    assert "no run, skill or dataset" in error(capsys, "info", chain)
    torn = chain / "torn.h5"
    torn.write_bytes((chain / "demo.h5").read_bytes()[:1000])
    assert "torn.h5: truncated" in error(capsys, "info", torn)
    torn.unlink()
    assert "neither an annotation" in error(capsys, "info", chain / "data" / "dataset.json")


def test_missing_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nowhere = tmp_path / "nowhere.h5"
    for argv in (
        ["suggest", nowhere, "--out", tmp_path / "a.json"],
        ["augment", nowhere, nowhere, "--out", tmp_path / "d"],
        ["validate", nowhere],
        ["train", nowhere, "--out", tmp_path / "s"],
        ["evaluate", nowhere, "--out", tmp_path / "e.json"],
        ["info", nowhere],
    ):
        assert "nowhere.h5: no such" in error(capsys, *argv)
    assert list(tmp_path.iterdir()) == []


def test_validate_proves_a_dataset_again_and_names_what_does_not_hold(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = run(capsys, "validate", chain / "data")
    assert found["episodes"] == 4
    assert 0 < found["least_measured_clearance_mm"] < 100
    assert 0.2 <= found["least_commanded_clearance_mm"] < 100
    stated = run(capsys, "info", chain / "data")["least_commanded_clearance_mm"]
    assert found["least_commanded_clearance_mm"] == pytest.approx(stated, abs=0.011)
    assert 0 < found["largest_deviation_mm"] < 5
    broken = shutil.copytree(chain / "data", tmp_path / "data")
    episode = sorted(broken.glob("episodes/*/*.h5"))[0]
    episode.write_bytes(episode.read_bytes()[:2000])
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit_:
        main(["validate", str(broken)])
    assert exit_.value.code == 2
    said = capsys.readouterr().err
    assert f"{episode.name}: " in said and "truncated" in said
    assert "1 of 4 episodes don't hold; generate them again" in said
    (broken / "dataset.json").unlink()
    assert "interrupted while it was made" in error(capsys, "validate", broken)


def test_validate_executes_trajectories_to_the_goal_if_it_is_asked_to(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = shutil.copytree(chain / "data", tmp_path / "data")
    for flag, value in (("--workers", "2"), ("--overwrite", None), ("--backend", "pybullet")):
        argv = ["validate", data, flag, *([value] if value else [])]
        assert f"{flag}: is about executing the trajectories; add" in error(capsys, *argv)
    assert not (data / "replay.json").exists()
    found = run(capsys, "validate", data, "--replay", "--workers", 2)
    assert found["succeeded"] == "4 of 4" and found["failures"] == {}
    assert 0 < found["largest_difference_mm"] < 20
    assert "replay.json: already exists; add --overwrite" in error(
        capsys, "validate", data, "--replay"
    )


def test_augment_follows_the_demonstration_if_it_is_asked_to_and_counts_resets(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["augment", chain / "demo.h5", chain / "annotation.json", "--n", 3]
    options = ["--execution", "replay", "--recording", "return"]
    found = run(capsys, *argv, "--out", tmp_path / "d", *options)
    assert (found["n_kept"], found["resets"]) == (2, 1)
    assert run(capsys, "validate", tmp_path / "d")["episodes"] == 2
    assert "executor 'rplay': did you mean 'replay'" in error(
        capsys, *argv, "--out", tmp_path / "e", "--execution", "rplay"
    )


def test_a_person_at_the_terminal_is_told_what_to_do_and_waited_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    waited: list[str] = []
    monkeypatch.setattr("builtins.input", lambda prompt: waited.append(prompt) or "")
    asked: list[Any] = []
    monkeypatch.setattr(pipeline, "augment", lambda *_, ask, **__: asked.append(ask))
    monkeypatch.setattr("sart_toolkit.cli.augment.describe_dataset", lambda _: {})
    for terminal in (True, False):
        monkeypatch.setattr(sys.stdin, "isatty", lambda answer=terminal: answer)
        main(["augment", "demo.h5", "--out", "d"])
    assert asked[1] is None
    asked[0]("Put the scene back")
    assert "Put the scene back" in capsys.readouterr().err and len(waited) == 1


def test_radii_are_suggested_from_the_recorded_images_alone(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["suggest", chain / "demo.h5", "--source", "cloud"]
    behind = run(capsys, *argv, "--out", tmp_path / "behind.json")["spheres"]
    free = run(capsys, *argv, "--out", tmp_path / "free.json", "--unknown", "free")["spheres"]
    assert all("cloud" in sphere["limited_by"] for sphere in behind)
    assert len(free) >= len(behind) >= 1
    run(
        capsys, "augment", chain / "demo.h5", tmp_path / "behind.json", "--out", tmp_path / "d",
        "--n", 3,
    )  # fmt: skip
    assert run(capsys, "validate", tmp_path / "d")["episodes"] == 2


def test_truncated_demonstration_is_refused_and_nothing_replaced(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (chain / "demo.h5").read_bytes()
    cut = tmp_path / "cut.h5"
    cut.write_bytes(whole[: len(whole) // 2])
    target = tmp_path / "a.json"
    target.write_text("mine")
    assert "truncated" in error(capsys, "suggest", cut, "--out", target, "--overwrite")
    assert target.read_text() == "mine"


def test_annotation_of_another_demonstration_is_refused(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.h5"
    run(capsys, "record", "peg_in_hole", "--out", other, "--seed", 9, "--image-size", 32)
    said = error(capsys, "augment", other, chain / "annotation.json", "--out", tmp_path / "d")
    assert "made for another demonstration" in said
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize("radius", [0.0, -0.01, math.nan, math.inf])
def test_impossible_radius_is_refused(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], radius: float
) -> None:
    value = json.loads((chain / "annotation.json").read_text())
    value["spheres"][0]["radius_m"] = radius
    edited = tmp_path / "edited.json"
    edited.write_text(json.dumps(value))
    said = error(capsys, "augment", chain / "demo.h5", edited, "--out", tmp_path / "d")
    expected = "radius of the sphere at waypoint 0: expected a finite number > 0"
    assert (expected if math.isfinite(radius) else "edited.json: not readable as JSON") in said
    assert not (tmp_path / "d").exists()


def test_poses_out_of_reach_are_counted_and_end_in_an_error(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    value = json.loads((chain / "annotation.json").read_text())
    value["spheres"] = [{**value["spheres"][0], "radius_m": 3.0, "source": "human"}]
    edited = tmp_path / "edited.json"
    edited.write_text(json.dumps(value))
    said = error(capsys, "augment", chain / "demo.h5", edited, "--out", tmp_path / "d", "--n", 2)
    assert "none of 20 attempts" in said and "out of reach: 20" in said and "smaller radii" in said


def test_unknown_names_offer_the_nearest_and_leave_nothing(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x"
    said = error(capsys, "run", "peg_in_hol", "--out", out)
    assert "unknown task 'peg_in_hol': did you mean 'peg_in_hole'?" in said
    said = error(capsys, "record", "peg_in_hole", "--out", out, "--backend", "pybulet")
    assert "did you mean 'pybullet'" in said
    said = error(capsys, "record", "peg_in_hole", "--out", out, "--robot", "ur5")
    assert "unknown robot 'ur5': did you mean 'ur5e_2f85'?" in said
    said = error(capsys, "record", "peg_in_hole", "--out", out, "--image-size", 8)
    assert "image_size: expected at least 16 pixels, got 8" in said
    said = error(capsys, "train", chain / "data", "--out", out, "--policy", "compact")
    assert "did you mean 'compact_mlp'" in said
    said = error(capsys, "train", chain / "data", "--out", out, "--cameras", "wrist,overwiev")
    assert "unknown camera 'overwiev'" in said
    said = error(
        capsys, "augment", chain / "demo.h5", chain / "annotation.json", "--out", out,
        "--strategy", "sert",
    )  # fmt: skip
    assert "did you mean 'sart'" in said
    assert not out.exists()


def test_what_is_there_is_not_replaced_without_overwrite(
    chain: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (chain / "demo.h5").read_bytes()
    said = error(capsys, "record", "peg_in_hole", "--out", chain / "demo.h5")
    assert "already exists; add --overwrite" in said
    assert (chain / "demo.h5").read_bytes() == before
    argv = ["augment", chain / "demo.h5", chain / "annotation.json", "--out", chain / "data"]
    assert "made with other settings" in error(capsys, *argv, "--n", 7)


def test_no_permission_is_one_line(chain: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Not even root may create files there.
    said = error(capsys, "suggest", chain / "demo.h5", "--out", "/proc/sart/annotation.json")
    assert "/proc/sart/annotation.json: " in said
    # A file where a directory should be.
    said = error(capsys, "record", "peg_in_hole", "--out", chain / "demo.h5" / "x.h5")
    assert "choose another --out" in said


def test_overwrite_of_a_directory_that_is_no_run_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    said = error(capsys, "run", "peg_in_hole", "--out", tmp_path, "--overwrite")
    assert "holds other things (no run.json)" in said
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


@pytest.mark.parametrize(
    ("flag", "value", "message"),
    [
        ("--n", "1", "n: expected at least 2"),
        ("--seed", "-1", "seed: expected a whole number >= 0"),
        ("--duration", "0", "duration: expected a finite number > 0"),
        ("--rotation-per-metre", "nan", "rotation_per_metre: expected a finite number >= 0"),
        ("--workers", "0", "workers: expected at least 1"),
    ],
)
def test_impossible_options_are_refused(
    chain: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    flag: str,
    value: str,
    message: str,
) -> None:
    argv = ["augment", chain / "demo.h5", chain / "annotation.json", "--out", tmp_path / "d"]
    assert message in error(capsys, *argv, flag, value)


def test_interruption_says_how_to_go_on(
    chain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sart_toolkit.annotate.suggest.suggest_annotation", interrupted)
    with pytest.raises(SystemExit) as exit_:
        main(["suggest", str(chain / "demo.h5"), "--out", str(tmp_path / "a.json")])
    assert exit_.value.code == 130
    assert "type the same command again" in capsys.readouterr().err
    assert not (tmp_path / "a.json").exists()


def test_a_demonstration_that_fails_is_not_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sart_toolkit.tasks.peg_in_hole.PegInHole.success", lambda *_: False)
    argv = ["record", "peg_in_hole", "--out", tmp_path / "d.h5", "--image-size", 32]
    assert "did not reach the goal" in error(capsys, *argv)
    assert list(tmp_path.iterdir()) == []


def test_several_cameras_and_rectangular_images_are_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["record", "peg_in_hole", "--out", tmp_path / "d.h5", "--image-size", "48x32"]
    said = run(capsys, *argv, "--cameras", "wrist,overview")
    assert said["cameras"] == {"wrist": "48x32", "overview": "48x32"}
    assert "unknown camera 'top'" in error(capsys, *argv, "--overwrite", "--cameras", "wrist,top")


def test_placement_can_be_random(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "d.h5"
    argv = ["record", "peg_in_hole", "--out", out, "--placement", "random", "--image-size", 32]
    said = run(capsys, *argv)
    placement = load_demonstration(out).task_parameters["placement"]
    assert said["placement"] == placement
    assert placement["x"] != 0.0 and abs(placement["x"]) <= 0.05


def test_yaw_and_appearance_vary_only_where_asked_for(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["record", "peg_in_hole", "--image-size", 32, "--out"]
    assert "add --placement random" in error(capsys, *argv, tmp_path / "a.h5", "--yaw-deg", 5)
    turn = ("--placement", "random", "--yaw-deg", 15)
    assert run(capsys, *argv, tmp_path / "b.h5", *turn)["placement"]["yaw_deg"] != 0.0
    assert "can be turned by 0 to" in error(
        capsys, *argv, tmp_path / "c.h5", "--placement", "random", "--yaw-deg", 90
    )
    run(capsys, *argv, tmp_path / "d.h5", "--vary-appearance")
    plain, varied = (load_demonstration(p) for p in (chain / "demo.h5", tmp_path / "d.h5"))
    assert (plain.raw_commands == varied.raw_commands).all()
    images = [d.steps.cameras["wrist"].rgb[0].astype(int) for d in (plain, varied)]
    assert abs(images[0] - images[1]).mean() > 2
    assert "appearance" not in plain.task_parameters


def test_what_was_recorded_with_varied_appearance_is_augmented_alike_and_trained_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    demo, spheres, data = (tmp_path / name for name in ("d.h5", "a.json", "data"))
    run(
        capsys, "record", "peg_in_hole", "--vary-appearance", "--image-size", 32, "--out", demo,
        "--seed", 4,
    )  # fmt: skip
    assert run(capsys, "info", demo)["varied_appearance"] is True
    run(capsys, "suggest", demo, "--out", spheres)
    run(capsys, "augment", demo, spheres, "--out", data, "--n", 4)
    dataset = load_dataset(data)
    recorded = load_demonstration(demo).steps.cameras["wrist"]
    episode = dataset.episode(0).steps.cameras["wrist"]
    np.testing.assert_allclose(episode.T_frame_camera, recorded.T_frame_camera, atol=1e-6)
    # A corner that shows the table throughout.
    colours = [images.rgb[:, -1, 0].mean(0) for images in (recorded, episode)]
    np.testing.assert_allclose(colours[0], colours[1], atol=6)
    said = run(capsys, "train", data, "--out", tmp_path / "skill", "--epochs", 1, "--device", "cpu")
    assert said["trajectories"] == 4


def test_a_recording_s_backend_looks_as_it_did(peg_demonstration: Demonstration) -> None:
    task = get_task("peg_in_hole")
    plain = get_robot(task.robot), task.scene
    appearance = Appearance((4, 1), AppearanceConfig(light=0.4))
    for parameters, expected in (({}, plain), ({"appearance": appearance.to_json()},
                                               appearance.applied(*plain))):  # fmt: skip
        demonstration = dataclasses.replace(
            peg_demonstration, task_parameters={**peg_demonstration.task_parameters, **parameters}
        )
        made = pipeline.backend_maker(demonstration, (32, 32)).args
        assert repr(made[1:3]) == repr(expected)
    assert repr(appearance.applied(*plain)) != repr(plain)


def test_another_backend_than_the_demonstration_s_is_refused_at_once(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["augment", chain / "demo.h5", chain / "annotation.json", "--out", tmp_path / "d"]
    said = error(capsys, *argv, "--backend", "sapien")
    assert "backend 'sapien': can't restore the states that backend 'pybullet' has saved" in said
    assert "augment on 'pybullet', or record a demonstration on 'sapien'" in said
    assert not (tmp_path / "d").exists()


def test_the_operator_benchmark_prints_a_rate_for_each_task_and_backend(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "operator.json"
    argv = ["benchmark", "operator", "--backends", "pybullet", "--episodes", 1, "--workers", 1]
    argv += ["--tasks", "peg_in_hole,lid_closing"]
    said = run(capsys, *argv, "--out", out)
    assert set(said) == {"benchmark", "peg_in_hole/pybullet", "lid_closing/pybullet"}
    assert said["lid_closing/pybullet"].startswith("1/1 (95 % interval 21 to 100 %)")
    assert "already exists" in error(capsys, *argv, "--out", out)
    assert "did you mean 'lid_closing'" in error(capsys, *argv[:-1], "lid_closin", "--out", out)
    assert "unknown backend 'bullet'" in error(capsys, *argv[:2], "--backends", "bullet")


def test_the_replay_benchmark_compares_backends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "replay.json"
    said = run(capsys, "benchmark", "replay", "--tasks", "bottle_placing", "--out", out)
    assert "success, 0.0" in said["bottle_placing: pybullet to sapien"]
    assert "success, 0.0" in said["bottle_placing: sapien to pybullet"]
    assert len(json.loads(out.read_text())["replays"]) == 2


@pytest.mark.slow
@pytest.mark.usefixtures("_short_rollouts")
@pytest.mark.slow
def test_every_task_runs_from_demonstration_to_report_on_every_backend(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["benchmark", "skill", "--out", tmp_path / "runs", "--n", 4, "--epochs", 1]
    argv += ["--episodes", 1, "--workers", 1]
    said = run(capsys, *argv)
    assert len(said) == 1 + len(TASKS) * len(BACKENDS)
    for task in TASKS:
        for backend in BACKENDS:
            assert (tmp_path / "runs" / f"{task}-{backend}" / "report.html").exists()
            assert "/1 (95 % interval" in said[f"{task}/{backend}"]
    cells = json.loads((tmp_path / "runs" / "benchmark.json").read_text())["cells"]
    assert {cell["kept"] for cell in cells.values()} == {3}


def test_a_library_that_does_not_load_leads_to_the_doctor_who_needs_none(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("sart_toolkit.cli.info", "pinocchio"):
        monkeypatch.setitem(sys.modules, name, None)
    assert "`sart doctor` says what is missing" in error(capsys, "info", "x")

    broken = Finding("kinematics", False, "libgomp.so.1 is missing", "install it", required=True)
    monkeypatch.setattr("sart_toolkit.doctor.diagnose", lambda full: [broken])
    with pytest.raises(SystemExit) as exit_:
        main(["doctor"])
    assert exit_.value.code == 1
    assert (
        "FAIL kinematics  libgomp.so.1 is missing\n      -> install it" in capsys.readouterr().out
    )
    with pytest.raises(SystemExit):
        main(["doctor", "--json"])
    said = json.loads(capsys.readouterr().out)
    assert said["usable"] is False and said["findings"][0]["remedy"] == "install it"


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--workers", "2"], "--workers: a single training takes one process; add --seeds"),
        (["--executor", "ray"], "--workers: a single training takes one process; add --seeds"),
        (["--seeds", "0,x"], "--seeds: expected whole numbers separated by commas, got '0,x'"),
        (["--seeds", "0,1", "--seed", "0"], "--seed: is for a single training"),
        (["--seeds", "0,0"], "seeds: expected different whole numbers >= 0"),
        (["--seeds", "0", "--ray-address", "auto"], "ray_address: is for the executor 'ray'"),
    ],
)
def test_flags_of_training_that_do_not_fit_are_refused(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], argv: list[str], message: str
) -> None:
    assert message in error(capsys, "train", chain / "data", "--out", tmp_path / "s", *argv)
    assert not (tmp_path / "s").exists()


def test_a_training_for_each_seed_leaves_skills_and_a_table(
    chain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["train", chain / "data", "--out", tmp_path / "s", "--seeds", "2,5", "--epochs", 1]
    argv += ["--image-size", 32, "--device", "cpu"]
    said = run(capsys, *argv)
    assert list(said) == ["table", *(str(tmp_path / "s" / f"seed{seed}") for seed in (2, 5))]
    table = json.loads(Path(said["table"]).read_text())
    assert [row["seed"] for row in table["skills"]] == [2, 5]
    assert run(capsys, "info", tmp_path / "s" / "seed5")["kind"] == "skill"
    assert "already exists" in error(capsys, *argv)
