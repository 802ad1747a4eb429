"""SAPIEN behind the `Backend` interface, with all abilities: PhysX, images by its rasteriser."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from sart_toolkit.backends.interface import (
    CameraView,
    CommandSent,
    Contact,
    Observation,
    Simulator,
)
from sart_toolkit.backends.sapien_renderer import (
    ALONG_Z,
    REMEDY,
    Renderer,
    sapien,
    sapien_axis,
    sapien_pose,
    why_no_images,
)
from sart_toolkit.backends.states import pack_state, scene_digest, unpack_state
from sart_toolkit.backends.targets import PeriodTargets
from sart_toolkit.collision.parts import primitive
from sart_toolkit.data.records import DEFAULT_RATES, Rates
from sart_toolkit.errors import MissingCapability, SartError
from sart_toolkit.poses import Array
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import (
    CameraSpec,
    ConvexShape,
    ImageSize,
    RobotSpec,
    Shape,
    check_image_size,
    mass_properties,
)
from sart_toolkit.scenes.spec import Body, Joint, SceneSpec, SceneState

# Solver iterations: fewer let fingers sink into what they squeeze.
_ITERATIONS = 40
# So stiff that a drive closes its whole error within one physics step, unless its force limit or
# a contact keeps it from it.
_STIFF = 1e9
# How far the gripper's linkage gives under its full force, in parts of its way from open to closed.
_LINKAGE_GIVE = 1e-3
_FINGER_FRICTION, _LINK_FRICTION = 1.0, 0.5
_CONTACT_OFFSET = 1e-3
# [m/s]: bodies that a state has overlap come apart, but don't fly apart.
_DEPENETRATION_SPEED = 1.0

# Who collides with whom: what no joint moves, the arm up to its last three joints, the wrist, the
# tool; bodies that stay and bodies that move.
_BASE, _ARM, _WRIST, _TOOL, _STILL, _FREE = (1 << i for i in range(6))
_MEETS = {
    _BASE: _TOOL | _FREE,
    _ARM: _TOOL | _STILL | _FREE,
    _WRIST: _STILL | _FREE,
    _TOOL: _BASE | _ARM | _STILL | _FREE,
    _STILL: _ARM | _WRIST | _TOOL | _FREE,
    _FREE: _BASE | _ARM | _WRIST | _TOOL | _STILL | _FREE,
}


@dataclass(frozen=True)
class _Moment:
    """All that moves at one time: what is observed, and what physics can be started again from.

    `q`, `dq` of all the robot's joints, in Pinocchio's order; `joints`: positions and velocities of
    jointed bodies; of the others poses `(4, 4)` and, where they move, `twists (6,)` (linear,
    angular, world frame).
    """

    q: Array
    dq: Array
    Ts_world_body: Mapping[str, Array]
    twists: Mapping[str, Array]
    joints: Mapping[str, Array]

    def plain(self) -> dict[str, Any]:
        """The same as JSON values, exactly."""
        plain: dict[str, Any] = {"q": self.q.tolist(), "dq": self.dq.tolist()}
        for name in ("Ts_world_body", "twists", "joints"):
            plain[name] = {k: v.tolist() for k, v in getattr(self, name).items()}
        return plain

    @staticmethod
    def of(plain: Mapping[str, Any]) -> _Moment:
        """What `plain` gave."""
        bodies = [
            {k: np.array(v) for k, v in plain[name].items()}
            for name in ("Ts_world_body", "twists", "joints")
        ]
        return _Moment(np.array(plain["q"]), np.array(plain["dq"]), *bodies)


class SapienBackend(Simulator):
    """A robot in its scene in SAPIEN (PhysX 5 on the CPU), without a window.

    The gripper's linkage moves as one, give or take a hundredth of its way, and its joints together
    bear the driver's force. Gravity doesn't act on the robot. Arm and tool may collide with each
    other; neighbouring links may not. The friction between two bodies is the mean of their
    coefficients.

    PhysX remembers contacts in ways that can't be saved. So every `reset` and `restore` builds the
    physics, and what follows depends on the state alone, to the bit; but the motion after a
    `save` and the one after its `restore` may differ by `drift`.

    Physics needs no graphics. Where SAPIEN can't draw, `no_images` of the instance says why, and
    so does asking for an image.
    """

    name = "sapien"
    drift = 1e-3
    drift_deg = 0.2
    # 0.23 mm were measured, free or with an object in the grasp.
    tracking_error = 4e-4

    def __init__(
        self,
        robot: RobotSpec,
        scene: SceneSpec,
        image_size: ImageSize = 128,
        rates: Rates = DEFAULT_RATES,
    ) -> None:
        """Load robot and scene; call `reset` before anything else.

        Raises:
            InvalidInput: the robot's URDF has joints or shapes that this backend doesn't know.
        """
        super().__init__(robot, scene, image_size, rates)
        why = why_no_images()
        self.no_images = f"SAPIEN can't draw here ({why}); {REMEDY}" if why else ""
        self._renderer: Renderer | None = None
        self._model = RobotModel(robot, scene.held)
        self._robot = _ConvexParts(robot, self._model)
        self._scene_digest = scene_digest(self._model, scene)
        self._physics: _Physics | None = None
        bodies = {body.name: body.T_world_body for body in scene.bodies if body.joint is None}
        self._start(
            _Moment(
                q=self._robot.q_all(robot.home, 0.0),
                dq=np.zeros(self._robot.model.nv),
                Ts_world_body=bodies,
                twists={body.name: np.zeros(6) for body in scene.bodies if body.name in bodies},
                joints={name: np.zeros(2) for name in scene.jointed},
            ),
            robot.home,
            0.0,
        )

    def reset(self, state: SceneState) -> None:
        self._running()
        q = self._model.check_limits(state.q)
        self.scene.check_state(state)
        bodies = {k: T for k, T in state.Ts_world_body.items() if k not in self.scene.jointed}
        self._start(
            _Moment(
                q=self._robot.q_all(q, state.gripper),
                dq=np.zeros(self._robot.model.nv),
                Ts_world_body=bodies,
                twists={name: np.zeros(6) for name in bodies},
                joints={k: np.array([at, 0.0]) for k, at in state.joint_positions.items()},
            ),
            q,
            state.commanded_gripper,
        )

    def _start(self, moment: _Moment, q: Array, gripper: float) -> None:
        """Rebuild the physics with all as at a moment, the targets at rest, and time 0."""
        self._now = moment
        self._physics = _Physics(self._robot, self.scene, moment, self.rates.physics_hz)
        self._targets = PeriodTargets(self._model, self.rates.physics_per_control)
        self._targets.rest_at(q, gripper)
        self._periods = 0
        self._touched: dict[tuple[str, str], tuple[float, float]] = {}
        self._joint_path: list[Array] = []

    def _running(self) -> _Physics:
        if self._physics is None:
            raise SartError("backend 'sapien': was closed; make a new one")
        return self._physics

    def observe(
        self, cameras: Sequence[str] = (), image_size: ImageSize | None = None
    ) -> Observation:
        self._running()
        size = self.image_size if image_size is None else check_image_size(image_size)
        self.check_cameras(cameras)
        now, robot = self._now, self._robot
        Ts_body = self.body_poses()
        return Observation(
            q=now.q[robot.arm],
            dq=now.dq[robot.arm],
            gripper=self._opening(),
            T_world_tool=robot.frame_pose(self.robot.tool_frame),
            time=self._periods / self.rates.control_hz,
            cameras=self._take([self.cameras[n] for n in cameras], size, Ts_body),
            Ts_world_body=Ts_body,
            joint_path=np.array(self._joint_path),
        )

    def _opening(self) -> float:
        """The gripper's command that its driver is at; without fingers, the one in force."""
        if self._robot.driver is None:
            return float(self._targets.last[-1])
        return self.robot.gripper.command_at(float(self._now.q[self._robot.driver]))

    def body_poses(self) -> dict[str, Array]:
        self._running()
        now, robot = self._now, self._robot
        robot.place(now.q)
        Ts = {body.name: robot.frame_pose(body.name) for body in self.scene.held}
        Ts |= {name: T.copy() for name, T in now.Ts_world_body.items()}
        for name, body in self.scene.jointed.items():
            assert body.joint is not None
            at = float(now.joints[name][0])
            Ts[name] = Ts[body.joint.parent] @ body.joint.T_parent_moved(at)
        return Ts

    def draw(self, state: SceneState, camera: CameraSpec, width: int, height: int) -> CameraView:
        self._running()
        q = self._model.check_limits(state.q)
        self.scene.check_state(state)
        if self.no_images:
            raise MissingCapability(self.no_images)
        self._robot.place(self._robot.q_all(q, state.gripper))
        size = check_image_size((width, height))
        return self._take([camera], size, state.Ts_world_body)[camera.name]

    def _take(
        self,
        cameras: Sequence[CameraSpec],
        size: tuple[int, int],
        Ts_world_body: Mapping[str, Array],
    ) -> dict[str, CameraView]:
        """Images of the robot as last placed, and of bodies at poses `(4, 4)`."""
        if not cameras:
            return {}
        robot = self._robot
        if self._renderer is None:
            self._renderer = Renderer(robot.geometry(pin.GeometryType.VISUAL), self.scene)
        placed = [(camera, robot.frame_pose(camera.frame)) for camera in cameras]
        return self._renderer.take(placed, size, robot.joint_poses(), Ts_world_body)

    def command(self, q: Array, gripper: float) -> CommandSent:
        self._running()
        return self._targets.command(q, gripper)

    def step(self) -> None:
        physics = self._running()
        self._touched = {}
        self._joint_path = []
        for target in self._targets.rows:
            physics.advance(target[:-1], self.robot.gripper.driver_position(float(target[-1])))
            self._joint_path.append(physics.arm_positions())
            for pair, (force, penetration) in physics.contacts().items():
                old = self._touched.get(pair, (0.0, 0.0))
                self._touched[pair] = max(old[0], force), max(old[1], penetration)
        self._now = physics.moment(self._now)
        self._targets.advance()
        self._periods += 1

    def contacts(self) -> list[Contact]:
        self._running()
        return [Contact(a, b, *values) for (a, b), values in sorted(self._touched.items())]

    def save(self) -> bytes:
        self._running()
        head = {
            "robot": self.robot.name,
            "scene": self._scene_digest,
            "bodies": sorted(body.name for body in self.scene.bodies),
            **self._targets.to_json(),
            "periods": self._periods,
            "now": self._now.plain(),
        }
        return pack_state(self.name, head, b"")

    def restore(self, state: bytes) -> None:
        self._running()
        names = sorted(body.name for body in self.scene.bodies)
        head, _ = unpack_state(self.name, state, self.robot.name, self._scene_digest, names)
        self._start(_Moment.of(head["now"]), self.robot.home, 0.0)
        self._targets.take(head)
        self._periods = int(head["periods"])

    def close(self) -> None:
        self._physics = self._renderer = None


