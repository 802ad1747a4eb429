"""Look names up in the literal tables of robots, backends, tasks and policies."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

from sart_toolkit.errors import unknown_name


def lookup(kind: str, name: str, table: Mapping[str, str]) -> Any:
    """What `table[name]`, of the form "module:attribute", names; imported now, not before.

    Args:
        kind: what is looked up, such as "task", for the message.
        name: the name wanted.
        table: one of the literal tables.

    Raises:
        UnknownName: the table has no such name; the message offers the nearest.
    """
    if name not in table:
        raise unknown_name(kind, name, table)
    module, attribute = table[name].split(":")
    return getattr(importlib.import_module(module), attribute)
