"""A trained skill: a directory that can be loaded and executed on any backend."""

from __future__ import annotations

import dataclasses
import hashlib
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from sart_toolkit.data import storage
from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.records import (
    ACTION_SIZE,
    Annotation,
    Demonstration,
    Image,
    Referring,
    digest,
    library_versions,
)
from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, SartError
from sart_toolkit.learn.frames import input_size, resize_area
from sart_toolkit.learn.policy import Policy
from sart_toolkit.learn.samples import remove_windows
from sart_toolkit.learn.skillfiles import ANNOTATION, check_directory, load_files, write_config
from sart_toolkit.learn.tensorfile import load_tensors, save_tensors
from sart_toolkit.learn.training import (
    CHECKPOINT,
    TrainConfig,
    TrainResult,
    build_policy,
    resolve_device,
    torch_threads,
)
from sart_toolkit.poses import Array, check_array, check_pose, frozen

_T = TypeVar("_T")

# A gripper commanded to open and close takes two values; more mean an analogue trigger.
_FEW_GRIPPER_COMMANDS = 4
# For a batch of one, more only wait for each other: measured on two busy cores, two took 3 times
# (compact_mlp) and 6 times (resnet18_mlp) as long, with another process beside them 8 to 13 times.
# And what a policy does must not depend on the machine's cores.
_THREADS = 1


@dataclass(frozen=True)
class SkillCamera:
    """A camera as it was in the demonstration.

    `size` is the recorded `(height, width)` [pixels]; `intrinsics (3, 3)` in pixels;
    `T_frame_camera (4, 4)` in the `frame` that it was mounted on, "tool" or "world".
    """

    size: tuple[int, int]
    intrinsics: Array
    frame: str
    T_frame_camera: Array

    def __post_init__(self) -> None:
        size = tuple(self.size)
        if len(size) != 2 or not all(isinstance(n, int) and n > 0 for n in size):
            raise InvalidInput(f"size: expected (height, width) [pixels], got {size}")
        object.__setattr__(self, "size", size)
        intrinsics = check_array("intrinsics", self.intrinsics, (3, 3))
        object.__setattr__(self, "intrinsics", frozen(intrinsics))
        T_frame_camera = check_pose("T_frame_camera", self.T_frame_camera)
        object.__setattr__(self, "T_frame_camera", frozen(T_frame_camera))

    def to_json(self) -> dict[str, Any]:
        """The camera as JSON values."""
        return {
            "size": list(self.size),
            "intrinsics": self.intrinsics.tolist(),
            "frame": self.frame,
            "T_frame_camera": self.T_frame_camera.tolist(),
        }


