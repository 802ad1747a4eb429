"""PyBullet behind the `Backend` interface: physics at 240 Hz, pictures by its CPU renderer."""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sart_toolkit.backends.interface import (
    Backend,
    CameraView,
    Capabilities,
    Contact,
    Observation,
    check_size,
)
from sart_toolkit.errors import BrokenFile, InvalidInput, unknown_name
from sart_toolkit.poses import Array, check_array, inverse
from sart_toolkit.records import CONTROL_HZ, PHYSICS_HZ
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec, Shape
from sart_toolkit.scene.spec import Body, SceneSpec, SceneState


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


with _without_greetings():
    import pybullet as p
    from pybullet_utils.bullet_client import BulletClient

_STEPS = PHYSICS_HZ // CONTROL_HZ
_MAGIC = b"sart-pybullet-2\n"
# OpenGL's camera looks along -z with y up; ours looks along z with y down.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_JOINT_TOLERANCE = 1e-6


class PyBulletBackend(Backend):
    """A robot in its scene in PyBullet, without a window.

    Between two commands the joint targets move linearly at 240 Hz, so that the motion is as smooth
    as an arm's own interpolator makes it. The gripper's linkage follows its driver through gear
    constraints. Arm and tool may collide with each other; neighbouring links may not.
    """

    name = "pybullet"
    capabilities = Capabilities(
        can_restore=True, has_contacts=True, renders=True, observes_bodies=True
    )

    def __init__(self, robot: RobotSpec, scene: SceneSpec, image_size: int = 128) -> None:
        """Load robot and scene; call `reset` before anything else."""
        super().__init__(robot, scene, image_size)
        self._model = RobotModel(robot, scene.held)
        with _without_greetings():
            self._client: Any = BulletClient(p.DIRECT)
        c = self._client
        c.setTimeStep(1.0 / PHYSICS_HZ)
        c.setGravity(*scene.gravity)
        c.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
        self._load_robot()
        self._bodies: dict[str, int] = {}
        for body in scene.bodies:
            index = self._bodies[body.name] = _make_body(c, body)
            if body.mass is None:
                # The arm stands on the table: what neither of them moves can't collide.
                for link in self._base_links:
                    c.setCollisionFilterPair(self._robot, index, link, -1, 0)
        self._names = {(i, -1): name for name, i in self._bodies.items()}
        self._names |= {(self._robot, i): name for name, i in self._links.items()}
        self._touched: dict[tuple[str, str], tuple[float, float]] = {}
        self._time = 0.0
        # Shapes and what is held, but not where bodies stand: that is part of a state.
        what = [(b.name, b.shapes, b.mass, b.friction) for b in scene.bodies]
        urdf = self._model.urdf.read_bytes()
        with np.printoptions(precision=17, floatmode="unique", threshold=10**6):
            self._scene_digest = hashlib.sha256(repr(what).encode() + urdf).hexdigest()
        n = len(robot.arm_joints)
        self._target = self._last_target = np.zeros(n + 1)

    def _load_robot(self) -> None:
        c, robot = self._client, self.robot
        self._robot = c.loadURDF(
            str(self._model.urdf),
            useFixedBase=True,
            flags=p.URDF_USE_INERTIA_FROM_FILE | p.URDF_USE_SELF_COLLISION,
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
        self._driver = joints[robot.gripper.driver]
        self._followers = {joints[n]: ratio for n, ratio in robot.gripper.followers.items()}
        self._tool_link = self._links[robot.tool_frame]
        self._forces = [c.getJointInfo(self._robot, j)[10] for j in self._arm]
        for link in robot.gripper.finger_links:
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
        q = self._check_q(state.q)
        if set(state.Ts_world_body) != set(self._bodies):
            odd = sorted(set(state.Ts_world_body) ^ set(self._bodies))
            raise unknown_name("body in the state to reset to", odd[0], self._bodies)
        c = self._client
        for joint, angle in zip(self._arm, q, strict=True):
            c.resetJointState(self._robot, joint, angle)
        angle = self.robot.gripper.closed_angle * state.gripper
        for joint, ratio in {self._driver: 1.0, **self._followers}.items():
            c.resetJointState(self._robot, joint, angle * ratio)
        for name, T in state.Ts_world_body.items():
            c.resetBasePositionAndOrientation(self._bodies[name], T[:3, 3], _quaternion(T))
            c.resetBaseVelocity(self._bodies[name], [0, 0, 0], [0, 0, 0])
        self._target = self._last_target = np.append(q, state.gripper)
        self._time = 0.0
        self._touched = {}
        # A restore from the file that this state saves to also drops what the solver remembers of
        # earlier contacts, so that what follows depends on the state alone.
        self.restore(self.save())

    def observe(self, cameras: Sequence[str] = (), image_size: int | None = None) -> Observation:
        c = self._client
        known = self.cameras
        size = self.image_size if image_size is None else check_size(image_size)
        for name in cameras:
            if name not in known:
                raise unknown_name("camera", name, known)
        states = c.getJointStates(self._robot, self._arm)
        frames = {known[name].frame for name in cameras} - {"world"}
        frames |= {self.robot.tool_frame, *(body.name for body in self.scene.held)}
        Ts = {name: self._link_pose(name) for name in frames}
        Ts_body = {body.name: Ts[body.name] for body in self.scene.held}
        for name, body in self._bodies.items():
            Ts_body[name] = _matrix(*c.getBasePositionAndOrientation(body))
        return Observation(
            q=np.array([s[0] for s in states]),
            dq=np.array([s[1] for s in states]),
            gripper=c.getJointState(self._robot, self._driver)[0] / self.robot.gripper.closed_angle,
            T_world_tool=Ts[self.robot.tool_frame],
            time=self._time,
            cameras={name: self._picture(name, Ts, size) for name in cameras},
            Ts_world_body=Ts_body,
        )

    def _link_pose(self, name: str) -> Array:
        state = self._client.getLinkState(self._robot, self._links[name], 0, 1)
        return _matrix(state[4], state[5])

    def _picture(self, name: str, Ts_world_frame: dict[str, Array], size: int) -> CameraView:
        camera = self.cameras[name]
        T = np.eye(4) if camera.frame == "world" else Ts_world_frame[camera.frame]
        T_world_camera = T @ camera.T_frame_camera
        near, far = camera.near, camera.far
        view = inverse(T_world_camera @ _FLIP)
        _, _, rgb, buffer, _ = self._client.getCameraImage(
            size,
            size,
            view.T.ravel().tolist(),
            _projection(camera.fov_y_deg, near, far, size),
            shadow=0,
            lightDirection=[0.3, 0.4, 1.0],
            flags=p.ER_NO_SEGMENTATION_MASK,
            renderer=p.ER_TINY_RENDERER,
        )
        rgb = np.asarray(rgb, np.uint8).reshape(size, size, 4)[:, :, :3]
        z = np.asarray(buffer, np.float64).reshape(size, size)
        depth = near * far / (far - (far - near) * z)
        # What nothing was drawn over keeps the buffer's far plane, give or take a rounding.
        depth[depth >= far * (1 - 1e-4)] = 0.0
        return CameraView(np.ascontiguousarray(rgb), depth.astype(np.float32), T_world_camera)

    def command(self, q: Array, gripper: float) -> None:
        if not 0.0 <= gripper <= 1.0:
            raise InvalidInput(f"gripper: expected 0 (open) to 1 (closed), got {gripper}")
        self._target = np.append(self._check_q(q), gripper)

    def _check_q(self, q: Array) -> Array:
        q = check_array("q", q, (len(self._arm),))
        over = (q < self._model.lower - _JOINT_TOLERANCE) | (
            q > self._model.upper + _JOINT_TOLERANCE
        )
        if over.any():
            j = int(np.argmax(over))
            raise InvalidInput(
                f"{self.robot.arm_joints[j]}: {q[j]:.3f} rad is outside its limits "
                f"[{self._model.lower[j]:.3f}, {self._model.upper[j]:.3f}]"
            )
        return q

    def step(self) -> None:
        c, robot = self._client, self._robot
        arm, n = self._arm, len(self._arm)
        ones = [1.0] * n
        gripper = self.robot.gripper
        self._touched = {}
        for i in range(1, _STEPS + 1):
            target = self._last_target + (i / _STEPS) * (self._target - self._last_target)
            # Position gain 1 closes the whole error within one physics step. A velocity target
            # beside it would put the arm one physics step ahead of its targets.
            c.setJointMotorControlArray(
                robot, arm, p.POSITION_CONTROL, target[:n].tolist(),
                targetVelocities=[0.0] * n,
                forces=self._forces, positionGains=ones, velocityGains=ones,
            )  # fmt: skip
            c.setJointMotorControl2(
                robot, self._driver, p.POSITION_CONTROL, gripper.closed_angle * target[n],
                force=gripper.force, maxVelocity=gripper.speed,
            )  # fmt: skip
            c.stepSimulation()
            self._collect_contacts()
        self._last_target = self._target
        self._time += 1.0 / CONTROL_HZ

    def _collect_contacts(self) -> None:
        for point in self._client.getContactPoints():
            distance, force = point[8], point[9]
            if distance > 0.0 and force <= 0.0:
                continue
            if self._robot not in (point[1], point[2]):
                continue
            a, b = self._names[point[1], point[3]], self._names[point[2], point[4]]
            pair = (a, b) if a <= b else (b, a)
            old = self._touched.get(pair, (0.0, 0.0))
            self._touched[pair] = (max(old[0], force), max(old[1], -distance))

    def contacts(self) -> list[Contact]:
        return [Contact(a, b, *values) for (a, b), values in sorted(self._touched.items())]

    def save(self) -> bytes:
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
            "target": self._target.tolist(),
            "last_target": self._last_target.tolist(),
            "time": self._time,
        }
        body = zlib.compress(json.dumps(head).encode() + b"\n" + world, 1)
        return _MAGIC + hashlib.sha256(body).digest() + body

    def restore(self, state: bytes) -> None:
        try:
            if not state.startswith(_MAGIC):
                raise ValueError("not a state of this backend")
            sha, packed = state[len(_MAGIC) :][:32], state[len(_MAGIC) + 32 :]
            if hashlib.sha256(packed).digest() != sha:
                raise ValueError("damaged")
            head_line, world = zlib.decompress(packed).split(b"\n", 1)
            head = json.loads(head_line)
        except (ValueError, zlib.error) as error:
            raise BrokenFile(f"saved state: {error}; record the demonstration again") from error
        if head["scene"] != self._scene_digest:
            raise BrokenFile(
                f"saved state: of robot {head['robot']!r} with {head['bodies']}, this backend "
                f"has {self.robot.name!r} with {sorted(self._bodies)} or other shapes; load the "
                "matching task"
            )
        handle, path = tempfile.mkstemp(suffix=".bullet")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(world)
            self._client.restoreState(fileName=path)
        except p.error as error:
            raise BrokenFile(f"saved state: PyBullet refuses it ({error})") from error
        finally:
            os.unlink(path)
        self._target = np.array(head["target"])
        self._last_target = np.array(head["last_target"])
        self._time = head["time"]
        self._touched = {}

    def close(self) -> None:
        if self._client is not None:
            with suppress(p.error):
                self._client.disconnect()
            self._client = None


