"""robomimic's HDF5: what it documents is there, and what breaks a training is found."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from sart_toolkit.data.formats.format import Trajectory, about_dataset
from sart_toolkit.data.formats.robomimic import Robomimic
from sart_toolkit.errors import InvalidInput


@pytest.fixture
def copy(exported: Callable[[str], Path], tmp_path: Path) -> Path:
    return Path(shutil.copy(exported("robomimic"), tmp_path / "copy.hdf5"))


def test_it_is_as_robomimic_documents_it(exported, trajectories):
    with h5py.File(exported("robomimic")) as file:
        data = file["data"]
        env = json.loads(data.attrs["env_args"])
        assert env["type"] == 2 and env["env_name"] == "sart/PegInHole-v0"
        assert env["env_kwargs"] == {"backend": "pybullet"}
        assert data.attrs["total"] == sum(map(len, trajectories))
        assert sorted(data) == [f"demo_{i}" for i in range(5)]
        for i, trajectory in enumerate(trajectories):
            demo, n = data[f"demo_{i}"], len(trajectory)
            assert demo.attrs["num_samples"] == n and "model_file" in demo.attrs
            assert demo["dones"][()].tolist() == [0] * (n - 1) + [1]
            assert demo["rewards"][()].tolist() == trajectory.success.tolist()
            camera = trajectory.steps.cameras["wrist"]
            assert np.array_equal(demo["obs/wrist_image"][()], camera.rgb)
            assert np.array_equal(demo["obs/wrist_depth"][()][..., 0], camera.depth)
            assert demo["obs/robot0_eef_quat"].shape == (n, 4)
        assert [name.decode() for name in file["mask/demonstrations"][()]] == ["demo_0"]
        assert len(file["mask/generated"]) == 4


def test_actions_are_scaled_to_one_and_the_scale_gives_them_back(exported, trajectories):
    with h5py.File(exported("robomimic")) as file:
        data = file["data"]
        scale, offset = data.attrs["action_scale"], data.attrs["action_offset"]
        scaled = [data[f"demo_{i}"]["actions"][()] for i in range(5)]
    every = np.concatenate(scaled)
    assert np.abs(every).max() <= 1 and np.abs(every.astype(np.float32)).max() <= 1
    assert np.abs(every[:, :3]).max() > 0.99 and np.abs(every[:, 3:6]).max() > 0.99
    # Nothing turns or moves where nothing did: one scale for all axes, and no offset.
    assert scale[0] == scale[1] == scale[2] and not offset[:6].any()
    for actions, trajectory in zip(scaled, trajectories, strict=True):
        np.testing.assert_allclose(actions * scale + offset, trajectory.actions, atol=1e-12)
        assert not actions[-1, :6].any()


def test_a_motion_that_never_occurs_has_a_scale_all_the_same(trajectories, peg_dataset, tmp_path):
    actions = trajectories[0].actions.copy()
    actions[:, 3:6] = 0.0
    still = Trajectory(**{**trajectories[0].__dict__, "actions": actions})
    Robomimic().write(tmp_path / "a.hdf5", [still], about_dataset(peg_dataset))
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert file["data"].attrs["action_scale"][3:6].tolist() == [1.0] * 3
        assert not file["data/demo_0/actions"][:, 3:6].any()


def test_nan_is_refused(trajectories, peg_dataset, tmp_path):
    actions = np.full_like(trajectories[0].actions, np.nan)
    broken = Trajectory(**{**trajectories[0].__dict__, "actions": actions})
    with pytest.raises(InvalidInput, match="demo00: actions have NaN or infinite values"):
        Robomimic().write(tmp_path / "a.hdf5", [broken], about_dataset(peg_dataset))


def _rename(file: h5py.File) -> None:
    file.move("data/demo_1", "data/second")


def _shorten(file: h5py.File) -> None:
    rewards = file["data/demo_1/rewards"][()]
    del file["data/demo_1/rewards"]
    file["data/demo_1/rewards"] = rewards[:-1]


def _enlarge(file: h5py.File) -> None:
    file["data/demo_2/actions"][3, 1] = 1.5


MUTATIONS: dict[str, tuple[Callable[[h5py.File], object], str]] = {
    "an action outside": (
        _enlarge,
        "data/demo_2: actions lie outside [-1, 1], the first at step 3, value 1: 1.5",
    ),
    "a demo by another name": (_rename, "data/second: expected a name demo_<int>"),
    "a wrong total": (lambda file: file["data"].attrs.create("total", 3), "data: total is 3, "),
    "no type of environment": (
        lambda file: file["data"].attrs.create("env_args", "{}"),
        "data: env_args has no type",
    ),
    "env_args that are no JSON": (
        lambda file: file["data"].attrs.create("env_args", "env"),
        "data: attribute env_args is missing, or no JSON",
    ),
    "a wrong number of samples": (
        lambda file: file["data/demo_0"].attrs.create("num_samples", 3),
        "data: total is ",
    ),
    "steps that are missing": (_shorten, "data/demo_1: rewards has "),
    "observations that are missing": (
        lambda file: file.__delitem__("data/demo_3/obs"),
        "data/demo_3: obs is missing",
    ),
    "a camera that one lacks": (
        lambda file: file.__delitem__("data/demo_3/obs/wrist_image"),
        "data/demo_3: obs/wrist_image is missing",
    ),
    "a filter of what isn't there": (
        lambda file: file.__setitem__("mask/train", np.array(["demo_9"], "S")),
        "mask/train: no such demonstration 'demo_9'",
    ),
    "no data": (lambda file: file.__delitem__("data"), "data: no such group"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_what_a_training_fails_on_is_found(name, copy):
    mutate, complaint = MUTATIONS[name]
    with h5py.File(copy, "r+") as file:
        mutate(file)
    found = Robomimic().problems(copy)
    assert found and found[0].startswith(complaint), found


def test_a_file_that_is_none_is_said_to_be(tmp_path):
    (tmp_path / "a.hdf5").write_bytes(b"nothing")
    (line,) = Robomimic().problems(tmp_path / "a.hdf5")
    assert "can't be read as such a file" in line
