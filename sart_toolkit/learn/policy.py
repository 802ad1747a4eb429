"""The interface of every policy: what training and skills ask of it, and nothing about how."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from sart_toolkit.data.records import ACTION_SIZE
from sart_toolkit.errors import InvalidInput
from sart_toolkit.learn.samples import Normalisation


@dataclass(frozen=True)
class PolicySetup:
    """What a policy is built for.

    `cameras` gives the `(height, width)` [pixels] of each camera's images by its name; `history`
    the images per observation; `hidden` and `norm` are `TrainConfig`'s.
    """

    cameras: Mapping[str, tuple[int, int]]
    history: int
    hidden: int
    norm: str


class Policy(nn.Module, ABC):
    """Actions from a history of images and gripper openings, and from how the tool is tilted.

    An observation is named tensors: `images/<camera>` uint8 `(B, K, 3, H, W)` for each camera
    (fastest when each image is channels-last in memory) and `gripper` `(B, K)` in [0, 1], both
    oldest first; and `up` `(B, 3)`, the world's upward direction in the tool frame now: how the
    tool is tilted, which a picture of a few objects tells badly and which, unlike the rest of its
    pose, says nothing of where the object stands. A training batch also has `action` `(B, 7)`: xyz
    [m], rotation vector [rad], tool frame, and gripper target in [0, 1]; or `(B, chunk, 7)`, the
    actions that follow each other, where the class says `chunk` > 1. All are in recorded units.
    Where it says `shares_pictures`, a training batch has `pictures/<camera>` `(M, 3, H, W)`, each
    different picture once, and `pictures` `(B, K)`, which of them each window has, instead of
    `images/<camera>`.

    A subclass is built from a `PolicySetup`. Means and scales of the data lie in buffers, hence in
    the state dict, once `set_normalisation` was called.

    Attributes:
        chunk: actions that a training batch holds for each observation.
        shares_pictures: whether a training batch holds each different picture once.
        norms: what `TrainConfig.norm` may be.
        train_defaults: the options of `TrainConfig` that suit it on a CPU.
    """

    chunk: ClassVar[int] = 1
    shares_pictures: ClassVar[bool] = False
    norms: ClassVar[tuple[str, ...]] = ("none",)
    train_defaults: ClassVar[Mapping[str, Any]] = {
        "epochs": 100,
        "batch_size": 128,
        "lr": 1e-3,
        "weight_decay": 1e-4,
        "schedule": "cosine",
        "image_size": 64,
        "image_shift": 0,
        "norm": "none",
    }
    gripper_mean: Tensor
    gripper_std: Tensor
    up_mean: Tensor
    action_mean: Tensor
    action_std: Tensor

    def __init__(self, setup: PolicySetup) -> None:
        super().__init__()
        self.setup = setup
        self.register_buffer("gripper_mean", torch.zeros(1))
        self.register_buffer("gripper_std", torch.ones(1))
        self.register_buffer("up_mean", torch.zeros(3))
        self.register_buffer("action_mean", torch.zeros(ACTION_SIZE))
        self.register_buffer("action_std", torch.ones(ACTION_SIZE))

    @abstractmethod
    def loss(self, batch: Mapping[str, Tensor]) -> Tensor:
        """What training lowers: a scalar, the mean over the batch."""

    @abstractmethod
    def predict(self, observation: Mapping[str, Tensor]) -> Tensor:
        """Actions `(B, 7)`, or chunks `(B, k, 7)` that are executed one after the other."""

    def reset(self) -> None:
        """Forget what was observed: the next observation begins another execution."""

    def set_normalisation(self, normalisation: Normalisation) -> None:
        """Take over the data's means and standard deviations."""
        for name, value in vars(normalisation).items():
            getattr(self, name).copy_(torch.as_tensor(value))

    def set_demonstration(self, actions: Tensor) -> None:
        """Take over the actions `(T, 7)` of the first demonstration, in recorded units."""

    def load_backbone(self, path: Path) -> None:
        """Start from the weights in a file.

        Raises:
            InvalidInput: this policy has no published weights to start from.
        """
        raise InvalidInput(
            f"{type(self).__name__} takes no --backbone-weights; leave it out, or use resnet18_mlp"
        )
