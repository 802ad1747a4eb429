"""Planned paths: round what is in the way, proved clear, and the same whatever was planned before.

The scene is a post beside the tool, which holds a peg over a table.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys

import numpy as np
import pytest

from sart_toolkit.collision.certificate import certify
from sart_toolkit.collision.cloud import CloudConfig, SceneCloud
from sart_toolkit.collision.model import CLOUD, CollisionModel, PlacedModel
from sart_toolkit.collision.obstacles import CloudObstacles
from sart_toolkit.errors import InvalidInput, MissingExtra, MotionRejected, Unreachable
from sart_toolkit.motion import planning
from sart_toolkit.motion.path import PolylinePath
from sart_toolkit.motion.planning import PlanConfig, check_planner, plan_motion, plan_path
from sart_toolkit.poses import distance, pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.spec import Attachment, Shape
from sart_toolkit.scenes.spec import Body, SceneSpec
from sart_toolkit.tasks.parts import TABLE, tool_down

MARGIN = 0.001
QUERIES = 40
POST = Body("post", (Shape("box", (0.06, 0.06, 0.36)),), pose([0.5, 0.12, 0.18]))
PEG = Attachment("peg", "tool", (Shape("box", (0.03, 0.03, 0.08)),), pose([0, 0, 0.02]))


def make_placed():
    scene = SceneSpec(bodies=(TABLE, POST), held=(PEG,))
    model = CollisionModel(get_robot("ur5e_2f85"), scene)
    return model.placed({body.name: body.T_world_body for body in scene.bodies}, 0.67)


def make_start(placed):
    return placed.kinematics.ik(tool_down([0.5, -0.02, 0.22]), placed.kinematics.spec.home)


def blocked_goals(placed, start, n):
    """Configurations with the tool on the far side of the post, none in a straight joint motion."""
    rng = np.random.default_rng(4)
    goals = []
    while len(goals) < n:
        T = tool_down(rng.uniform([0.4, 0.2, 0.14], [0.6, 0.27, 0.34]))
        T = T @ pose(rotvec=rng.uniform(-0.2, 0.2, 3))
        try:
            q = placed.kinematics.ik(T, start)
        except Unreachable:
            continue
        clear = placed.nearest(q).distance > MARGIN
        if clear and certify(placed, PolylinePath(np.array([start, q])), MARGIN).verdict != "free":
            goals.append(q)
    return goals


def digest(path):
    return hashlib.sha256(path.spline.t.tobytes() + path.spline.c.tobytes()).hexdigest()


@pytest.fixture(scope="module")
def placed():
    return make_placed()


@pytest.fixture(scope="module")
def start(placed):
    return make_start(placed)


@pytest.fixture(scope="module")
def goals(placed, start):
    return blocked_goals(placed, start, QUERIES)


@pytest.fixture(scope="module")
def plan(placed, start):
    """Plans with random numbers of one seed."""
    pytest.importorskip("ompl")

    def plan(goal, seed=0, margin=MARGIN, config=None, **others):
        rng = np.random.default_rng(seed)
        return plan_path(placed, others.get("start", start), goal, margin, rng, config)

    return plan


@pytest.fixture(scope="module")
def planned(plan, goals):
    """Path and certificate of each query."""
    return [plan(goal, seed) for seed, goal in enumerate(goals)]


@pytest.fixture
def without_ompl(monkeypatch):
    monkeypatch.setitem(sys.modules, "ompl", None)


# --- round a cloud ------------------------------------------------------------------------------


def test_round_a_post_that_is_known_by_points_alone_the_path_is_clear_of_the_post(
    placed, start, goals
):
    pytest.importorskip("ompl")
    half, spacing = np.array(POST.shapes[0].size) / 2, 0.012
    axes = [np.linspace(-h, h, 1 + int(np.ceil(2 * h / spacing))) for h in half]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    points = grid[(np.abs(grid) > half - 1e-9).any(1)] + POST.T_world_body[:3, 3]
    # Balls that cover the faces between the points.
    config = CloudConfig(inflation=spacing / np.sqrt(2))
    n = len(points)
    seen = SceneCloud(points, np.zeros((n, 3), np.uint8), np.zeros(n, bool), config)
    collision = CollisionModel(get_robot("ur5e_2f85"), SceneSpec((), held=(PEG,)))
    cloud = collision.placed({}, 0.67, cloud=CloudObstacles(seen))
    goal = next(q for q in goals if cloud.nearest(q).distance > 0.01)
    direct = certify(cloud, PolylinePath(np.array([start, goal])), MARGIN)
    assert (direct.verdict, direct.pair[1]) == ("collision", CLOUD)
    path, certificate = plan_path(cloud, start, goal, MARGIN, np.random.default_rng(0))
    assert certificate.verdict == "free" and certificate.clearance >= MARGIN
    post = [k for k in range(len(placed.pairs)) if placed.names(k)[1] == "post"]
    along = path.positions(np.linspace(0, 1, 200))
    assert min(min(placed.pair_distances(q, post)) for q in along) >= MARGIN


# --- what a planned path is ---------------------------------------------------------------------


def test_round_a_post_a_path_is_found_for_each_of_40_queries_and_proved_clear(placed, planned):
    for path, certificate in planned:
        assert (certificate.verdict, certificate.margin) == ("free", MARGIN)
        assert certificate.clearance >= MARGIN
        certify(placed, path, MARGIN).check_free()


def test_distances_along_a_planned_path_bear_its_certificate_out(placed, planned):
    for path, certificate in planned:
        apart = min(placed.distances(q).min() for q in path.positions(np.linspace(0, 1, 60)))
        assert apart >= certificate.clearance


def test_a_planned_path_leads_exactly_from_start_to_goal(planned, start, goals):
    for (path, _), goal in zip(planned, goals, strict=True):
        first, last = path.positions(np.array([0.0, 1.0]))
        np.testing.assert_array_equal(first, start)
        np.testing.assert_array_equal(last, goal)


def test_a_planned_path_stays_within_joint_limits_and_near_start_and_goal(
    placed, planned, start, goals
):
    model = placed.kinematics
    for (path, _), goal in zip(planned, goals, strict=True):
        q = path.positions(np.linspace(0, 1, 200))
        assert ((q > model.lower) & (q < model.upper)).all()
        window = PlanConfig().window + 1e-9
        assert (q >= np.minimum(start, goal) - window).all()
        assert (q <= np.maximum(start, goal) + window).all()


def test_a_planned_path_is_run_through_at_even_speed_and_few_control_points(planned):
    for path, _ in planned:
        assert len(path.spline.c) <= 48
        speed = np.linalg.norm(path.spline(np.linspace(0, 1, 200), nu=1), axis=1)
        assert speed.max() < 3 * np.median(speed)


def test_a_straight_joint_motion_that_is_clear_is_the_path(placed, start, plan):
    goal = start + 0.05
    path, certificate = plan(goal)
    assert certificate.verdict == "free"
    s = np.linspace(0, 1, 11)
    expected = start + s[:, None] * (goal - start)
    np.testing.assert_allclose(path.positions(s), expected, rtol=0, atol=1e-12)


def test_from_a_configuration_to_itself_the_path_stays_there(start, plan):
    path, certificate = plan(start)
    assert certificate.verdict == "free"
    np.testing.assert_allclose(path.positions(np.linspace(0, 1, 5)), np.tile(start, (5, 1)))


def test_where_there_is_nothing_to_hit_the_path_is_straight(placed, start):
    pytest.importorskip("ompl")
    nothing = PlacedModel(placed.kinematics, placed.parts, [], placed.T_joint_tool)
    path, certificate = plan_path(nothing, start, start + 0.5, 0.01, np.random.default_rng(0))
    assert certificate.verdict == "free" and certificate.clearance == np.inf
    np.testing.assert_allclose(path.positions(np.array([0.5]))[0], start + 0.25, atol=1e-12)


def test_a_goal_with_little_room_is_reached_all_the_same(placed, start, goals, plan):
    close = min(goals, key=lambda q: placed.nearest(q).distance)
    room = placed.nearest(close).distance
    path, certificate = plan(close, margin=room - 2e-4)
    assert certificate.clearance >= room - 2e-4
    np.testing.assert_array_equal(path.positions(np.array([1.0]))[0], close)


# --- the same path from the same random numbers --------------------------------------------------


def test_equal_random_numbers_give_the_same_path_in_whatever_order(planned, goals, plan):
    for seed in (7, 3, 7):
        path, certificate = plan(goals[seed], seed)
        assert digest(path) == digest(planned[seed][0])
        assert certificate == planned[seed][1]


def test_other_random_numbers_give_another_path(planned, goals, plan):
    other = [digest(plan(goals[seed], seed + 100)[0]) for seed in range(2)]
    assert all(digest(planned[seed][0]) != other[seed] for seed in range(2))


def test_ompl_s_own_random_numbers_have_no_say(planned, goals, plan):
    util = pytest.importorskip("ompl.util")
    util.RNG().uniform01()
    path, _ = plan(goals[5], 5)
    assert digest(path) == digest(planned[5][0])


def test_another_process_plans_the_same_path(planned):
    code = f"""
