"""The interface: a policy without encoder or head, defined here, goes the whole way."""

import dataclasses

import numpy as np
import pytest
import torch
from torch import nn

from sart_toolkit.errors import InvalidInput
from sart_toolkit.learn.policies import POLICIES
from sart_toolkit.learn.policy import Policy
from sart_toolkit.learn.skill import load_skill, save_skill
from sart_toolkit.learn.training import TrainConfig, build_policy, train

_CHUNK = 3
# The tool points down.
UP = (0.0, 0.0, -1.0)


class Linear(Policy):
    """The next three actions from the mean colours of the newest image, and one frozen weight."""

    chunk = _CHUNK
    norms = ("none", "batch")
    train_defaults = {**Policy.train_defaults, "epochs": 4, "image_size": 16}

    def __init__(self, setup):
        super().__init__(setup)
        self.layer = nn.Linear(4, 7 * _CHUNK)
        self.frozen = nn.Parameter(torch.ones(1), requires_grad=False)

    def loss(self, batch):
        target = (batch["action"] - self.action_mean) / self.action_std
        return (self._normalised(batch) - target).abs().mean()

    def predict(self, observation):
        return self._normalised(observation) * self.action_std + self.action_mean

    def _normalised(self, observation):
        colours = observation["images/wrist"][:, -1].float().mean((2, 3)) / 255
        features = torch.cat([colours, observation["gripper"][:, -1:]], 1)
        return (self.frozen * self.layer(features)).unflatten(1, (_CHUNK, 7))


@pytest.fixture
def config(monkeypatch):
    monkeypatch.setitem(POLICIES, "linear", f"{__name__}:Linear")
    return TrainConfig.for_policy("linear", batch_size=8, device="cpu", threads=1, bfloat16="off")


def test_a_policy_of_ones_own_is_trained_saved_loaded_and_run(dataset, config, tmp_path):
    result = train(dataset, config, tmp_path)
    assert isinstance(result.policy, Linear) and result.final_loss < result.curve[0].loss
    save_skill(tmp_path, result, dataset)
    skill = load_skill(tmp_path)
    steps = dataset.sources[0].demonstration.steps
    image = steps.cameras["wrist"].rgb[0]
    actions = [skill.act({"wrist": image}, 0.5, UP)[:6] for _ in range(_CHUNK)]
    observation = {
        "images/wrist": torch.from_numpy(
            image.reshape(16, 2, 16, 2, 3).mean((1, 3)).round().astype(np.uint8)
        ).permute(2, 0, 1)[None, None],
        "gripper": torch.tensor([[0.5]]),
        "up": torch.tensor([UP]),
    }
    with torch.inference_mode():
        expected = result.policy.predict(observation)[0, :, :6]
    assert np.allclose(actions, expected, atol=1e-6)


def test_a_policy_of_ones_own_resumes(dataset, config, tmp_path):
    whole = train(dataset, config, tmp_path / "whole")

    def die(done, total, text):
        if done == 2 * total // config.epochs:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(dataset, dataclasses.replace(config), tmp_path / "cut", die)
    resumed = train(dataset, config, tmp_path / "cut")
    for name, tensor in whole.policy.state_dict().items():
        assert torch.equal(resumed.policy.state_dict()[name], tensor)


def test_a_policy_has_what_training_needs_without_saying_so(monkeypatch):
    class Least(Linear):
        train_defaults = Policy.train_defaults

    monkeypatch.setattr(f"{__name__}.Linear", Least)
    monkeypatch.setitem(POLICIES, "least", f"{__name__}:Linear")
    policy = build_policy(TrainConfig.for_policy("least"), {"wrist": (64, 64)})
    policy.reset()
    with pytest.raises(InvalidInput, match="Least takes no --backbone-weights"):
        policy.load_backbone("weights.pth")
