"""Tasks that are broken, each in one way."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import numpy as np

from sart_toolkit.backends.interface import Observation
from sart_toolkit.poses import Array, pose
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scenes.spec import Body, SceneSpec, SceneState
from sart_toolkit.tasks.parts import tool_down
from sart_toolkit.tasks.peg_in_hole import HOLE_DEPTH, PegInHole
from sart_toolkit.tasks.task import Placement, PlanStep

# --- what it is ---------------------------------------------------------------------------------


class ReportsNoBody(PegInHole):
    """What moves with the placement is called otherwise in the scene."""

    report_body = "hole"


def _made_in_a_function() -> type[PegInHole]:
    class Nameless(PegInHole):
        pass

    return Nameless


Nameless = _made_in_a_function()


class HoldsAFunction(PegInHole):
    """One of its attributes can't be pickled."""

    def __init__(self) -> None:
        self.margin = lambda: 0.012


# --- placements ---------------------------------------------------------------------------------


class PlacedTooFar(PegInHole):
    """Drawn from twice its range, where no other square is given."""

    def sample_placement(
        self, rng: np.random.Generator, yaw_deg: float = 0.0, half_width: float | None = None
    ) -> Placement:
        if half_width is None:
            half_width = 2 * self.placement_range
        return super().sample_placement(rng, yaw_deg, half_width)


class AlwaysTurned(PegInHole):
    """It is turned though nobody asked."""

    def sample_placement(
        self, rng: np.random.Generator, yaw_deg: float = 0.0, half_width: float | None = None
    ) -> Placement:
        return super().sample_placement(rng, self.yaw_range_deg, half_width)


class KnowsOneSquare(PegInHole):
    """Another half width than its own is ignored."""

    def sample_placement(
        self, rng: np.random.Generator, yaw_deg: float = 0.0, half_width: float | None = None
    ) -> Placement:
        return super().sample_placement(rng, yaw_deg)


class RandomOfItsOwn(PegInHole):
    """Placements don't follow from the generator given."""

    def sample_placement(
        self, rng: np.random.Generator, yaw_deg: float = 0.0, half_width: float | None = None
    ) -> Placement:
        return super().sample_placement(np.random.default_rng(), yaw_deg, half_width)


class SinglePrecision(PegInHole):
    """Placements hold numbers that JSON doesn't know."""

    def sample_placement(
        self, rng: np.random.Generator, yaw_deg: float = 0.0, half_width: float | None = None
    ) -> Placement:
        drawn = super().sample_placement(rng, yaw_deg, half_width)
        single: Any = np.float32
        return Placement(single(0.9 * drawn.x), single(0.9 * drawn.y), single(0.9 * drawn.yaw_deg))


class TurnedAnyhow(PegInHole):
    """No turn is refused."""

    def check_operable(self, yaw_deg: float) -> None:
        pass


class NowhereIsTheMiddle(PegInHole):
    """Where a placement isn't a number it is taken to be 0."""

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        values = {k: float(np.nan_to_num(v)) for k, v in dataclasses.asdict(placement).items()}
        return super().initial_state(model, Placement(**values))


# --- the start ----------------------------------------------------------------------------------


class BeyondTheLimits(PegInHole):
    """A joint is turned farther than it can be."""

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        state = super().initial_state(model, placement)
        q = np.array(state.q)
        q[-1] = 10.0
        return dataclasses.replace(state, q=q)


class OutOfReach(PegInHole):
    """The tool begins where the robot can't be, once the object is placed to the left."""

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        if placement.y > 0:
            model.ik(tool_down([2.0, 0.0, 0.3]), model.spec.home)
        return super().initial_state(model, placement)


class ForgetsTheTable(PegInHole):
    """The start says nothing about a body."""

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        state = super().initial_state(model, placement)
        return dataclasses.replace(state, Ts_world_body={"block": state.Ts_world_body["block"]})


class NeverTwiceTheSame(PegInHole):
    """The robot begins a little elsewhere each time."""

    rng: ClassVar[np.random.Generator] = np.random.default_rng(0)

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        state = super().initial_state(model, placement)
        return dataclasses.replace(state, q=state.q + self.rng.normal(0.0, 1e-4, len(state.q)))


class Mirrored(PegInHole):
    """The object stands on the other side."""

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        return super().initial_state(model, dataclasses.replace(placement, y=-placement.y))


class TurnedTheOtherWay(PegInHole):
    """The object is turned against the yaw."""

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        return super().initial_state(
            model, dataclasses.replace(placement, yaw_deg=-placement.yaw_deg)
        )


def _with(body: Body) -> SceneSpec:
    return dataclasses.replace(PegInHole.scene, bodies=(*PegInHole.scene.bodies, body))


class BeginsPressing(PegInHole):
    """A post stands where the peg's tip is at the start, a millimetre too high."""

    scene = _with(
        Body("post", (Shape("box", (0.02, 0.02, 0.166), pose([0, 0, 0.083])),), pose([0.37, 0, 0]))
    )

    @staticmethod
    def _start() -> Array:
        return tool_down([0.37, 0.0, 0.225])

    def plan(self, state: SceneState) -> list[PlanStep]:
        return [PlanStep(tool_down([0.37, 0.0, 0.3]), 0.67, 0.1), *super().plan(state)]


class DropsACup(PegInHole):
    """Beside the table's middle a cup begins 3 cm above the table."""

    scene = _with(
        Body("cup", (Shape("box", (0.04, 0.04, 0.04)),), pose([0.4, 0.4, 0.05]), mass=0.1)
    )


class LooksAway(PegInHole):
    """The robot begins where its camera doesn't see the object."""

    @staticmethod
    def _start() -> Array:
        return tool_down([0.3, 0.45, 0.3])


# --- success ------------------------------------------------------------------------------------


class AlwaysSatisfied(PegInHole):
    """Whatever is observed is a success."""

    def success(self, observation: Observation) -> bool:
        return True


class WithoutReasons(PegInHole):
    """A failure isn't explained."""

    def failure_reason(self, observation: Observation) -> str:
        return ""


class RemembersSuccess(PegInHole):
    """Once reached, the goal stays so, whatever is observed."""

    reached = False

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        self.reached = False
        return super().initial_state(model, placement)

    def success(self, observation: Observation) -> bool:
        self.reached = self.reached or super().success(observation)
        return self.reached


# --- the operator's plan ------------------------------------------------------------------------


class PlansForTheMiddle(PegInHole):
    """Wherever the hole is, the peg is lowered in the middle of its range."""

    def plan(self, state: SceneState) -> list[PlanStep]:
        block = pose([0.5, 0.0, 0.0])
        return super().plan(
            dataclasses.replace(state, Ts_world_body={**state.Ts_world_body, "block": block})
        )


class PullsItOutAgain(PegInHole):
    """The plan goes on after the goal is reached."""

    def plan(self, state: SceneState) -> list[PlanStep]:
        steps = super().plan(state)
        T = np.array(steps[-1].T_world_tool)
        T[2, 3] += HOLE_DEPTH
        return [*steps, dataclasses.replace(steps[-1], T_world_tool=T)]


class InAHurry(PegInHole):
    """Rollouts end before the operator could be done."""

    horizon = 3.0
