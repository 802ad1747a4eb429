"""Every task as a Gymnasium environment: importing this module registers them.

import gymnasium
import sart_toolkit.gym

env = gymnasium.make("sart/PegInHole-v0", backend="pybullet")
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from sart_toolkit.backends import DEFAULT_BACKEND, make_backend
from sart_toolkit.backends.interface import Draws, Observation, Resets, require
from sart_toolkit.data.records import DEFAULT_RATES, Image, Rates, apply_action
from sart_toolkit.errors import InvalidInput, MissingExtra, MotionRejected, Unreachable
from sart_toolkit.motion.config import ControllerConfig
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.poses import check_array
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.appearance import randomise_appearance
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.tasks.task import Placement

try:
    import gymnasium
    from gymnasium import spaces
except ImportError as error:
    raise MissingExtra(
        "sart_toolkit.gym needs Gymnasium, which is not installed; pip install 'sart_toolkit[gym]'"
    ) from error

if TYPE_CHECKING:
    from sart_toolkit.backends.interface import Backend
    from sart_toolkit.record.screen import Screen
    from sart_toolkit.robots.spec import ImageSize, RobotSpec
    from sart_toolkit.tasks.task import Task

RenderMode = Literal["rgb_array", "human"]
_OVERVIEW, _RENDER_SIZE = "overview", 384
# Where the window shows the scene and the first camera: left, top, width, height.
_SCENE_BOX, _CAMERA_BOX = (16, 16, 768, 768), (800, 16, 464, 464)


def env_id(task: str) -> str:
    """The id of the environment of one of our tasks: `sart/PegInHole-v0` of `peg_in_hole`."""
    return f"sart/{task.replace('_', ' ').title().replace(' ', '')}-v0"


class SartEnv(gymnasium.Env[dict[str, Any], NDArray[np.float32]]):
    """A task on a backend: images and gripper in, relative tool poses out.

    Observation: `pixels`, of each camera an image uint8 `(H, W, 3)` by its name, and `agent_pos`,
    float32 `(5,)`: the measured gripper in [0, 1] (0 open), its rate [1/s], and how the tool is
    tilted, as the world's upward direction in its frame. Neither joints nor absolute poses, as for
    our own policies.

    Action, float32 `(7,)`: as everywhere in the toolkit, the next commanded tool pose relative to
    the present one, xyz [m] and rotation vector [rad] in the tool frame, then the gripper target in
    [0, 1]. The command stays near the measured pose, as in a rollout.

    Reward: 1 when the goal has been reached for as long as `Task.achieved` wants it, which also
    ends the episode; otherwise 0. It also ends where the arm is steered out of reach, and is cut
    off at the task's horizon. `info` has `is_success`, `goal_reached` (now), `placement`, and at
    the end without success `reason`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 10}

    def __init__(
        self,
        task: str | Task | type[Task],
        backend: str | type[Backend] = DEFAULT_BACKEND,
        robot: str | RobotSpec | None = None,
        cameras: Sequence[str] = ("wrist",),
        image_size: ImageSize = 128,
        yaw_deg: float = 0.0,
        vary_appearance: bool = False,
        render_mode: RenderMode | None = None,
        rates: Rates = DEFAULT_RATES,
    ) -> None:
        """An environment; nothing moves before `reset`.

        Args:
            task: its name, a reference or the task itself.
            backend: what it runs on; a name, a reference or the class.
            robot: in place of the task's own.
            cameras: whose images are observed.
            image_size: width and height of these [pixels]; one number for a square.
            yaw_deg: objects also turn, uniformly within ± this [deg].
            vary_appearance: colours, light and camera mounting differ from episode to episode.
            render_mode: "rgb_array": `render` gives the scene from outside; "human": a window shows
                it in real time.
            rates: physics, commands and, how often `step` is called, recorded steps.

        Raises:
            UnknownName: no such task, backend, robot or camera.
            MissingCapability: the backend can't be reset or draw, or lacks what the task's success
                is judged by.
            InvalidInput: `yaw_deg` is beyond what the task can be turned by, or the render mode is
                none.
        """
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise InvalidInput(
                f"render_mode: expected one of {self.metadata['render_modes']} or None, got "
                f"{render_mode!r}"
            )
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": rates.record_hz}
        self.task = get_task(task)
        self._robot = get_robot(robot if robot is not None else self.task.robot)
        self._cameras, self._yaw_deg, self._rates = tuple(cameras), yaw_deg, rates
        self._vary = vary_appearance
        self.task.check_operable(yaw_deg)
        self._backend: Backend | None = make_backend(
            backend, self._robot, self.task.scene, image_size, rates
        )
        try:
            self._check(self._backend)
        except BaseException:
            self.close()
            raise
        self._model = RobotModel(self._robot, self.task.scene.held)
        self._controller = ToolController(self._model, rates=rates)
        self._screen: Screen | None = None
        self._shown_at = 0.0
        self._reached: list[bool] = []
        self._seen: Observation | None = None
        self._placement = Placement()
        width, height = self._backend.image_size
        self.observation_space = spaces.Dict({
            "pixels": spaces.Dict({
                name: spaces.Box(0, 255, (height, width, 3), np.uint8) for name in self._cameras
            }),
            "agent_pos": spaces.Box(
                np.array([0.0, -rates.record_hz, -1.0, -1.0, -1.0], np.float32),
                np.array([1.0, rates.record_hz, 1.0, 1.0, 1.0], np.float32),
            ),
        })  # fmt: skip
        # No farther than a command may lead in each control period.
        limits, n = ControllerConfig(), rates.control_per_record
        far, turn = n * limits.max_lead, n * np.deg2rad(limits.max_lead_deg)
        most = np.array([far] * 3 + [turn] * 3 + [1.0], np.float32)
        self.action_space = spaces.Box(np.append(-most[:6], np.float32(0)), most)

    def _check(self, backend: Backend) -> None:
        backend.check_cameras(self._cameras)
        require(backend, Resets, "an episode begins at the task's start")
        for ability in self.task.observes:
            require(backend, ability, f"the success of task {self.task.name!r} is judged by it")
        if self.render_mode is not None:
            require(backend, Draws, "the scene is drawn from outside")
            backend.check_cameras([_OVERVIEW])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """The first observation at a placement that is drawn at random, and `info`.

        Args:
            seed: of the placements of this and all later episodes.
            options: `placement`, a `Placement` or its JSON values, in place of a drawn one.

        Raises:
            InvalidInput: an option is unknown, or the placement is none; or it was closed.
        """
        super().reset(seed=seed)
        options = dict(options or {})
        placement = options.pop("placement", None)
        if options:
            raise InvalidInput(f"options: expected placement alone, got {sorted(options)}")
        if placement is None:
            placement = self.task.sample_placement(self.np_random, self._yaw_deg)
        elif not isinstance(placement, Placement):
            placement = Placement.from_json(placement)
        self._placement = placement
        backend = self._open()
        if self._vary:
            robot, scene = randomise_appearance(self._robot, self.task.scene, self.np_random)
            backend.close()
            backend = type(backend)(robot, scene, backend.image_size, backend.rates)
            self._backend = backend
        state = self.task.initial_state(self._model, placement)
        require(backend, Resets, "an episode begins at the task's start").reset(state)
        self._controller.reset(state.q)
        self._reached = []
        self._seen = seen = backend.observe(self._cameras)
        self._show()
        return self._observation(seen, seen.gripper), self._info(False)

    def step(
        self, action: NDArray[Any]
    ) -> tuple[dict[str, Any], SupportsFloat, bool, bool, dict[str, Any]]:
        """Command an action and let a recorded step pass.

        Raises:
            InvalidInput: not seven finite numbers; or it was closed, or not reset.
        """
        backend, before = self._open(), self._seen
        if before is None:
            raise InvalidInput("step: the environment wasn't reset; call reset first")
        command = check_array("action", action, (7,))
        controller = self._controller
        desired, gripper = apply_action(controller.commanded_T_world_tool, command)
        reason = None
        try:
            targets = controller.move(desired, before.T_world_tool, self._rates.control_per_record)
        except (Unreachable, MotionRejected) as error:
            # The observation stays the last one: nothing was sent.
            reason = f"steered out of reach: {str(error).split(':')[0]}"
            return self._observation(before, before.gripper), 0.0, True, False, self._info(
                False, reason
            )  # fmt: skip
        for q in targets:
            sent = backend.command(q, gripper)
            backend.step()
        controller.acknowledge(sent.q)
        self._seen = seen = backend.observe(self._cameras)
        self._reached.append(self.task.success(seen))
        hz = self._rates.record_hz
        achieved = self.task.achieved(np.array(self._reached), hz)
        cut = not achieved and len(self._reached) >= round(self.task.horizon * hz)
        if cut:
            reason = self.task.failure_reason(seen)
            if self._reached[-1]:
                reason = f"goal reached, but not for {self.task.hold:g} s"
        self._show()
        observation = self._observation(seen, before.gripper)
        return observation, float(achieved), achieved, cut, self._info(achieved, reason)

    def _observation(self, seen: Observation, gripper_before: float) -> dict[str, Any]:
        # A measured gripper may be a little outside.
        now, before = np.clip([seen.gripper, gripper_before], 0.0, 1.0)
        return {
            "pixels": {name: seen.cameras[name].rgb.copy() for name in self._cameras},
            "agent_pos": np.array(
                [now, (now - before) * self._rates.record_hz, *np.clip(seen.up, -1.0, 1.0)],
                np.float32,
            ),
        }

    def _info(self, achieved: bool, reason: str | None = None) -> dict[str, Any]:
        return {
            "is_success": achieved,
            "goal_reached": bool(self._reached and self._reached[-1]),
            "placement": self._placement.to_json(),
            **({} if reason is None else {"reason": reason}),
        }

    def render(self) -> Image | None:
        """The scene from outside, uint8 `(H, W, 3)`, where the render mode is "rgb_array".

        Raises:
            InvalidInput: it was closed, or not reset.
        """
        if self.render_mode != "rgb_array":
            return None
        return self._drawn()

    def _drawn(self) -> Image:
        backend, seen = self._open(), self._seen
        if seen is None:
            raise InvalidInput("render: the environment wasn't reset; call reset first")
        stage = require(backend, Draws, "the scene is drawn from outside")
        state = backend.scene.seen_state(seen.q, seen.gripper, seen.Ts_world_body)
        return stage.draw(state, backend.cameras[_OVERVIEW], _RENDER_SIZE, _RENDER_SIZE).rgb

    def _show(self) -> None:
        """Show a person how it stands, in real time."""
        if self.render_mode != "human" or self._seen is None:
            return
        from sart_toolkit.record.screen import Screen

        if self._screen is None:
            self._screen = Screen(f"{self.task.name} on {self._open().name}")
        # What is pressed means nothing here, but a desktop wants it taken.
        for _ in self._screen.events():
            pass
        time.sleep(max(0.0, self._shown_at + 1 / self._rates.record_hz - time.monotonic()))
        self._shown_at = time.monotonic()
        self._screen.clear()
        self._screen.image(_SCENE_BOX, self._drawn())
        if self._cameras:
            self._screen.image(_CAMERA_BOX, self._seen.cameras[self._cameras[0]].rgb)
        reached = bool(self._reached and self._reached[-1])
        self._screen.text((800, 496), "goal reached" if reached else f"step {len(self._reached)}")
        self._screen.show()

    def close(self) -> None:
        """Free the simulator and close the window; calling it again does nothing."""
        if self._backend is not None:
            self._backend.close()
        self._backend = None
        screen, self._screen = getattr(self, "_screen", None), None
        if screen is not None:
            screen.__exit__()

    def _open(self) -> Backend:
        if self._backend is None:
            raise InvalidInput("the environment was closed; make another")
        return self._backend


for _task in TASKS:
    if env_id(_task) not in gymnasium.registry:
        gymnasium.register(
            env_id(_task), entry_point="sart_toolkit.gym:SartEnv", kwargs={"task": _task}
        )
