"""What is generated leads to the goal when it is executed, and what doesn't is counted."""

from __future__ import annotations

import json
import shutil

import pytest

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.augment.trajectories import replay_dataset
from sart_toolkit.backends.interface import KnowsBodies, Resets, SavesStates
from sart_toolkit.data.combine import merge_datasets
from sart_toolkit.data.dataset import REPLAY
from sart_toolkit.data.records import Annotation, PrecisionSphere
from sart_toolkit.errors import InvalidInput, Mismatch, MissingCapability, OutputExists
from sart_toolkit.tasks import get_task


@pytest.fixture
def dataset(peg_dataset, tmp_path):
    return shutil.copytree(peg_dataset.path, tmp_path / "dataset")


class NeverAtTheGoal(type(get_task("peg_in_hole"))):
    """The same task with a goal that nothing reaches."""

    def success(self, observation):
        return False


def test_generated_trajectories_lead_to_the_goal(dataset, peg_task, make_peg_backend):
    seen = []
    result = replay_dataset(
        dataset, peg_task, make_peg_backend, progress=lambda *args: seen.append(args)
    )
    assert (result["n_success"], result["n_judged"], result["failures"]) == (4, 4, {})
    assert seen == [(1, 4, 0), (2, 4, 0), (3, 4, 0), (4, 4, 0)]
    # The reversed record doesn't know that the robot lags behind its commands.
    assert 1.0 < result["largest_segment_difference_mm"] <= result["largest_difference_mm"] < 10.0
    written = json.loads((dataset / REPLAY).read_text())
    assert written["trajectories"] == result["trajectories"]
    names = [row["name"] for row in result["trajectories"]]
    assert sorted(names) == [str(p.relative_to(dataset)) for p in sorted(dataset.rglob("*_k*.h5"))]


def test_a_trajectory_that_is_shorter_than_the_goal_must_be_held_counts(
    peg_demonstration, peg_task, make_peg_backend, tmp_path
):
    last = len(peg_demonstration) - 2
    T = peg_demonstration.steps.measured_Ts_world_tool[last]
    sphere = PrecisionSphere(last, T, 0.003)
    annotation = Annotation((sphere,), peg_demonstration.content_hash())
    path = tmp_path / "end"
    config = AugmentConfig(n=4, cameras=())
    made = augment_demonstration(peg_demonstration, annotation, make_peg_backend, path, config)
    hold = peg_task.steps_held(peg_demonstration.rates.record_hz)
    assert all(e.provenance.t_star >= last for e in made)
    assert all(len(e.actions(peg_demonstration)) <= hold for e in made)
    result = replay_dataset(path, peg_task, make_peg_backend)
    assert result["n_success"] == result["n_judged"] == len(made)


def test_what_was_recorded_on_the_return_is_what_a_policy_will_live_through(
    peg_demonstration, peg_annotation, peg_task, make_peg_backend, dataset, tmp_path
):
    config = AugmentConfig(n=5, recording="return", cameras=())
    augment_demonstration(
        peg_demonstration, peg_annotation, make_peg_backend, tmp_path / "back", config
    )
    far = {
        path: replay_dataset(path, peg_task, make_peg_backend)["trajectories"]
        for path in (dataset, tmp_path / "back")
    }
    for a, b in zip(*far.values(), strict=True):
        assert b["segment_mm"] < 0.8 * a["segment_mm"]


def test_trajectories_that_miss_the_goal_are_counted_with_the_reason(dataset, make_peg_backend):
    result = replay_dataset(dataset, NeverAtTheGoal(), make_peg_backend)
    assert (result["n_success"], result["n_judged"]) == (0, 4)
    assert result["failures"] == {"goal not reached": 4}
    assert all("peg in the hole" in row["reason"] for row in result["trajectories"])


def test_a_trajectory_that_ends_at_t_star_has_its_poses_compared_alone(
    peg_demonstration, peg_annotation, peg_task, make_peg_backend, tmp_path
):
    out, config = tmp_path / "d", AugmentConfig(n=3, strategy="no_merge", cameras=())
    augment_demonstration(peg_demonstration, peg_annotation, make_peg_backend, out, config)
    result = replay_dataset(out, NeverAtTheGoal(), make_peg_backend)
    assert (result["n_trajectories"], result["n_judged"], result["failures"]) == (2, 0, {})
    assert result["largest_difference_mm"] == result["largest_segment_difference_mm"] > 0


def test_an_interrupted_execution_resumes_and_processes_make_no_difference(
    dataset, peg_task, make_peg_backend
):
    def interrupt(done, wanted, failed):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        replay_dataset(dataset, peg_task, make_peg_backend, progress=interrupt)
    seen = []
    resumed = replay_dataset(
        dataset, peg_task, make_peg_backend, progress=lambda *args: seen.append(args)
    )
    assert seen == [(3, 4, 0), (4, 4, 0)]
    with pytest.raises(OutputExists, match=r"replay.json: already exists; add --overwrite"):
        replay_dataset(dataset, peg_task, make_peg_backend)
    assert replay_dataset(dataset, peg_task, make_peg_backend, 2, overwrite=True) == resumed


def test_an_interrupted_execution_of_another_task_is_refused(dataset, peg_task, make_peg_backend):
    def interrupt(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        replay_dataset(dataset, peg_task, make_peg_backend, progress=interrupt)
    other = NeverAtTheGoal()
    other.name = "another"
    with pytest.raises(Mismatch, match="holds results of"):
        replay_dataset(dataset, other, make_peg_backend)


def test_sources_that_were_generated_with_other_settings_are_executed_with_theirs(
    peg_demonstration, peg_annotation, peg_task, make_peg_backend, peg_dataset, tmp_path
):
    config = AugmentConfig(n=3, seed=1, recording="return", cameras=("wrist",))
    other = augment_demonstration(
        peg_demonstration, peg_annotation, make_peg_backend, tmp_path / "other", config
    )
    alone = replay_dataset(other.path, peg_task, make_peg_backend)
    merge_datasets([peg_dataset, other], tmp_path / "both")
    both = replay_dataset(tmp_path / "both", peg_task, make_peg_backend)
    assert both["n_success"] == 6
    figures = [{**row, "name": ""} for row in both["trajectories"]]
    assert all({**row, "name": ""} in figures for row in alone["trajectories"])


def test_a_backend_that_cannot_restore_or_judge_is_refused(
    dataset, peg_task, make_peg_backend, limited
):
    for abilities, lacking in (((Resets, KnowsBodies), "SavesStates"), ((SavesStates,), "KnowsB")):
        with pytest.raises(MissingCapability, match=f"lacks the ability {lacking}"):
            replay_dataset(dataset, peg_task, lambda a=abilities: limited(make_peg_backend(), *a))
    with pytest.raises(InvalidInput, match="workers: expected at least 1, got 0"):
        replay_dataset(dataset, peg_task, make_peg_backend, workers=0)
