"""What is swept by a gripper is enclosed at every opening, also between those that are sampled."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.collision.hull import Hull
from sart_toolkit.collision.linkage import Linkage
from sart_toolkit.collision.model import CollisionModel
from sart_toolkit.collision.parts import ConvexPart
from sart_toolkit.poses import Array, pose
from sart_toolkit.robots import USUAL_ROBOTS, get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import GripperSpec, RobotSpec, Shape
from sart_toolkit.scenes.spec import Body, SceneSpec

RANGES = [(-0.006, 0.006), (0.3, 0.42), (0.0, 1.0), (0.855, 1.006)]
_LINK = """<link name="{0}"><inertial><mass value="1"/><origin xyz="0 0 0" rpy="0 0 0"/>
  <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
  <collision><origin xyz="0.05 0 0.02" rpy="0 0 0"/><geometry><box size="0.1 0.01 0.02"/></geometry>
  </collision></link>"""
_JOINT = """<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/>
  <origin xyz="0.1 0 0.02" rpy="0 0 0"/><axis xyz="{4}"/>
  <limit lower="-2" upper="2" effort="10" velocity="1"/></joint>"""


def urdf(path: Path, links: list[str], joints: list[tuple[str, ...]]) -> str:
    parts = [_LINK.format(link) for link in links] + [_JOINT.format(*joint) for joint in joints]
    path.write_text(f'<robot name="{path.stem}">{"".join(parts)}</robot>')
    return str(path)


@pytest.fixture
def make_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., RobotSpec]:
    """Makes a robot of two joints with a gripper of any two, the second carried by the first."""
    monkeypatch.setenv("SART_CACHE", str(tmp_path / "cache"))

    def make_robot(first: str, second: str) -> RobotSpec:
        arm = urdf(tmp_path / "arm.urdf", ["base_link", "upper", "flange"], [
            ("shoulder", "revolute", "base_link", "upper", "0 0 1"),
            ("wrist", "revolute", "upper", "flange", "0 0 1"),
        ])  # fmt: skip
        gripper = urdf(tmp_path / "gripper.urdf", ["palm", "knuckle", "tip"], [
            ("bend", first, "palm", "knuckle", "0 1 0"),
            ("reach", second, "knuckle", "tip", "1 0 0"),
        ])  # fmt: skip
        linkage = GripperSpec(gripper, "flange", "bend", {"reach": 0.4}, 0.5, ("gripper_tip",))
        linkage = dataclasses.replace(
            linkage, driver="gripper_bend", followers={"gripper_reach": 0.4}
        )
        return RobotSpec(
            "own", arm, ("shoulder", "wrist"), np.zeros(2), np.ones(2), np.ones(2), np.ones(2),
            linkage, "gripper_palm", pose([0, 0, 0.1]),
        )  # fmt: skip

    return make_robot


def check_enclosed(linkage: Linkage, low: float, high: float, rng: np.random.Generator) -> None:
    """Fails where a point of a part is outside of all that its sweep encloses it in."""
    sweep = linkage.over(low, high)
    hulls: dict[int, list[tuple[Hull, float]]] = {}
    for part, origin, excess in zip(*sweep, strict=True):
        assert 0.0 <= excess <= 2.1e-5
        hulls.setdefault(origin, []).append((Hull(part.points), excess))
    for opening in [low, high, *rng.uniform(low, high, 12)]:
        for i, part in enumerate(linkage.at(float(opening)).parts):
            out = [(hull.bound(part.points) - excess).max() for hull, excess in hulls[i]]
            assert min(out) <= 1e-9, (part.body, opening)


@pytest.mark.parametrize("robot", [*USUAL_ROBOTS, "panda"])
@pytest.mark.parametrize("ends", RANGES)
def test_a_sweep_encloses_every_part_at_any_opening_of_its_range(
    robot: str, ends: tuple[float, float], rng: np.random.Generator
) -> None:
    collision = CollisionModel(get_robot(robot), SceneSpec(()))
    check_enclosed(collision._linkage, *ends, rng)


@pytest.mark.parametrize("kinds", [
    ("revolute", "revolute"), ("revolute", "prismatic"),
    ("prismatic", "revolute"), ("prismatic", "prismatic"),
])  # fmt: skip
def test_a_sweep_encloses_fingers_of_any_linkage_of_two_joints(
    make_robot: Callable[..., RobotSpec], kinds: tuple[str, str], rng: np.random.Generator
) -> None:
    collision = CollisionModel(make_robot(*kinds), SceneSpec(()))
    check_enclosed(collision._linkage, 0.0, 1.0, rng)
    check_enclosed(collision._linkage, 0.2, 0.3, rng)


@pytest.mark.parametrize("kinds", [("revolute", "revolute"), ("revolute", "prismatic")])
def test_no_point_accelerates_by_more_than_the_bound_and_one_by_a_third_of_it(
    make_robot: Callable[..., RobotSpec], kinds: tuple[str, str]
) -> None:
    linkage = CollisionModel(make_robot(*kinds), SceneSpec(()))._linkage
    h = 1e-3

    def tip(opening: float) -> Array:
        return next(p.points for p in linkage.at(opening).parts if p.body == "gripper_tip")

    index = [p.body for p in linkage.at(0.0).parts].index("gripper_tip")
    most = 0.0
    for opening in np.linspace(0.01, 0.99, 50):
        a, b, c = (tip(opening + k * h) for k in (-1, 0, 1))
        most = max(most, float(np.linalg.norm(a - 2 * b + c, axis=1).max()) / h**2)
    assert linkage._bends[index] / 3 < most <= linkage._bends[index] * (1 + 1e-6)


@pytest.mark.parametrize("robot", [*USUAL_ROBOTS, "panda"])
def test_distances_over_a_range_are_those_of_its_worst_opening_or_hardly_less(
    robot: str, rng: np.random.Generator
) -> None:
    """Less by at most the millimetre that the hull of an arc may bulge inwards."""
    spec = get_robot(robot)
    scene = SceneSpec((Body("ball", (Shape("sphere", (0.01,)),)),))
    collision = CollisionModel(spec, scene)
    T_tool = RobotModel(spec).fk(spec.home)
    low, high = 0.2, 0.6
    for _ in range(15):
        T = T_tool @ pose(rng.uniform([-0.07, -0.03, -0.05], [0.07, 0.03, 0.03]))

        def nearest(gripper: float | tuple[float, float], T: Array = T) -> float:
            placed = collision.placed({"ball": T}, gripper)
            pairs = [k for k in range(len(placed.pairs)) if placed.names(k)[1] == "ball"]
            return min(placed.pair_distances(spec.home, pairs))

        worst = min(nearest(float(opening)) for opening in np.linspace(low, high, 41))
        over = nearest((low, high))
        # Between 41 openings the fingers are never 0.3 mm nearer.
        assert over <= worst + 1e-6
        # Depths of overlap are of one hull or another.
        assert over >= worst - 0.0014 or worst < 0


def test_what_the_gripper_does_not_move_is_as_it_was() -> None:
    collision = CollisionModel(get_robot("ur5e_2f85"), SceneSpec(()))
    one, over = collision._linkage.at(0.5), collision._linkage.over(0.0, 1.0)

    def fixed(parts: tuple[ConvexPart, ...]) -> list[ConvexPart]:
        return [p for p in parts if "knuckle" not in p.body and "finger" not in p.body]

    assert fixed(one.parts) == fixed(over.parts) and len(fixed(one.parts)) >= 11


def test_nearly_equal_ranges_share_their_parts() -> None:
    linkage = CollisionModel(get_robot("ur5e_2f85"), SceneSpec(()))._linkage
    assert linkage.over(-0.0058, 0.0063) is linkage.over(-0.0055, 0.0061)
