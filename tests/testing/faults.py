"""Backends that are broken, each in one way."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import pybullet

from sart_toolkit.backends.interface import CameraView, CommandSent, Contact, Observation
from sart_toolkit.backends.pybullet import PyBulletBackend
from sart_toolkit.backends.states import pack_state, unpack_state
from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.spec import CameraSpec, ImageSize, RobotSpec
from sart_toolkit.scenes.spec import Joint, SceneSpec, SceneState

# --- images -----------------------------------------------------------------------------------


class _SpoiledCamera(PyBulletBackend):
    """Takes images as if the cameras were others, and says that they are the right ones."""

    def spoilt(self, spec: CameraSpec) -> CameraSpec:
        return spec

    def _image(self, camera: CameraSpec, width: int, height: int) -> CameraView:
        right = super()._image(camera, width, height)
        view = super()._image(self.spoilt(camera), width, height)
        return dataclasses.replace(view, T_world_camera=right.T_world_camera)


class CameraOfOpenGL(_SpoiledCamera):
    """The camera looks along -z, y up."""

    def spoilt(self, spec: CameraSpec) -> CameraSpec:
        T = spec.T_frame_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
        return dataclasses.replace(spec, T_frame_camera=T)


class WideFieldOfView(_SpoiledCamera):
    """The field of view is 10 % too wide."""

    def spoilt(self, spec: CameraSpec) -> CameraSpec:
        return dataclasses.replace(spec, fov_y_deg=1.1 * spec.fov_y_deg)


class _SpoiledView(PyBulletBackend):
    def spoilt(self, view: CameraView, spec: CameraSpec) -> CameraView:
        raise NotImplementedError

    def _image(self, camera: CameraSpec, width: int, height: int) -> CameraView:
        return self.spoilt(super()._image(camera, width, height), camera)


class DepthInMillimetres(_SpoiledView):
    def spoilt(self, view: CameraView, spec: CameraSpec) -> CameraView:
        return dataclasses.replace(view, depth=view.depth * np.float32(1000))


class DepthAlongTheRay(_SpoiledView):
    def spoilt(self, view: CameraView, spec: CameraSpec) -> CameraView:
        height, width = view.depth.shape
        rows, columns = np.mgrid[:height, :width]
        rays = np.stack([columns, rows, np.ones((height, width))], -1)
        length = np.linalg.norm(rays @ np.linalg.inv(spec.intrinsics(width, height)).T, axis=-1)
        return dataclasses.replace(view, depth=(view.depth * length).astype(np.float32))


class FarthestDepthForNothing(_SpoiledView):
    def spoilt(self, view: CameraView, spec: CameraSpec) -> CameraView:
        depth = np.where(view.depth == 0, np.float32(spec.far), view.depth)
        return dataclasses.replace(view, depth=depth)


class DepthUpsideDown(_SpoiledView):
    def spoilt(self, view: CameraView, spec: CameraSpec) -> CameraView:
        return dataclasses.replace(view, depth=np.ascontiguousarray(view.depth[::-1]))


class BlueGreenRed(_SpoiledView):
    def spoilt(self, view: CameraView, spec: CameraSpec) -> CameraView:
        return dataclasses.replace(view, rgb=np.ascontiguousarray(view.rgb[:, :, ::-1]))


class CameraPoseOfItsFrame(PyBulletBackend):
    """`T_world_camera` leaves out where the camera is in its frame."""

    def _image(self, camera: CameraSpec, width: int, height: int) -> CameraView:
        view = super()._image(camera, width, height)
        T_world_frame = view.T_world_camera @ inverse(camera.T_frame_camera)
        return dataclasses.replace(view, T_world_camera=T_world_frame)


class WristCameraStays(PyBulletBackend):
    """The wrist camera's images are taken from where it is at home."""

    def _image(self, camera: CameraSpec, width: int, height: int) -> CameraView:
        right = super()._image(camera, width, height)
        if camera.frame != "world":
            T = self._model.fk(self.robot.home, camera.frame) @ camera.T_frame_camera
            camera = dataclasses.replace(camera, frame="world", T_frame_camera=T)
        view = super()._image(camera, width, height)
        return dataclasses.replace(view, T_world_camera=right.T_world_camera)


