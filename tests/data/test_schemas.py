"""JSON of ours: strict, bounded and typed; whatever else it is, the error says file and field."""

from __future__ import annotations

import json
import os

import pytest

from sart_toolkit.data import storage
from sart_toolkit.data.schemas import (
    DatasetFile,
    EvaluationFile,
    RunFile,
    SkillFile,
    TrainingFile,
)
from sart_toolkit.data.storage import (
    Journal,
    append_json_line,
    check_values,
    load_annotation,
    parse_json,
    read_json,
    read_json_lines,
    with_seal,
    write_json,
)
from sart_toolkit.errors import BrokenFile

EVALUATION = {
    "task": "t", "backend": "b", "robot": "r", "policy": "p", "n_episodes": 1, "n_success": 1,
    "success_rate": 1.0, "ci95": [0.2, 1.0],
    "episodes": [{"episode": 0, "outcome": "success", "seed": [1, 0]}],
    "videos": [{"path": "videos/success_000.mp4", "episode": 0, "outcome": "success"}],
}  # fmt: skip
DATASET = {
    "n_trajectories": 1, "n_kept": 0, "n_attempted": 0, "rejections": {}, "by_sphere": [],
    "least_commanded_clearance_m": None, "content_hash": "0", "manifest_hash": "0", "versions": {},
}  # fmt: skip
TRAINING = {
    "curve": [{"epoch": 1, "loss": 0.5, "seconds": 1.0}], "images_per_second": 1.0, "config": {},
}  # fmt: skip
SKILL = {"files": {"demo.h5": "0" * 64}, "demonstration_hash": "0" * 64, "references": {}}
RUN = {"config": {}, "stages": {"record": 1.0}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": NaN}', "invalid character"),
        ('{"a": -Infinity}', "invalid character"),
        ('{"a": 1e400}', "out of range"),
        ('{"a": 1' + "0" * 400 + "}", "whole number of 401 digits"),
        ('{"a": 1' + "0" * 5000 + "}", "out of range"),
        ("[" * 100_000, "recursion"),
        ('{"a": ' * 100_000, "recursion"),
        (r'{"a": "\ud800"}', "truncated"),
        ('{"a": 1, "b": {"c": 1, "c": 2}}', "'c' stands there twice"),
        ('{"a": ' + "[" * 50 + "]" * 50 + "}", "nested more than 50 deep"),
        ('{"a": 1} x', "trailing"),
        ("\ufeff{}", "invalid character"),
    ],
)
def test_what_is_no_strict_json_is_broken(text, message):
    with pytest.raises(BrokenFile, match=f"x.json: not readable as JSON .*{message}"):
        parse_json(text.encode(), "x.json")


@pytest.mark.parametrize(
    ("schema", "whole", "changes", "where"),
    [
        (EvaluationFile, EVALUATION, {"n_episodes": 0}, "n_episodes"),
        (EvaluationFile, EVALUATION, {"n_episodes": "many"}, "n_episodes"),
        (EvaluationFile, EVALUATION, {"n_success": 10**19}, "n_success"),
        (EvaluationFile, EVALUATION, {"ci95": [0.1]}, "ci95"),
        (EvaluationFile, EVALUATION, {"episodes": [{}]}, r"episodes\[0\]"),
        (EvaluationFile, EVALUATION, {"success_rate": None}, "success_rate"),
        (DatasetFile, DATASET, {"rejections": {"a": -1}}, r"rejections\[...\]"),
        (DatasetFile, DATASET, {"references": {"task": "a\0b"}}, r"references\[...\]"),
        (DatasetFile, DATASET, {"references": {"model": "a"}}, "references"),
        (TrainingFile, TRAINING, {"curve": [{"epoch": 1}]}, r"curve\[0\]"),
        (SkillFile, SKILL, {"files": {"demo.h5": "short"}}, r"files\[...\]"),
        (SkillFile, SKILL, {"task": 3}, "task"),
        (RunFile, RUN, {"stages": {"train": "long"}}, r"stages\[...\]"),
        (RunFile, RUN, {"config": []}, "config"),
    ],
)
def test_a_value_of_another_type_is_broken_and_its_place_named(schema, whole, changes, where):
    check_values(whole, schema, "x.json")
    with pytest.raises(BrokenFile, match=rf"x.json: a field is missing or wrong .*`\$.{where}"):
        check_values({**whole, **changes}, schema, "x.json")


