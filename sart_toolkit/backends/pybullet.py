"""PyBullet behind the `Backend` interface, with all abilities; images by ray casting."""

from __future__ import annotations

import ctypes
import functools
import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sart_toolkit.backends.interface import (
    CameraView,
    CommandSent,
    Contact,
    Observation,
    Simulator,
)
from sart_toolkit.backends.raycast import RayCaster
from sart_toolkit.backends.states import pack_state, scene_digest, unpack_state
from sart_toolkit.backends.targets import PeriodTargets
from sart_toolkit.data.records import DEFAULT_RATES, Rates
from sart_toolkit.errors import BrokenFile, MissingExtra
from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots.elements import add_joint, rigid_link
from sart_toolkit.robots.frames import without_frames
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import (
    CameraSpec,
    ImageSize,
    RobotSpec,
    check_image_size,
)
from sart_toolkit.robots.visuals import RobotVisuals, body_meshes
from sart_toolkit.scenes.spec import Body, Joint, SceneSpec, SceneState


@contextmanager
def _without_greetings() -> Iterator[None]:
    """Keep off stdout and stderr what PyBullet prints from C on import and connection."""
    libc = ctypes.CDLL(None)
    kept = [os.dup(fd) for fd in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for fd in (1, 2):
            os.dup2(nowhere, fd)
        yield
        libc.fflush(None)
    finally:
        for fd, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, fd)
            os.close(copy)
        os.close(nowhere)


try:
    with _without_greetings():
        import pybullet as p
except ImportError as error:
    raise MissingExtra(
        f"pybullet can't be imported ({error}); it has no wheel for Python 3.12 and later: use "
        "--backend sapien, or Python 3.11"
    ) from error

# As a prism, which is what a cylinder becomes otherwise, it would be a millimetre larger.
_URDF_FLAGS = (
    p.URDF_USE_INERTIA_FROM_FILE | p.URDF_USE_IMPLICIT_CYLINDER | p.URDF_IGNORE_VISUAL_SHAPES
)
# The gripper is drawn with its joints at the nearest multiples [rad or m] of this, hundredths of a
# pixel away: they are never quite at rest, and what moves with the camera is drawn once.
_GRIPPER_STEP = 5e-5
_MOST_FOUND = 32
_MOST_STATES = 16


class _Client:
    """PyBullet's functions, each bound to one simulation when first used."""

    def __init__(self) -> None:
        self._id = p.connect(p.DIRECT)

    def __getattr__(self, name: str) -> Any:
        bound = functools.partial(getattr(p, name), physicsClientId=self._id)
        setattr(self, name, bound)
        return bound


