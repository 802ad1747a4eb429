"""One interface to obstacles, whether they are known from a description or from images."""

import dataclasses
from contextlib import closing

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sart_toolkit.backends import make_backend
from sart_toolkit.collision import SOURCES, make_world
from sart_toolkit.collision.certificate import certify
from sart_toolkit.collision.cloud import CloudConfig
from sart_toolkit.collision.cloud_world import CloudWorld
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.collision.hull import Hull
from sart_toolkit.collision.model import CLOUD
from sart_toolkit.errors import Mismatch, MotionRejected, UnknownName
from sart_toolkit.motion.path import PolylinePath
from sart_toolkit.poses import inverse, pose
from sart_toolkit.robots import get_robot


@pytest.fixture(scope="module", params=SOURCES)
def world(request, peg_demonstration, peg_model, peg_task):
    return make_world(request.param, peg_demonstration, peg_model.spec, peg_task.scene)


def descent(world, start, end):
    return PolylinePath(world.demonstration.steps.joint_positions[start:end])


def test_a_source_s_name_makes_its_world(peg_demonstration, peg_model, peg_task):
    about = peg_demonstration, peg_model.spec, peg_task.scene
    for source, kind in (("scene", ExactWorld), ("cloud", CloudWorld)):
        world = make_world(source, *about, slip_tolerance=0.001)
        assert type(world) is kind
        assert world.slip_tolerance == 0.001
        assert world.demonstration is peg_demonstration
        assert world.kinematics.spec is peg_model.spec
        assert len(world.phases) == len(peg_demonstration)
    thick = make_world("cloud", *about, cloud=CloudConfig(inflation=0.01))
    thin = make_world("cloud", *about)
    q = peg_demonstration.steps.joint_positions[0]
    apart = [w.placed(0).tool_clearances(q)[0].distance for w in (thick, thin)]
    assert apart[1] - apart[0] == pytest.approx(0.01 - CloudConfig().inflation, abs=2e-6)


def test_the_way_down_to_the_hole_is_proved_free_and_into_the_table_is_not(world):
    way_down = descent(world, 0, 20)
    certificate = world.certify(0, way_down, 0.001)
    assert certificate.verdict == "free" and certificate.margin == 0.001
    assert certificate == certify(world.placed(0), way_down, 0.001)
    q = world.demonstration.steps.joint_positions[0]
    model = world.kinematics
    T = model.fk(q)
    T[2, 3] -= 0.2
    down = PolylinePath([q, model.ik(T, q)])
    assert world.certify(0, down).verdict == "collision"


def test_a_pair_that_is_too_close_is_reported_by_its_names(world):
    q = world.demonstration.steps.joint_positions[0]
    apart = world.placed(0).nearest(q)
    assert world.too_close(0, q, apart.distance - 1e-5) is None
    assert world.too_close(0, q, apart.distance + 1e-5) == " / ".join(apart.pair)


def test_only_what_is_known_to_move_is_reported_to(picked, first_grasp, toolbox):
    demo, robot = picked.demonstration, get_robot(toolbox.robot)
    assert picked.moving(0) is None and picked.moving(first_grasp + 5) is None
    # Carried away without being in the grasp, that is.
    blind = ExactWorld(dataclasses.replace(demo, touching=((),) * len(demo)), robot, toolbox.scene)
    assert blind.moving(first_grasp + 10) == "toolbox"
    seen = CloudWorld(demo, robot, toolbox.scene)
    assert all(seen.moving(t) is None for t in range(len(demo)))


def test_nothing_is_proved_while_a_body_moves(picked, first_grasp, toolbox):
    demo, robot = picked.demonstration, get_robot(toolbox.robot)
    blind = ExactWorld(dataclasses.replace(demo, touching=((),) * len(demo)), robot, toolbox.scene)
    still = PolylinePath(demo.steps.joint_positions[[0, 0]])
    with pytest.raises(MotionRejected, match="toolbox moves: nothing can be proved at waypoint"):
        blind.certify(first_grasp + 10, still)


def test_proofs_hold_for_every_opening_from_the_measured_to_the_commanded(picked):
    steps = picked.demonstration.steps
    for t, phase in enumerate(picked.phases):
        low, high = picked.openings(t)
        # What is grasped and lifted gives way, by more or less.
        for s in range(t, len(steps)):
            if picked.phases[s].gripper != phase.gripper or picked.phases[s].grasped:
                break
            assert low <= steps.measured_gripper[s] <= high
        assert low <= steps.commanded_gripper[t] <= high
        wider = 0.1 if phase.grasped else 0.012
        assert high - low == pytest.approx(
            abs(steps.measured_gripper[t] - steps.commanded_gripper[t]) + wider, abs=1e-9
        )


