"""The head that `compact_mlp` and `resnet18_mlp` share: two hidden layers over image features."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn

from sart_toolkit.data.records import ACTION_SIZE
from sart_toolkit.learn.policies.encoder import Encoder
from sart_toolkit.learn.policy import Policy, PolicySetup

STATE_FEATURE = 512
# The tilt that counts as one [rad].
_TILT = 0.1


class MLPPolicy(Policy):
    """One action from an encoder for each camera, under one multi-layer perceptron.

    The features of every image and a 512-d feature of the gripper history and the tool's tilt pass
    two hidden ReLU layers (the paper's table, which has no tilt). Cameras share the encoder's
    class, not its weights.

    A subclass names its `encoder`. The loss is the mean squared error of the normalised actions.
    """

    encoder: ClassVar[type[Encoder]]
    shares_pictures: ClassVar[bool] = True
    image_mean: Tensor
    image_scale: Tensor

    def __init__(self, setup: PolicySetup) -> None:
        super().__init__(setup)
        encoders = [self.encoder(size, setup.norm) for size in setup.cameras.values()]
        self.encoders = nn.ModuleList(encoders)
        n_features = sum(encoder.feature_size for encoder in encoders)
        self.state_layer = nn.Sequential(nn.Linear(setup.history + 3, STATE_FEATURE), nn.ReLU())
        self.head = nn.Sequential(
            nn.Linear(setup.history * n_features + STATE_FEATURE, setup.hidden),
            nn.ReLU(),
            nn.Linear(setup.hidden, setup.hidden),
            nn.ReLU(),
            nn.Linear(setup.hidden, ACTION_SIZE),
        )
        self.register_buffer("image_mean", torch.tensor(self.encoder.image_mean)[:, None, None])
        self.register_buffer("image_scale", 1 / torch.tensor(self.encoder.image_std)[:, None, None])

    def loss(self, batch: Mapping[str, Tensor]) -> Tensor:
        target = (batch["action"] - self.action_mean) / self.action_std
        return (self._normalised_actions(batch) - target).square().mean()

    def predict(self, observation: Mapping[str, Tensor]) -> Tensor:
        return self._normalised_actions(observation) * self.action_std + self.action_mean

    def _normalised_actions(self, observation: Mapping[str, Tensor]) -> Tensor:
        gripper = observation["gripper"]
        features = []
        # In training, windows that follow each other have images in common: each is encoded once.
        where = observation.get("pictures")
        for camera, encoder in zip(self.setup.cameras, self.encoders, strict=True):
            if where is None:
                images = observation[f"images/{camera}"].flatten(0, 1)
            else:
                images = observation[f"pictures/{camera}"]
            feature = encoder((images.float() - self.image_mean) * self.image_scale)
            features.append(feature if where is None else feature[where])
        # The head costs a tenth of the encoder; in bfloat16, coordinates would lose an eighth of
        # a pixel.
        with torch.autocast(gripper.device.type, enabled=False):
            opening = (gripper - self.gripper_mean) / self.gripper_std
            tilt = (observation["up"] - self.up_mean) / _TILT
            state = self.state_layer(torch.cat([opening, tilt], 1))
            seen = [feature.float().reshape(len(gripper), -1) for feature in features]
            return self.head(torch.cat([*seen, state], 1))
