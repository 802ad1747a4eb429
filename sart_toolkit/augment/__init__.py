"""Self-augmentation: which poses to visit (strategies) and visiting them (engine).

A new strategy is one class and one line in `STRATEGIES`; one outside the repository needs no
line, `package.module:NAME` or `path/to/file.py:NAME` names it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sart_toolkit.registry import expect, resolve

if TYPE_CHECKING:
    from sart_toolkit.augment.strategies import Strategy

STRATEGIES = {
    "sart": "sart_toolkit.augment.strategies:SART",
    "sart_planned": "sart_toolkit.augment.strategies:SART_PLANNED",
}


def get_strategy(strategy: str | Strategy) -> Strategy:
    """The strategy that a name or reference names; a strategy itself is returned.

    Raises:
        UnknownName: there is none; the message says which part is wrong.
        MissingExtra: it plans, and OMPL isn't installed.
    """
    from sart_toolkit.augment.strategies import Strategy
    from sart_toolkit.motion.planning import check_planner

    found = expect("strategy", strategy, resolve("strategy", strategy, STRATEGIES), Strategy)
    if found.plans:
        check_planner()
    return found
