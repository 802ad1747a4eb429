"""Policies by name; each is a `Policy`, and these two share a head (`mlp.py`).

A new policy is one file with a `Policy` and one line in `POLICIES`.
"""

from __future__ import annotations

from sart_toolkit.errors import InvalidInput
from sart_toolkit.learn.policy import Policy
from sart_toolkit.registry import lookup

POLICIES = {
    "compact_mlp": "sart_toolkit.learn.policies.compact_mlp:CompactMLP",
    "resnet18_mlp": "sart_toolkit.learn.policies.resnet18_mlp:ResNet18MLP",
}


def get_policy(name: str) -> type[Policy]:
    """The class of the policy called `name`.

    Raises:
        UnknownName: no such policy; the message offers the nearest.
        InvalidInput: what is called so is no subclass of `Policy`.
    """
    policy = lookup("policy", name, POLICIES)
    if not (isinstance(policy, type) and issubclass(policy, Policy)):
        raise InvalidInput(f"policy {name!r}: expected a subclass of Policy, got {policy!r}")
    return policy
