"""A first `RobotSpec` of a robot, read from its URDF: a file with comments, to be completed."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence

import numpy as np

from sart_toolkit.bringup.fingers import fingers_of
from sart_toolkit.collision.model import CollisionModel
from sart_toolkit.errors import InvalidInput, SartError
from sart_toolkit.poses import Array, log_rotation, pose
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.references import resource_path
from sart_toolkit.robots.spec import CameraSpec, GripperSpec, RobotSpec, look_at
from sart_toolkit.robots.urdf import source_elements
from sart_toolkit.scenes.spec import SceneSpec

_FINGER = re.compile(r"finger|gripper|jaw|claw|knuckle|hand|drive", re.IGNORECASE)
# A joint that slides farther [m] is that of a base which drives.
_LONGEST_SLIDE = 3.0
_ACCELERATION, _JERK = 10.0, 400.0
# How far before its base, and at which heights, the tool of an arm of 0.6 m may start [m].
_START = (0.45, 0.25, 0.45, 0.7)
_TRIES = 100
# What of the robot isn't a neighbour is at home so far apart [m].
_CLEAR = 0.04
# So far from the joints' limits [rad or m].
_FROM_LIMITS = 0.05


@dataclasses.dataclass(frozen=True)
class Draft:
    """A robot as far as its URDF tells, and the text of a file that makes it."""

    robot: RobotSpec
    text: str


def draft_robot(urdf: str, name: str | None = None, package_dirs: Sequence[str] = ()) -> Draft:
    """What a URDF tells about its robot: arm, gripper, tool frame, and a home that it can reach.

    The arm is the longest chain of joints; what moves beyond its end is the gripper, open where
    the gap between its fingers is larger.

    Args:
        urdf: the URDF, `package:path/inside/it` or a path.
        name: what to call the robot; the URDF's own name if left out.
        package_dirs: folders to look in for `package://` meshes.

    Raises:
        MissingExtra, MissingFile, BrokenFile: the URDF or a mesh can't be read.
        InvalidInput: something in it isn't acceptable, or nothing in it moves.
    """
    source = resource_path(urdf)
    tree = _Tree(source_elements(source, "", package_dirs))
    arm, fingers = tree.arm_and_fingers()
    if not arm:
        raise InvalidInput(f"{source.name}: no joint moves, expected those of an arm; check it")
    flange = tree.child[arm[-1]]
    leaf = tree.frame_beyond(flange)
    limits = [tree.limits(joint) for joint in arm]
    middle = np.array([np.clip(0.0, *_inner(lower, upper)) for lower, upper, _ in limits])
    n = len(arm)
    robot = RobotSpec(
        name=re.sub(r"\W+", "_", name or source.stem).strip("_").lower(),
        urdf=urdf,
        arm_joints=tuple(arm),
        home=middle,
        velocity_limits=np.array([velocity for _, _, velocity in limits]),
        acceleration_limits=np.full(n, _ACCELERATION),
        jerk_limits=np.full(n, _JERK),
        gripper=GripperSpec(),
        gripper_base=leaf,
        T_gripper_tool=np.eye(4),
        package_dirs=tuple(package_dirs),
    )
    doubts: list[str] = []
    if fingers:
        robot = _with_gripper(robot, tree, fingers, doubts)
    else:
        doubts.append("nothing moves beyond the arm: a fixed tool, or a gripper of its own URDF")
    robot = dataclasses.replace(robot, cameras=(_camera(robot),))
    robot = _at_home(robot, doubts)
    return Draft(robot, _text(robot, source.name, doubts))


def _inner(lower: float, upper: float) -> tuple[float, float]:
    """Limits, a tenth of the range within."""
    room = 0.1 * (upper - lower)
    return lower + room, upper - room


class _Tree:
    """A URDF's links and joints by name."""

    def __init__(self, elements: Sequence[ET.Element]) -> None:
        self.links = {e.get("name", ""): e for e in elements if e.tag == "link"}
        self.joints = {e.get("name", ""): e for e in elements if e.tag == "joint"}
        self.child = {name: _end(joint, "child") for name, joint in self.joints.items()}
        self.parent = {name: _end(joint, "parent") for name, joint in self.joints.items()}
        children = set(self.child.values())
        self.root = next((link for link in self.links if link not in children), "")

    def below(self, link: str) -> Iterator[str]:
        """The joints beyond a link, nearest first."""
        waiting = [link]
        for at in waiting:
            for name, parent in self.parent.items():
                if parent == at and self.child[name] not in waiting:
                    yield name
                    waiting.append(self.child[name])

    def moving(self, link: str) -> list[str]:
        """The joints beyond a link that move."""
        return [name for name in self.below(link) if self.joints[name].get("type") != "fixed"]

    def limits(self, joint: str) -> tuple[float, float, float]:
        """Lower and upper limit, and velocity; a full turn and 1/s where there are none."""
        limit = self.joints[joint].find("limit")
        given = {} if limit is None else limit.attrib
        velocity = float(given.get("velocity", 0)) or 1.0
        if self.joints[joint].get("type") == "continuous":
            return -2 * np.pi, 2 * np.pi, velocity
        return float(given.get("lower", 0)), float(given.get("upper", 0)), velocity

    def arm_and_fingers(self) -> tuple[list[str], list[str]]:
        """The joints of the longest chain up to what looks like fingers, and those of these."""
        arm: list[str] = []
        link = self.root
        while True:
            beyond = [name for name, parent in self.parent.items() if parent == link]
            if not beyond:
                return arm, []
            reach = {
                name: len(self.moving(self.child[name]))
                + (self.joints[name].get("type") != "fixed")
                for name in beyond
            }
            best = max(reach, key=lambda name: reach[name])
            if not reach[best]:
                return arm, []
            rest = self.moving(link)
            branches = sum(count > 0 for count in reach.values())
            mimics = any(self.joints[name].find("mimic") is not None for name in rest)
            few = len(rest) <= 2 and len(arm) >= 4
            if arm and (
                all(_FINGER.search(name) for name in rest) or (branches > 1 and (mimics or few))
            ):
                return arm, rest
            if self.joints[best].get("type") != "fixed" and not self._drives(best):
                arm.append(best)
            link = self.child[best]

    def _drives(self, joint: str) -> bool:
        """Whether a joint looks like that of a base which drives."""
        lower, upper, _ = self.limits(joint)
        return (
            self.joints[joint].get("type") == "prismatic" and upper - lower > _LONGEST_SLIDE
        ) or bool(re.match(r"root|world|base_(x|y|rot)", joint))

    def frame_beyond(self, link: str) -> str:
        """The last link that is fixed beyond another: its flange or tool frame."""
        fixed = [name for name in self.below(link) if self.joints[name].get("type") == "fixed"]
        plain = [name for name in fixed if self.links[self.child[name]].find("visual") is None]
        named = [name for name in plain if re.search(r"tool|flange|ee|tcp|eef", self.child[name])]
        return self.child[named[-1]] if named else link


