"""Training windows over a dataset: image history, gripper history, action.

Each demonstration and every episode (its segment, then its demonstration from t*) is one sequence.
Each sequence contributes a window for each of its steps, so the demonstration's steps count once
for every trajectory that passes them (the paper's data). Windows that are equal are kept once,
with that count as their multiplicity; images are kept once in any case.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sart_toolkit.data.dataset import Dataset, count_demonstrations
from sart_toolkit.data.pace import Pace, travel
from sart_toolkit.data.records import (
    Demonstration,
    Image,
    Steps,
    actions_from_commands,
    digest,
)
from sart_toolkit.data.storage import check_room, remove, replacing
from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, MissingFile, unknown_name
from sart_toolkit.learn.frames import FrameLayout, Frames, input_size
from sart_toolkit.learn.tensorfile import load_tensors, save_tensors
from sart_toolkit.poses import Array, up_in_tool

FRAMES, SAMPLES = "frames.bin", "samples.safetensors"

Batch = dict[str, Tensor]

# Smallest scale of each kind of action. A dimension that hardly moves must not be blown up: noise
# there would weigh as much as motion in the others.
_RELATIVE_FLOOR = 0.1
_TRANSLATION_FLOOR = 1e-4  # [m]
_ROTATION_FLOOR = 1e-3  # [rad]
_GRIPPER_FLOOR = 0.1

WEIGHTINGS = ("balanced", "trajectories")
# A step counts fully where the tool gets on by this share of the demonstration's pace, over so many
# steps; where it is slower, as the square. And the least that one counts.
_FULL_PACE, _SEVERAL, _LEAST_ACTIVITY = 0.35, 4, 0.1
# What the step counts in which the gripper's command changes: there is one for each grasp.
_EVENT = 4.0
# A segment counts fully if its first picture differs from the one that it leads to by this share of
# what the demonstration's mostly do for as much motion, up to so many steps at its pace. And the
# least that one counts.
_TOLD, _TOLD_STEPS, _LEAST_TOLD = 0.5, 5, 0.02
# Changes when the files do.
_LAYOUT = 2
# In a step, of the gripper's range.
_COMMAND_CHANGE, _GRIPPER_MOTION = 0.1, 0.02


@dataclass(frozen=True)
class Normalisation:
    """Means and scales of the measured gripper (1,) and of the actions (7,), in recorded units.

    And the mean `up_mean (3,)` of the upward direction.
    """

    gripper_mean: Array
    gripper_std: Array
    up_mean: Array
    action_mean: Array
    action_std: Array


@dataclass(frozen=True)
class WindowConfig:
    """What a window holds.

    `history` images of each of `cameras`, `image_size` [pixels] high, that can be shifted by up to
    `image_shift` pixels; and the `chunk` actions that follow.
    """

    cameras: tuple[str, ...]
    image_size: int
    history: int
    image_shift: int = 0
    chunk: int = 1

    def __post_init__(self) -> None:
        for name, least in (("image_size", 1), ("history", 1), ("image_shift", 0), ("chunk", 1)):
            if getattr(self, name) < least:
                raise InvalidInput(f"{name}: expected at least {least}, got {getattr(self, name)}")


@dataclass(frozen=True)
class Variation:
    """How each of a batch's windows is varied.

    `runs (B,)` int64: which run each is of; windows of one run are varied alike and share images.
    `offsets (R, 2)` int64: the row and column in 0..2 `image_shift` at which a run's images are
    cut.
    """

    offsets: Tensor
    runs: Tensor


@dataclass(frozen=True)
class Windows:
    """All distinct windows of a dataset.

    `frames`: each step's images, once. `gripper (F,)` float32: the gripper measured with them;
    `up (F, 3)` float32: the world's upward direction in the tool frame.
    `history (U, K)` int64: each window's steps, oldest first. `actions (U, 7)` float32, or
    `(U, chunk, 7)`. `multiplicity (U,)` int64: how many trajectories contribute the window.
    `activity (U,)` float32: how much happens in it, from 0.1 where the tool stands still to 1
    where it gets on at a third of the demonstration's pace, or the gripper moves, and 4 where the
    gripper's command changes; of a segment times how well pictures tell where it begins, see
    `_told`.
    `n_trajectories`: how many there are. `data_hash`: SHA-256 over all that training depends on.
    """

    frames: Frames
    gripper: Tensor
    up: Tensor
    history: Tensor
    actions: Tensor
    multiplicity: Tensor
    activity: Tensor
    n_trajectories: int
    data_hash: str

    @property
    def device(self) -> torch.device:
        """Where batches are gathered."""
        return self.history.device

    def to(self, device: torch.device) -> Windows:
        """The same windows, with a copy of all images, in the memory of a device."""
        moved = {
            field.name: getattr(self, field.name).to(device)
            for field in dataclasses.fields(self)
            if field.name not in ("n_trajectories", "data_hash")
        }
        return dataclasses.replace(self, **moved)

    def batch(
        self, windows: Tensor, variation: Variation | None = None, shared: bool = False
    ) -> Batch:
        """The named tensors of some windows, as `Policy` says.

        Args:
            windows: which windows, int64 `(B,)`.
            variation: how they are varied; not at all if left out.
            shared: give each picture once: `pictures/<camera>` instead of `images/<camera>`.
        """
        at = self.history[windows]
        runs = torch.zeros_like(windows) if variation is None else variation.runs
        steps = (runs[:, None] * len(self.gripper) + at).flatten()
        where = None
        if shared:
            steps, where = steps.unique(return_inverse=True)
        of, steps = steps // len(self.gripper), steps % len(self.gripper)
        offsets = None if variation is None else variation.offsets[of]
        batch = {
            "gripper": self.gripper[at],
            "up": self.up[at[:, -1]],
            "action": self.actions[windows],
        }
        if where is not None:
            batch["pictures"] = where.view_as(at)
        for camera, pictures in self.frames.gather(steps, offsets).items():
            if where is None:
                batch[f"images/{camera}"] = pictures.unflatten(0, at.shape)
            else:
                batch[f"pictures/{camera}"] = pictures
        return batch

    def will_need(self, windows: Tensor) -> None:
        """Say which windows come next, so that the disk has read them by then."""
        self.frames.will_need(self.history[windows])

    def epoch_order(
        self, rng: np.random.Generator, weighting: str = "balanced", run: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """One epoch's windows, as many as all trajectories have together, and each one's run.

        Args:
            rng: decides the order, and which of windows that weigh alike come once more.
            weighting: "trajectories" draws each as often as its multiplicity, so that most of what
                is learned from is what trajectories share. "balanced" draws each in proportion to
                the root of its multiplicity, times its activity.
            run: so many windows that follow each other stay together, at random places in the
                order; they have most of their images in common.
        """
        multiplicity = self.multiplicity.cpu().numpy()
        weights = multiplicity.astype(np.float64)
        if weighting == "balanced":
            weights = np.sqrt(weights) * self.activity.cpu().numpy()
        # Systematic sampling: each count is the expected one, rounded up or down.
        ends = np.cumsum(weights) * (multiplicity.sum() / weights.sum())
        ends[-1] = multiplicity.sum()
        counts = np.diff(np.floor(ends + rng.random()), prepend=0).astype(np.int64)
        windows = np.repeat(np.arange(len(counts)), counts)
        runs = (np.arange(len(windows)) + rng.integers(run)) // run
        runs = rng.permutation(runs[-1] + 1)[runs]
        order = np.argsort(runs, kind="stable")
        return windows[order], runs[order]

    def normalisation(self) -> Normalisation:
        """Means and scales over all trajectories.

        A scale is the standard deviation, but no less than a tenth of the greatest of its kind
        (the three translations, or the three rotations) and than a small absolute floor.
        """
        weights = self.multiplicity.cpu().numpy()
        gripper = self.gripper[self.history[:, -1]].cpu().numpy()[:, None]
        gripper_mean, gripper_std = _weighted_moments(gripper, weights)
        # Of a chunk, the first action: the others are other windows' first.
        actions = self.actions.reshape(len(weights), -1, self.actions.shape[-1])[:, 0]
        action_mean, action_std = _weighted_moments(actions.cpu().numpy(), weights)
        up_mean, _ = _weighted_moments(self.up[self.history[:, -1]].cpu().numpy(), weights)
        for kind, floor in (
            (slice(0, 3), _TRANSLATION_FLOOR),
            (slice(3, 6), _ROTATION_FLOOR),
            (slice(6, 7), _GRIPPER_FLOOR),
        ):
            std = action_std[kind]
            action_std[kind] = np.maximum(std, max(floor, _RELATIVE_FLOOR * std.max()))
        gripper_std = np.maximum(gripper_std, _GRIPPER_FLOOR)
        return Normalisation(gripper_mean, gripper_std, up_mean, action_mean, action_std)


def open_windows(
    dataset: Dataset,
    config: WindowConfig,
    directory: Path,
    progress: Callable[[int, int], None] | None = None,
) -> Windows:
    """The windows of a dataset, on the CPU, their images in a file that is mapped into memory.

    Only images, measured gripper, how the tool is tilted, and actions enter. A window that would
    begin before its trajectory does repeats the trajectory's first step; a chunk that would end
    after it repeats the last action, which holds still.

    The files in `directory` are written once, episode by episode, and used again for the same
    dataset and `config`.

    Args:
        dataset: demonstrations and their episodes; without episodes, the demonstrations alone.
        config: what a window holds.
        directory: where `frames.bin` and `samples.safetensors` are; made if needed.
        progress: called with (read, in all) after each demonstration or episode.

    Raises:
        InvalidInput: the demonstration holds no images.
        UnknownName: a demonstration has no such camera.
        Mismatch: an episode belongs to another demonstration, or was seen by another camera.
        CannotWrite: the disk refuses, or has too little room.
    """
    layout = _layout(dataset, config)
    options = dataclasses.asdict(config)
    key = digest({"dataset": dataset.content_hash, "layout": _LAYOUT, **options})
    frames, samples = Path(directory) / FRAMES, Path(directory) / SAMPLES
    try:
        tensors, about = load_tensors(samples)
        n_bytes = len(tensors["gripper"]) * layout.frame_bytes
        usable = about.get("key") == key and frames.stat().st_size == n_bytes
    except (MissingFile, BrokenFile, FileNotFoundError):
        usable = False
    if not usable:
        remove(samples)
        tensors, about = _write(dataset, config, layout, frames, progress)
        # Last, so that frames with it are whole.
        save_tensors(samples, tensors, {**about, "key": key})
    return Windows(
        Frames.in_file(frames, layout),
        **tensors,
        n_trajectories=about["n_trajectories"],
        data_hash=about["data_hash"],
    )


def remove_windows(directory: Path) -> None:
    """Remove what `open_windows` wrote.

    Raises:
        CannotWrite: the disk refuses.
    """
    remove(Path(directory) / SAMPLES)
    remove(Path(directory) / FRAMES)


def _layout(dataset: Dataset, config: WindowConfig) -> FrameLayout:
    cameras = dataset.sources[0].demonstration.steps.cameras
    if not cameras:
        raise InvalidInput(
            "the dataset's first demonstration holds no images; record one with a camera, such as "
            "--cameras wrist, and generate from it"
        )
    for camera in config.cameras:
        if camera not in cameras:
            raise unknown_name("camera", camera, cameras)
    sizes = {
        camera: input_size(cameras[camera].rgb.shape[1:3], config.image_size)
        for camera in config.cameras
    }
    return FrameLayout(sizes, config.image_shift)


def _write(
    dataset: Dataset,
    config: WindowConfig,
    layout: FrameLayout,
    path: Path,
    progress: Callable[[int, int], None] | None,
) -> tuple[dict[str, Tensor], dict[str, object]]:
    """Write the frames' file; the windows' tensors, and what else is to be known of them."""
    n_trajectories = count_demonstrations(dataset.sources) + len(dataset)
    demonstrations = {s.demonstration_hash: len(s.demonstration) for s in dataset.sources}
    n_steps = sum(demonstrations.values())
    n_steps += sum(entry.steps for entry in dataset.index)
    check_room(path, n_steps * layout.frame_bytes)

    back, ahead = np.arange(-config.history + 1, 1), np.arange(config.chunk)
    gripper, up = np.empty(n_steps), np.empty((n_steps, 3))
    histories: list[NDArray[np.int64]] = []
    chunks: list[NDArray[np.float32]] = []
    change = 0.0
    activities: list[Array] = []
    pace = Pace(dataset.sources[0].demonstration)
    n_written = 0
    sha = hashlib.sha256()
    with replacing(path) as temporary, open(temporary, "w+b") as file:
        for steps, following, actions, joined in _trajectories(dataset, config.cameras):
            packed = layout.pack(steps)
            file.write(packed.data)
            sha.update(packed.data)
            gripper[n_written : n_written + len(steps)] = steps.measured_gripper
            up[n_written : n_written + len(steps)] = up_in_tool(steps.measured_Ts_world_tool)
            sequence = np.concatenate([np.arange(n_written, n_written + len(steps)), following])
            histories.append(sequence[_clipped(len(sequence), back)])
            chunks.append(actions.astype(np.float32)[_clipped(len(sequence), ahead)])
            activity = _activity(actions, gripper[sequence], pace.step)
            if joined is not None:
                file.seek(joined * layout.frame_bytes)
                goal = np.frombuffer(file.read(layout.frame_bytes), np.uint8)
                file.seek(0, os.SEEK_END)
                far = travel(actions[: len(steps)]).sum()
                activity[: len(steps)] *= _told(
                    packed[0], goal, min(far, _TOLD_STEPS * pace.step) * change
                )
            elif not n_written:
                change = _change(packed, actions)
            activities.append(activity)
            n_written += len(steps)
            if progress is not None:
                progress(len(histories), n_trajectories)

    # The last step of a window determines what follows, so equal histories are equal windows.
    windows, chosen, multiplicity = np.unique(
        np.concatenate(histories), axis=0, return_index=True, return_counts=True
    )
    chunk = np.concatenate(chunks)[chosen]
    arrays = {
        "gripper": gripper[:n_written].astype(np.float32),
        "up": up[:n_written].astype(np.float32),
        "history": windows,
        "actions": chunk[:, 0] if config.chunk == 1 else chunk,
        "multiplicity": multiplicity,
        "activity": np.concatenate(activities)[chosen].astype(np.float32),
    }
    about = {
        "n_trajectories": n_trajectories,
        "data_hash": digest({"frames": sha.hexdigest(), **arrays}),
    }
    return {name: torch.from_numpy(array) for name, array in arrays.items()}, about


def _trajectories(
    dataset: Dataset, cameras: tuple[str, ...]
) -> Iterator[tuple[Steps, NDArray[np.int64], Array, int | None]]:
    """For each trajectory its own steps, the numbers of those that follow them, and its actions.

    And of a segment the number of the step at t*. Steps are numbered as they are yielded: an
    episode's are followed by its demonstration's.
    """
    # Sources may share a demonstration, which is learned from once.
    demonstrations: dict[str, tuple[Demonstration, int, Array]] = {}
    n_yielded = 0
    reference = dataset.sources[0].demonstration.steps
    for source in dataset.sources:
        if source.demonstration_hash in demonstrations:
            continue
        demonstration, actions = source.demonstration, source.demonstration.actions
        _check_same_cameras(source.name, demonstration.steps, reference, cameras)
        demonstrations[source.demonstration_hash] = demonstration, n_yielded, actions
        yield demonstration.steps, np.arange(0), actions, None
        n_yielded += len(demonstration)
    for i, episode in enumerate(dataset):
        t_star = episode.provenance.t_star
        source = dataset.sources[dataset.index[i].source]
        demonstration, first, actions = demonstrations[source.demonstration_hash]
        if not 0 <= t_star < len(demonstration):
            raise Mismatch(
                f"episode {i} rejoins at step {t_star} of a demonstration of "
                f"{len(demonstration)} steps; generate again"
            )
        _check_same_cameras(f"episode {i}", episode.steps, reference, cameras)
        # `episode.actions(demonstration)`, of which those from t* on are known already.
        n = len(episode)
        commanded, gripper = episode.commands(demonstration)
        own_actions = actions_from_commands(commanded[: n + 1], gripper[: n + 1])[:n]
        # Where it isn't merged, the step that it leads to has no action of its own to learn.
        after = np.arange(t_star, len(demonstration) if episode.provenance.merged else t_star)
        yield (
            episode.steps,
            first + after,
            np.concatenate([own_actions, actions[after]]),
            first + t_star,
        )


def _activity(actions: Array, gripper: Array, pace: float) -> Array:
    """How much happens `(n,)` in a trajectory's steps, see `Windows`.

    What stands still looks alike whatever comes next. Were waiting steps to count as much as
    others, a policy would learn to go on waiting. A hand trembles while it waits, so what counts is
    how far the tool gets in several steps, those that come or those that were.
    """
    along = np.cumsum(np.vstack([np.zeros(6), actions[:, :6]]), axis=0)
    at, n = np.arange(len(actions)), len(actions)
    to, since = np.minimum(at + _SEVERAL, n), np.maximum(at + 1 - _SEVERAL, 0)
    coming = travel(along[to] - along[at]) / (to - at)
    gone = travel(along[at + 1] - along[since]) / (at + 1 - since)
    share = np.maximum(coming, gone) / (_FULL_PACE * pace)
    activity = np.clip(share**2, _LEAST_ACTIVITY, 1.0)
    activity[:-1][np.abs(np.diff(gripper)) > _GRIPPER_MOTION] = 1.0
    activity[1:][np.abs(np.diff(actions[:, 6])) > _COMMAND_CHANGE] = _EVENT
    return activity


def _change(packed: Image, actions: Array) -> float:
    """How much a demonstration's pictures change [of 255] a metre, as `travel` counts it."""
    changes = np.abs(np.diff(packed.astype(np.int16), axis=0)).mean(1)
    return float(changes.sum() / max(travel(actions).sum(), 1e-9))


