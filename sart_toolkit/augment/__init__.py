"""Self-augmentation: which poses to visit (strategies) and visiting them (executors, engine).

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
    "no_position": "sart_toolkit.augment.strategies:NO_POSITION",
    "no_orientation": "sart_toolkit.augment.strategies:NO_ORIENTATION",
    "return_to_center": "sart_toolkit.augment.strategies:RETURN_TO_CENTER",
    "no_merge": "sart_toolkit.augment.strategies:NO_MERGE",
    "next_sphere_center": "sart_toolkit.augment.strategies:NEXT_SPHERE_CENTER",
    "next_sphere_convergence": "sart_toolkit.augment.strategies:NEXT_SPHERE_CONVERGENCE",
    "extended_convergence": "sart_toolkit.augment.strategies:EXTENDED_CONVERGENCE",
    "inside_sphere": "sart_toolkit.augment.strategies:INSIDE_SPHERE",
    "miles": "sart_toolkit.augment.strategies:MILES",
    "miles_1cm": "sart_toolkit.augment.strategies:MILES_1CM",
    "miles_10cm": "sart_toolkit.augment.strategies:MILES_10CM",
    "bc": "sart_toolkit.augment.strategies:BC",
    "replay": "sart_toolkit.augment.strategies:REPLAY",
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