class ImagesStretched(PyBulletBackend):
    """An image shows a square of the world, whatever its shape."""

    def _image(self, camera: CameraSpec, width: int, height: int) -> CameraView:
        view = super()._image(camera, height, height)
        columns = (np.arange(width) + 0.5) * height / width
        rgb, depth = view.rgb[:, columns.astype(int)], view.depth[:, columns.astype(int)]
        return dataclasses.replace(view, rgb=rgb, depth=depth)


class DrawsThePresent(PyBulletBackend):
    """Draws where everything is now, whatever state it is given."""

    def draw(self, state: SceneState, camera: CameraSpec, width: int, height: int) -> CameraView:
        now = self.observe()
        self._place_drawing(list(now.q), now.Ts_world_body)
        return self._image(camera, width, height)


class DrawsItsOwnCamera(PyBulletBackend):
    """Draws by the scene's camera of the name."""

    def draw(self, state: SceneState, camera: CameraSpec, width: int, height: int) -> CameraView:
        return super().draw(state, self.cameras[camera.name], width, height)


class DrawingResets(PyBulletBackend):
    """Robot and bodies stay in the state that was drawn."""

    def draw(self, state: SceneState, camera: CameraSpec, width: int, height: int) -> CameraView:
        self.reset(state)
        now = self.observe()
        self._place_drawing(list(now.q), now.Ts_world_body)
        return self._image(camera, width, height)


# --- motion -------------------------------------------------------------------------------------


class StuckJoint(PyBulletBackend):
    """The last joint ignores commands."""

    def command(self, q: Array, gripper: float) -> CommandSent:
        stays = self._targets.last[len(self._arm) - 1]
        sent = super().command(q, gripper)
        self._targets.rows[:, len(self._arm) - 1] = stays
        return sent


class LateJoints(PyBulletBackend):
    """Each period covers half of the way to the command."""

    def step(self) -> None:
        commanded = self._targets.rows[-1]
        half = 0.5 * (self._targets.last + commanded)
        steps = len(self._targets.rows)
        self._targets.rows = np.linspace(self._targets.last, half, steps + 1)[1:]
        super().step()
        self._targets.rows = np.repeat(commanded[None], steps, axis=0)


class WrongClock(PyBulletBackend):
    """A step takes 33 ms."""

    def step(self) -> None:
        before = self._time
        super().step()
        self._time = before + 0.033


class JointPathIsLate(PyBulletBackend):
    """It is that of the control period before."""

    _measured: list[list[float]]

    def __init__(self, robot: RobotSpec, scene: SceneSpec, *options: Any) -> None:
        super().__init__(robot, scene, *options)
        self._measured = []

    def step(self) -> None:
        late = self._measured
        super().step()
        self._measured, self._joint_path = self._joint_path, late


class JointPathSinceTheReset(PyBulletBackend):
    """It is that of all control periods, not of the last one."""

    def step(self) -> None:
        before = self._joint_path
        super().step()
        self._joint_path = before + self._joint_path


class JointPathOutlivesARestore(PyBulletBackend):
    def restore(self, state: bytes) -> None:
        path = self._joint_path
        super().restore(state)
        self._joint_path = path


class ToolIsTheFlange(PyBulletBackend):
    def observe(
        self, cameras: Sequence[str] = (), image_size: ImageSize | None = None
    ) -> Observation:
        seen = super().observe(cameras, image_size)
        T = self._model.fk(seen.q, self.robot.gripper_base)
        return dataclasses.replace(seen, T_world_tool=T)


class HeldLeftBehind(PyBulletBackend):
    """The stick is said to be where it is at home."""

    def observe(
        self, cameras: Sequence[str] = (), image_size: ImageSize | None = None
    ) -> Observation:
        seen = super().observe(cameras, image_size)
        Ts = dict(seen.Ts_world_body)
        if "stick" in Ts:
            Ts["stick"] = self._model.fk(self.robot.home, "stick")
        return dataclasses.replace(seen, Ts_world_body=Ts)


class InstancesShareTargets(PyBulletBackend):
    """The last command to any instance is everybody's."""

    _everybody_s: ClassVar[Array | None] = None

    def reset(self, state: SceneState) -> None:
        super().reset(state)
        InstancesShareTargets._everybody_s = None

    def command(self, q: Array, gripper: float) -> CommandSent:
        sent = super().command(q, gripper)
        InstancesShareTargets._everybody_s = self._targets.rows[-1]
        return sent

    def step(self) -> None:
        if self._everybody_s is not None:
            last, steps = self._targets.last, len(self._targets.rows)
            self._targets.rows = np.linspace(last, self._everybody_s, steps + 1)[1:]
        super().step()