def test_fingers_that_close_on_a_body_are_not_clear_of_it(picked):
    """As they are measured they are still apart from the toolbox; soon they will touch it."""
    steps = picked.demonstration.steps
    fingers = picked.collision.robot.gripper.finger_links
    closing = next(t for t in range(len(steps)) if steps.commanded_gripper[t] > 0.5)
    for t in (closing, closing + 1):
        q = steps.joint_positions[t]
        measured = picked.collision.placed(*picked.at(t))
        pads = [
            k for k in range(len(measured.pairs))
            if measured.names(k)[0] in fingers and measured.names(k)[1] == "toolbox"
        ]  # fmt: skip
        assert min(measured.pair_distances(q, pads)) > 0.002
        still = PolylinePath(np.stack([q, q]))
        found = picked.certify(t, still)
        assert found.verdict == "collision" and found.pair[1] == "toolbox"


def test_fingers_that_open_are_as_wide_as_they_will_be(picked, toolbox):
    steps, spec = picked.demonstration.steps, picked.collision.robot
    t = len(steps) - 1
    commanded = steps.commanded_gripper.copy()
    commanded[t] = 0.0
    let_go = dataclasses.replace(
        picked.demonstration, steps=dataclasses.replace(steps, commanded_gripper=commanded)
    )
    opening = ExactWorld(let_go, get_robot(toolbox.robot), toolbox.scene)

    def width(world):
        points = [p.points for p in world.placed(t).parts if p.body in spec.gripper.finger_links]
        return float(np.ptp(np.concatenate(points), axis=0).max())

    assert width(opening) - width(picked) > 0.03


def test_nothing_of_the_scene_but_what_was_seen_enters_a_cloud_s_certificate(
    peg_demonstration, peg_model, peg_task
):
    path = PolylinePath(peg_demonstration.steps.joint_positions[:20])
    blind = dataclasses.replace(peg_demonstration, body_Ts_world={})
    bare = dataclasses.replace(peg_task.scene, bodies=())
    known = CloudWorld(peg_demonstration, peg_model.spec, peg_task.scene)
    unknown = CloudWorld(blind, peg_model.spec, bare)
    names = {body.name for body in peg_task.scene.bodies}
    placed = unknown.placed(0)
    assert CLOUD in {placed.names(k)[1] for k in range(len(placed.pairs))}
    assert names.isdisjoint(name for k in range(len(placed.pairs)) for name in placed.names(k))
    assert unknown.certify(0, path) == known.certify(0, path)


def test_the_same_waypoint_is_put_together_once(world):
    assert world.placed(3) is world.placed(3)
    np.testing.assert_array_equal(world.placed(3).pairs, world.placed(4).pairs)


@pytest.mark.parametrize("source", SOURCES)
def test_a_demonstration_of_another_robot_is_refused(
    source, peg_demonstration, peg_model, peg_task
):
    stranger = dataclasses.replace(peg_demonstration, robot="ur3")
    with pytest.raises(Mismatch, match="the demonstration is of robot 'ur3', not "):
        make_world(source, stranger, peg_model.spec, peg_task.scene)


def test_another_source_is_refused(peg_demonstration, peg_model, peg_task):
    with pytest.raises(UnknownName, match="unknown source 'clouds': did you mean 'cloud'"):
        make_world("clouds", peg_demonstration, peg_model.spec, peg_task.scene)


def _link_pose(backend, link):
    """Where PyBullet has a link of the robot."""
    state = backend._client.getLinkState(backend._robot, backend._links[link], 0, 1)
    return pose(state[4], Rotation.from_quat(state[5]).as_rotvec())


def test_fingers_bent_by_what_they_hold_are_inside_of_what_is_proved_clear(
    picked, toolbox, first_grasp
):
    """Where PyBullet has the links, not where the measured opening has them."""
    linkage, bent = picked.collision._linkage, []
    robot = get_robot(toolbox.robot)
    with closing(make_backend("pybullet", robot, toolbox.scene, 16)) as backend:
        for t in (2, first_grasp + 3, first_grasp + 15, len(picked.demonstration) - 1):
            backend.restore(picked.demonstration.states[t])
            seen, placed = backend.observe(), picked.placed(t)
            T_joint_world = inverse(placed.joint_poses(seen.q)[-1])
            as_measured = linkage.at(round(float(np.clip(seen.gripper, 0, 1)), 4)).parts
            for i, part in enumerate(linkage.at(0.0).parts):
                if not linkage.moves(i):
                    continue
                T = T_joint_world @ _link_pose(backend, part.body) @ inverse(linkage._open[i])
                points = part.points @ T[:3, :3].T + T[:3, 3]
                bent.append(np.linalg.norm(points - as_measured[i].points, axis=1).max())
                out = [
                    Hull(swept.points).bound(points).max()
                    for swept in placed.parts
                    if swept.body == part.body
                ]
                assert min(out) <= picked.gripper_play(t) + 2.1e-5
    assert max(bent) > 0.0005
