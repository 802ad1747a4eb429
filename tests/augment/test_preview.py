"""A preview says what a generation does before anything is executed."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import pytest

from sart_toolkit import pipeline
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.preview import preview_sources
from sart_toolkit.collision.phases import BODY_STILLNESS, OUT_AND_BACK_STILLNESS
from sart_toolkit.data.sampling import SamplingConfig
from sart_toolkit.data.storage import (
    load_demonstration,
    read_json_lines,
    save_annotation,
    save_demonstration,
)
from sart_toolkit.errors import InvalidInput, OutputExists
from sart_toolkit.robots import get_robot

CONFIG = AugmentConfig(n=9, cameras=(), allocation="equal", sampling=SamplingConfig("paper"))


@pytest.fixture(scope="module")
def previewed(peg_demonstration, peg_task, crowded, tmp_path_factory):
    """Makes a preview of crowded spheres: what is said of it, and its file."""

    def previewed(workers=1, **changes):
        out = tmp_path_factory.mktemp("preview") / "plan.jsonl"
        arguments = (get_robot(peg_task.robot), peg_task.scene, 4e-4, out, CONFIG, workers)
        return preview_sources([(peg_demonstration, crowded)], *arguments, **changes), out

    return previewed


@pytest.fixture(scope="module")
def preview(previewed):
    return previewed()


def test_what_is_proved_is_what_generating_executes(
    preview, peg_demonstration, crowded, make_peg_backend, tmp_path
):
    from sart_toolkit.augment.engine import augment_demonstration

    dataset = augment_demonstration(
        peg_demonstration, crowded, make_peg_backend, tmp_path / "dataset", CONFIG
    )
    head, *rows = read_json_lines(preview[1])
    assert head["config"] == dataset.info["config"] and head["tracking_error"] == 4e-4
    assert head["sources"][0]["demonstration"] == peg_demonstration.content_hash()
    found = {(row["source"], row["sphere"], row["k"]): row for row in rows}
    for episode in dataset:
        p = episode.provenance
        row = found[p.source, p.sphere, p.k]
        assert row["outcome"] == "proved" and row["t_star"] == p.t_star
        assert row["T_world_sampled"] == p.T_world_sampled.tolist()
        # The last digits of a distance hang on what was computed before.
        drop = {"checks", "at"}
        proof = p.certificate["commanded"]
        assert {k: v for k, v in row["certificate"].items() if k not in drop} == {
            k: v for k, v in proof.items() if k not in drop
        }
        assert row["duration"] == p.certificate["duration"]
    rejected = {tuple(row[k] for k in ("source", "sphere", "k")) for row in rows
                if row["outcome"] != "proved"}  # fmt: skip
    assert rejected and rejected.isdisjoint(entry.key for entry in dataset.index)


def test_it_counts_what_each_sphere_gives_and_why_not_more(preview):
    said, out = preview
    rows = read_json_lines(out)[1:]
    assert (said.wanted, said.attempted) == (8, len(rows))
    assert said.proved == sum(row["outcome"] == "proved" for row in rows) == 8
    assert sum(said.rejections.values()) == len(rows) - 8 > 0
    assert [here["waypoint"] for here in said.by_sphere] == [15, 19]
    for i, here in enumerate(said.by_sphere):
        own = [row for row in rows if row["sphere"] == i]
        assert (here["proved"], here["attempted"]) == (here["wanted"], len(own))
        reasons = [row["outcome"] for row in own if row["outcome"] != "proved"]
        assert here["rejections"] == {
            reason: reasons.count(reason) for reason in sorted(set(reasons))
        }
    assert all(row["detail"].startswith(row["outcome"]) for row in rows if "detail" in row)


def test_two_processes_write_the_same_file(preview, previewed):
    progress = []
    said, out = previewed(workers=2, progress=lambda *counts: progress.append(counts))
    assert said == preview[0]
    assert out.read_bytes() == preview[1].read_bytes()
    assert progress[-1] == (8, 8, said.attempted - 8)


def test_no_simulator_is_loaded(tmp_path):
    code = (
        "import sys; from sart_toolkit import pipeline; from pathlib import Path; "
        "from sart_toolkit.data.assets import asset; "
        "demo = asset('peg_in_hole/demo.h5'); "
        "pipeline.preview(demo, demo.with_name('annotation.json'), Path(sys.argv[1]), n=3); "
        "bad = {'pybullet_data', 'sapien', 'torch'} & set(sys.modules); "
        "assert not bad, bad; import pybullet; assert not pybullet.isConnected(0)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "plan.jsonl")], check=True)
    assert len(read_json_lines(tmp_path / "plan.jsonl")) == 3


def test_a_file_that_is_there_is_not_replaced_unless_asked_for(
    preview, peg_demonstration, peg_task, crowded
):
    sources, robot = [(peg_demonstration, crowded)], get_robot(peg_task.robot)
    before = preview[1].read_bytes()
    with pytest.raises(OutputExists, match="already exists; add --overwrite"):
        preview_sources(sources, robot, peg_task.scene, 4e-4, preview[1], CONFIG)
    with pytest.raises(InvalidInput, match="expected more than the 9 demonstrations"):
        preview_sources(
            sources * 9, robot, peg_task.scene, 4e-4, preview[1], CONFIG, overwrite=True
        )
    assert preview[1].read_bytes() == before


def test_where_nothing_can_be_restored_the_margin_is_that_of_replays(
    peg_demonstration, crowded, tmp_path
):
    save_demonstration(tmp_path / "demo.h5", dataclasses.replace(peg_demonstration, states=()))
    demonstration = load_demonstration(tmp_path / "demo.h5")
    spheres = dataclasses.replace(crowded, demonstration_hash=demonstration.content_hash())
    save_annotation(tmp_path / "annotation.json", spheres)
    margins = []
    for execution in ("restore", "auto"):
        out = tmp_path / f"{execution}.jsonl"
        files = tmp_path / "demo.h5", tmp_path / "annotation.json"
        pipeline.preview(*files, out, n=3, execution=execution)
        head, *rows = read_json_lines(out)
        margins += [row["certificate"]["margin"] for row in rows if "certificate" in row][:1]
    assert head["config"]["execution"] == "replay"
    assert margins[1] - margins[0] == pytest.approx(OUT_AND_BACK_STILLNESS - BODY_STILLNESS)