class PyBulletBackend(Simulator):
    """A robot in its scene in PyBullet, without a window.

    The gripper's linkage follows its driver through gear constraints. Arm and tool may collide with
    each other; neighbouring links may not. The friction between two bodies is the product of their
    coefficients.
    """

    name = "pybullet"
    drift = 0.0
    drift_deg = 0.0
    # With a heavy object in the grasp 0.29 mm were measured, free 0.23 mm.
    tracking_error = 4e-4

    def __init__(
        self,
        robot: RobotSpec,
        scene: SceneSpec,
        image_size: ImageSize = 128,
        rates: Rates = DEFAULT_RATES,
    ) -> None:
        """Load robot and scene; call `reset` before anything else."""
        super().__init__(robot, scene, image_size, rates)
        self._model = RobotModel(robot, scene.held)
        with _without_greetings():
            self._client: Any = _Client()
        c = self._client
        c.setTimeStep(1.0 / rates.physics_hz)
        c.setGravity(*scene.gravity)
        c.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
        # Bullet would keep every file that it ever read, each restored state among them.
        c.setPhysicsEngineParameter(enableFileCaching=0)
        self._load_robot()
        # Where each body is: its multibody, and its link there (-1: the base).
        self._bodies: dict[str, tuple[int, int]] = {}
        self._springs: list[tuple[int, int, Joint]] = []
        self._Ts_body_centre: dict[int, Array] = {}
        self._Ts_centre_body: dict[int, Array] = {}
        # Where bodies are that stay where a reset or restore has put them.
        self._still: dict[str, Array] = {}
        for body in scene.bodies:
            if body.joint is None:
                self._load_bodies(body)
        still = {self._bodies[body.name] for body in scene.bodies if body.mass is None}
        still |= {(self._robot, link) for link in self._base_links}
        for a in still:
            for b in still:
                # The arm stands on the table: what never moves can't collide.
                c.setCollisionFilterPair(a[0], b[0], a[1], b[1], 0)
        self._names = {at: name for name, at in self._bodies.items()}
        self._names |= {(self._robot, i): name for name, i in self._links.items()}
        self._touched: dict[tuple[str, str], tuple[float, float]] = {}
        self._joint_path: list[list[float]] = []
        self._time = 0.0
        self._scene_digest = scene_digest(self._model, scene)
        self._targets = PeriodTargets(self._model, rates.physics_per_control)
        self._drawing: _Drawing | None = None
        # What PyBullet calls the states that it has in memory, by their bytes: it reads a file for
        # 10 ms, and segments start from few states again and again.
        self._known_states: dict[bytes, int] = {}
        # The bytes restored last, until something changes: Bullet renumbers contacts each time.
        self._restored: bytes | None = None

    def _load_bodies(self, root: Body) -> None:
        """Load a body and those that move on it as one multibody."""
        c = self._client
        moving = {b.name: b for b in self.scene.bodies if b.joint and b.joint.parent == root.name}
        with tempfile.TemporaryDirectory(prefix="sart-scene-") as folder:
            path = Path(folder) / "body.urdf"
            path.write_text(_scene_urdf(root, moving.values(), path.parent), encoding="utf-8")
            index = c.loadURDF(str(path), useFixedBase=root.mass is None, flags=_URDF_FLAGS)
        self._bodies[root.name] = index, -1
        # PyBullet's base is a body's centre of mass with its principal axes.
        dynamics = c.getDynamicsInfo(index, -1)
        self._Ts_body_centre[index] = _matrix(dynamics[3], dynamics[4])
        self._Ts_centre_body[index] = inverse(self._Ts_body_centre[index])
        for link in range(c.getNumJoints(index)):
            body = moving[c.getJointInfo(index, link)[12].decode()]
            assert body.joint is not None
            self._bodies[body.name] = index, link
            if body.joint.stiffness or body.joint.detent:
                self._springs.append((index, link, body.joint))
            # A motor that wants to stand still, of limited strength, is dry friction.
            c.setJointMotorControl2(
                index, link, p.VELOCITY_CONTROL, targetVelocity=0.0, force=body.joint.friction
            )
        for body in (root, *moving.values()):
            c.changeDynamics(
                *self._bodies[body.name],
                lateralFriction=body.friction,
                linearDamping=0,
                angularDamping=0,
                jointDamping=0,
            )

    def _load_robot(self) -> None:
        c, robot = self._client, self.robot
        # Each link costs time in each physics step, places of no mass as much as others.
        bodies = without_frames(self._model.urdf)
        with _urdf_file(bodies.urdf) as path:
            self._robot = c.loadURDF(
                path, useFixedBase=True, flags=_URDF_FLAGS | p.URDF_USE_SELF_COLLISION
            )
        joints, self._links = {}, {c.getBodyInfo(self._robot)[0].decode(): -1}
        parents = {-1: -1}
        for i in range(c.getNumJoints(self._robot)):
            info = c.getJointInfo(self._robot, i)
            joints[info[1].decode()] = i
            self._links[info[12].decode()] = i
            parents[i] = info[16]
            c.changeDynamics(self._robot, i, linearDamping=0, angularDamping=0, jointDamping=0)
        self._arm = [joints[name] for name in robot.arm_joints]
        self._gripper = {name: joints[name] for name in robot.gripper.joint_positions(0.0)}
        driver = robot.gripper.driver
        self._driver = None if driver is None else joints[driver]
        self._followers = {joints[n]: ratio for n, ratio in robot.gripper.followers.items()}
        # On which link, and where there, are the tool and what it holds.
        self._at_tool: dict[str, tuple[int, Array]] = {}
        for name in (robot.tool_frame, *(body.name for body in self.scene.held)):
            link, T_link_frame = bodies.frames.get(name, (name, np.eye(4)))
            self._at_tool[name] = self._links[link], T_link_frame
        self._forces = [c.getJointInfo(self._robot, j)[10] for j in self._arm]
        for link in robot.gripper.finger_links:
            # One without a shape touches nothing.
            if link in self._links:
                c.changeDynamics(self._robot, self._links[link], lateralFriction=1.0)
        for joint, ratio in self._followers.items():
            c.setJointMotorControl2(self._robot, joint, p.VELOCITY_CONTROL, force=0)
            gear = c.createConstraint(
                self._robot, self._driver, self._robot, joint, p.JOINT_GEAR,
                [1, 0, 0], [0, 0, 0], [0, 0, 0],
            )  # fmt: skip
            c.changeConstraint(gear, gearRatio=-ratio, maxForce=200, erp=1.0)
        self._limit_self_collision(parents)

    def _limit_self_collision(self, parents: dict[int, int]) -> None:
        """Let the tool (all that the last arm joint carries) collide with the arm, nothing else."""
        c = self._client
        rank = {-1: 0}
        for i in sorted(set(parents) - {-1}):
            rank[i] = rank[parents[i]] + (i in self._arm)
        self._base_links = [i for i, order in rank.items() if order == 0]
        n = len(self._arm)
        links = sorted(rank)
        for a in links:
            for b in links:
                # The last three joints share a wrist: their links are neighbours of the tool.
                keep = rank[a] == n and rank[b] <= n - 3
                if a > b and not keep:
                    c.setCollisionFilterPair(self._robot, self._robot, a, b, 0)

    def reset(self, state: SceneState) -> None:
        q = self._model.check_limits(state.q)
        self.scene.check_state(state)
        self._forget_contacts()
        self._place(state)
        self._targets.rest_at(q, state.commanded_gripper)
        self._time = 0.0
        self._touched = {}
        # A restore from the file that this state saves to also drops what the solver remembers of
        # earlier contacts, so that what follows depends on the state alone.
        self._restored = None
        self.restore(self.save())

    def _place(self, state: SceneState) -> None:
        c = self._client
        for joint, angle in zip(self._arm, state.q, strict=True):
            c.resetJointState(self._robot, joint, angle)
        for name, position in self.robot.gripper.joint_positions(state.gripper).items():
            c.resetJointState(self._robot, self._gripper[name], position)
        for name, (index, link) in self._bodies.items():
            if link >= 0:
                c.resetJointState(index, link, state.joint_positions[name])
                continue
            T = state.Ts_world_body[name] @ self._Ts_body_centre[index]
            c.resetBasePositionAndOrientation(index, T[:3, 3], _quaternion(T))
            c.resetBaseVelocity(index, [0, 0, 0], [0, 0, 0])

    def _forget_contacts(self) -> None:
        """Take all bodies apart: contacts that last keep the forces that they had."""
        c = self._client
        for i, (index, link) in enumerate(self._bodies.values()):
            if link < 0:
                c.resetBasePositionAndOrientation(index, [100.0 + 10.0 * i, 0, 0], [0, 0, 0, 1])
        c.performCollisionDetection()

    def observe(
        self, cameras: Sequence[str] = (), image_size: ImageSize | None = None
    ) -> Observation:
        c = self._client
        size = self.image_size if image_size is None else check_image_size(image_size)
        self.check_cameras(cameras)
        states = c.getJointStates(self._robot, self._arm)
        T_world_tool, Ts_world_body = self._poses()
        if cameras:
            self._place_drawing([s[0] for s in states], Ts_world_body)
        return Observation(
            q=np.array([s[0] for s in states]),
            dq=np.array([s[1] for s in states]),
            gripper=self._opening(),
            T_world_tool=T_world_tool,
            time=self._time,
            cameras={name: self._image(self.cameras[name], *size) for name in cameras},
            Ts_world_body=Ts_world_body,
            joint_path=np.array(self._joint_path),
        )

    def _opening(self) -> float:
        """The gripper's command that its driver is at; without fingers, the one in force."""
        if self._driver is None:
            return float(self._targets.last[-1])
        state = self._client.getJointState(self._robot, self._driver)
        return self.robot.gripper.command_at(state[0])

    def _place_drawing(self, q: Sequence[float], Ts_world_body: Mapping[str, Array]) -> None:
        """Draw robot and scene where they are now: arm joints `q` [rad], and bodies."""
        joints = list(self._gripper.values())
        # Of no joints PyBullet returns nothing.
        linkage = self._client.getJointStates(self._robot, joints) if joints else ()
        self._open_drawing().place(
            dict(zip(self.robot.arm_joints, q, strict=True)),
            dict(zip(self._gripper, (s[0] for s in linkage), strict=True)),
            Ts_world_body,
        )

    def _image(self, camera: CameraSpec, width: int, height: int) -> CameraView:
        """An image of robot and scene where they are drawn."""
        return self._open_drawing().view(camera, (width, height))

    def body_poses(self) -> dict[str, Array]:
        return self._poses()[1]

    def _poses(self) -> tuple[Array, dict[str, Array]]:
        """Where the tool is, and where the bodies are."""
        c = self._client
        links, Ts_link_frame = zip(*self._at_tool.values(), strict=True)
        states = c.getLinkStates(self._robot, links, 0, 1)
        T_world_tool, *held = (
            _matrix(state[4], state[5]) @ T for state, T in zip(states, Ts_link_frame, strict=True)
        )
        Ts = {body.name: T for body, T in zip(self.scene.held, held, strict=True)}
        for name, (index, link) in self._bodies.items():
            if link >= 0:
                state = c.getLinkState(index, link, 0, 1)
                Ts[name] = _matrix(state[4], state[5])
            elif name in self._still:
                Ts[name] = self._still[name].copy()
            else:
                T_world_centre = _matrix(*c.getBasePositionAndOrientation(index))
                Ts[name] = T_world_centre @ self._Ts_centre_body[index]
        return T_world_tool, Ts

    def draw(self, state: SceneState, camera: CameraSpec, width: int, height: int) -> CameraView:
        q = self._model.check_limits(state.q)
        self.scene.check_state(state)
        self._open_drawing().place(
            dict(zip(self.robot.arm_joints, q, strict=True)),
            self.robot.gripper.joint_positions(state.gripper),
            state.Ts_world_body,
        )
        return self._image(camera, *check_image_size((width, height)))

    def _open_drawing(self) -> _Drawing:
        """What draws robot and scene, whose meshes are read when first needed."""
        if self._drawing is None:
            self._drawing = _Drawing(self._model, self.scene)
        return self._drawing

    def command(self, q: Array, gripper: float) -> CommandSent:
        sent = self._targets.command(q, gripper)
        self._restored = None
        return sent

    def step(self) -> None:
        c, robot, arm = self._client, self._robot, self._arm
        n = len(arm)
        ones, zeros = [1.0] * n, [0.0] * n
        gripper = self.robot.gripper
        self._touched = {}
        self._joint_path = []
        self._restored = None
        closing: float | None = None
        for target in self._targets.rows.tolist():
            # Position gain 1 closes the whole error within one physics step. A velocity target
            # beside it would put the arm one physics step ahead of its targets.
            c.setJointMotorControlArray(
                robot, arm, p.POSITION_CONTROL, target[:n],
                targetVelocities=zeros,
                forces=self._forces, positionGains=ones, velocityGains=ones,
            )  # fmt: skip
            if self._driver is not None and target[n] != closing:
                # It stays in force until it is another.
                closing = target[n]
                c.setJointMotorControl2(
                    robot, self._driver, p.POSITION_CONTROL, gripper.driver_position(closing),
                    force=gripper.force, maxVelocity=gripper.speed,
                )  # fmt: skip
            for index, link, joint in self._springs:
                effort = joint.effort(c.getJointState(index, link)[0])
                c.setJointMotorControl2(index, link, p.TORQUE_CONTROL, force=effort)
            c.stepSimulation()
            self._joint_path.append([s[0] for s in c.getJointStates(robot, arm)])
            points = c.getContactPoints()
            if points:
                self._collect_contacts(points)
        self._targets.advance()
        self._time += 1.0 / self.rates.control_hz

    def _collect_contacts(self, points: Sequence[Any]) -> None:
        forces: dict[tuple[str, str], float] = {}
        for point in points:
            distance, force = point[8], point[9]
            if distance > 0.0 and force <= 0.0:
                continue
            a, b = self._names[point[1], point[3]], self._names[point[2], point[4]]
            pair = (a, b) if a <= b else (b, a)
            forces[pair] = forces.get(pair, 0.0) + force
            greatest, deepest = self._touched.get(pair, (0.0, 0.0))
            self._touched[pair] = (greatest, max(deepest, -distance))
        for pair, force in forces.items():
            greatest, deepest = self._touched[pair]
            self._touched[pair] = (max(greatest, force), deepest)

    def contacts(self) -> list[Contact]:
        return [Contact(a, b, *values) for (a, b), values in sorted(self._touched.items())]

    def save(self) -> bytes:
        if self._restored is not None:
            return self._restored
        handle, path = tempfile.mkstemp(suffix=".bullet")
        os.close(handle)
        try:
            self._client.saveBullet(path)
            with open(path, "rb") as file:
                world = file.read()
        finally:
            with suppress(FileNotFoundError):
                os.unlink(path)
        head = {
            "robot": self.robot.name,
            "scene": self._scene_digest,
            "bodies": sorted(self._bodies),
            **self._targets.to_json(),
            "time": self._time,
        }
        return pack_state(self.name, head, world)

    def restore(self, state: bytes) -> None:
        head, world = unpack_state(
            self.name, state, self.robot.name, self._scene_digest, sorted(self._bodies)
        )
        # Existing contacts would keep forces that the state doesn't have.
        self._forget_contacts()
        if state in self._known_states:
            self._client.restoreState(self._known_states[state])
        else:
            self._restore_file(world)
            if len(self._known_states) >= _MOST_STATES:
                oldest = next(iter(self._known_states))
                self._client.removeState(self._known_states.pop(oldest))
            self._known_states[state] = self._client.saveState()
        self._targets.take(head)
        self._time = head["time"]
        self._touched = {}
        self._joint_path = []
        self._still = {}
        Ts_world_body = self._poses()[1]
        self._still = {b.name: Ts_world_body[b.name] for b in self.scene.bodies if b.mass is None}
        self._restored = state

    def _restore_file(self, world: bytes) -> None:
        handle, path = tempfile.mkstemp(suffix=".bullet")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(world)
            self._client.restoreState(fileName=path)
        except p.error as error:
            raise BrokenFile(f"saved state: PyBullet refuses it ({error})") from error
        finally:
            os.unlink(path)

    def close(self) -> None:
        if self._client is not None:
            with suppress(p.error):
                self._client.disconnect()
            self._client = None


