"""The UR5e with its gripper, and a way to test it with other joint limits."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel


@pytest.fixture(scope="session")
def model() -> RobotModel:
    return RobotModel(get_robot("ur5e_2f85"))


@pytest.fixture(scope="session")
def with_limits(model: RobotModel) -> Callable[..., RobotModel]:
    """Makes the model with other limits, by their names in the robot's specification."""

    def make(**limits: np.ndarray) -> RobotModel:
        other = copy.copy(model)
        other.spec = dataclasses.replace(model.spec, **limits)
        return other

    return make