import importlib.util, numpy as np
spec = importlib.util.spec_from_file_location("planned", {__file__!r})
tests = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tests)
placed = tests.make_placed()
start = tests.make_start(placed)
goals = tests.blocked_goals(placed, start, 6)
for seed in (5, 2):
    path, _ = tests.plan_path(placed, start, goals[seed], tests.MARGIN, np.random.default_rng(seed))
    print(tests.digest(path))
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == [digest(planned[seed][0]) for seed in (5, 2)]
    assert result.stderr == "", "neither OMPL nor its bindings have anything to say"


def test_an_interruption_while_planning_leaves_nothing_behind(planned, goals, plan, monkeypatch):
    util = pytest.importorskip("ompl.util")
    level, calls = util.getLogLevel(), []

    def interrupt(*args):
        calls.append(args)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return certify(*args)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(planning, "certify", interrupt)
        plan(goals[2], 2)
    assert len(calls) == 5
    assert util.getLogLevel() == level
    assert digest(plan(goals[2], 2)[0]) == digest(planned[2][0])


# --- motions ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def move(placed, start):
    pytest.importorskip("ompl")

    def move(T_world_goal, duration=2.0, margin=MARGIN, config=None):
        rng = np.random.default_rng(0)
        return plan_motion(placed, start, T_world_goal, duration, margin, rng, config)

    return move


