"""Clutter: the same from a seed, clear of the robot at home; lines that can be reached, half of
them beside something."""

from __future__ import annotations

import dataclasses
from contextlib import closing

import numpy as np
import pytest

from sart_toolkit.errors import InvalidInput, MotionRejected
from sart_toolkit.motion.line import straight_line
from sart_toolkit.poses import distance, interpolate, inverse
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.spec import SceneSpec
from sart_toolkit.tasks.parts import TABLE
from sart_toolkit.testing import clutter
from sart_toolkit.testing.closest import ClosestPoints
from sart_toolkit.testing.clutter import CLUTTER, LOWER, UPPER, random_segment

kinds = pytest.mark.parametrize("kind", list(CLUTTER))


def scenes(kind, n):
    return [CLUTTER[kind](np.random.default_rng(seed)) for seed in range(n)]


def shapes(scene):
    """All shapes but the table, with their poses in the world."""
    return [
        (shape, body.T_world_body @ shape.T_body_shape)
        for body in scene.bodies
        if body is not TABLE
        for shape in body.shapes
    ]


def numbers(scene):
    return [(s.identity, T.tolist()) for s, T in shapes(scene)]


# --- scenes -------------------------------------------------------------------------------------


@kinds
def test_a_seed_decides_a_scene(kind):
    make = CLUTTER[kind]
    first = numbers(make(np.random.default_rng(7)))
    assert first == numbers(make(np.random.default_rng(7)))
    assert first != numbers(make(np.random.default_rng(8)))


@kinds
def test_a_scene_is_a_table_and_12_to_25_shapes_that_never_move(kind):
    counts = set()
    for scene in scenes(kind, 20):
        assert TABLE in scene.bodies
        assert all(body.mass is None and body.joint is None for body in scene.bodies)
        counts.add(len(shapes(scene)))
    assert 12 <= min(counts) < max(counts) <= 25


@kinds
def test_shapes_stand_in_the_workspace(kind):
    for scene in scenes(kind, 10):
        p = np.array([T[:3, 3] for _, T in shapes(scene)])
        # A shelf may reach out of it by half its width.
        assert (p > LOWER - 0.3).all()
        assert (p < UPPER + 0.3).all()
        inside = ((p > LOWER - 1e-9) & (p < UPPER + 1e-9)).all(1)
        assert inside.mean() > 0.6


@kinds
@pytest.mark.parametrize("robot", ["ur5e_2f85", "ur5e_hande"])
def test_no_scene_touches_the_robot_at_home(kind, robot, peg_task):
    spec = get_robot(robot)
    for scene in scenes(kind, 3):
        held = dataclasses.replace(scene, held=peg_task.scene.held)
        with closing(ClosestPoints(spec, held)) as points:
            for gripper in (0.0, 1.0):
                points.place({body.name: body.T_world_body for body in scene.bodies}, gripper)
                assert points.nearest(spec.home, 0.005) == ("", "", np.inf)


def test_rods_are_thin_and_vertical_slanted_and_horizontal():
    for scene in scenes("rods", 5):
        upright = [abs(T[2, 2]) for shape, T in shapes(scene)]
        assert all(0.002 <= shape.size[0] <= 0.004 for shape, _ in shapes(scene))
        assert sum(c > 0.999 for c in upright) >= 4
        assert sum(c < 0.001 for c in upright) >= 4
        assert sum(0.3 < c < 0.96 for c in upright) >= 4


def test_mixed_scenes_have_tilted_shapes_of_all_kinds():
    for scene in scenes("mixed", 5):
        for kind in ("box", "cylinder", "sphere"):
            tilts = [abs(T[2, 2]) for shape, T in shapes(scene) if shape.kind == kind]
            assert len(tilts) >= 4
            assert min(tilts) < 0.95


# --- segments -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluttered(peg_task, peg_model):
    scene = dataclasses.replace(
        CLUTTER["mixed"](np.random.default_rng(1)), held=peg_task.scene.held
    )
    with closing(ClosestPoints(peg_model.spec, scene)) as points:
        yield scene, points


@pytest.fixture(scope="module")
def segments(cluttered, peg_model):
    scene, points = cluttered
    rng = np.random.default_rng(2)
    return [
        random_segment(
            peg_model,
            peg_model.spec.home,
            rng,
            scene,
            accept_start=lambda q: not points.collides(q),
        )
        for _ in range(120)
    ]


def test_a_seed_decides_a_segment(cluttered, peg_model):
    scene, _ = cluttered

    def drawn(seed):
        segment = random_segment(peg_model, peg_model.spec.home, np.random.default_rng(seed), scene)
        return [v.tolist() for v in (segment.q_start, segment.T_world_start, segment.T_world_end)]

    assert drawn(5) == drawn(5)
    assert drawn(5) != drawn(6)


def test_segments_are_of_all_lengths_and_turns_up_to_20_cm_and_0_4_rad(segments):
    sizes = np.array([distance(s.T_world_start, s.T_world_end) for s in segments])
    assert sizes.min(0)[0] > 0.02 - 1e-9
    assert sizes.max(0)[0] < 0.20 + 1e-9
    assert sizes.max(0)[1] < 0.4 + 1e-9
    assert np.ptp(sizes, axis=0) == pytest.approx([0.18, 0.4], rel=0.1)