class _ConvexParts:
    """The robot's joints and convex parts as its URDF has them, links without joints merged.

    Attributes:
        model: Pinocchio's model of arm and gripper.
        arm, driver: where their positions are in `q`.
        linkage: the ratio to the driver of each joint that the gripper moves, by joint index.
        parts: each joint's parts, a link's name, shape or mesh file, and pose in the joint each.
        groups: each joint's place in `_MEETS`.
    """

    def __init__(self, spec: RobotSpec, model: RobotModel) -> None:
        self.spec = spec
        self._urdf = model.urdf
        self.model = pin.buildModelFromUrdf(str(model.urdf))
        self._data = self.model.createData()
        self._frames = {frame.name: i for i, frame in enumerate(self.model.frames)}
        index = {name: j for j, name in enumerate(self.model.names)}
        self.arm = [index[name] - 1 for name in spec.arm_joints]
        driver = spec.gripper.driver
        self.driver = None if driver is None else index[driver] - 1
        self.linkage = {index[name]: ratio for name, ratio in spec.gripper.ratios.items()}
        self.parts: dict[int, list[tuple[str, Shape | str, Array]]] = {}
        for item in self.geometry(pin.GeometryType.COLLISION).geometryObjects:
            T = np.array(item.placement.homogeneous)
            mesh = item.meshPath.endswith(".obj")
            shape = item.meshPath if mesh else primitive(item.geometry)
            link = self.model.frames[item.parentFrame].name
            self.parts.setdefault(int(item.parentJoint), []).append((link, shape, T))
        rank = [0]
        for j in range(1, self.model.njoints):
            rank.append(rank[self.model.parents[j]] + (j - 1 in self.arm))
        n = len(self.arm)
        # The last three joints share a wrist: their links are neighbours of the tool.
        self.groups = [
            _BASE if r == 0 else _ARM if r <= n - 3 else _WRIST if r < n else _TOOL for r in rank
        ]

    def geometry(self, kind: pin.GeometryType) -> pin.GeometryModel:
        """What collides, or what is drawn."""
        folder = str(self._urdf.parent)
        return pin.buildGeomFromUrdf(self.model, str(self._urdf), kind, package_dirs=folder)

    def q_all(self, q: Array, gripper: float) -> Array:
        """Positions of all joints, from those of the arm and the gripper's in [0, 1]."""
        full = np.array(pin.neutral(self.model))
        at = self.spec.gripper.driver_position(gripper)
        for joint, ratio in self.linkage.items():
            full[joint - 1] = at * ratio
        full[self.arm] = q
        return full

    def place(self, q_all: Array) -> None:
        """Put all frames where the joint positions have them."""
        pin.framesForwardKinematics(self.model, self._data, q_all)

    def frame_pose(self, name: str) -> Array:
        """The pose `(4, 4)` of a frame, or of "world", as last placed."""
        if name == "world":
            return np.eye(4)
        return np.array(self._data.oMf[self._frames[name]].homogeneous)

    def joint_poses(self) -> dict[int, Array]:
        """The poses `(4, 4)` of all joint frames as last placed."""
        return {j: np.array(T.homogeneous) for j, T in enumerate(self._data.oMi)}

    def axis(self, joint: int) -> tuple[str, Array]:
        """A joint's kind and axis `(3,)`."""
        data = self.model.joints[joint].createData()
        self.model.joints[joint].calc(data, np.zeros(1))
        linear, angular = np.split(np.array(data.S).ravel(), 2)
        return ("revolute", angular) if angular.any() else ("prismatic", linear)