class _Drawing:
    """A robot in its scene as it is drawn, wherever they are put."""

    def __init__(self, model: RobotModel, scene: SceneSpec) -> None:
        self._robot = RobotVisuals(model)
        bodies = {f"joint {name}": meshes for name, meshes in self._robot.bodies.items()}
        for body in scene.bodies:
            bodies[f"body {body.name}"] = tuple(body_meshes(body.shapes))
        self._caster = RayCaster(bodies, scene.light)
        self._found: dict[tuple[str, tuple[tuple[str, float], ...]], dict[str, Array]] = {}

    def place(
        self,
        arm: Mapping[str, float],
        gripper: Mapping[str, float],
        Ts_world_body: Mapping[str, Array],
    ) -> None:
        """Put all where it is to be drawn.

        Args:
            arm, gripper: positions of the joints, by name.
            Ts_world_body: poses `(4, 4)` of the scene's bodies.
        """
        rounded = {name: round(x / _GRIPPER_STEP) * _GRIPPER_STEP for name, x in gripper.items()}
        self._Ts_world_joint = self._robot.poses({**arm, **rounded})
        self._gripper = tuple(rounded.items())
        self._Ts_world_body = {f"body {name}": T for name, T in Ts_world_body.items()}

    def view(self, camera: CameraSpec, size: tuple[int, int]) -> CameraView:
        """The image of a camera, which need not be one of the robot's or the scene's."""
        joint, T_joint_frame = self._robot.mount(camera.frame)
        return self._caster.view(
            camera,
            self._Ts_world_joint[joint] @ T_joint_frame,
            size,
            {f"joint {name}": T for name, T in self._Ts_world_joint.items()} | self._Ts_world_body,
            self._tool_around(camera.frame, self._gripper) if joint in self._robot.tool else {},
        )

    def _tool_around(self, frame: str, gripper: tuple[tuple[str, float], ...]) -> dict[str, Array]:
        """Where what moves with the tool is in one of its frames: the same wherever the arm is."""
        if (frame, gripper) not in self._found:
            if len(self._found) >= _MOST_FOUND:
                self._found.clear()
            Ts_arm_joint = self._robot.poses(dict(gripper))
            joint, T_joint_frame = self._robot.mount(frame)
            T_frame_arm = inverse(Ts_arm_joint[joint] @ T_joint_frame)
            self._found[frame, gripper] = {
                f"joint {name}": T_frame_arm @ Ts_arm_joint[name] for name in self._robot.tool
            }
        return self._found[frame, gripper]


