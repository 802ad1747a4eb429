"""The policy: any encoder under the one head, with its normalisation inside."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sart_toolkit.data.records import ACTION_SIZE
from sart_toolkit.learn.policies.encoder import Encoder
from sart_toolkit.learn.samples import Normalisation

STATE_FEATURE = 512


class Policy(nn.Module):
    """Actions from a history of wrist pictures and gripper openings, and nothing else.

    The encoder's features of every picture and a 512-d feature of the gripper history pass two
    hidden ReLU layers (the paper's table). Normalisation of pictures, gripper and actions lives in
    buffers, hence in the state dict: inputs and outputs are in recorded units.

    Args:
        encoder: features per picture.
        history: pictures per window.
        hidden: width of the two hidden layers.
    """

    image_mean: Tensor
    image_scale: Tensor
    gripper_mean: Tensor
    gripper_std: Tensor
    action_mean: Tensor
    action_std: Tensor

    def __init__(self, encoder: Encoder, history: int, hidden: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.gripper_layer = nn.Sequential(nn.Linear(history, STATE_FEATURE), nn.ReLU())
        self.head = nn.Sequential(
            nn.Linear(history * encoder.feature_size + STATE_FEATURE, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, ACTION_SIZE),
        )
        self.register_buffer("image_mean", torch.tensor(encoder.image_mean)[:, None, None])
        self.register_buffer("image_scale", 1.0 / torch.tensor(encoder.image_std)[:, None, None])
        self.register_buffer("gripper_mean", torch.zeros(1))
        self.register_buffer("gripper_std", torch.ones(1))
        self.register_buffer("action_mean", torch.zeros(ACTION_SIZE))
        self.register_buffer("action_std", torch.ones(ACTION_SIZE))

    def set_normalisation(self, normalisation: Normalisation) -> None:
        """Take over the data's means and standard deviations."""
        for name, value in vars(normalisation).items():
            getattr(self, name).copy_(torch.as_tensor(value))

    def forward(self, frames: Tensor, gripper: Tensor) -> Tensor:
        """Actions `(B, 7)`: xyz [m], rotation vector [rad], tool frame; gripper target in [0, 1].

        Args:
            frames: uint8 `(B, history, 3, S, S)`, oldest first; fastest when each picture is
                channels-last in memory.
            gripper: measured gripper `(B, history)` in [0, 1], oldest first.
        """
        return self._normalised_actions(frames, gripper) * self.action_std + self.action_mean

    def loss(self, frames: Tensor, gripper: Tensor, actions: Tensor) -> Tensor:
        """Mean squared error of the normalised actions, over batch and dimensions."""
        target = (actions - self.action_mean) / self.action_std
        return (self._normalised_actions(frames, gripper) - target).square().mean()

    def _normalised_actions(self, frames: Tensor, gripper: Tensor) -> Tensor:
        pictures = (frames.flatten(0, 1).float() - self.image_mean) * self.image_scale
        features = self.encoder(pictures)
        # The head costs a tenth of the encoder; in bfloat16, coordinates would lose an eighth of
        # a pixel.
        with torch.autocast(frames.device.type, enabled=False):
            state = self.gripper_layer((gripper - self.gripper_mean) / self.gripper_std)
            seen = features.float().reshape(len(frames), -1)
            return self.head(torch.cat([seen, state], 1))