class _Physics:
    """Robot and bodies in PhysX, started at a moment."""

    def __init__(
        self, robot: _ConvexParts, scene: SceneSpec, moment: _Moment, physics_hz: int
    ) -> None:
        self._hz = physics_hz
        with _scene_config(scene.gravity):
            self._system = sapien.physx.PhysxCpuSystem()
        self._system.timestep = 1.0 / physics_hz
        self._scene = sapien.Scene([self._system])
        # Names of shapes: links that are fixed to each other are one body to PhysX.
        self._names: dict[Any, str] = {}
        self._free: dict[str, Any] = {}
        self._jointed: dict[str, tuple[Joint, Any]] = {}
        self._add_robot(robot, moment)
        # A body with a joint and the one that it moves on have the same number; bodies of one
        # number don't collide if they share a bit.
        numbers = {b.name: i + 1 for i, b in enumerate(scene.bodies) if b.mass is None}
        bits = dict.fromkeys(numbers, 0)
        for body in scene.bodies:
            if body.joint is not None:
                parent = body.joint.parent
                ignored = 1 << bits[parent], numbers[parent]
                self._add_jointed(body, body.joint, moment, ignored)
                bits[parent] += 1
            elif body.mass is None:
                component = sapien.physx.PhysxRigidStaticComponent()
                self._attach_shapes(component, body, _STILL, (2**32 - 1, numbers[body.name]))
                self._enter(component, moment.Ts_world_body[body.name])
            else:
                self._add_free(body, body.mass, moment)

    def _add_robot(self, robot: _ConvexParts, moment: _Moment) -> None:
        model, gripper = robot.model, robot.spec.gripper
        links: list[Any] = []
        for j in range(model.njoints):
            parent = links[model.parents[j]] if j else None
            link = sapien.physx.PhysxArticulationLinkComponent(parent)
            # Position control bears the robot's weight.
            link.disable_gravity = True
            links.append(link)
            for name, shape, T in robot.parts.get(j, []):
                friction = _FINGER_FRICTION if name in gripper.finger_links else _LINK_FRICTION
                self._attach(link, name, shape, T, friction, robot.groups[j], (0, 0))
            if j > 0:
                inertia = model.inertias[j]
                _set_mass(link, inertia.mass, inertia.lever, inertia.inertia)
                limits = model.lowerPositionLimit[j - 1], model.upperPositionLimit[j - 1]
                T_parent_joint = np.array(model.jointPlacements[j].homogeneous)
                _set_joint(link, *robot.axis(j), T_parent_joint, limits)
                link.joint.set_drive_properties(_STIFF, 0.0, float(model.effortLimit[j - 1]))
                link.joint.set_drive_target(float(moment.q[j - 1]))
        self._robot = self._enter_articulation(links, np.eye(4))
        self._order = [links.index(joint.child_link) - 1 for joint in self._robot.active_joints]
        _place(self._robot, moment.q[self._order], moment.dq[self._order])
        self._arm = [links[at + 1].joint for at in robot.arm]
        self._arm_order = [self._order.index(at) for at in robot.arm]
        # Stiff springs hold each joint of the linkage to its ratio times s, one number for all.
        self._linkage = [(links[j].joint, ratio) for j, ratio in robot.linkage.items()]
        squared = sum(ratio**2 for _, ratio in self._linkage)
        self._weights = np.zeros(len(self._order))
        for j, ratio in robot.linkage.items():
            self._weights[self._order.index(j - 1)] = ratio / squared
        self._lead = _LINKAGE_GIVE * abs(gripper.closed_position - gripper.open_position)
        self._reach = max(gripper.speed / self._hz, self._lead)
        for joint, _ in self._linkage:
            joint.set_drive_properties(gripper.force / (squared * self._lead), 0.0)

    def _add_free(self, body: Body, mass: float, moment: _Moment) -> None:
        component = sapien.physx.PhysxRigidDynamicComponent()
        self._attach_shapes(component, body, _FREE, (0, 0))
        _set_mass(component, mass, *mass_properties(body.shapes, mass))
        component.solver_position_iterations = _ITERATIONS
        component.sleep_threshold = 0.0
        self._enter(component, moment.Ts_world_body[body.name])
        component.linear_velocity = moment.twists[body.name][:3].tolist()
        component.angular_velocity = moment.twists[body.name][3:].tolist()
        self._free[body.name] = component

    def _add_jointed(
        self, body: Body, joint: Joint, moment: _Moment, ignored: tuple[int, int]
    ) -> None:
        assert body.mass is not None
        root = sapien.physx.PhysxArticulationLinkComponent(None)
        link = sapien.physx.PhysxArticulationLinkComponent(root)
        self._attach_shapes(link, body, _FREE, ignored)
        _set_mass(link, body.mass, *mass_properties(body.shapes, body.mass))
        _set_joint(link, joint.kind, joint.axis, np.eye(4), (joint.lower, joint.upper))
        # A motor that wants to stand still, of limited strength, is dry friction.
        link.joint.set_drive_properties(0.0, _STIFF if joint.friction else 0.0, joint.friction)
        T_world_joint = moment.Ts_world_body[joint.parent] @ joint.T_parent_body
        articulation = self._enter_articulation([root, link], T_world_joint)
        _place(articulation, *moment.joints[body.name].reshape(2, 1))
        self._jointed[body.name] = joint, articulation

    def _attach_shapes(
        self, component: Any, body: Body, group: int, ignored: tuple[int, int]
    ) -> None:
        for shape in body.shapes:
            for part in shape.convex_parts() if shape.collides else ():
                T = shape.T_body_shape
                self._attach(component, body.name, part, T, body.friction, group, ignored)

    def _attach(
        self,
        component: Any,
        name: str,
        shape: ConvexShape | str,
        T: Array,
        friction: float,
        group: int,
        ignored: tuple[int, int],
    ) -> None:
        """Give a body a primitive, a hull by its corners, or that of a file, at `T (4, 4)`."""
        material = sapien.physx.PhysxMaterial(friction, friction, 0.0)
        if not isinstance(shape, Shape):
            made = sapien.physx.PhysxCollisionShapeConvexMesh(shape, [1.0, 1.0, 1.0], material)
        elif shape.kind == "box":
            half = [edge / 2 for edge in shape.size]
            made = sapien.physx.PhysxCollisionShapeBox(half, material)
        elif shape.kind == "sphere":
            made = sapien.physx.PhysxCollisionShapeSphere(shape.size[0], material)
        else:
            radius, length = shape.size
            made = sapien.physx.PhysxCollisionShapeCylinder(radius, length / 2, material)
            T = T @ ALONG_Z
        made.local_pose = sapien_pose(T)
        made.contact_offset = _CONTACT_OFFSET
        made.set_collision_groups([group, _MEETS[group], *ignored])
        component.attach(made)
        self._names[made] = name

    def _enter(self, component: Any, T_world_body: Array) -> None:
        entity = sapien.Entity()
        entity.add_component(component)
        entity.set_pose(sapien_pose(T_world_body))
        self._scene.add_entity(entity)

    def _enter_articulation(self, links: list[Any], T_world_root: Array) -> Any:
        """The articulation that the links make, in the scene and its first link fixed."""
        links[0].joint.type = "fixed"
        articulation = links[0].articulation
        articulation.solver_position_iterations = _ITERATIONS
        articulation.sleep_threshold = 0.0
        for link in links:
            link.linear_damping = link.angular_damping = 0.0
            self._enter(link, T_world_root)
        return articulation

    def advance(self, q: Array, driver: float) -> None:
        """One physics step towards joint targets `(n,)` and the gripper driver's target."""
        for joint, target in zip(self._arm, q.tolist(), strict=True):
            joint.set_drive_target(target)
        # The forces of the linkage's springs on s balance where s is the weighted mean of what the
        # joints say. So far ahead of that mean as they give under the gripper's force, the springs
        # act with that force; nor may s run ahead of the gripper's speed.
        s, speed = float(self._weights @ self._robot.qpos), float(self._weights @ self._robot.qvel)
        ahead = min(max(speed, 0.0) / self._hz + self._lead, self._reach)
        behind = min(max(-speed, 0.0) / self._hz + self._lead, self._reach)
        s = min(max(driver, s - behind), s + ahead)
        for joint, ratio in self._linkage:
            joint.set_drive_target(ratio * s)
        for joint, articulation in self._jointed.values():
            if joint.stiffness or joint.detent:
                effort = joint.effort(float(articulation.qpos[0]))
                articulation.set_qf(np.array([effort], np.float32))
        self._system.step()

    def arm_positions(self) -> Array:
        """Where the arm's joints `(n,)` [rad] are now."""
        return np.array(self._robot.qpos[self._arm_order], np.float64)

    def contacts(self) -> dict[tuple[str, str], tuple[float, float]]:
        """Force [N] and penetration [m] of each pair that touched in the last step."""
        found: dict[tuple[str, str], tuple[float, float]] = {}
        for contact in self._system.get_contacts():
            force = self._hz * sum(math.hypot(*point.impulse) for point in contact.points)
            separation = min((point.separation for point in contact.points), default=math.inf)
            # PhysX also reports bodies that are only near each other.
            if separation > 0.0 and force <= 0.0:
                continue
            a, b = sorted(self._names[shape] for shape in contact.shapes)
            old = found.get((a, b), (0.0, 0.0))
            found[a, b] = old[0] + force, max(old[1], -separation)
        return found

    def moment(self, before: _Moment) -> _Moment:
        """Where everything is now; what never moves is where it was before."""
        q, dq = np.empty(len(self._order)), np.empty(len(self._order))
        q[self._order], dq[self._order] = self._robot.qpos, self._robot.qvel
        Ts, twists = dict(before.Ts_world_body), dict(before.twists)
        for name, component in self._free.items():
            Ts[name] = _matrix(component.entity.pose)
            twists[name] = np.append(component.linear_velocity, component.angular_velocity)
        joints = {
            name: np.append(articulation.qpos, articulation.qvel).astype(np.float64)
            for name, (_, articulation) in self._jointed.items()
        }
        return _Moment(q, dq, Ts, twists, joints)


