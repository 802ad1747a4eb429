"""A dataset that was tampered with is reported, whatever was changed in it."""

import dataclasses
import json
import re
import shutil

import numpy as np
import pytest

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.augment.validate import validate_dataset
from sart_toolkit.data.combine import merge_datasets, split_dataset
from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.manifest import Manifest
from sart_toolkit.data.records import Steps
from sart_toolkit.data.storage import (
    append_json_line,
    load_episode,
    read_json_lines,
    save_episode,
    with_seal,
)
from sart_toolkit.errors import BrokenFile, Mismatch, MissingFile


@pytest.fixture(scope="module")
def made(peg_demonstration, peg_annotation, make_peg_backend, tmp_path_factory):
    out = tmp_path_factory.mktemp("validate") / "dataset"
    augment_demonstration(
        peg_demonstration, peg_annotation, make_peg_backend, out, AugmentConfig(n=4)
    )
    return out


@pytest.fixture
def copy(made, tmp_path):
    return shutil.copytree(made, tmp_path / "dataset")


@pytest.fixture
def validate(peg_model, peg_task):
    return lambda path, **options: validate_dataset(path, peg_model.spec, peg_task.scene, **options)


def rewrite(path, changes):
    """Change top-level keys of a JSON file of ours and make its hash fit; None removes one."""
    value = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps(with_seal({k: v for k, v in value.items() if v is not None})))


def change(path, index=0, **changes):
    """Change an episode and write it with hashes that fit."""
    name = load_dataset(path).index[index].name
    episode = load_episode(path / name)
    changed = dataclasses.replace(episode, **changes)
    save_episode(path / name, changed)
    manifest = path / "manifest.jsonl"
    old, new = episode.content_hash(), changed.content_hash()
    relist(
        path,
        [
            row | ({"content_hash": new} if old in row.values() else {})
            for row in read_json_lines(manifest)
        ],
    )
    return name


def relist(path, rows):
    """Write other rows to a dataset's manifest, with hashes that fit."""
    manifest = path / "manifest.jsonl"
    manifest.unlink()
    for row in rows:
        append_json_line(manifest, row)
    found = Manifest.from_rows(manifest, read_json_lines(manifest))
    hashes = {"content_hash": found.content_hash(), "manifest_hash": found.whole_hash()}
    rewrite(path / "dataset.json", hashes)


def with_steps(episode, **changes):
    fields = {f.name: getattr(episode.steps, f.name) for f in dataclasses.fields(Steps)}
    return Steps(**{**fields, **changes})


def test_what_was_generated_holds(made, validate):
    seen = []
    found = validate(made, progress=lambda done, wanted: seen.append((done, wanted)))
    assert not found.problems
    assert found.episodes == 3 and seen == [(1, 3), (2, 3), (3, 3)]
    proofs = [e.provenance.certificate for e in load_dataset(made)]
    for which in ("commanded", "measured"):
        stated = min(p[which]["clearance"] for p in proofs)
        found_least = getattr(found, f"least_{which}_clearance")
        assert found_least == pytest.approx(stated, abs=1.1e-5)
    assert found.least_commanded_clearance != found.least_measured_clearance
    assert found.largest_deviation == pytest.approx(max(p["deviation"] for p in proofs), abs=2e-6)


def test_a_truncated_episode_and_a_missing_one_are_reported_and_the_others_still_checked(
    copy, validate
):
    torn, missing, _ = (entry.name for entry in load_dataset(copy).index)
    (copy / torn).write_bytes((copy / torn).read_bytes()[:3000])
    (copy / missing).unlink()
    found = validate(copy)
    assert set(found.problems) == {torn, missing}
    assert "truncated or not a episode" in found.problems[torn]
    assert "no such file" in found.problems[missing]


def test_a_flipped_bit_is_reported_by_the_hash(copy, validate):
    name = load_dataset(copy).index[0].name
    file = copy / name
    content = bytearray(file.read_bytes())
    at = content.find(load_episode(file).joint_path.tobytes())
    content[at + 800] ^= 1
    file.write_bytes(content)
    assert "content differs from its hash" in validate(copy).problems[name]


def test_an_episode_exchanged_for_a_good_one_is_reported_by_the_index(copy, validate):
    good, exchanged, _ = (entry.name for entry in load_dataset(copy).index)
    shutil.copy(copy / good, copy / exchanged)
    assert "content differs from its hash" in validate(copy).problems[exchanged]


def provenance(**changes):
    return lambda episode: {"provenance": dataclasses.replace(episode.provenance, **changes)}


def certificate(which, **changes):
    def change(episode):
        proof = episode.provenance.certificate
        return provenance(certificate={**proof, which: {**proof[which], **changes}})(episode)

    return change


def stated(**changes):
    def change(episode):
        return provenance(certificate={**episode.provenance.certificate, **changes})(episode)

    return change


def moved_path(episode):
    path = np.array(episode.joint_path)
    path[200:240] += 0.01
    return {"joint_path": path}


def folded_path(episode):
    path = np.array(episode.joint_path)
    path[200] = [0.0, 0.3, 2.6, 0.0, 0.0, 0.0]
    return {"joint_path": path}


