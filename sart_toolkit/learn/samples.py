"""Training windows over a dataset: picture history, gripper history, action.

The demonstration and every episode (its segment, then the demonstration from t*) is one sequence.
Each sequence contributes a window for each of its steps, so the demonstration's steps count once
for every trajectory that passes them (the paper's data). Windows that are equal are kept once,
with that count as their multiplicity; pictures are kept once in any case.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sart_toolkit.data.records import CameraRecord, Dataset, Image, Steps, digest
from sart_toolkit.errors import InvalidInput, Mismatch, unknown_name
from sart_toolkit.poses import Array

Batch = tuple[Tensor, Tensor, Tensor]

# Smallest scale of each kind of action. A dimension that hardly moves must not be blown up: noise
# there would weigh as much as motion in the others.
_RELATIVE_FLOOR = 0.1
_TRANSLATION_FLOOR = 1e-4  # [m]
_ROTATION_FLOOR = 1e-3  # [rad]
_GRIPPER_FLOOR = 0.1


def resize_area(rgb: Image, size: int) -> Image:
    """The picture uint8 `(size, size, 3)`, each pixel the mean of the area it covers.

    Computed in whole numbers up to the last division, hence the same to the bit everywhere, and
    without BLAS, whose threads would cost far more than so small a product.

    Args:
        rgb: uint8 `(H, W, 3)`, of any height and width.
        size: new height and width [pixels].
    """
    height, width = rgb.shape[:2]
    if (height, width) == (size, size):
        return rgb
    rows = _area_sums(rgb.reshape(height, -1), size).reshape(size, width, 3)
    columns = _area_sums(rows.swapaxes(0, 1).reshape(width, -1), size).reshape(size, size, 3)
    return np.rint(columns.swapaxes(0, 1) / (height * width)).astype(np.uint8)


def _area_sums(x: NDArray[Any], size: int) -> NDArray[np.int64]:
    """Sums `(size, m)` of `x (n, m)` over `size` equal parts of its rows; a row counts `size`."""
    n = len(x)
    before = np.zeros((n + 1, x.shape[1]), np.int64)
    np.cumsum(x, axis=0, out=before[1:])
    whole, part = np.divmod(np.arange(size + 1) * n, size)
    up_to_edge = size * before[whole] + part[:, None] * x[np.minimum(whole, n - 1)]
    return np.diff(up_to_edge, axis=0)


@dataclass(frozen=True)
class Normalisation:
    """Means and scales of the measured gripper (1,) and of the actions (7,), in recorded units."""

    gripper_mean: Array
    gripper_std: Array
    action_mean: Array
    action_std: Array


@dataclass(frozen=True)
class Windows:
    """All distinct windows of a dataset, as tensors on one device.

    `frames (F, S + 2 pad, S + 2 pad, 3)` uint8: every picture once, its edge repeated `pad` times
    around it. `gripper (F,)` float32: the gripper measured with it. `history (U, K)` int64: each
    window's frames, oldest first. `actions (U, 7)` float32. `multiplicity (U,)` int64: how many
    trajectories contribute the window.
    """

    frames: Tensor
    gripper: Tensor
    history: Tensor
    actions: Tensor
    multiplicity: Tensor
    pad: int = 0

    @property
    def image_size(self) -> int:
        """Height and width of a batch's pictures."""
        return self.frames.shape[1] - 2 * self.pad

    def batch(self, windows: Tensor, offsets: Tensor | None = None) -> Batch:
        """Frames uint8 `(B, K, 3, S, S)`, channels-last in memory, gripper `(B, K)`, actions.

        Args:
            windows: which windows, int64 `(B,)`.
            offsets: rows and columns, int64 `(B, 2)` in 0..2 pad, at which each window's pictures
                are cut from the padded ones: the same for all of a window's pictures. In the
                middle when left out.
        """
        at = self.history[windows]
        size = self.image_size
        if self.pad == 0:
            frames = self.frames.index_select(0, at.flatten()).unflatten(0, at.shape)
            frames = frames.permute(0, 1, 4, 2, 3)
        elif offsets is None:
            middle = slice(self.pad, self.pad + size)
            frames = self.frames[at][:, :, middle, middle].permute(0, 1, 4, 2, 3)
        else:
            cuts = self.frames.unfold(1, size, 1).unfold(2, size, 1).permute(0, 1, 2, 4, 5, 3)
            frames = cuts[at, offsets[:, :1], offsets[:, 1:]].permute(0, 1, 4, 2, 3)
        return frames, self.gripper[at], self.actions[windows]

    def padded(self, pad: int) -> Windows:
        """The same windows whose pictures can be shifted by up to `pad` pixels."""
        size = self.image_size
        inside = torch.arange(-pad, size + pad, device=self.frames.device).clamp(0, size - 1)
        inside = inside + self.pad
        frames = self.frames[:, inside][:, :, inside].contiguous()
        return dataclasses.replace(self, frames=frames, pad=pad)

    def to(self, device: torch.device) -> Windows:
        """The same windows on another device."""
        tensors = {k: v.to(device) for k, v in vars(self).items() if isinstance(v, Tensor)}
        return Windows(**tensors, pad=self.pad)

    def epoch_order(self, rng: np.random.Generator) -> NDArray[np.int64]:
        """One epoch's windows in random order, each as often as its multiplicity."""
        multiplicity = self.multiplicity.cpu().numpy()
        return rng.permutation(np.repeat(np.arange(len(multiplicity)), multiplicity))

    def normalisation(self) -> Normalisation:
        """Means and scales over all trajectories.

        A scale is the standard deviation, but no less than a tenth of the greatest of its kind
        (the three translations, or the three rotations) and than a small absolute floor.
        """
        weights = self.multiplicity.cpu().numpy()
        gripper = self.gripper[self.history[:, -1]].cpu().numpy()[:, None]
        gripper_mean, gripper_std = _weighted_moments(gripper, weights)
        action_mean, action_std = _weighted_moments(self.actions.cpu().numpy(), weights)
        for kind, floor in (
            (slice(0, 3), _TRANSLATION_FLOOR),
            (slice(3, 6), _ROTATION_FLOOR),
            (slice(6, 7), _GRIPPER_FLOOR),
        ):
            std = action_std[kind]
            action_std[kind] = np.maximum(std, max(floor, _RELATIVE_FLOOR * std.max()))
        gripper_std = np.maximum(gripper_std, _GRIPPER_FLOOR)
        return Normalisation(gripper_mean, gripper_std, action_mean, action_std)

    def content_hash(self) -> str:
        """SHA-256 over all tensors: what a training run depends on."""
        return digest({k: v.cpu().numpy() for k, v in vars(self).items() if isinstance(v, Tensor)})


