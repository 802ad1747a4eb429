"""A trained skill: a directory that can be loaded and executed on any backend."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sart_toolkit.data import storage
from sart_toolkit.data.records import (
    Annotation,
    Dataset,
    Demonstration,
    Image,
    Referring,
    library_versions,
)
from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, MissingFile, SartError
from sart_toolkit.learn.model import Policy
from sart_toolkit.learn.samples import resize_area
from sart_toolkit.learn.tensorfile import load_tensors, save_tensors
from sart_toolkit.learn.training import (
    CHECKPOINT,
    TrainConfig,
    TrainResult,
    build_policy,
    resolve_device,
)
from sart_toolkit.poses import Array, check_array, check_pose, frozen

# A gripper that is told to open and to close knows two; more stand for a finger on a trigger.
_FEW_GRIPPER_COMMANDS = 4


@dataclass(frozen=True)
class SkillConfig(Referring):
    """What must be known to execute a skill elsewhere.

    The task and its parameters, robot and backend it was shown on; the camera by name, its
    recorded `(height, width)` [pixels], `intrinsics (3, 3)` and `T_tool_camera (4, 4)`; the
    demonstration's content hash; and how it was trained.
    """

    task: str
    task_parameters: Mapping[str, Any]
    robot: str
    backend: str
    camera: str
    recorded_size: tuple[int, int]
    intrinsics: Array
    T_tool_camera: Array
    demonstration_hash: str
    training: TrainConfig
    references: Mapping[str, str]

    def __post_init__(self) -> None:
        size = tuple(self.recorded_size)
        if len(size) != 2 or not all(isinstance(n, int) and n > 0 for n in size):
            raise InvalidInput(f"recorded_size: expected (height, width) [pixels], got {size}")
        object.__setattr__(self, "recorded_size", size)
        intrinsics = check_array("intrinsics", self.intrinsics, (3, 3))
        object.__setattr__(self, "intrinsics", frozen(intrinsics))
        T_tool_camera = check_pose("T_tool_camera", self.T_tool_camera)
        object.__setattr__(self, "T_tool_camera", frozen(T_tool_camera))

    def to_json(self) -> dict[str, Any]:
        """The configuration as JSON values."""
        return {
            **{field.name: getattr(self, field.name) for field in dataclasses.fields(self)},
            "task_parameters": dict(self.task_parameters),
            "recorded_size": list(self.recorded_size),
            "intrinsics": self.intrinsics.tolist(),
            "T_tool_camera": self.T_tool_camera.tolist(),
            "training": self.training.to_json(),
            "references": dict(self.references),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> SkillConfig:
        """The configuration in JSON values.

        Raises:
            InvalidInput: a key is missing or unknown, or a value is not acceptable.
            UnknownName: an unknown policy or training option.
        """
        names = {field.name for field in dataclasses.fields(cls)}
        if wrong := sorted(names ^ value.keys()):
            problem = "is missing" if wrong[0] in names else "is unknown"
            raise InvalidInput(
                f"skill configuration: {wrong[0]!r} {problem}; train the skill again"
            )
        return cls(**{**value, "training": TrainConfig.from_json(value["training"])})


class Skill:
    """A trained policy that remembers its own history: `reset()`, then `act(...)` at 10 Hz.

    Attributes:
        config: what must be known to execute it elsewhere.
        demonstration: the demonstration it came from.
        annotation: the annotation it came from.
        training: its training curve, speed and versions, as `training.json` has them.
    """

    def __init__(
        self,
        policy: Policy,
        config: SkillConfig,
        demonstration: Demonstration,
        annotation: Annotation,
        training: Mapping[str, Any],
        device: str = "cpu",
    ) -> None:
        self.config = config
        self.demonstration = demonstration
        self.annotation = annotation
        self.training = dict(training)
        self._device = resolve_device(device)
        self._policy = policy.to(self._device).eval()
        self._gripper_commands = np.unique(demonstration.steps.commanded_gripper)
        self._pictures: deque[Image] = deque(maxlen=config.training.history)
        self._gripper: deque[float] = deque(maxlen=config.training.history)

    def reset(self) -> None:
        """Forget the history: the next `act` starts a new execution."""
        self._pictures.clear()
        self._gripper.clear()

    def act(self, rgb: Image, gripper: float) -> Array:
        """The action `(7,)`: xyz [m], rotation vector [rad], tool frame; gripper target in [0, 1].

        Where the demonstration knew a few gripper commands only, the nearest of them is given.

        Args:
            rgb: what the skill's camera sees now, uint8 `(H, W, 3)` of any size; resized exactly
                as in training.
            gripper: measured gripper in [0, 1] (0 open).

        Raises:
            InvalidInput: not such a picture, or the gripper is not a finite number.
        """
        rgb = np.asarray(rgb)
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or rgb.size == 0:
            raise InvalidInput(
                f"rgb: expected uint8 of shape (H, W, 3), got {rgb.dtype} {rgb.shape}"
            )
        if not np.isfinite(gripper):
            raise InvalidInput(f"gripper: expected a number in [0, 1], got {gripper}")
        self._pictures.append(resize_area(rgb, self.config.training.image_size))
        self._gripper.append(float(gripper))
        while len(self._pictures) < self.config.training.history:
            self._pictures.appendleft(self._pictures[0])
            self._gripper.appendleft(self._gripper[0])
        frames = torch.from_numpy(np.stack(self._pictures)).permute(0, 3, 1, 2)[None]
        with torch.inference_mode():
            action = self._policy(
                frames.to(self._device), torch.tensor([list(self._gripper)], device=self._device)
            )
        values = action[0].double().cpu().numpy()
        values[6] = self._commandable(values[6])
        return values

    def _commandable(self, gripper: float) -> float:
        """The gripper target itself, or the nearest of the few that the demonstration commanded.

        A regressed target is a little off, the gripper follows it, and the policy follows the
        gripper: what was shown only open or closed would creep shut on the way.
        """
        shown = self._gripper_commands
        if len(shown) > _FEW_GRIPPER_COMMANDS:
            return gripper
        return float(shown[np.argmin(np.abs(shown - gripper))])


def save_skill(
    path: Path, result: TrainResult, dataset: Dataset, overwrite: bool = False
) -> SkillConfig:
    """Write a skill directory; `config.json` comes last, so that a directory with it is whole.

    A training checkpoint in the directory is removed: the skill takes its place.

    Raises:
        OutputExists: there is a skill already and `overwrite` is false.
        CannotWrite: the disk refuses.
    """
    path = Path(path)
    storage.check_writable(path / "config.json", overwrite)
    storage.remove(path / "config.json")
    demonstration = dataset.demonstration
    camera = demonstration.steps.cameras[result.config.camera]
    config = SkillConfig(
        task=demonstration.task,
        task_parameters=demonstration.task_parameters,
        robot=demonstration.robot,
        backend=demonstration.backend,
        camera=result.config.camera,
        recorded_size=(camera.rgb.shape[1], camera.rgb.shape[2]),
        intrinsics=camera.intrinsics,
        T_tool_camera=camera.T_tool_camera,
        demonstration_hash=demonstration.content_hash(),
        training=result.config,
        references=demonstration.references,
    )
    storage.save_demonstration(path / "demo.h5", demonstration)
    storage.save_annotation(path / "annotation.json", dataset.annotation)
    storage.write_json(
        path / "training.json",
        {
            "curve": [dataclasses.asdict(record) for record in result.curve],
            "final_loss": result.final_loss,
            "seconds": result.seconds,
            "images_per_second": result.images_per_second,
            "windows": result.n_windows,
            "trajectories": 1 + len(dataset.episodes),
            "device": result.device,
            "bfloat16": result.bfloat16,
            "config": result.config.to_json(),
            "versions": library_versions(),
        },
    )
    save_tensors(
        path / "model.safetensors",
        result.policy.state_dict(),
        {"demonstration_hash": config.demonstration_hash},
    )
    storage.write_json(path / "config.json", config.to_json())
    storage.remove(path / CHECKPOINT)
    return config


def load_skill(path: Path, device: str = "cpu") -> Skill:
    """The skill in a directory, ready to act.

    Args:
        path: the directory that training wrote.
        device: "cpu", "cuda" or "auto".

    Raises:
        MissingFile: no such directory, or it lacks a file.
        BrokenFile: a file is truncated or not what it should be.
        Mismatch: its files belong to different skills.
        InvalidInput: CUDA was asked for and isn't there.
    """
    path = Path(path)
    if not path.is_dir():
        raise MissingFile(f"{path}: no such skill directory; make it with `sart train`")
    try:
        config = SkillConfig.from_json(storage.read_json(path / "config.json"))
    except (MissingFile, BrokenFile):
        raise
    except (SartError, TypeError) as error:
        raise BrokenFile(f"{path / 'config.json'}: {error}") from error
    training = storage.read_json(path / "training.json")
    demonstration = storage.load_demonstration(path / "demo.h5")
    annotation = storage.load_annotation(path / "annotation.json")
    tensors, about = load_tensors(path / "model.safetensors")
    for name, found in (
        ("demo.h5", demonstration.content_hash()),
        ("annotation.json", annotation.demonstration_hash),
        ("model.safetensors", about.get("demonstration_hash")),
    ):
        if found != config.demonstration_hash:
            raise Mismatch(
                f"{path / name}: belongs to another demonstration than config.json; copy the "
                "whole skill directory again"
            )
    policy = build_policy(config.training)
    try:
        policy.load_state_dict(tensors)
    except RuntimeError as error:
        raise Mismatch(
            f"{path / 'model.safetensors'}: does not fit the policy in config.json "
            f"({str(error).splitlines()[-1].strip()}); copy the whole skill directory again"
        ) from error
    return Skill(policy, config, demonstration, annotation, training, device)