def _told(first: Image, goal: Image, usual: float) -> float:
    """How well (0 to 1) a picture tells where a segment begins from where it leads to.

    Where all that a camera sees is in the grasp, pictures hardly change. Segments there lead every
    which way from what looks alike; counted fully they keep a policy from doing what the
    demonstration did.

    Args:
        first: the packed picture of the segment's first step.
        goal: that of the demonstration's step at t*.
        usual: the change [of 255] that is to be expected.
    """
    if not usual > 0:
        return 1.0
    seen = np.abs(first.astype(np.int16) - goal).mean()
    return max(_LEAST_TOLD, min(1.0, float(seen / (_TOLD * usual))) ** 2)


def _clipped(n: int, around: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each of `n` steps the steps `around` it, those beyond the ends replaced by the ends."""
    return np.clip(np.arange(n)[:, None] + around, 0, n - 1)


def _check_same_cameras(
    what: str, steps: Steps, reference: Steps, cameras: tuple[str, ...]
) -> None:
    for name in cameras:
        expected, camera = reference.cameras[name], steps.cameras.get(name)
        if camera is None:
            raise Mismatch(f"{what} has no images of camera {name!r}; generate again with it")
        if (
            camera.rgb.shape[1:] != expected.rgb.shape[1:]
            or not np.allclose(camera.intrinsics, expected.intrinsics)
            or camera.frame != expected.frame
            or not np.allclose(camera.T_frame_camera, expected.T_frame_camera, rtol=0, atol=1e-5)
        ):
            raise Mismatch(
                f"{what}: camera {name!r} has another size, intrinsics or mounting than in "
                "the first demonstration; generate again with the same camera"
            )


def _weighted_moments(
    values: NDArray[np.float32], weights: NDArray[np.int64]
) -> tuple[Array, Array]:
    shares = weights / weights.sum()
    mean: Array = shares @ values.astype(np.float64)
    std: Array = np.sqrt(shares @ (values - mean) ** 2)
    return mean, std