def build_windows(dataset: Dataset, camera: str, image_size: int, history: int) -> Windows:
    """The windows of a dataset, on the CPU.

    Only pictures, measured gripper and actions enter. A window that would begin before its
    trajectory does repeats the trajectory's first frame.

    Args:
        dataset: the demonstration and its episodes; without episodes, the demonstration alone.
        camera: whose pictures.
        image_size: height and width [pixels] to which pictures are resized by area.
        history: frames per window, at least 1.

    Raises:
        InvalidInput: `image_size` or `history` below 1.
        UnknownName: the demonstration has no such camera.
        Mismatch: an episode belongs to another demonstration, or was seen by another camera.
    """
    for name, value in (("image_size", image_size), ("history", history)):
        if value < 1:
            raise InvalidInput(f"{name}: expected at least 1, got {value}")
    demonstration = dataset.demonstration
    if camera not in demonstration.steps.cameras:
        raise unknown_name("camera", camera, demonstration.steps.cameras)
    reference = demonstration.steps.cameras[camera]
    demonstration_hash = demonstration.content_hash()

    recordings: list[Steps] = [demonstration.steps]
    sequences = [np.arange(len(demonstration))]
    actions = [demonstration.actions]
    n_frames = len(demonstration)
    for i, episode in enumerate(dataset.episodes):
        t_star = episode.provenance.t_star
        if episode.provenance.demonstration_hash != demonstration_hash:
            raise Mismatch(f"episode {i} was generated from another demonstration; generate again")
        if not 0 <= t_star < len(demonstration):
            raise Mismatch(
                f"episode {i} rejoins at step {t_star} of a demonstration of "
                f"{len(demonstration)} steps; generate again"
            )
        _check_same_camera(i, camera, episode.steps.cameras.get(camera), reference)
        own = np.arange(n_frames, n_frames + len(episode))
        sequences.append(np.concatenate([own, np.arange(t_star, len(demonstration))]))
        actions.append(episode.actions(demonstration))
        recordings.append(episode.steps)
        n_frames += len(episode)

    back = np.arange(-history + 1, 1)
    all_windows = np.concatenate(
        [sequence[np.clip(np.arange(len(sequence))[:, None] + back, 0, None)]
         for sequence in sequences]
    )  # fmt: skip
    # The last frame of a window determines its action, so equal histories are equal windows.
    windows, first, multiplicity = np.unique(
        all_windows, axis=0, return_index=True, return_counts=True
    )
    pictures = [
        resize_area(rgb, image_size) for steps in recordings for rgb in steps.cameras[camera].rgb
    ]
    return Windows(
        frames=torch.from_numpy(np.stack(pictures)),
        gripper=torch.from_numpy(
            np.concatenate([steps.measured_gripper for steps in recordings]).astype(np.float32)
        ),
        history=torch.from_numpy(windows),
        actions=torch.from_numpy(np.concatenate(actions)[first].astype(np.float32)),
        multiplicity=torch.from_numpy(multiplicity),
    )


def _check_same_camera(
    i: int, name: str, camera: CameraRecord | None, reference: CameraRecord
) -> None:
    if camera is None:
        raise Mismatch(f"episode {i} has no pictures of camera {name!r}; generate again with it")
    if (
        camera.rgb.shape[1:] != reference.rgb.shape[1:]
        or not np.allclose(camera.intrinsics, reference.intrinsics)
        or camera.frame != reference.frame
        or not np.allclose(camera.T_frame_camera, reference.T_frame_camera, rtol=0, atol=1e-5)
    ):
        raise Mismatch(
            f"episode {i}: camera {name!r} has another size, intrinsics or mounting than in the "
            "demonstration; generate again with the same camera"
        )


def _weighted_moments(
    values: NDArray[np.float32], weights: NDArray[np.int64]
) -> tuple[Array, Array]:
    shares = weights / weights.sum()
    mean: Array = shares @ values.astype(np.float64)
    std: Array = np.sqrt(shares @ (values - mean) ** 2)
    return mean, std
