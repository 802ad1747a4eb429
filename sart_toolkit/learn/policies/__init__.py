"""Policies by name; each is a `Policy`, and those that learn share a head (`mlp.py`).

A new policy is one file with a `Policy` and one line in `POLICIES`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sart_toolkit.registry import expect_class, resolve

if TYPE_CHECKING:
    from sart_toolkit.learn.policy import Policy

POLICIES = {
    "compact_mlp": "sart_toolkit.learn.policies.compact_mlp:CompactMLP",
    "resnet18_mlp": "sart_toolkit.learn.policies.resnet18_mlp:ResNet18MLP",
    "replay": "sart_toolkit.learn.policies.replay:Replay",
}


def get_policy(policy: str | type[Policy]) -> type[Policy]:
    """The class that a policy's name or reference names; a class itself is returned.

    Raises:
        UnknownName: there is none; the message says which part is wrong.
    """
    from sart_toolkit.learn.policy import Policy

    return expect_class("policy", policy, resolve("policy", policy, POLICIES), Policy)