@pytest.mark.parametrize(
    ("schema", "whole"),
    [(EvaluationFile, EVALUATION), (DatasetFile, DATASET), (TrainingFile, TRAINING),
     (SkillFile, SKILL), (RunFile, RUN)],
)  # fmt: skip
def test_a_field_that_every_such_file_has_may_not_be_missing(schema, whole):
    for name in set(whole) - {"videos", "references"}:
        lacking = {k: v for k, v in whole.items() if k != name}
        with pytest.raises(BrokenFile, match=f"missing required field `{name}`"):
            check_values(lacking, schema, "x.json")


@pytest.mark.parametrize(
    "path", ["../x.mp4", "/x.mp4", "videos/../../x.mp4", "videos/..", "a\0b", "a\\..\\b", ".."]
)
def test_a_path_in_a_file_leads_nowhere_but_below_it(path):
    video = {"path": path, "episode": 0, "outcome": "success"}
    with pytest.raises(BrokenFile, match=r"`\$.videos\[0\].path`"):
        check_values({**EVALUATION, "videos": [video]}, EvaluationFile, "evaluation.json")


def test_a_changed_value_is_refused_by_the_file_s_hash(tmp_path):
    write_json(tmp_path / "x.json", EVALUATION)
    assert read_json(tmp_path / "x.json", EvaluationFile) == EVALUATION
    value = json.loads((tmp_path / "x.json").read_text())
    # Another layout holds the same.
    (tmp_path / "x.json").write_text(json.dumps(dict(reversed(value.items()))))
    assert read_json(tmp_path / "x.json", EvaluationFile) == EVALUATION
    for changed in ({**value, "n_success": 0}, {k: v for k, v in value.items() if k != "sha256"}):
        (tmp_path / "x.json").write_text(json.dumps(changed))
        with pytest.raises(BrokenFile, match="x.json: content differs from its hash; restore a c"):
            read_json(tmp_path / "x.json", EvaluationFile)
    (tmp_path / "x.json").write_text(json.dumps(with_seal({**value, "n_success": 0})))
    assert read_json(tmp_path / "x.json", EvaluationFile)["n_success"] == 0


def test_names_that_are_numbers_keep_their_file_readable(tmp_path):
    write_json(tmp_path / "x.json", {"counts": {10: 1, 9: 2}})
    assert read_json(tmp_path / "x.json", dict) == {"counts": {"10": 1, "9": 2}}


def test_a_file_larger_than_any_of_ours_is_not_read(tmp_path, monkeypatch):
    write_json(tmp_path / "x.json", RUN)
    append_json_line(tmp_path / "x.jsonl", RUN)
    monkeypatch.setattr(storage, "MAX_JSON_BYTES", 20)
    monkeypatch.setattr(storage, "MAX_LINES_BYTES", 20)
    with pytest.raises(BrokenFile, match="x.json: has 0 MiB, at most 0 are read; check that"):
        read_json(tmp_path / "x.json", RunFile)
    with pytest.raises(BrokenFile, match="x.jsonl: has 0 MiB, at most 0 are read; check that"):
        read_json_lines(tmp_path / "x.jsonl")


def test_what_is_no_regular_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "x.json")
    for load in (load_annotation, storage.load_demonstration, storage.load_recording):
        with pytest.raises(BrokenFile, match="x.json: is no regular file"):
            load(tmp_path / "x.json")


@pytest.mark.parametrize(
    "damage",
    [
        lambda line: line.replace(b"1.5", b"2.5"),
        lambda line: line.replace(b"seconds", b"secondz"),
        lambda line: line.replace(b'"check": "', b'"check": "0'),
        lambda line: b'{"cell": "a", "seconds": 1.5}\n',
        lambda line: b"\xff" + line,
        lambda line: b"[" * 100_000 + b"\n",
    ],
)
def test_a_changed_line_of_a_log_is_refused_and_named(damage, tmp_path):
    path = tmp_path / "log.jsonl"
    for row in ({"n": 1}, {"cell": "a", "seconds": 1.5}, {}):
        append_json_line(path, row)
    assert read_json_lines(path) == [{"n": 1}, {"cell": "a", "seconds": 1.5}, {}]
    first, second, third = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(first + damage(second) + third)
    with pytest.raises(BrokenFile, match="log.jsonl: line 2 differs from its hash; restore a copy"):
        read_json_lines(path)
    with pytest.raises(BrokenFile, match="line 2 differs from its hash"):
        Journal(path)
    Journal(path, read=False).close()


def test_a_line_after_one_that_a_crash_cut_short_stands_by_itself(tmp_path):
    path = tmp_path / "log.jsonl"
    append_json_line(path, {"k": 0})
    append_json_line(path, {"k": 1})
    path.write_bytes(path.read_bytes()[:-5])
    append_json_line(path, {"k": 2})
    assert read_json_lines(path) == [{"k": 0}, {"k": 2}]