class NoisySteps(PyBulletBackend):
    """Targets are reached up to a ten-millionth of a radian, by a generator without seed."""

    _rng: ClassVar = np.random.default_rng()

    def step(self) -> None:
        right = self._targets.rows
        self._targets.rows = right + 1e-7 * self._rng.standard_normal(right.shape)
        super().step()
        self._targets.rest_at(right[-1, :-1], right[-1, -1])


class ClippedCommands(PyBulletBackend):
    """A bad command is made a good one."""

    def command(self, q: Array, gripper: float) -> CommandSent:
        if np.shape(q) == self._model.lower.shape and np.isfinite(q).all():
            q = np.clip(q, self._model.lower, self._model.upper)
        return super().command(q, gripper)


class SaysItSentMore(PyBulletBackend):
    """Goes no farther than a little at a time, and says that it goes all the way."""

    def command(self, q: Array, gripper: float) -> CommandSent:
        sent = super().command(q, gripper)
        here = self._targets.last[: len(self._arm)]
        rows = self._targets.rows[:, : len(self._arm)]
        rows[:] = here + np.clip(rows - here, -0.05, 0.05)
        return sent


# --- gripper ------------------------------------------------------------------------------------


class GripperInverted(PyBulletBackend):
    """1 opens it."""

    def command(self, q: Array, gripper: float) -> CommandSent:
        return super().command(q, 1.0 - gripper)


class _OtherGripper(PyBulletBackend):
    """Takes the robot's gripper for another one."""

    changes: ClassVar[dict[str, float]] = {}

    def __init__(self, robot: RobotSpec, scene: SceneSpec, *options: Any) -> None:
        # What draws is made from the changed robot, and must not be changed twice.
        proper = get_robot(robot.name).gripper
        changed = {name: getattr(proper, name) * by for name, by in self.changes.items()}
        gripper = dataclasses.replace(robot.gripper, **changed)
        super().__init__(dataclasses.replace(robot, gripper=gripper), scene, *options)


class GripperClosesHalfWay(_OtherGripper):
    """At 1 the fingers have gone four fifths of their way."""

    changes: ClassVar = {"closed_position": 0.8, "speed": 0.8}


class GripperTooFast(_OtherGripper):
    changes: ClassVar = {"speed": 10.0}


class SlipperyFingers(PyBulletBackend):
    def __init__(self, robot: RobotSpec, scene: SceneSpec, *options: Any) -> None:
        super().__init__(robot, scene, *options)
        for link in self._links.values():
            self._client.changeDynamics(self._robot, link, lateralFriction=0.0)


# --- contacts -----------------------------------------------------------------------------------


class NoContacts(PyBulletBackend):
    def contacts(self) -> list[Contact]:
        return []


class _MoreContacts(PyBulletBackend):
    """Reports pairs that don't touch."""

    _stepped = False

    def reset(self, state: SceneState) -> None:
        super().reset(state)
        self._stepped = False

    def restore(self, state: bytes) -> None:
        super().restore(state)
        self._stepped = False

    def step(self) -> None:
        super().step()
        self._stepped = True

    def more(self) -> list[tuple[str, str]]:
        raise NotImplementedError

    def contacts(self) -> list[Contact]:
        right = super().contacts()
        known = {(c.a, c.b) for c in right}
        new = [Contact(*pair, 0.0, 0.0) for pair in self.more() if pair not in known]
        return sorted(right + (new if self._stepped else []), key=lambda c: (c.a, c.b))


class PhantomContact(_MoreContacts):
    """The forearm touches the block, it says."""

    def more(self) -> list[tuple[str, str]]:
        return [("block", "forearm_link")]


class EarlyContacts(_MoreContacts):
    """Contacts count from 5 mm on."""

    def more(self) -> list[tuple[str, str]]:
        if "block" not in self._bodies or "stick" not in self._links:
            return []
        stick = {"linkIndexA": self._links["stick"]}
        near = self._client.getClosestPoints(self._robot, self._bodies["block"][0], 0.005, **stick)
        return [("block", "stick")] if near else []


class StaticContacts(_MoreContacts):
    """What stands on something that stands is reported, too."""

    def more(self) -> list[tuple[str, str]]:
        return [("block", "table")] if "block" in self._bodies else []