@contextmanager
def _scene_config(gravity: Array) -> Iterator[None]:
    """SAPIEN's settings for new scenes, which it keeps for the whole process."""
    old = sapien.physx.get_scene_config()
    config = sapien.physx.PhysxSceneConfig()
    config.gravity = gravity.tolist()
    config.enable_enhanced_determinism = True
    # The temporal solver (TGS) would let so stiff a drive reach its target within the first
    # fraction of a step and report no velocity.
    config.enable_tgs = False
    sapien.physx.set_scene_config(config)
    try:
        yield
    finally:
        sapien.physx.set_scene_config(old)


def _set_mass(component: Any, mass: float, centre: Array, inertia: Array) -> None:
    """Mass [kg], centre `(3,)` [m] and inertia `(3, 3)` [kg m²] about it; PhysX wants its axes."""
    moments, axes = np.linalg.eigh(inertia)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = axes * np.sign(np.linalg.det(axes)), centre
    component.mass = mass
    component.cmass_local_pose = sapien_pose(T)
    component.inertia = moments.tolist()
    component.max_depenetration_velocity = _DEPENETRATION_SPEED


def _set_joint(
    link: Any, kind: str, axis: Array, T_parent_joint: Array, limits: tuple[float, float]
) -> None:
    """Let a link move on its parent about or along `axis (3,)`; PhysX wants its x axis there."""
    joint, T = link.joint, sapien_axis(axis)
    joint.type = kind
    joint.pose_in_parent = sapien_pose(T_parent_joint @ T)
    joint.pose_in_child = sapien_pose(T)
    joint.limit = np.array([limits], np.float32)
    joint.friction = 0.0


def _place(articulation: Any, q: Array, dq: Array) -> None:
    articulation.set_qpos(q.astype(np.float32))
    articulation.set_qvel(dq.astype(np.float32))


def _matrix(placed: Any) -> Array:
    w, x, y, z = placed.q.astype(np.float64)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    T[:3, 3] = placed.p
    return T
