from __future__ import annotations

import dataclasses

import pytest

from sart_toolkit.benchmark import jobs as module
from sart_toolkit.benchmark.jobs import jobs_of
from sart_toolkit.benchmark.plans import PlanCell

CELL = PlanCell("peg_in_hole", n=40)


def changed(**values):
    """The stages whose key is another one when a cell's fields have other values."""
    before, after = jobs_of(CELL), jobs_of(dataclasses.replace(CELL, **values))
    return [stage for stage in before if stage in after and before[stage].key != after[stage].key]


@pytest.mark.parametrize(
    ("values", "again"),
    [
        ({}, []),
        ({"episodes": 10}, ["evaluate"]),
        ({"variation": {"latency": 0.1}}, ["evaluate"]),
        ({"evaluate_on": "sapien"}, ["evaluate"]),
        ({"training_seed": 1}, ["train", "evaluate"]),
        ({"training": {"lr": 1e-4}}, ["train", "evaluate"]),
        ({"policy": "resnet18_mlp"}, ["train", "evaluate"]),
        ({"device": "cuda"}, ["train", "evaluate"]),
        ({"n": 20}, ["augment", "train", "evaluate"]),
        ({"generation": {"recording": "return"}}, ["augment", "train", "evaluate"]),
        ({"suggestion": {"margin": 0.001}}, ["suggest", "augment", "train", "evaluate"]),
        ({"demonstration_seed": 1}, ["record", "suggest", "augment", "train", "evaluate"]),
        ({"backend": "sapien"}, ["record", "suggest", "augment", "train", "evaluate"]),
    ],
)
def test_what_a_value_decides_is_done_again_and_nothing_before_it(values, again):
    assert changed(**values) == again


def test_a_label_decides_nothing():
    labelled = dataclasses.replace(CELL, variation={"label": "as trained"})
    assert jobs_of(labelled)["evaluate"].key == jobs_of(CELL)["evaluate"].key


def test_methods_share_a_demonstration_but_not_what_they_make_of_it():
    sart, miles = (jobs_of(dataclasses.replace(CELL, strategy=s)) for s in ("sart", "miles"))
    assert sart["record"].key == miles["record"].key
    assert "suggest" not in miles and sart["augment"].key != miles["augment"].key
    bc = jobs_of(dataclasses.replace(CELL, strategy="bc"))
    assert bc["record"].size == 40 and bc["record"].options["count"] == 40


def test_where_only_effort_is_asked_for_nothing_is_trained():
    assert list(jobs_of(dataclasses.replace(CELL, until="augment"))) == [
        "record", "suggest", "augment",
    ]  # fmt: skip


def test_a_changed_source_makes_its_stage_and_what_follows_again(monkeypatch, tmp_path):
    before = jobs_of(CELL)
    real = module._sources
    monkeypatch.setattr(
        module, "_sources", lambda last: real(last) + ("x" if last in ("learn", "evaluate") else "")
    )
    after = jobs_of(CELL)
    assert [s for s in before if before[s].key != after[s].key] == ["train", "evaluate"]


def test_a_stage_depends_on_sources_up_to_its_own_package_and_no_later_ones(monkeypatch, tmp_path):
    for name in ("tasks", "learn", "evaluate"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.py").write_text("x = 1\n")
    for name in ("errors.py", "poses.py", "userfiles.py", "registry.py", "pipeline.py"):
        (tmp_path / name).write_text("")
    monkeypatch.setattr(module, "_PACKAGE", tmp_path)

    def sums():
        module._sources.cache_clear()
        return [module._sources(last) for last in ("record", "learn", "evaluate")]

    try:
        first = sums()
        (tmp_path / "learn" / "a.py").write_text("x = 2\n")
        second = sums()
        (tmp_path / "tasks" / "b.py").write_text("x = 2\n")
        third = sums()
    finally:
        module._sources.cache_clear()
    assert [a == b for a, b in zip(first, second, strict=True)] == [True, False, False]
    assert [a == b for a, b in zip(second, third, strict=True)] == [False] * 3


def test_every_package_that_a_stage_may_import_is_among_its_sources():
    """In their order; those above the stages decide no result."""
    above = {"bringup", "report", "benchmark", "testing", "cli", "assets"}
    packages = {path.name for path in module._PACKAGE.iterdir() if (path / "__init__.py").exists()}
    assert packages - above == {name for name in module._SOURCES if not name.endswith(".py")}


def test_a_persons_own_task_is_part_of_the_key(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = (
        "from sart_toolkit.tasks.peg_in_hole import PegInHole\n"
        "class Mine(PegInHole):\n    hold = 1.0\n"
    )
    (tmp_path / "mine.py").write_text(source)
    cell = PlanCell("mine.py:Mine")
    first = jobs_of(cell)["record"].key
    (tmp_path / "mine.py").write_text(source.replace("1.0", "0.5"))
    module._setting.cache_clear()
    assert jobs_of(cell)["record"].key != first
    module._setting.cache_clear()
