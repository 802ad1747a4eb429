"""Which way of a segment is recorded: out, reversed, or the return."""

from __future__ import annotations

import dataclasses
from typing import get_args

import numpy as np
import pytest

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.augment.executors import RestoreExecutor
from sart_toolkit.augment.validate import validate_dataset
from sart_toolkit.backends.interface import Contact
from sart_toolkit.data.manifest import AttemptKey
from sart_toolkit.data.records import Recording, apply_action
from sart_toolkit.errors import UnknownName
from sart_toolkit.poses import distance

RECORDINGS = get_args(Recording)


@pytest.fixture(scope="module")
def datasets(peg_demonstration, peg_annotation, make_peg_backend, tmp_path_factory):
    out = tmp_path_factory.mktemp("recording")
    return {
        recording: augment_demonstration(
            peg_demonstration,
            peg_annotation,
            make_peg_backend,
            out / recording,
            AugmentConfig(n=5, recording=recording),
        )
        for recording in RECORDINGS
    }


@pytest.mark.parametrize("recording", RECORDINGS)
def test_a_commanded_pose_followed_by_its_action_is_the_next_one_whichever_way_is_recorded(
    datasets, peg_demonstration, recording
):
    for episode in datasets[recording]:
        assert episode.provenance.recording == recording
        Ts, gripper = episode.commands(peg_demonstration)
        for t, action in enumerate(episode.actions(peg_demonstration)[:-1]):
            T, g = apply_action(Ts[t], action)
            np.testing.assert_allclose(T, Ts[t + 1], rtol=0, atol=1e-9)
            assert g == gripper[t + 1]


def test_both_recordings_have_the_same_commands(datasets):
    for a, b in zip(datasets["reversed"], datasets["return"], strict=True):
        for name in ("commanded_Ts_world_tool", "commanded_joint_positions", "commanded_gripper"):
            np.testing.assert_allclose(
                getattr(a.steps, name), getattr(b.steps, name), rtol=0, atol=1e-9
            )


@pytest.mark.parametrize(("recording", "periods"), [("reversed", 0), ("return", -1)])
def test_on_the_return_the_robot_lags_behind_its_commands_as_when_a_policy_acts(
    datasets, peg_demonstration, recording, periods
):
    """By a control period; a command that was reversed doesn't lead the robot at all."""
    per_record = peg_demonstration.rates.control_per_record
    for episode in datasets[recording]:
        commanded = episode.steps.commanded_Ts_world_tool[:, :3, 3]
        measured = episode.steps.measured_Ts_world_tool[:, :3, 3]
        stride = np.diff(commanded, axis=0)[4:-4]
        ahead = ((measured - commanded)[4:-5] * stride).sum(1) / (stride**2).sum(1)
        np.testing.assert_allclose(ahead * per_record, periods, atol=0.1)


def test_a_recorded_return_begins_at_rest_at_the_sampled_pose(datasets):
    for episode in datasets["return"]:
        steps, sampled = episode.steps, episode.provenance.T_world_sampled
        far, turn = distance(steps.measured_Ts_world_tool[0], sampled)
        assert far < 4e-4 and turn < 2e-3
        assert np.abs(steps.joint_velocities[0]).max() < 0.01
        assert np.abs(steps.joint_velocities[1]).max() > 0.01


def test_the_measured_path_of_a_return_leads_out_and_back(datasets, peg_model, peg_demonstration):
    for episode in datasets["return"]:
        tools = [peg_model.fk(q) for q in episode.joint_path]
        at = peg_demonstration.steps.commanded_Ts_world_tool[episode.provenance.t_star]
        far = np.array([distance(T, at)[0] for T in tools])
        outermost = distance(episode.provenance.T_world_sampled, at)[0]
        assert far.max() == pytest.approx(outermost, abs=1e-3)
        assert far[-1] < 1e-3 and 0.4 < far.argmax() / len(far) < 0.6


def test_datasets_of_both_recordings_hold(datasets, peg_model, peg_task):
    for dataset in datasets.values():
        assert not validate_dataset(dataset.path, peg_model.spec, peg_task.scene).problems


def test_a_contact_on_the_way_back_rejects_the_segment(
    peg_demonstration, peg_annotation, peg_backend, monkeypatch
):
    steps = []
    step = peg_backend.step
    monkeypatch.setattr(peg_backend, "step", lambda: (steps.append(1), step()))
    bump = [Contact("block", "peg", 1.0, 0.0)]
    monkeypatch.setattr(peg_backend, "contacts", lambda: bump if len(steps) == 100 else [])
    sources = [(peg_demonstration, peg_annotation)]
    outcomes = {}
    for recording in RECORDINGS:
        steps.clear()
        config = AugmentConfig(recording=recording)
        attempt = RestoreExecutor(peg_backend, sources, config).attempt(AttemptKey(0, 0, 0))
        outcomes[recording] = attempt.outcome
    assert outcomes == {"reversed": "kept", "return": "contact block / peg"}


def test_a_robot_that_does_not_come_to_rest_is_not_recorded_on_its_return(
    peg_demonstration, peg_annotation, peg_backend, monkeypatch
):
    observe = peg_backend.observe

    def trembling(*args):
        seen = observe(*args)
        return dataclasses.replace(seen, dq=seen.dq + 0.02)

    monkeypatch.setattr(peg_backend, "observe", trembling)
    sources, config = [(peg_demonstration, peg_annotation)], AugmentConfig(recording="return")
    attempt = RestoreExecutor(peg_backend, sources, config).attempt(AttemptKey(0, 0, 0))
    assert attempt.outcome == "no rest at the sampled pose"


def test_an_unknown_recording_is_refused():
    with pytest.raises(UnknownName, match="recording 'reverse': did you mean 'reversed'"):
        AugmentConfig(recording="reverse")