def test_a_planned_motion_reaches_its_pose_within_every_joint_s_limits(placed, start, goals, move):
    model = placed.kinematics
    for goal in goals[:4]:
        T_goal = model.fk(goal)
        motion, certificate = move(T_goal)
        assert certificate.verdict == "free"
        assert 2.0 <= motion.duration <= 8.0
        assert motion.duration * 10 == pytest.approx(round(motion.duration * 10))
        assert max(distance(motion.T_world_tool(motion.duration), T_goal)) < 2e-6
        np.testing.assert_array_equal(motion.T_world_tool(0.0), model.fk(start))
        times = motion.times(240)
        np.testing.assert_array_equal(motion.joints(times[-1:])[0], motion.path.spline(1.0))
        T, q = motion.T_world_tool(1.0), motion.joints(np.array([1.0]))[0]
        np.testing.assert_array_equal(T, model.fk(q))
        limits = (
            model.spec.velocity_limits,
            model.spec.acceleration_limits,
            model.spec.jerk_limits,
        )
        for greatest, limit in zip(motion.derivatives(times), limits, strict=True):
            assert (np.abs(greatest).max(0) <= limit * (1 + 1e-9)).all()


@pytest.mark.parametrize(
    "limits", [{}, {"stride": 0.005}, {"stride_deg": 1.0}], ids=["usual", "stride", "stride_deg"]
)
def test_a_motion_takes_as_long_as_the_tool_s_strides_ask_for(placed, goals, move, limits):
    config = PlanConfig(**limits)
    motion, _ = move(placed.kinematics.fk(goals[0]), config=config)
    Ts = [motion.T_world_tool(t) for t in np.arange(0, motion.duration, 0.01)]
    strides = np.array([distance(*pair) for pair in zip(Ts[:-10], Ts[10:], strict=True)])
    shares = strides.max(0) / [config.stride, np.deg2rad(config.stride_deg)]
    assert shares.max() < 1.005
    assert motion.duration == 2.0 or shares.max() > 0.8, "and no longer than that"


def test_a_pose_that_is_out_of_reach_is_unreachable(move):
    with pytest.raises(Unreachable, match="is out of reach"):
        move(tool_down([1.4, 0, 0.3]))


def test_a_pose_that_only_another_branch_reaches_is_unreachable(placed, start, move):
    turned = placed.kinematics.fk(start) @ pose(rotvec=[0, 0, 2.5])
    with pytest.raises(Unreachable, match="goal: only another branch of the arm reaches it"):
        move(turned)


def test_a_sampled_pose_that_collides_is_rejected_and_says_with_what(move):
    with pytest.raises(
        MotionRejected, match=r"sampled pose too close peg / table: they overlap by 30\.0 mm; use"
    ):
        move(tool_down([0.5, -0.02, 0.03]))


@pytest.mark.parametrize("duration", [0, -1, np.nan])
def test_a_duration_that_is_not_positive_is_refused(placed, start, move, duration):
    with pytest.raises(InvalidInput, match="duration: expected a finite number > 0 s"):
        move(placed.kinematics.fk(start), duration=duration)