class DrawerTouchesItsRail(_MoreContacts):
    def more(self) -> list[tuple[str, str]]:
        return [("drawer", "rail")] if "drawer" in self._bodies else []


class ContactsInAnyOrder(PyBulletBackend):
    def contacts(self) -> list[Contact]:
        return super().contacts()[::-1]


class ContactsSinceTheReset(PyBulletBackend):
    def step(self) -> None:
        before = self._touched
        super().step()
        self._touched = {**before, **self._touched}


class ContactsOutliveTheReset(PyBulletBackend):
    def reset(self, state: SceneState) -> None:
        touched = self._touched
        super().reset(state)
        self._touched = touched


class FreeBodiesTouchNothing(PyBulletBackend):
    """Contacts of bodies that aren't the robot's are left out."""

    def contacts(self) -> list[Contact]:
        links = set(self._links)
        return [c for c in super().contacts() if links & {c.a, c.b}]


class ForcesInKilograms(PyBulletBackend):
    def contacts(self) -> list[Contact]:
        return [dataclasses.replace(c, force=c.force / 9.81) for c in super().contacts()]


# --- bodies -------------------------------------------------------------------------------------


class HingesWithoutFriction(PyBulletBackend):
    def __init__(self, robot: RobotSpec, scene: SceneSpec, *options: Any) -> None:
        super().__init__(robot, scene, *options)
        c = self._client
        for index, link in self._bodies.values():
            if link >= 0:
                c.setJointMotorControl2(
                    index, link, pybullet.VELOCITY_CONTROL, targetVelocity=0.0, force=0.0
                )


class _OtherJoints(PyBulletBackend):
    def spoilt(self, joint: Joint) -> Joint:
        raise NotImplementedError

    def __init__(self, robot: RobotSpec, scene: SceneSpec, *options: Any) -> None:
        super().__init__(robot, scene, *options)
        self._springs = [(i, link, self.spoilt(joint)) for i, link, joint in self._springs]


class SpringsHalfAsStiff(_OtherJoints):
    def spoilt(self, joint: Joint) -> Joint:
        return dataclasses.replace(joint, stiffness=joint.stiffness / 2)


class _OnlyDrawsIn(Joint):
    def effort(self, position: float) -> float:
        if self.detent is None:
            return super().effort(position)
        x = position - self.detent.position
        return -self.detent.effort * float(np.sign(x)) if abs(x) < self.detent.width else 0.0


class DetentsOnlyDrawIn(_OtherJoints):
    """A catch pulls from its full width."""

    def spoilt(self, joint: Joint) -> Joint:
        return _OnlyDrawsIn(**{f.name: getattr(joint, f.name) for f in dataclasses.fields(joint)})


class JointsWithoutLimits(PyBulletBackend):
    def __init__(self, robot: RobotSpec, scene: SceneSpec, *options: Any) -> None:
        super().__init__(robot, scene, *options)
        for index, link in self._bodies.values():
            if link >= 0:
                self._client.changeDynamics(index, link, jointLowerLimit=-9, jointUpperLimit=9)


class BodiesFallInHoney(PyBulletBackend):
    def __init__(self, robot: RobotSpec, scene: SceneSpec, *options: Any) -> None:
        super().__init__(robot, scene, *options)
        for index, link in self._bodies.values():
            if link < 0:
                self._client.changeDynamics(index, link, linearDamping=0.6)


class ResetKeepsSpeed(PyBulletBackend):
    """Free bodies keep moving as fast as they were."""

    _stepped = False

    def step(self) -> None:
        super().step()
        self._stepped = True

    def reset(self, state: SceneState) -> None:
        stepped, self._stepped = self._stepped, False
        speeds = _speeds(self)
        super().reset(state)
        for index, (linear, angular) in speeds.items():
            if stepped and np.linalg.norm(linear) > 0.5:
                self._client.resetBaseVelocity(index, linear, angular)


def _speeds(backend: PyBulletBackend) -> dict[int, Any]:
    free = [body.name for body in backend.scene.bodies if body.mass and not body.joint]
    indices = [backend._bodies[name][0] for name in free]
    return {index: backend._client.getBaseVelocity(index) for index in indices}


# --- states -------------------------------------------------------------------------------------