def test_a_segment_starts_at_its_joints_and_its_end_can_be_reached(segments, peg_model):
    for segment in segments:
        np.testing.assert_allclose(peg_model.fk(segment.q_start), segment.T_world_start, atol=1e-5)
        q = peg_model.check_limits(segment.q_start)
        for s in np.linspace(0, 1, 11)[1:]:
            q = peg_model.ik(interpolate(segment.T_world_start, segment.T_world_end, s), q, 0.5)
        np.testing.assert_allclose(peg_model.fk(q), segment.T_world_end, atol=1e-5)


def test_nearly_all_segments_are_straight_lines_that_the_robot_can_drive(segments, peg_model):
    driven = 0
    for segment in segments[::4]:
        try:
            straight_line(
                peg_model, segment.q_start, segment.T_world_start, segment.T_world_end, 3.0
            )
            driven += 1
        except MotionRejected:
            pass
    assert driven >= 27


def test_tools_point_down_or_sideways_anyhow(segments):
    axes = np.array([segment.T_world_start[:3, :3] for segment in segments])
    down = -axes[:, 2, 2]
    assert 0.1 < (down < 0.5).mean() < 0.35
    assert (down > 0.6).mean() > 0.6
    # The camera is on every side.
    heading = np.arctan2(axes[:, 1, 0], axes[:, 0, 0])
    assert all(((heading > a) & (heading < a + np.pi / 2)).mean() > 0.1 for a in (-np.pi, -1.57))


def test_starts_are_accepted_as_asked_for(segments, cluttered):
    _, points = cluttered
    assert points.first_collision(np.stack([s.q_start for s in segments])) is None


def test_half_of_the_segments_pass_beside_something(segments, cluttered):
    scene, _ = cluttered
    names = {segment.beside for segment in segments}
    assert 0.4 < np.mean([segment.beside != "" for segment in segments]) < 0.6
    assert len(names) > 8
    assert names - {""} <= {body.name for body in scene.bodies}


def test_the_middle_of_a_line_beside_a_body_has_the_tool_up_to_4_cm_off_it(
    segments, cluttered, peg_model
):
    scene, points = cluttered
    home = peg_model.spec.home
    here, there = peg_model.link_poses(home), peg_model.link_poses(home + 0.1)
    tool = [
        part.name
        for part in points._parts
        if np.allclose(
            inverse(here["tool"]) @ here[part.name], inverse(there["tool"]) @ there[part.name]
        )
    ]
    gaps = []
    for segment in segments:
        if segment.beside:
            middle = interpolate(segment.T_world_start, segment.T_world_end, 0.5)
            q = peg_model.ik(middle, segment.q_start)
            gaps.append(min(points.pair(q, link, segment.beside) for link in tool))
    # Meshes read up to 0.06 mm too far.
    assert -1e-5 < min(gaps) < 0.005
    assert 0.035 < max(gaps) < 0.0401
    assert 0.012 < np.median(gaps) < 0.028


def test_lines_beside_something_collide_or_come_near_and_others_less_often(
    segments, cluttered, peg_model
):
    _, points = cluttered
    near = {True: [], False: []}
    for segment in segments:
        qs = [segment.q_start]
        for s in np.linspace(0, 1, 31)[1:]:
            T = interpolate(segment.T_world_start, segment.T_world_end, s)
            qs.append(peg_model.ik(T, qs[-1]))
        _, nearest = points.nearest_along(np.array(qs), 0.2)
        near[segment.beside != ""].append(nearest.distance)
    beside = np.array(near[True])
    assert 0.25 < (beside < 0).mean() < 0.75
    assert ((beside > 0) & (beside < 0.02)).mean() > 0.2
    assert (beside < 0.041).all()
    assert np.median(near[False]) > np.median(beside)


def test_without_a_scene_lines_are_put_anywhere(peg_model, rng):
    segment = random_segment(peg_model, peg_model.spec.home, rng, beside_share=0.0)
    assert segment.beside == ""
    with pytest.raises(InvalidInput, match="no body to put lines beside; give a scene"):
        random_segment(peg_model, peg_model.spec.home, rng)
    with pytest.raises(InvalidInput, match="no body to put lines beside; give a scene"):
        random_segment(peg_model, peg_model.spec.home, rng, SceneSpec(()))


def test_a_robot_that_may_start_nowhere_is_reported(peg_model, rng, monkeypatch):
    monkeypatch.setattr(clutter, "_TRIES", 5)
    with pytest.raises(MotionRejected, match="no line: 5 drawn ones are out of reach or start"):
        random_segment(
            peg_model, peg_model.spec.home, rng, beside_share=0.0, accept_start=lambda q: False
        )


def test_the_tools_points_are_those_of_the_gripper_that_the_model_has(peg_task):
    spec = get_robot("ur5e_2f85")
    opened, closed = (
        clutter._tool_points(RobotModel(spec, peg_task.scene.held, gripper)) for gripper in (0, 1)
    )
    # Closed fingers reach farther out; the peg's tip, 6 cm beyond the tool frame, farther still.
    assert opened[:, 2].max() == pytest.approx(0.06)
    assert np.ptp(opened[:, 0]) > np.ptp(closed[:, 0])


@pytest.fixture
def rng():
    return np.random.default_rng(4)