def steps(**changes):
    return lambda episode: {
        "steps": with_steps(
            episode, **{k: v(getattr(episode.steps, k)) for k, v in changes.items()}
        )
    }


@pytest.mark.parametrize(
    ("tamper", "message"),
    [
        (provenance(k=17), "it is of another attempt than the index says"),
        (provenance(seed=5), "another seed, strategy, distribution or recording"),
        (provenance(recording="return"), "another seed, strategy, distribution or recording"),
        (provenance(t_star=3), "lead to another pose or waypoint"),
        (provenance(demonstration_hash="0" * 64), "was generated from another demonstration"),
        (provenance(certificate=None), "certificate: there is none"),
        (certificate("commanded", clearance=0.2), "commanded path is proved .* 200.000 mm are"),
        (certificate("measured", clearance=0.2), "measured path is proved .* 200.000 mm are"),
        (certificate("commanded", verdict="collision"), "is free, collision is stated"),
        (certificate("commanded", margin=0.0), "commanded path is proved"),
        (stated(tracking_error=0.0003), "commanded path is proved"),
        (stated(tracking_error="none"), "tracking_error: expected a length >= 0 m, got 'none'"),
        (stated(deviation=-0.001), "deviation: expected a length >= 0 m, got -0.001"),
        (stated(body_stillness=0.0), "proved for bodies that move by less than 0.1 mm"),
        (certificate("measured", margin=0.0), "measured path is proved"),
        (certificate("commanded", nonsense=1), "certificate: a field is missing or unknown"),
        (moved_path, r"measured path is (proved|\d+\.\d+ mm off)"),
        (folded_path, "the measured path is collision, free is stated"),
        (lambda e: {"joint_path": e.joint_path[::-1]}, "measured joints aren't the measured path"),
        (steps(commanded_joint_positions=lambda q: q[::-1]), "commanded joints aren't the planned"),
        (steps(commanded_Ts_world_tool=lambda T: T[::-1]), "commanded poses aren't the planned"),
        (steps(measured_Ts_world_tool=lambda T: T[::-1]), "poses and joints don't belong together"),
    ],
)
def test_whatever_is_changed_is_reported_though_all_hashes_fit(copy, validate, tamper, message):
    name = change(copy, **tamper(load_dataset(copy).episode(0)))
    assert re.search(message, validate(copy).problems[name])


def test_a_return_whose_measured_steps_are_not_those_of_its_measured_path_is_reported(
    peg_demonstration, peg_annotation, make_peg_backend, validate, tmp_path
):
    out, config = tmp_path / "dataset", AugmentConfig(n=2, recording="return")
    dataset = augment_demonstration(
        peg_demonstration, peg_annotation, make_peg_backend, out, config
    )
    q = np.array(dataset.episode(0).steps.joint_positions)
    q[5] += 1e-4
    name = change(out, steps=with_steps(dataset.episode(0), joint_positions=q))
    assert "measured joints aren't those of the measured path" in validate(out).problems[name]


def test_an_episode_with_a_step_too_few_is_reported(copy, validate):
    episode = load_dataset(copy).episode(0)
    shorter = {
        f.name: getattr(episode.steps, f.name)[1:]
        for f in dataclasses.fields(Steps)
        if f.name != "cameras"
    }
    name = change(copy, steps=Steps(cameras={}, **shorter))
    assert "course: 19 steps, the motion has 20" in validate(copy).problems[name]


def test_what_is_no_dataset_is_refused(copy, validate, tmp_path):
    with pytest.raises(MissingFile, match="dataset.json: no such file"):
        validate(tmp_path)
    head, *rows = read_json_lines(copy / "manifest.jsonl")
    relist(copy, [{**head, "request": {}}, *rows])
    with pytest.raises(BrokenFile, match="'config' is missing or wrong; generate again"):
        validate(copy)


def test_an_annotation_of_another_demonstration_is_refused(copy, validate):
    path = copy / "sources" / "demo00" / "annotation.json"
    annotation = json.loads(path.read_text())
    annotation["demonstration_hash"] = "0" * 64
    path.write_text(json.dumps(annotation))
    with pytest.raises(Mismatch, match="isn't the one that the dataset was made from"):
        validate(copy)


def test_a_merged_dataset_is_proved_with_each_part_s_own_settings(
    made, peg_demonstration, peg_annotation, make_peg_backend, validate, tmp_path
):
    config = AugmentConfig(n=3, seed=7, duration=1.5, margin=0.0003, strategy="no_orientation")
    other = augment_demonstration(
        peg_demonstration, peg_annotation, make_peg_backend, tmp_path / "other", config
    )
    merged = merge_datasets([load_dataset(made), other], tmp_path / "merged")
    found = validate(merged.path)
    assert found.episodes == 5 and found.problems == {}
    parts = split_dataset(merged, tmp_path / "parts", {"a": 0.6, "b": 0.4})
    assert [validate(part.path).problems for part in parts.values()] == [{}, {}]
    # Held against another part's settings they don't hold.
    rows = read_json_lines(merged.path / "manifest.jsonl")
    origins = [source["origin"] for source in rows[0]["sources"]]
    for source, origin in zip(rows[0]["sources"], origins[::-1], strict=True):
        source["origin"] = origin
    relist(merged.path, rows)
    assert len(validate(merged.path).problems) == 5
