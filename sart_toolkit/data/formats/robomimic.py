"""robomimic's HDF5: a group `demo_<int>` for each trajectory, actions scaled to [-1, 1]."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sart_toolkit.data.formats.format import (
    ACTION_NAMES,
    About,
    Format,
    Trajectory,
    all_problems,
    quaternions,
)
from sart_toolkit.data.formats.hdf5 import Hdf5Output, reading_hdf5
from sart_toolkit.data.storage import put_frames
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array

# robomimic's number for an environment of Gym.
_GYM = 2
_DEMO = re.compile(r"demo_(0|[1-9]\d*)")


class Robomimic(Format):
    """robomimic's HDF5, one file.

    `actions = (action - offset) / scale`, both attributes of `data`: the translations have one
    scale, the rotations another, the greatest that occurs, so that 0 stays 0; the gripper's
    [0, 1] becomes [-1, 1].
    """

    name = "robomimic"
    suffix = ".hdf5"

    def write(self, path: Path, trajectories: Iterable[Trajectory], about: About) -> None:
        greatest = np.zeros(2)
        total = 0
        names: dict[str, list[str]] = {"demonstrations": [], "generated": []}
        with Hdf5Output(path) as output:
            data = output.file.create_group("data")
            for i, trajectory in enumerate(trajectories):
                demo = f"demo_{i}"
                _put(data.create_group(demo), trajectory, about)
                moved = np.abs(trajectory.actions)
                greatest = np.maximum(greatest, [moved[:, :3].max(), moved[:, 3:6].max()])
                total += len(trajectory)
                shown = trajectory.provenance.get("kind") == "demonstration"
                names["demonstrations" if shown else "generated"].append(demo)
                output.check()
            scale, offset = _scaling(greatest)
            # Actions are small; how large they are is known only now.
            for demo in data:
                actions = data[demo]["actions"]
                actions[...] = (actions[()] - offset) / scale
            mask = output.file.create_group("mask")
            for name, demos in names.items():
                if demos:
                    mask[name] = np.array(demos, dtype="S")
            data.attrs["total"] = total
            data.attrs["env_args"] = json.dumps(_env_args(about))
            data.attrs["action_scale"] = scale
            data.attrs["action_offset"] = offset
            data.attrs["action_names"] = json.dumps(ACTION_NAMES)
            data.attrs["instruction"] = about.instruction
            data.attrs["sart"] = json.dumps(about.sart)

    def problems(self, path: Path) -> Sequence[str]:
        return all_problems(_file_problems(Path(path)))


def _scaling(greatest: Array) -> tuple[Array, Array]:
    """Scale and offset of actions, by the greatest translation [m] and rotation [rad]."""
    # Rounding to float32 must not lead out of [-1, 1].
    translation, rotation = np.where(greatest > 0, greatest * (1 + 1e-6), 1.0)
    scale = np.array([translation] * 3 + [rotation] * 3 + [0.5])
    return scale, np.array([0.0] * 6 + [0.5])


def _env_args(about: About) -> dict[str, Any]:
    words = about.task.replace("_", " ").title().replace(" ", "")
    return {
        "env_name": f"sart/{words}-v0",
        "type": _GYM,
        "env_version": str(about.sart["versions"].get("sart_toolkit", "")),
        "env_kwargs": {"backend": about.sart["backend"]},
    }


def _put(demo: h5py.Group, trajectory: Trajectory, about: About) -> None:
    steps, n = trajectory.steps, len(trajectory)
    poses = steps.measured_Ts_world_tool
    obs = demo.create_group("obs")
    obs["robot0_joint_pos"] = steps.joint_positions
    obs["robot0_joint_vel"] = steps.joint_velocities
    obs["robot0_eef_pos"] = poses[:, :3, 3]
    obs["robot0_eef_quat"] = quaternions(poses, real="last")
    obs["robot0_gripper_qpos"] = steps.measured_gripper[:, None]
    for name, camera in steps.cameras.items():
        put_frames(obs, f"{name}_image", camera.rgb)
        if about.depth:
            put_frames(obs, f"{name}_depth", camera.depth[..., None])
    if not np.isfinite(trajectory.actions).all():
        raise InvalidInput(f"{trajectory.name}: actions have NaN or infinite values; leave it out")
    demo["actions"] = trajectory.actions.astype(np.float64)
    demo["states"] = np.concatenate([steps.joint_positions, steps.measured_gripper[:, None]], 1)
    demo["rewards"] = trajectory.success.astype(np.float64)
    demo["dones"] = (np.arange(n) == n - 1).astype(np.int64)
    demo.attrs["num_samples"] = n
    demo.attrs["model_file"] = ""
    demo.attrs["sart"] = json.dumps({"name": trajectory.name, **trajectory.provenance})


def _file_problems(path: Path) -> Iterator[str]:
    with reading_hdf5(path) as file:
        yield from _problems(file)


def _problems(file: h5py.File) -> Iterator[str]:
    if "data" not in file:
        yield "data: no such group"
        return
    data = file["data"]
    try:
        env_args = json.loads(data.attrs["env_args"])
        if "type" not in env_args:
            yield "data: env_args has no type"
    except (KeyError, TypeError, ValueError):
        yield "data: attribute env_args is missing, or no JSON"
    demos = [name for name in data if _DEMO.fullmatch(name)]
    for name in data:
        if name not in demos:
            yield f"data/{name}: expected a name demo_<int>"
    if not demos:
        yield "data: has no demo_<int>"
        return
    demos.sort(key=lambda name: int(name[5:]))
    samples = [int(data[name].attrs.get("num_samples", -1)) for name in demos]
    if (total := data.attrs.get("total")) != sum(samples):
        yield f"data: total is {total}, num_samples make {sum(samples)}"
    first = _shapes(data[demos[0]])
    for name, n in zip(demos, samples, strict=True):
        yield from _demo_problems(name, data[name], n, first)
    for key, names in file.get("mask", {}).items():
        for text in names[()]:
            if (demo := bytes(text).decode()) not in demos:
                yield f"mask/{key}: no such demonstration {demo!r}"


def _shapes(demo: h5py.Group) -> dict[str, tuple[int, ...]]:
    """The shape of a step in each array that is read by steps."""
    found: dict[str, tuple[int, ...]] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = item.shape[1:]

    demo.visititems(visit)
    return found


def _demo_problems(
    name: str, demo: h5py.Group, n: int, first: dict[str, tuple[int, ...]]
) -> Iterator[str]:
    for key in ("actions", "obs"):
        if key not in demo:
            yield f"data/{name}: {key} is missing"
    if "actions" not in demo:
        return
    if n != len(demo["actions"]):
        yield f"data/{name}: num_samples is {n}, actions has {len(demo['actions'])}"
        n = len(demo["actions"])
    shapes = _shapes(demo)
    for key in sorted(shapes.keys() ^ first.keys()):
        yield f"data/{name}: {key} is {'missing' if key in first else 'in this one alone'}"
    for key in sorted(shapes.keys() & first.keys()):
        if shapes[key] != first[key]:
            yield f"data/{name}: {key} has steps of {shapes[key]}, the first of {first[key]}"
    for key in shapes:
        if len(demo[key]) != n:
            yield f"data/{name}: {key} has {len(demo[key])} steps, actions has {n}"
    actions = np.asarray(demo["actions"][()], dtype=np.float64)
    # Written so that NaN is outside.
    outside = np.argwhere(~(np.abs(actions) <= 1.0))
    if len(outside):
        step, value = (int(number) for number in outside[0][:2])
        yield (
            f"data/{name}: actions lie outside [-1, 1], the first at step {step}, value {value}: "
            f"{actions[step, value]:.4g}"
        )