def _end(joint: ET.Element, tag: str) -> str:
    element = joint.find(tag)
    return "" if element is None else element.get("link", "")


def _with_gripper(
    robot: RobotSpec, tree: _Tree, fingers: list[str], doubts: list[str]
) -> RobotSpec:
    """The robot with the gripper that these joints are, and the tool frame between its fingers."""
    leaders = [
        mimic.get("joint", "") for name in fingers
        if (mimic := tree.joints[name].find("mimic")) is not None
    ]  # fmt: skip
    driver = next((name for name in leaders if name in fingers), fingers[0])
    lower, upper, velocity = tree.limits(driver)
    followers: dict[str, float] = {}
    for name in fingers:
        mimic = tree.joints[name].find("mimic")
        if mimic is not None and mimic.get("joint") == driver:
            followers[name] = float(mimic.get("multiplier", 1))
        elif mimic is None and name != driver and _alike(tree, name, driver):
            # Fingers of one range, or of one mirrored, are moved together.
            followers[name] = 1.0 if tree.limits(name)[1] == upper else -1.0
            doubts.append(f"{name} has no <mimic>: taken to follow {driver}")
    linked = [driver, *followers]
    held = [name for name in fingers if name not in linked]
    if held:
        doubts.append(f"not of the linkage, held: {', '.join(held)}")
    candidates = _fingertips(tree, linked)
    base = tree.parent[driver]
    if len(candidates) < 2:
        candidates.append(base)
        doubts.append(f"one finger moves: {base!r} is taken for the other")
    turns = tree.joints[driver].get("type") != "prismatic"
    gripper = GripperSpec(
        driver=driver,
        followers=followers,
        open_position=lower,
        closed_position=upper,
        finger_links=tuple(candidates[:2]),
        force=6.0 if turns else 40.0,
        speed=min(velocity, 1.0 if turns else 0.1),
        armature=1e-3 if turns else 0.3,
    )
    robot = dataclasses.replace(robot, gripper=gripper, gripper_base=base)
    found = fingers_of(RobotModel(robot))
    if found is not None and found.gaps[-1] > found.gaps[0]:
        gripper = dataclasses.replace(gripper, open_position=upper, closed_position=lower)
        robot = dataclasses.replace(robot, gripper=gripper)
        found = fingers_of(RobotModel(robot))
    if found is not None and found.gaps.max() <= 0:
        doubts.append("the fingers' hulls overlap even open: check which position is closed")
    if found is None or not found.closing.any():
        doubts.append("the tool frame couldn't be told: complete T_gripper_tool")
        return robot
    return dataclasses.replace(robot, T_gripper_tool=_between(robot))


