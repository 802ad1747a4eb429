"""`compact_mlp`: four convolutions and a spatial soft-argmax; the default on a CPU."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from sart_toolkit.learn.policies.encoder import Encoder
from sart_toolkit.learn.policies.mlp import MLPPolicy

_CHANNELS = (16, 32, 32, 32)
_KERNELS = (7, 5, 3, 3)
_STRIDES = (2, 2, 1, 1)


class CompactEncoder(Encoder):
    """Where in the image each of 32 learned features is, and how strongly it shows.

    Spatial soft-argmax (Levine et al., "End-to-end training of deep visuomotor policies", JMLR
    17, 2016): with p = softmax of one channel's map over its pixels, the features are E_p[x] and
    E_p[y] in [-1, 1], sub-pixel, and the map's soft maximum log mean exp.
    """

    grid: Tensor

    def __init__(self, image_size: tuple[int, int], norm: str) -> None:
        super().__init__(image_size, norm)
        layers: list[nn.Module] = []
        n_in, (height, width) = 3, image_size
        for n_out, kernel, stride in zip(_CHANNELS, _KERNELS, _STRIDES, strict=True):
            conv = nn.Conv2d(n_in, n_out, kernel, stride, kernel // 2)
            # torch's own initial weights shrink from layer to layer; the soft-argmax would start
            # uniform and see no gradient.
            nn.init.kaiming_normal_(conv.weight, nonlinearity="relu")
            nn.init.zeros_(conv.bias)  # type: ignore[arg-type]
            layers += [conv, nn.ReLU(inplace=True)]
            n_in, height, width = n_out, math.ceil(height / stride), math.ceil(width / stride)
        self.layers = nn.Sequential(*layers[:-1])
        self.feature_size = 3 * n_in
        x = torch.linspace(-1.0, 1.0, width).repeat(height)
        y = torch.linspace(-1.0, 1.0, height).repeat_interleave(width)
        self.register_buffer("grid", torch.stack([x, y, torch.ones_like(x)], 1), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        maps = self.layers(images)
        with torch.autocast(maps.device.type, enabled=False):
            # One product gives sum e^z x, sum e^z y and sum e^z, far cheaper than a softmax and
            # sums over it. The maximum only keeps e^z finite, so it needs no gradient.
            z = maps.flatten(2).float()
            highest = z.detach().amax(2, keepdim=True)
            x, y, total = ((z - highest).exp() @ self.grid).unbind(2)
            presence = highest[..., 0] + (total / z.shape[2]).log()
            return torch.cat([x / total, y / total, presence], 1)


class CompactMLP(MLPPolicy):
    """Small and quick: some thousand images per second on two cores."""

    encoder: ClassVar[type[Encoder]] = CompactEncoder
    train_defaults: ClassVar[Mapping[str, Any]] = {
        "epochs": 60,
        "batch_size": 128,
        "lr": 2e-3,
        "weight_decay": 1e-4,
        "schedule": "cosine",
        "image_size": 64,
        "image_shift": 2,
        "norm": "none",
    }
