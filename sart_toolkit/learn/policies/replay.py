"""`replay`: the demonstration's actions given again, whatever the cameras see."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from sart_toolkit.data.records import ACTION_SIZE
from sart_toolkit.learn.policy import Policy, PolicySetup


class Replay(Policy):
    """The first demonstration's actions one after the other, then holding still: a baseline.

    It learns nothing; its loss is 0.
    """

    train_defaults: ClassVar[Mapping[str, Any]] = {**Policy.train_defaults, "epochs": 1}
    actions: Tensor

    def __init__(self, setup: PolicySetup) -> None:
        super().__init__(setup)
        self.register_buffer("actions", torch.zeros(0, ACTION_SIZE))
        # An optimizer wants a weight to train; this one has no elements.
        self.nothing = nn.Parameter(torch.zeros(0))
        self._given = False

    def set_demonstration(self, actions: Tensor) -> None:
        self.actions = actions.to(self.actions)

    def loss(self, batch: Mapping[str, Tensor]) -> Tensor:
        return self.nothing.sum()

    def predict(self, observation: Mapping[str, Tensor]) -> Tensor:
        actions = self.actions
        if self._given:
            actions = torch.zeros_like(actions[:1])
            actions[:, -1] = self.actions[-1, -1]
        self._given = True
        return actions.expand(len(observation["gripper"]), *actions.shape)

    def reset(self) -> None:
        self._given = False

    def _load_from_state_dict(
        self, state_dict: Mapping[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        # How long the demonstration was isn't known before.
        saved = state_dict.get(f"{prefix}actions")
        if saved is not None:
            self.actions = torch.zeros_like(saved)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