def _alike(tree: _Tree, a: str, b: str) -> bool:
    (low_a, high_a, _), (low_b, high_b, _) = tree.limits(a), tree.limits(b)
    same = np.allclose((low_a, high_a), (low_b, high_b))
    return bool(same or np.allclose((low_a, high_a), (-high_b, -low_b)))


def _fingertips(tree: _Tree, linked: Sequence[str]) -> list[str]:
    """Links with a shape beyond which nothing moves, one for each end of the linkage."""
    ends = [name for name in linked if not tree.moving(tree.child[name])]
    found: list[str] = []
    for name in ends:
        shaped = [
            link
            for link in (tree.child[name], *(tree.child[j] for j in tree.below(tree.child[name])))
            if any(tree.links[link].find(tag) is not None for tag in ("collision", "visual"))
        ]
        if shaped:
            found.append(shaped[-1])
    inner = [link for link in found if re.search(r"pad|tip|finger", link, re.IGNORECASE)]
    return inner if len(inner) >= 2 else found


def _between(robot: RobotSpec) -> Array:
    """A tool frame `(4, 4)` in the gripper's base, between the fingertips.

    x is where the fingers close, z the axis of the base that points out most.
    """
    found = fingers_of(RobotModel(robot))
    assert found is not None
    x = found.closing
    # The axes of the base that are across the closing direction; the fingers reach along one.
    tips = []
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        if abs(axis @ x) > 0.5:
            continue
        z = axis - (axis @ x) * x
        z /= np.linalg.norm(z)
        T = np.eye(4)
        T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
        seen = fingers_of(RobotModel(dataclasses.replace(robot, T_gripper_tool=T)))
        assert seen is not None
        tips.append((float(seen.tips[2]), T, seen.tips))
    _, T, tip = max(tips, key=lambda each: each[0])
    return np.asarray(T @ pose(tip - [0, 0, 0.01]))


def _camera(robot: RobotSpec) -> CameraSpec:
    """A camera beside the gripper that looks at a point just beyond the tool."""
    T = robot.T_gripper_tool
    p_camera = T @ np.array([0.0, 0.09, -0.11, 1.0])
    p_target = T @ np.array([0.0, 0.0, 0.08, 1.0])
    up = -T[:3, 1]
    return CameraSpec("wrist", robot.gripper_base, look_at(p_camera[:3], p_target[:3], up))