def test_a_goal_that_is_no_pose_is_refused(move):
    with pytest.raises(InvalidInput, match="T_world_goal: not a rigid transform"):
        move(np.zeros((4, 4)))


# --- what can't be planned ----------------------------------------------------------------------


def sunk(placed, start, depth):
    """A configuration with the peg's end, 2 cm below the tool's centre, `depth` in the table."""
    model = placed.kinematics
    return model.ik(tool_down([0.5, -0.02, 0.06 - depth]), start)


@pytest.mark.parametrize(
    ("height", "said"),
    [
        (-0.0012, r"they overlap by 1\.2 mm"),
        (0.0004, r"0\.4 mm apart, 1\.0 mm are asked for"),
    ],
)
def test_a_start_or_goal_without_the_margin_is_rejected_and_says_by_how_much(
    placed, start, plan, height, said
):
    q = sunk(placed, start, -height)
    with pytest.raises(MotionRejected, match=rf"^start too close peg / table: {said}; start else"):
        plan(start, start=q)
    with pytest.raises(MotionRejected, match=rf"^goal too close peg / table: {said}; choose"):
        plan(q)


@pytest.fixture(scope="module")
def behind(placed, start):
    """A configuration with the tool low down, right behind the post."""
    return placed.kinematics.ik(tool_down([0.5, 0.26, 0.15]), start)


@pytest.mark.parametrize(
    "hindrance", [{"max_edges": 2}, {"window": 1e-3, "max_edges": 20}], ids=["edges", "window"]
)
def test_where_the_planner_gives_up_no_path_is_found(behind, plan, hindrance):
    config = PlanConfig(**hindrance)
    said = rf"^no path found: after {2 * config.max_edges} edges; use a smaller radius or other"
    with pytest.raises(MotionRejected, match=said):
        plan(behind, config=config)


def test_where_no_smooth_path_is_clear_none_is_found(behind, plan, monkeypatch):
    monkeypatch.setattr(planning, "_CONTROL_POINTS", (6,))
    with pytest.raises(MotionRejected, match="^no path found: none that is smooth .* of .* post;"):
        plan(behind)


@pytest.mark.parametrize("margin", [-1e-4, np.nan, np.inf])
def test_a_margin_that_is_none_is_refused(placed, start, plan, move, margin):
    with pytest.raises(InvalidInput, match="margin: expected a finite number >= 0 m"):
        plan(start, margin=margin)
    with pytest.raises(InvalidInput, match="margin: expected a finite number >= 0 m"):
        move(placed.kinematics.fk(start), margin=margin)


def test_a_configuration_outside_the_limits_is_refused(start, plan):
    beyond = start + [0, 0, 7, 0, 0, 0]
    with pytest.raises(InvalidInput, match="elbow_joint: .* is outside its limits"):
        plan(beyond)
    with pytest.raises(InvalidInput, match=r"q: expected shape \(6,\)"):
        plan(start[:5])


@pytest.mark.parametrize("name", ["window", "edge", "spare", "attempts", "shortcuts", "max_edges"])
@pytest.mark.parametrize("bad", [0, -1, np.nan])
def test_a_setting_that_is_not_positive_is_refused(name, bad):
    with pytest.raises(InvalidInput, match=f"{name}: expected a finite number > 0"):
        PlanConfig(**{name: bad})


@pytest.mark.parametrize("name", ["attempts", "shortcuts", "max_edges"])
def test_a_count_that_is_no_whole_number_is_refused(name):
    with pytest.raises(InvalidInput, match=f"{name}: expected a whole number, got 2.5"):
        PlanConfig(**{name: 2.5})


# --- without OMPL -------------------------------------------------------------------------------


def test_without_ompl_it_is_said_how_to_install_it(placed, start, without_ompl):
    rng = np.random.default_rng(0)
    for ask in (
        check_planner,
        lambda: plan_path(placed, start, start, MARGIN, rng),
        lambda: plan_motion(placed, start, placed.kinematics.fk(start), 2.0, MARGIN, rng),
    ):
        with pytest.raises(MissingExtra, match=r"pip install 'sart_toolkit\[planning\]'"):
            ask()


def test_nothing_imports_ompl_before_it_is_needed():
    code = (
        "import sys, sart_toolkit.augment.engine, sart_toolkit.motion.planning\n"
        "print('ompl' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (result.returncode, result.stdout) == (0, "False\n"), result.stderr
