"""`resnet18_mlp`: the paper's ResNet18, from scratch or from local ImageNet weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from sart_toolkit.errors import Mismatch
from sart_toolkit.learn.policies.encoder import Encoder, read_state_dict
from sart_toolkit.learn.policies.mlp import MLPPolicy

_GROUP_WIDTH = 16


def _group_norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(channels // _GROUP_WIDTH, channels)


_NORMS: Mapping[str, Callable[[int], nn.Module]] = {
    "batch": nn.BatchNorm2d,
    "group": _group_norm,
}


class _BasicBlock(nn.Module):
    """y = relu(shortcut(x) + norm(conv(relu(norm(conv(x))))))."""

    def __init__(self, n_in: int, n_out: int, stride: int, norm: str) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(n_in, n_out, 3, stride, 1, bias=False)
        self.bn1 = _NORMS[norm](n_out)
        self.conv2 = nn.Conv2d(n_out, n_out, 3, 1, 1, bias=False)
        self.bn2 = _NORMS[norm](n_out)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = (
            nn.Sequential(nn.Conv2d(n_in, n_out, 1, stride, bias=False), _NORMS[norm](n_out))
            if stride != 1 or n_in != n_out
            else None
        )

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        y = self.relu(self.bn1(self.conv1(x)))
        return torch.relu_(self.bn2(self.conv2(y)) + shortcut)


class ResNet18(nn.Module):
    """ResNet18 (He et al., CVPR 2016) with torchvision's names, shapes and initial weights.

    `norm` is "batch" or "group" (groups of 16 channels; no running statistics, so fewer names).
    """

    def __init__(self, norm: str = "batch", n_classes: int = 1000) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = _NORMS[norm](64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        self.layer1 = nn.Sequential(_BasicBlock(64, 64, 1, norm), _BasicBlock(64, 64, 1, norm))
        self.layer2 = nn.Sequential(_BasicBlock(64, 128, 2, norm), _BasicBlock(128, 128, 1, norm))
        self.layer3 = nn.Sequential(_BasicBlock(128, 256, 2, norm), _BasicBlock(256, 256, 1, norm))
        self.layer4 = nn.Sequential(_BasicBlock(256, 512, 2, norm), _BasicBlock(512, 512, 1, norm))
        self.fc: nn.Module = nn.Linear(512, n_classes)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor) -> Tensor:
        x = self.maxpool(self.relu(self.bn1(self.conv1(x))))
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        return self.fc(x.mean((2, 3)))


class ResNet18Encoder(Encoder):
    """The 512 pooled features of a ResNet18, all of it trained."""

    # ImageNet's statistics, which published weights expect.
    image_mean: ClassVar[tuple[float, float, float]] = (123.675, 116.28, 103.53)
    image_std: ClassVar[tuple[float, float, float]] = (58.395, 57.12, 57.375)

    def __init__(self, image_size: tuple[int, int], norm: str) -> None:
        super().__init__(image_size, norm)
        self.resnet = ResNet18(norm)
        self.resnet.fc = nn.Identity()
        self.feature_size = 512

    def forward(self, images: Tensor) -> Tensor:
        return self.resnet(images)


class ResNet18MLP(MLPPolicy):
    """The paper's policy."""

    encoder: ClassVar[type[Encoder]] = ResNet18Encoder
    norms: ClassVar[tuple[str, ...]] = tuple(_NORMS)
    train_defaults: ClassVar[Mapping[str, Any]] = {
        "epochs": 40,
        "batch_size": 32,
        "lr": 1e-5,
        "weight_decay": 1e-4,
        "schedule": "constant",
        "image_size": 128,
        "image_shift": 0,
        "norm": "batch",
    }

    def load_backbone(self, path: Path) -> None:
        """Start every camera from a ResNet18 state dict with torchvision's names, without its `fc`.

        Raises:
            MissingFile: no such file.
            InvalidInput: not a .pth, .pt or .safetensors file.
            BrokenFile: unreadable, or it holds anything but tensors by name.
            Mismatch: names or shapes differ from this ResNet18's.
        """
        resnets = [encoder.get_submodule("resnet") for encoder in self.encoders]
        given = {k: v for k, v in read_state_dict(path).items() if not k.startswith("fc.")}
        expected = resnets[0].state_dict()
        for problem, names in (
            ("lacks", sorted(expected.keys() - given.keys())),
            ("also holds", sorted(given.keys() - expected.keys())),
        ):
            if names:
                raise Mismatch(
                    f"{path}: {problem} {names[0]!r}{_and_more(names)}; pass a ResNet18 state dict "
                    "with torchvision's names, and --norm batch if it has running statistics"
                )
        for name, tensor in expected.items():
            if given[name].shape != tensor.shape:
                raise Mismatch(
                    f"{path}: {name!r} has shape {tuple(given[name].shape)}, ResNet18 needs "
                    f"{tuple(tensor.shape)}; pass weights of a ResNet18"
                )
        for resnet in resnets:
            resnet.load_state_dict(given)


def _and_more(names: list[str]) -> str:
    return f" and {len(names) - 1} more" if len(names) > 1 else ""
