from __future__ import annotations

from collections.abc import Callable

import pytest

from sart_toolkit.data.records import Annotation, Demonstration, PrecisionSphere


@pytest.fixture(scope="session")
def annotate(peg_demonstration: Demonstration) -> Callable[..., Annotation]:
    """Makes annotations by hand from (waypoint, radius) pairs."""

    def annotate(*spheres: tuple[int, float]) -> Annotation:
        Ts = peg_demonstration.steps.measured_Ts_world_tool
        return Annotation(
            tuple(PrecisionSphere(t, Ts[t], radius) for t, radius in spheres),
            peg_demonstration.content_hash(),
        )

    return annotate


@pytest.fixture(scope="session")
def crowded(annotate: Callable[..., Annotation]) -> Annotation:
    """Spheres that reach into the block: some attempts are kept, some rejected."""
    return annotate((15, 0.05), (19, 0.03))
