"""Several demonstrations: recorded, in one dataset, and what the baselines make of them."""

from __future__ import annotations

from pathlib import Path

import pytest

import sart_toolkit as sart
from sart_toolkit import pipeline
from sart_toolkit.cli import main
from sart_toolkit.data.storage import load_annotation, load_demonstration, save_annotation
from sart_toolkit.errors import InvalidInput, Mismatch, OutputExists


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two demonstrations of peg-in-hole at random placements, with suggested spheres."""
    path = tmp_path_factory.mktemp("several")
    main(
        f"record peg_in_hole --out {path / 'demos'} --count 2 --placement random "
        "--image-size 32".split()
    )
    for i in range(2):
        demo = pipeline.demonstration_path(path / "demos", i)
        pipeline.suggest(demo, path / f"spheres{i}.json")
    return path


def demos(folder: Path) -> list[Path]:
    return [pipeline.demonstration_path(folder / "demos", i) for i in range(2)]


def test_each_is_recorded_at_a_placement_of_its_own_and_kept_when_called_again(folder):
    first, second = map(load_demonstration, demos(folder))
    assert first.task_parameters["placement"] != second.task_parameters["placement"]
    assert first.seed != second.seed
    before = [path.stat().st_mtime_ns for path in demos(folder)]
    again = pipeline.record_several(
        "peg_in_hole", folder / "demos", 2, placement="random", image_size=32
    )
    assert [d.content_hash() for d in again] == [first.content_hash(), second.content_hash()]
    assert [path.stat().st_mtime_ns for path in demos(folder)] == before


def test_another_seed_is_refused_where_others_are(folder):
    with pytest.raises(OutputExists, match="holds another demonstration; add --overwrite"):
        pipeline.record_several("peg_in_hole", folder / "demos", 2, seed=1, image_size=32)
    with pytest.raises(OutputExists, match="holds another demonstration; add --overwrite"):
        pipeline.record_several("door_opening", folder / "demos", 2, image_size=32)
    with pytest.raises(InvalidInput, match="count: expected at least 1, got 0"):
        pipeline.record_several("peg_in_hole", folder / "demos", 0)


def test_each_annotation_finds_its_demonstration_in_whatever_order(folder, tmp_path, said):
    a, b = demos(folder)
    words = ["--n", 6, "--distribution", "area"]
    first = said("augment", a, folder / "spheres0.json", b, folder / "spheres1.json",
        "--out", tmp_path / "x", *words,
    )  # fmt: skip
    second = said("augment", folder / "spheres1.json", folder / "spheres0.json", a, b,
        "--out", tmp_path / "y", *words,
    )  # fmt: skip
    assert first["content_hash"] == second["content_hash"]
    assert (first["n_trajectories"], first["n_kept"]) == (6, 4)
    dataset = sart.load_dataset(tmp_path / "x")
    for source in dataset.sources:
        source.annotation.check_matches(source.demonstration)
    assert said("validate", tmp_path / "x")["episodes"] == 4


def test_files_that_do_not_belong_together_are_refused(folder, tmp_path, refused):
    a, b = demos(folder)
    out = ["--out", tmp_path / "x"]
    line = refused("augment", a, folder / "spheres1.json", *out)
    assert "annotation was made for another demonstration" in line
    line = refused("augment", a, b, folder / "spheres0.json", *out)
    assert "the demonstration has none; make one with `sart suggest`" in line
    line = refused("augment", a, a, folder / "spheres0.json", *out)
    assert "the same demonstration is given twice" in line
    save_annotation(tmp_path / "again.json", load_annotation(folder / "spheres0.json"))
    line = refused("augment", a, folder / "spheres0.json", tmp_path / "again.json", *out)
    assert "a second annotation of one demonstration" in line
    line = refused("augment", folder / "spheres0.json", *out)
    assert "expected a demonstration, got annotations alone" in line
    line = refused("augment", a, b, *out, "--strategy", "bc", "--n", 3)
    assert "so expected the number of demonstrations (2), got 3" in line
    assert not (tmp_path / "x").exists()


def test_scenes_that_look_different_are_refused_where_segments_are_seen(folder, tmp_path):
    varied = tmp_path / "varied.h5"
    pipeline.record("peg_in_hole", varied, vary_appearance=True, image_size=32, seed=4)
    pipeline.suggest(varied, tmp_path / "varied.json")
    both = [demos(folder)[0], varied]
    annotations = [folder / "spheres0.json", tmp_path / "varied.json"]
    with pytest.raises(Mismatch, match="scenes look different"):
        pipeline.augment(both, annotations, tmp_path / "x", n=4)
    assert len(pipeline.augment(both, [], tmp_path / "bc", strategy="bc").sources) == 2


@pytest.mark.parametrize(
    ("words", "policy", "trajectories", "stages"),
    [
        (["--strategy", "bc", "--n", 2], "compact_mlp", 2, {"record", "augment", "train"}),
        (["--strategy", "replay"], "replay", 1, {"record", "augment", "train"}),
        # It has spheres of its own: none are suggested.
        (["--strategy", "miles", "--n", 4], "compact_mlp", 4, {"record", "augment", "train"}),
        (
            ["--demonstrations", 2, "--n", 5],
            "compact_mlp",
            5,
            {"record", "suggest", "augment", "train"},
        ),
    ],
)
def test_a_run_records_what_its_strategy_needs(words, policy, trajectories, stages, tmp_path, said):
    command = [
        "run", "peg_in_hole", "--out", tmp_path / "run", "--image-size", 32, "--epochs", 1,
        "--episodes", 1, "--workers", 1, *words,
    ]  # fmt: skip
    result = said(*command)
    assert set(result["stages_seconds"]) == stages | {"evaluate"}
    assert (tmp_path / "run" / "report.html").exists()
    dataset = sart.load_dataset(tmp_path / "run" / "dataset")
    assert dataset.info["n_trajectories"] == trajectories
    assert dataset.info["policy"] == policy
    skill = sart.load_skill(tmp_path / "run" / "skill")
    assert skill.config.training.policy == policy
    # Typed again it finds all done.
    assert said(*command)["success"] == result["success"]


def test_numbers_that_do_not_fit_are_refused_before_anything_is_written(tmp_path):
    for options, message in (
        ({"strategy": "replay", "n": 3, "demonstrations": 2}, "3, as trajectories, got 2"),
        ({"n": 3, "demonstrations": 3}, "fewer than the 3 trajectories, got 3"),
        ({"demonstrations": 0}, "at least 1, and fewer than the 40"),
    ):
        with pytest.raises(InvalidInput, match=message):
            pipeline.run("peg_in_hole", tmp_path / "run", **options)
    assert not (tmp_path / "run" / "run.json").exists()
