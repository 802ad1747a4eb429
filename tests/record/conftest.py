"""Sessions of peg-in-hole, and a person's hand without a device or a window."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sart_toolkit.backends.interface import Backend
from sart_toolkit.record.desk import RecordingDesk
from sart_toolkit.record.session import DeviceSetup, SessionConfig, SessionState, TeleopSession
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks.task import Placement, Task


@pytest.fixture
def make_session(
    peg_backend: Backend, peg_task: Task, peg_model: RobotModel
) -> Callable[..., TeleopSession]:
    """Makes a session as for a person, without saved states; `seconds` is the longest."""

    def make(seconds: float = 60.0, cameras: tuple[str, ...] = (), **more: object) -> TeleopSession:
        config = SessionConfig(cameras, seconds, keep_states=False, end_on_success=True)
        return TeleopSession(peg_backend, peg_task, peg_model, config=config, **more)

    return make


@pytest.fixture
def peg_setup(peg_backend: Backend, peg_task: Task, peg_model: RobotModel) -> DeviceSetup:
    """What a device for peg-in-hole is made for."""
    state = peg_task.initial_state(peg_model, Placement())
    return DeviceSetup(
        peg_backend, peg_task, peg_model, state, np.random.default_rng(0), operator="tester"
    )


@pytest.fixture
def tick_until() -> Callable[..., None]:
    """Ticks a desk until a condition holds; fails after some simulated seconds."""

    def tick(desk: RecordingDesk, condition: Callable[[], bool], seconds: float = 20.0) -> None:
        for _ in range(round(30 * seconds)):
            if condition():
                return
            desk.tick()
        assert condition(), f"not within {seconds:g} simulated seconds: {desk.notice}"

    return tick


@pytest.fixture
def ended() -> Callable[[RecordingDesk], Callable[[], bool]]:
    """Whether a desk's recording has ended."""
    return lambda desk: lambda: desk.session.state is SessionState.ENDED
