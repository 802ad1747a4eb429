"""What a task is: scene, placements, success, and the plan that a scripted operator follows."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sart_toolkit.backends.interface import KnowsBodies, Observation
from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array, pose
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec, SceneState

if TYPE_CHECKING:
    from sart_toolkit.robots.model import RobotModel


@dataclass(frozen=True)
class Placement:
    """Where the task's object stands on the table relative to the middle of its range.

    `x`, `y` [m], `yaw_deg` [deg] about the vertical.
    """

    x: float = 0.0
    y: float = 0.0
    yaw_deg: float = 0.0

    @property
    def T_middle_object(self) -> Array:
        """The object's pose `(4, 4)` in the frame at the middle of the range."""
        return pose([self.x, self.y, 0.0], [0.0, 0.0, np.deg2rad(self.yaw_deg)])

    def to_json(self) -> dict[str, float]:
        """The placement as JSON values."""
        return asdict(self)

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> Placement:
        """The placement from JSON values.

        Raises:
            InvalidInput: a field is unknown or not a finite number.
        """
        try:
            placement = Placement(**{k: float(v) for k, v in value.items()})
        except (TypeError, ValueError) as error:
            raise InvalidInput(f"placement: expected x, y, yaw_deg, got {value!r}") from error
        if not np.isfinite([placement.x, placement.y, placement.yaw_deg]).all():
            raise InvalidInput(f"placement: has a NaN or infinite entry: {value!r}")
        return placement


@dataclass(frozen=True)
class PlanStep:
    """One step of an operator's plan: steer the tool to `T_world_tool (4,4)`.

    It ends when the tool has been within `tolerance` [m] and `tolerance_deg` for `pause` [s]
    (while fingers close, for instance). `speed` [m/s] is what a person would choose there;
    `gripper` is the command held throughout. With `through` the operator neither slows down before
    the end nor hesitates after it: a point on a curve. `tremor`: how unsteady the hand is, as a
    fraction of its usual tremor; a person who has to be exact takes care.
    """

    T_world_tool: Array
    gripper: float
    speed: float
    tolerance: float = 0.003
    tolerance_deg: float = 2.0
    pause: float = 0.0
    through: bool = False
    tremor: float = 1.0


class Task(abc.ABC):
    """A skill to be learned, described without naming a simulator.

    Attributes:
        name: what it is called in files and reports.
        robot: the robot it is made for: a name, a reference or the robot itself.
        scene: bodies, held bodies and fixed cameras.
        placement_range: half width [m] of the square that the object is placed in.
        yaw_range_deg: the largest turn [deg] either way that its operator can cope with.
        horizon: longest rollout [s].
        hold: how long [s] success must last before a rollout ends early.
        report_body: the body whose placement varies.
        observes: the abilities that a backend must have for `success` and `failure_reason`.
    """

    name: str
    robot: str | RobotSpec
    scene: SceneSpec
    placement_range: float
    yaw_range_deg: float = 15.0
    horizon: float
    hold: float = 1.0
    report_body: str
    observes: tuple[type, ...] = (KnowsBodies,)

    @abc.abstractmethod
    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        """Robot and bodies at rest at the start, the object at `placement`."""

    @abc.abstractmethod
    def success(self, observation: Observation) -> bool:
        """Whether the goal is reached now, by what a backend that has `observes` measures."""

    @abc.abstractmethod
    def failure_reason(self, observation: Observation) -> str:
        """Why the goal isn't reached now, in a few words with numbers."""

    @abc.abstractmethod
    def plan(self, state: SceneState) -> list[PlanStep]:
        """The steps by which a person would steer the tool from the start to the goal.

        None, `[]`, if only a person can do it.
        """

    def files_needed(self) -> list[Path]:
        """The files of the scene's meshes, which work on another machine needs as well."""
        meshes = self.scene.meshes.values()
        return [file for shapes in meshes for shape in shapes for file in shape.files_needed()]

    def achieved(
        self, success: NDArray[np.bool_], record_hz: int = DEFAULT_RATES.record_hz
    ) -> bool:
        """Whether the goal was reached at the end and had been for `hold` seconds.

        The one rule by which a sequence counts as a success: a demonstration, a replay, a rollout.

        Args:
            success: `(T,)`, whether it was reached at each recorded step.
            record_hz: recorded steps a second.
        """
        least = self.steps_held(record_hz)
        return len(success) >= least and bool(np.all(success[-least:]))

    def steps_held(self, record_hz: int = DEFAULT_RATES.record_hz) -> int:
        """At how many steps up to the end the goal must have been reached."""
        return max(1, round(self.hold * record_hz))

    def check_operable(self, yaw_deg: float) -> None:
        """Return if the operator's plan copes with an object turned by up to ± this [deg].

        Raises:
            InvalidInput: `yaw_deg` is negative or beyond `yaw_range_deg`.
        """
        if not 0.0 <= yaw_deg <= self.yaw_range_deg:
            raise InvalidInput(
                f"yaw_deg: {self.name} can be turned by 0 to {self.yaw_range_deg:g} deg either "
                f"way, got {yaw_deg}"
            )

    def sample_placement(
        self, rng: np.random.Generator, yaw_deg: float = 0.0, half_width: float | None = None
    ) -> Placement:
        """A placement drawn uniformly from a square.

        Args:
            rng: source of randomness.
            yaw_deg: the object is also turned, uniformly within ± this [deg]; at 0 it is not.
            half_width: of the square [m]; `placement_range` if left out.
        """
        half_width = self.placement_range if half_width is None else half_width
        x, y = rng.uniform(-half_width, half_width, size=2)
        yaw = rng.uniform(-yaw_deg, yaw_deg) if yaw_deg else 0.0
        return Placement(float(x), float(y), float(yaw))