def _make_body(client: Any, body: Body) -> int:
    visuals = _arrays(body.shapes, drawn=True)
    collisions = [shape for shape in body.shapes if shape.collides]
    visual = client.createVisualShapeArray(**visuals)
    collision = (
        client.createCollisionShapeArray(**_arrays(collisions, drawn=False)) if collisions else -1
    )
    T = body.T_world_body
    index = client.createMultiBody(
        body.mass or 0.0, collision, visual, T[:3, 3].tolist(), _quaternion(T)
    )
    client.changeDynamics(index, -1, lateralFriction=body.friction)
    return int(index)


def _projection(fov_y_deg: float, near: float, far: float, size: int) -> list[float]:
    """OpenGL's matrix, half a pixel off: TinyRenderer samples each pixel at its lower left corner.

    So (0, 0) of the picture is the centre of its first pixel, as `CameraSpec.intrinsics` says.
    """
    matrix = list(p.computeProjectionMatrixFOV(fov_y_deg, 1.0, near, far))
    matrix[8] += 1.0 / size
    matrix[9] += 1.0 / size
    return matrix


def _arrays(shapes: Sequence[Shape], drawn: bool) -> dict[str, Any]:
    kinds = {"box": p.GEOM_BOX, "cylinder": p.GEOM_CYLINDER, "sphere": p.GEOM_SPHERE}
    origin = "visualFrame" if drawn else "collisionFrame"
    arrays: dict[str, Any] = {
        "shapeTypes": [kinds[s.kind] for s in shapes],
        "halfExtents": [[v / 2 for v in s.size] if s.kind == "box" else [0] * 3 for s in shapes],
        "radii": [0.0 if s.kind == "box" else s.size[0] for s in shapes],
        "lengths": [s.size[1] if s.kind == "cylinder" else 0.0 for s in shapes],
        f"{origin}Positions": [s.T_body_shape[:3, 3].tolist() for s in shapes],
        f"{origin}Orientations": [_quaternion(s.T_body_shape) for s in shapes],
    }
    if drawn:
        arrays["rgbaColors"] = [list(s.rgba) for s in shapes]
    return arrays


def _matrix(position: Sequence[float], quaternion: Sequence[float]) -> Array:
    T = np.eye(4)
    T[:3, :3] = np.array(p.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
    T[:3, 3] = position
    return T


def _quaternion(T: Array) -> list[float]:
    """The xyzw quaternion of a pose, as PyBullet takes it."""
    return [float(v) for v in Rotation.from_matrix(T[:3, :3]).as_quat()]