def _scene_urdf(root: Body, moving: Iterable[Body], folder: Path) -> str:
    """A URDF of a body and of those that move on it; their meshes are written to the folder."""
    robot = ET.Element("robot", name=root.name)
    for number, body in enumerate((root, *moving)):
        mass = body.mass or 0.0
        robot.append(rigid_link(body.name, body.shapes, mass, folder, f"{number:03d}"))
        if body.joint is not None:
            joint = add_joint(
                robot, f"{body.name}_joint", root.name, body.name,
                body.joint.T_parent_body, body.joint.kind,
            )  # fmt: skip
            ET.SubElement(joint, "axis", xyz=" ".join(map(str, body.joint.axis)))
            limits = {"lower": body.joint.lower, "upper": body.joint.upper}
            ET.SubElement(joint, "limit", {k: str(v) for k, v in limits.items()})
    return ET.tostring(robot, encoding="unicode")


@contextmanager
def _urdf_file(urdf: str) -> Iterator[str]:
    """A file of a URDF, for as long as it is read."""
    handle, path = tempfile.mkstemp(suffix=".urdf")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(urdf)
        yield path
    finally:
        os.unlink(path)


def _matrix(position: Sequence[float], quaternion: Sequence[float]) -> Array:
    R, (x, y, z) = p.getMatrixFromQuaternion(quaternion), position
    return np.array([[*R[:3], x], [*R[3:6], y], [*R[6:], z], [0.0, 0.0, 0.0, 1.0]])


def _quaternion(T: Array) -> list[float]:
    """The xyzw quaternion of a pose, as PyBullet takes it."""
    return [float(v) for v in Rotation.from_matrix(T[:3, :3]).as_quat()]
