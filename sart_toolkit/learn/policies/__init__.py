"""Policies by name; each is a picture encoder under one shared head (`learn.model.Policy`).

A new policy is one file with an `Encoder` and one line in `POLICIES`.
"""

from __future__ import annotations

from sart_toolkit.learn.policies.encoder import Encoder
from sart_toolkit.registry import lookup

POLICIES = {
    "compact_mlp": "sart_toolkit.learn.policies.compact_mlp:CompactEncoder",
    "resnet18_mlp": "sart_toolkit.learn.policies.resnet18_mlp:ResNet18Encoder",
}


def get_encoder(policy: str) -> type[Encoder]:
    """The encoder class of the policy called `policy`.

    Raises:
        UnknownName: no such policy; the message offers the nearest.
    """
    encoder = lookup("policy", policy, POLICIES)
    assert issubclass(encoder, Encoder)
    return encoder