@dataclass(frozen=True)
class SkillConfig(Referring):
    """What must be known to execute a skill elsewhere.

    The task and its parameters, robot and backend it was shown on; the `cameras` it sees by name;
    the demonstration's content hash; and how it was trained.
    """

    task: str
    task_parameters: Mapping[str, Any]
    robot: str
    backend: str
    cameras: Mapping[str, SkillCamera]
    demonstration_hash: str
    training: TrainConfig
    references: Mapping[str, str]

    def __post_init__(self) -> None:
        if set(self.cameras) != set(self.training.cameras):
            raise InvalidInput(
                f"cameras: expected {', '.join(self.training.cameras)} as in training, got "
                f"{', '.join(self.cameras) or 'none'}"
            )

    @property
    def image_sizes(self) -> dict[str, tuple[int, int]]:
        """`(height, width)` [pixels] of the images that the policy sees, by camera, in order."""
        training = self.training
        return {
            name: input_size(self.cameras[name].size, training.image_size)
            for name in training.cameras
        }

    def to_json(self) -> dict[str, Any]:
        """The configuration as JSON values."""
        return {
            **{field.name: getattr(self, field.name) for field in dataclasses.fields(self)},
            "task_parameters": dict(self.task_parameters),
            "cameras": {name: camera.to_json() for name, camera in self.cameras.items()},
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
        _check_keys("skill configuration", value, cls)
        cameras = {}
        for name, camera in _named("cameras", value["cameras"]).items():
            _check_keys(f"camera {name!r} of the skill configuration", camera, SkillCamera)
            cameras[name] = SkillCamera(**camera)
        training = TrainConfig.from_json(value["training"])
        return cls(**{**value, "cameras": cameras, "training": training})


def _named(what: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise InvalidInput(f"{what}: expected values by name, got {value!r}")
    return value


def _check_keys(what: str, value: Any, record: type) -> None:
    names = {field.name for field in dataclasses.fields(record)}
    if wrong := sorted(names ^ _named(what, value).keys()):
        problem = "is missing" if wrong[0] in names else "is unknown"
        raise InvalidInput(f"{what}: {wrong[0]!r} {problem}; train the skill again")


class Skill:
    """A trained policy that remembers its own history: `reset()`, then `act(...)` at its rate.

    Attributes:
        config: what must be known to execute it elsewhere.
        demonstration: the demonstration it came from.
        annotation: the annotation it came from, `None` where there was none.
        training: its training curve, speed and versions, as `training.json` has them.
    """

    def __init__(
        self,
        policy: Policy,
        config: SkillConfig,
        demonstration: Demonstration,
        annotation: Annotation | None,
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
        history = config.training.history
        self._images: dict[str, deque[Image]] = {
            name: deque(maxlen=history) for name in config.training.cameras
        }
        self._gripper: deque[float] = deque(maxlen=history)
        self._chunk: deque[Array] = deque()

    @property
    def cameras(self) -> tuple[str, ...]:
        """The names of the cameras that it sees."""
        return self.config.training.cameras

    def reset(self) -> None:
        """Forget the history: the next `act` starts a new execution."""
        self._policy.reset()
        for images in self._images.values():
            images.clear()
        self._gripper.clear()
        self._chunk.clear()

    def act(self, images: Mapping[str, Image], gripper: float, up: Array) -> Array:
        """The action `(7,)`: xyz [m], rotation vector [rad], tool frame; gripper target in [0, 1].

        Where the policy predicts several actions at once, they are given one after the other
        before it is asked again. Where the demonstration knew a few gripper commands only, the
        nearest of them is given.

        Args:
            images: what the skill's `cameras` see now, by name, uint8 `(H, W, 3)` of any size;
                resized exactly as in training. Other cameras' are left aside.
            gripper: measured gripper in [0, 1] (0 open).
            up: the world's upward direction `(3,)` in the tool frame, as `Observation.up` has it.

        Raises:
            InvalidInput: a camera's image is missing or isn't one, the gripper is not a finite
                number, `up` is no direction, or the policy predicts no action.
        """
        seen = {name: _checked_image(name, images) for name in self.cameras}
        if not np.isfinite(gripper):
            raise InvalidInput(f"gripper: expected a number in [0, 1], got {gripper}")
        up = check_array("up", up, (3,))
        if not np.isclose(np.linalg.norm(up), 1.0, atol=1e-3):
            raise InvalidInput(f"up: expected a unit vector in the tool frame, got {up}")
        for name, size in self.config.image_sizes.items():
            _remember(self._images[name], resize_area(seen[name], size))
        _remember(self._gripper, float(gripper))
        if not self._chunk:
            self._chunk.extend(self._predict(up))
        action = self._chunk.popleft()
        action[6] = self._commandable(action[6])
        return action

    def __call__(self, observation: Mapping[str, Any]) -> Array:
        """The action `(7,)` for an observation of `sart_toolkit.gym`, see `act`.

        Args:
            observation: `pixels`, images by camera, and `agent_pos`: the gripper, its rate, and
                the upward direction.

        Raises:
            InvalidInput: as `act`.
        """
        state = np.asarray(observation["agent_pos"], np.float64)
        return self.act(observation["pixels"], float(state[0]), state[2:])

    def _predict(self, up: Array) -> Array:
        """The next actions `(k, 7)`."""
        observation = {
            f"images/{name}": torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)
            for name, images in self._images.items()
        }
        observation["gripper"] = torch.tensor(list(self._gripper))
        observation["up"] = torch.from_numpy(up.astype(np.float32))
        with torch.inference_mode(), torch_threads(_THREADS):
            predicted = self._policy.predict(
                {name: value[None].to(self._device) for name, value in observation.items()}
            )
        actions = predicted[0].double().cpu().numpy()
        actions = check_array("predicted actions", np.atleast_2d(actions), (None, ACTION_SIZE))
        if not len(actions):
            raise InvalidInput("predicted actions: expected at least one, got none")
        return actions

    def _commandable(self, gripper: float) -> float:
        """The gripper target itself, or the nearest of the few that the demonstration commanded.

        A regressed target is a little off, the gripper follows it, and the policy follows the
        gripper: what was shown only open or closed would creep shut on the way.
        """
        demonstrated = self._gripper_commands
        if len(demonstrated) > _FEW_GRIPPER_COMMANDS:
            return gripper
        return float(demonstrated[np.argmin(np.abs(demonstrated - gripper))])


def _checked_image(camera: str, images: Mapping[str, Image]) -> Image:
    if camera not in images:
        raise InvalidInput(
            f"images: expected one of camera {camera!r}, got {', '.join(images) or 'none'}"
        )
    rgb = np.asarray(images[camera])
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or rgb.size == 0:
        raise InvalidInput(
            f"image of camera {camera!r}: expected uint8 of shape (H, W, 3), got {rgb.dtype} "
            f"{rgb.shape}"
        )
    return rgb


def _remember(history: deque[_T], newest: _T) -> None:
    """Add to a history, which begins full of what was observed first."""
    history.extend([newest] * (1 if history else history.maxlen or 1))


def save_skill(
    path: Path, result: TrainResult, dataset: Dataset, overwrite: bool = False
) -> SkillConfig:
    """Write a skill directory; `config.json` comes last, so that a directory with it is whole.

    A training's checkpoint and windows in the directory are removed: the skill takes their place.

    Raises:
        OutputExists: there is a skill already and `overwrite` is false.
        InvalidInput: a weight is NaN or infinite.
        CannotWrite: another process is at work on the directory, or the disk refuses.
    """
    path = Path(path)
    weights = result.policy.state_dict()
    if (name := _not_finite(weights)) is not None:
        raise InvalidInput(
            f"policy: weight {name!r} has NaN or infinite values, so it can't be saved; train "
            "again with another --seed or a lower learning rate"
        )
    with storage.OutputLock(path, nested=True):
        storage.check_writable(path / "config.json", overwrite)
        return _write_skill(path, result, dataset, weights)


def _write_skill(
    path: Path, result: TrainResult, dataset: Dataset, weights: Mapping[str, torch.Tensor]
) -> SkillConfig:
    storage.remove(path / "config.json")
    source = dataset.sources[0]
    demonstration = source.demonstration
    recorded = {name: demonstration.steps.cameras[name] for name in result.config.cameras}
    config = SkillConfig(
        task=demonstration.task,
        task_parameters=demonstration.task_parameters,
        robot=demonstration.robot,
        backend=demonstration.backend,
        cameras={
            name: SkillCamera(
                (camera.rgb.shape[1], camera.rgb.shape[2]),
                camera.intrinsics,
                camera.frame,
                camera.T_frame_camera,
            )
            for name, camera in recorded.items()
        },
        demonstration_hash=demonstration.content_hash(),
        training=result.config,
        references=demonstration.references,
    )
    storage.save_demonstration(path / "demo.h5", demonstration)
    storage.remove(path / ANNOTATION)
    if source.annotation is not None:
        storage.save_annotation(path / ANNOTATION, source.annotation)
    training = {
        "curve": [dataclasses.asdict(record) for record in result.curve],
        "final_loss": result.final_loss,
        "seconds": result.seconds,
        "images_per_second": result.images_per_second,
        "windows": result.n_windows,
        "trajectories": result.n_trajectories,
        "device": result.device,
        "bfloat16": result.bfloat16,
        "config": result.config.to_json(),
        "versions": library_versions(),
    }
    storage.write_json(path / "training.json", training)
    save_tensors(
        path / "model.safetensors", weights, {"demonstration_hash": config.demonstration_hash}
    )
    write_config(path, config.to_json())
    storage.remove(path / CHECKPOINT)
    remove_windows(path)
    return config


def skill_hash(directory: Path) -> str:
    """SHA-256 over what decides how a skill's directory acts: its settings and its weights."""
    files = (Path(directory) / name for name in ("config.json", "model.safetensors"))
    return digest({file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files})


def load_skill(path: Path, device: str = "cpu") -> Skill:
    """The skill in a directory, ready to act.

    Args:
        path: the directory that training wrote.
        device: "cpu", "cuda" or "auto".

    Raises:
        MissingFile: no such directory, or it lacks a file.
        BrokenFile: a file is truncated, was changed, or holds a weight that is no finite number.
        Mismatch: its files belong to different skills.
        InvalidInput: CUDA was asked for and isn't there.
    """
    path = Path(path)
    check_directory(path)
    # What is damaged, before what belongs to something else.
    tensors, _ = load_tensors(path / "model.safetensors")
    files = load_files(path)
    try:
        config = SkillConfig.from_json(files.config)
    except (SartError, TypeError, ValueError, LookupError, OverflowError) as error:
        raise BrokenFile(f"{path / 'config.json'}: {error}") from error
    if (name := _not_finite(tensors)) is not None:
        raise BrokenFile(
            f"{path / 'model.safetensors'}: weight {name!r} has NaN or infinite values; train again"
        )
    policy = build_policy(config.training, config.image_sizes)
    try:
        policy.load_state_dict(tensors)
    except (RuntimeError, TypeError, ValueError) as error:
        raise Mismatch(
            f"{path / 'model.safetensors'}: does not fit the policy in config.json "
            f"({str(error).splitlines()[-1].strip()}); copy the whole skill directory again"
        ) from error
    return Skill(policy, config, files.demonstration, files.annotation, files.training, device)


def _not_finite(tensors: Mapping[str, torch.Tensor]) -> str | None:
    """The name of the first tensor that holds NaN or an infinite value."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not torch.isfinite(tensor).all():
            return name
    return None