def _at_home(robot: RobotSpec, doubts: list[str]) -> RobotSpec:
    """The robot with a home whose tool points down before its base, as far from limits as found."""
    collision = CollisionModel(robot, SceneSpec(()))
    model = collision.kinematics
    placed = collision.placed({}, 0.0)
    rng = np.random.default_rng(0)
    inner = np.array([_inner(a, b) for a, b in zip(model.lower, model.upper, strict=True)])
    low, high = np.maximum(inner[:, 0], -np.pi), np.minimum(inner[:, 1], np.pi)
    low, high = np.minimum(low, high), np.maximum(low, high)
    best, least = robot.home, np.inf
    size = float(np.median([np.linalg.norm(model.fk(q)[:3, 3] - robot.T_world_base[:3, 3])
                            for q in rng.uniform(low, high, (200, len(low)))]))  # fmt: skip
    scale = min(1.0, size / 0.6)
    for i in range(_TRIES):
        turned = np.diag([1.0, -1.0, -1.0, 1.0]) @ pose((0, 0, 0), (0, 0, np.pi / 2 * (i % 4)))
        turned[:3, 3] = scale * np.array([_START[0], 0.0, _START[i // 4 % len(_START[1:]) + 1]])
        start = rng.uniform(low, high)
        with contextlib.suppress(SartError):
            q = model.ik(turned, start)
            near = np.minimum(q - model.lower, model.upper - q) < _FROM_LIMITS
            if near.any() or placed.too_close(q, _CLEAR):
                continue
            singular = np.linalg.svd(model.jacobian(q), compute_uv=False)[-1]
            # A home near the joints' middles is also one that a person would choose.
            cost = float((((q - (low + high) / 2) / (high - low)) ** 2).sum()) + 0.02 / singular
            if cost < least:
                best, least = q, cost
    if least == np.inf:
        doubts.append("no home with the tool pointing down was found: complete home")
    return dataclasses.replace(robot, home=np.round(best, 3))


def _text(robot: RobotSpec, source: str, doubts: Sequence[str]) -> str:
    gripper = robot.gripper
    where = f"file.py:{robot.name.upper()}"
    lines = [
        f'"""{robot.name}, as {source} has it."""',
        "",
        "import numpy as np",
        "",
        "import sart_toolkit as sart",
        "",
        "# Read from the URDF; what it doesn't tell is marked with `complete`. Then type:",
        f"#   sart doctor --robot {where}",
        *(f"# Look at this: {doubt}." for doubt in doubts),
        "",
    ]
    if gripper.driver is None:
        lines += [
            "# No fingers. For a gripper of its own URDF give urdf, parent_frame, driver, ...",
            "GRIPPER = sart.GripperSpec()",
        ]
    else:
        lines += [
            "GRIPPER = sart.GripperSpec(",
            "    # The joint that the motor moves, and those that follow it, each by its ratio.",
            f"    driver={gripper.driver!r},",
            f"    followers={dict(gripper.followers)!r},",
            "    # Where the driver is, [rad] or [m], open and closed.",
            f"    open_position={gripper.open_position!r},",
            f"    closed_position={gripper.closed_position!r},",
            f"    finger_links={gripper.finger_links!r},",
            "    # complete: of the driver, from the data sheet ([N m] or [N], [rad/s] or [m/s]).",
            f"    force={gripper.force!r},",
            f"    speed={gripper.speed!r},",
            "    # The drive's inertia behind its gears, [kg m²] or [kg].",
            f"    armature={gripper.armature!r},",
            ")",
        ]
    T = robot.T_gripper_tool
    camera = robot.cameras[0]
    dirs = [f"    package_dirs={robot.package_dirs!r},"] if robot.package_dirs else []
    lines += [
        "",
        f"{robot.name.upper()} = sart.RobotSpec(",
        f"    name={robot.name!r},",
        f"    urdf={robot.urdf!r},",
        *dirs,
        f"    arm_joints={robot.arm_joints!r},",
        "    # Where episodes start: the tool pointing down before the base.",
        f"    home=np.array({_numbers(robot.home)}),",
        "    # The URDF's own.",
        f"    velocity_limits=np.array({_numbers(robot.velocity_limits)}),",
        "    # complete: from the data sheet, in rad/s² and rad/s³.",
        f"    acceleration_limits=np.full({len(robot.home)}, {_ACCELERATION}),",
        f"    jerk_limits=np.full({len(robot.home)}, {_JERK}),",
        "    gripper=GRIPPER,",
        f"    gripper_base={robot.gripper_base!r},",
        "    # The tool frame: z out between the fingertips, x where the fingers close.",
        f"    T_gripper_tool=sart.pose({_numbers(T[:3, 3])}, {_numbers(log_rotation(T[:3, :3]))}),",
        "    # complete: where the camera is, z along its view, x right, y down; its fov.",
        "    cameras=(",
        "        sart.CameraSpec(",
        f"            {camera.name!r},",
        f"            {camera.frame!r},",
        f"            sart.pose({_numbers(camera.T_frame_camera[:3, 3])}, "
        f"{_numbers(log_rotation(camera.T_frame_camera[:3, :3]))}),",
        "            fov_y_deg=60.0,",
        "        ),",
        "    ),",
        "    # complete: where the arm stands in the world, if not at its origin.",
        "    # T_world_base=sart.pose([0.0, 0.0, 0.0]),",
        ")",
    ]
    return "\n".join(lines) + "\n"


def _numbers(values: Array) -> str:
    return "[" + ", ".join(f"{round(float(v), 6) + 0.0:.6g}" for v in values) + "]"
