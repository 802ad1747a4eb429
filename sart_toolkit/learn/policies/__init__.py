"""Policies by name; each is a picture encoder under one shared head (`learn.model.Policy`).

A new policy is one file with an `Encoder` and one line in `POLICIES`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sart_toolkit.registry import expect_class, resolve

if TYPE_CHECKING:
    from sart_toolkit.learn.policies.encoder import Encoder

POLICIES = {
    "compact_mlp": "sart_toolkit.learn.policies.compact_mlp:CompactEncoder",
    "resnet18_mlp": "sart_toolkit.learn.policies.resnet18_mlp:ResNet18Encoder",
}


def get_encoder(policy: str | type[Encoder]) -> type[Encoder]:
    """The encoder class that a policy's name or reference names; a class itself is returned.

    Raises:
        UnknownName: there is none; the message says which part is wrong.
    """
    from sart_toolkit.learn.policies.encoder import Encoder

    return expect_class("policy", policy, resolve("policy", policy, POLICIES), Encoder)
