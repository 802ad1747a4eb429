"""Encoders of images, which the policies of `mlp.py` put under their head."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from sart_toolkit.errors import BrokenFile, InvalidInput, MissingFile


class Encoder(nn.Module, ABC):
    """Features `(n, feature_size)` from normalised images `(n, 3, *image_size)`.

    A subclass is built from `(image_size, norm)`, where `image_size` is `(height, width)` [pixels]
    and `norm` names its normalisation layers, and sets `feature_size`. Images reach it as
    (value - image_mean) / image_std, per channel, of values in 0..255.
    """

    image_mean: ClassVar[tuple[float, float, float]] = (127.5, 127.5, 127.5)
    image_std: ClassVar[tuple[float, float, float]] = (127.5, 127.5, 127.5)
    feature_size: int

    @abstractmethod
    def __init__(self, image_size: tuple[int, int], norm: str) -> None:
        super().__init__()

    @abstractmethod
    def forward(self, images: Tensor) -> Tensor: ...


def read_state_dict(path: Path) -> dict[str, Tensor]:
    """The tensors by name in a `.pth`, `.pt` or `.safetensors` file of weights, on the CPU.

    Raises:
        MissingFile: no such file.
        InvalidInput: another kind of file.
        BrokenFile: unreadable, or it holds anything but tensors by name.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFile(f"{path}: no such file of backbone weights; check the path")
    if path.suffix not in (".pth", ".pt", ".safetensors"):
        raise InvalidInput(f"{path}: expected a .pth, .pt or .safetensors file of weights")
    try:
        if path.suffix == ".safetensors":
            state = load_file(path)
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        # What a damaged or refused file raises depends on where torch's reader meets the damage.
        raise BrokenFile(
            f"{path}: not readable as plain weights ({type(error).__name__}); download it again, "
            "or save its state_dict() as .safetensors"
        ) from error
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise BrokenFile(f"{path}: expected tensors by name; save the model's state_dict() itself")
    return dict(state)