class RestoreForgetsBodies(PyBulletBackend):
    """Those that never move by themselves stay where the last reset put them."""

    def restore(self, state: bytes) -> None:
        c = self._client
        still = [self._bodies[body.name][0] for body in self.scene.bodies if body.mass is None]
        before = {index: c.getBasePositionAndOrientation(index) for index in still}
        super().restore(state)
        for index, where in before.items():
            c.resetBasePositionAndOrientation(index, *where)
        self._still = {}


class RestoreForgetsTargets(PyBulletBackend):
    """The command in force stays that of before the restore."""

    def restore(self, state: bytes) -> None:
        targets = self._targets.rows
        super().restore(state)
        self._targets.rows = targets


class RestoreForgetsSpeeds(PyBulletBackend):
    """Free bodies are restored at rest."""

    def restore(self, state: bytes) -> None:
        super().restore(state)
        for index, (linear, _) in _speeds(self).items():
            if np.linalg.norm(linear) > 0.1:
                self._client.resetBaseVelocity(index, [0, 0, 0], [0, 0, 0])


class RestoreForgetsTime(PyBulletBackend):
    """Time passes."""

    def restore(self, state: bytes) -> None:
        time = self._time
        super().restore(state)
        self._time = time


class ContactsOutliveAReset(PyBulletBackend):
    """The solver begins with the forces that contacts had before."""

    def _forget_contacts(self) -> None:
        pass


class HistoryInTheBytes(PyBulletBackend):
    """A saved state tells how many were saved before."""

    _saved = 0

    def save(self) -> bytes:
        self._saved += 1
        envelope = self.robot.name, self._scene_digest, sorted(self._bodies)
        head, world = unpack_state(self.name, super().save(), *envelope)
        return pack_state(self.name, {**head, "saved": self._saved}, world)


class AnyScene(PyBulletBackend):
    """A saved state doesn't say which scene it is of."""

    def __init__(self, robot: RobotSpec, scene: SceneSpec, *options: Any) -> None:
        super().__init__(robot, scene, *options)
        self._scene_digest = ""


# --- abilities and instances --------------------------------------------------------------------


class NoBodiesAfterAll(PyBulletBackend):
    """Has the ability to know bodies, and tells of none."""

    def body_poses(self) -> dict[str, Array]:
        return {}

    def observe(
        self, cameras: Sequence[str] = (), image_size: ImageSize | None = None
    ) -> Observation:
        return dataclasses.replace(super().observe(cameras, image_size), Ts_world_body={})


class ForgetsWhatItHolds(PyBulletBackend):
    """Tells where the scene's bodies are, not where the stick in the gripper is."""

    def body_poses(self) -> dict[str, Array]:
        return {name: T for name, T in super().body_poses().items() if name != "stick"}

    def observe(
        self, cameras: Sequence[str] = (), image_size: ImageSize | None = None
    ) -> Observation:
        seen = super().observe(cameras, image_size)
        return dataclasses.replace(seen, Ts_world_body=self.body_poses())


class SilentlyWithoutImages(PyBulletBackend):
    """Returns no images, and gives no reason."""

    def observe(
        self, cameras: Sequence[str] = (), image_size: ImageSize | None = None
    ) -> Observation:
        self.check_cameras(cameras)
        return super().observe()


class SilentThoughItHasAReason(PyBulletBackend):
    """Declares that it takes no images, and leaves them out where they are asked for."""

    no_images = "has no cameras"

    def observe(
        self, cameras: Sequence[str] = (), image_size: ImageSize | None = None
    ) -> Observation:
        for name in cameras:
            if name not in self.cameras:
                self.check_cameras([name])
        return super().observe()


class RatesOfItsOwn(PyBulletBackend):
    """Steps as long as ever, whatever rates it is made for."""

    def step(self) -> None:
        before = self._time
        super().step()
        self._time = before + 1 / 30


class CloseOnlyOnce(PyBulletBackend):
    def close(self) -> None:
        self._client.disconnect()
        self._client = None


class CloseReachesTheNext(PyBulletBackend):
    """Closes the instance made after it, too."""

    _made: ClassVar[list[PyBulletBackend]] = []

    def __init__(self, robot: RobotSpec, scene: SceneSpec, *options: Any) -> None:
        super().__init__(robot, scene, *options)
        self._made.append(self)

    def close(self) -> None:
        after = self._made[self._made.index(self) + 1 :]
        super().close()
        if after:
            PyBulletBackend.close(after[0])
