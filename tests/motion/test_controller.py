"""The tool controller: never far ahead of the tool, straight, and unchanged by what it refuses."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from sart_toolkit.errors import InvalidInput, MotionRejected, Unreachable
from sart_toolkit.motion.config import ControllerConfig
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.motion.line import straight_line
from sart_toolkit.poses import check_pose, distance, interpolate, pose

PROPERTY = settings(deadline=None, derandomize=True, max_examples=40)
LEAD, LEAD_ANGLE = 0.020, np.deg2rad(5)

directions = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


def offsets(p, angle):
    """A pose near the identity, within `p` [m] and `angle` [rad] an axis."""
    return st.builds(lambda a, b: pose(p * a, angle * b), directions, directions)


@pytest.fixture
def controller(model):
    controller = ToolController(model)
    controller.reset(model.spec.home)
    return controller


def make_controller(model):
    controller = ToolController(model)
    controller.reset(model.spec.home)
    return controller


# --- the clamp ----------------------------------------------------------------------------------


@PROPERTY
@given(away=offsets(0.1, 0.5))
def test_a_command_is_never_farther_from_the_measured_pose_than_the_lead(model, away):
    controller = make_controller(model)
    measured = controller.commanded_T_world_tool
    controller.move(measured @ away, measured, 3)
    commanded = check_pose("commanded", controller.commanded_T_world_tool)
    far, turned = distance(measured, commanded)
    assert far <= LEAD + 1e-9
    assert turned <= LEAD_ANGLE + 1e-9


@PROPERTY
@given(measured=offsets(0.5, 1), away=offsets(0.01, 0.05))
def test_a_pose_within_the_lead_is_commanded_unchanged(model, measured, away):
    desired = measured @ away
    np.testing.assert_array_equal(make_controller(model).clamped(desired, measured), desired)


@PROPERTY
@given(measured=offsets(0.5, 1), away=offsets(0.1, 0.5))
def test_a_clamped_pose_lies_on_the_way_to_the_desired_one(model, measured, away):
    desired = measured @ away
    clamped = make_controller(model).clamped(desired, measured)
    far, turned = distance(measured, desired)
    assert distance(measured, clamped) == pytest.approx(
        (min(far, LEAD), min(turned, LEAD_ANGLE)), abs=1e-9
    )
    rest = distance(clamped, desired)
    assert rest == pytest.approx((max(0, far - LEAD), max(0, turned - LEAD_ANGLE)), abs=1e-9)


def test_position_and_rotation_are_clamped_separately(controller):
    measured = controller.commanded_T_world_tool
    turned = controller.clamped(measured @ pose([0.01, 0, 0], [0, 0, 0.5]), measured)
    assert distance(measured, turned) == pytest.approx((0.01, LEAD_ANGLE), abs=1e-9)
    moved = controller.clamped(measured @ pose([0.05, 0, 0], [0, 0, 0.05]), measured)
    assert distance(measured, moved) == pytest.approx((LEAD, 0.05), abs=1e-9)


def test_another_lead_may_be_configured(model):
    controller = ToolController(model, ControllerConfig(max_lead=0.005, max_lead_deg=1.0))
    measured = controller.commanded_T_world_tool
    clamped = controller.clamped(measured @ pose([0.1, 0, 0], [0.5, 0, 0]), measured)
    assert distance(measured, clamped) == pytest.approx((0.005, np.deg2rad(1)), abs=1e-9)


def test_pressing_on_against_a_wall_holds_the_command_at_the_lead(controller):
    measured = controller.commanded_T_world_tool
    leads = []
    for _ in range(80):
        desired = controller.commanded_T_world_tool @ pose([0, 0, 0.004])
        controller.move(desired, measured, 1)
        leads.append(distance(measured, controller.commanded_T_world_tool)[0])
    expected = measured @ pose([0, 0, LEAD])
    np.testing.assert_allclose(controller.commanded_T_world_tool, expected, atol=1e-6)
    # On the way there the joints lag by a step, which comes on top and fades without swinging.
    assert max(leads) <= LEAD + 0.004 + 1e-9
    after = np.diff(leads[leads.index(max(leads)) :])
    assert (after <= 1e-12).all()


@pytest.mark.parametrize("speed", [0.1, 0.5])
def test_a_tool_that_follows_freely_is_not_held_back(controller, model, speed):
    measured = controller.commanded_T_world_tool
    step = pose([0, speed / 30, 0])
    for _ in range(12):
        (targets,) = controller.move(controller.commanded_T_world_tool @ step, measured, 1)
        measured = model.fk(targets[-1])
    went = [measured]
    for _ in range(6):
        (targets,) = controller.move(controller.commanded_T_world_tool @ step, measured, 1)
        measured = model.fk(targets[-1])
        went.append(measured)
    assert distance(went[0], went[-1])[0] == pytest.approx(6 * speed / 30, rel=0.1)


def test_the_command_is_never_anchored_again_to_the_measured_pose(controller):
    commanded = controller.commanded_T_world_tool
    sagging = commanded @ pose([0, 0, 0.008], [0.03, 0, 0])
    for _ in range(10):
        controller.move(controller.commanded_T_world_tool, sagging, 1)
    np.testing.assert_array_equal(controller.commanded_T_world_tool, commanded)


# --- the way there ------------------------------------------------------------------------------


@PROPERTY
@given(away=offsets(0.01, 0.04), n=st.integers(1, 6))
def test_the_desired_pose_is_approached_in_a_straight_line_of_even_steps(model, away, n):
    controller = make_controller(model)
    start = controller.commanded_T_world_tool
    desired = start @ away
    targets = controller.move(desired, start, n)
    assert targets.shape == (n, 8, 6)
    assert max(distance(model.fk(controller.commanded_q), desired)) < 3e-6
    np.testing.assert_array_equal(controller.commanded_T_world_tool, desired)
    held = []
    while not controller.settled:
        held.append(controller.hold())
    assert len(held) >= 2 or max(distance(start, desired)) < 1e-9
    sent = np.concatenate([*targets, *held])
    far = float(np.linalg.norm(desired[:3, 3] - start[:3, 3]))
    for q in sent:
        on_way = model.fk(q)
        along = np.linalg.norm(on_way[:3, 3] - start[:3, 3]) / max(far, 1e-9)
        expected = interpolate(start, desired, min(along, 1.0))
        # Where limits bind, as in a jump within less time, the joints bend the tool's way.
        assert n < 3 or distance(on_way, expected)[0] < 1e-3
    np.testing.assert_array_equal(sent[-1], controller.commanded_q)


@PROPERTY
@given(steps=st.lists(offsets(0.01, 0.04), min_size=2, max_size=6))
def test_each_move_continues_from_the_last_command(model, steps):
    controller, sent = make_controller(model), None
    for away in steps:
        start = controller.commanded_T_world_tool
        before = controller.commanded_q
        desired = start @ away
        targets = controller.move(desired, start, 2)
        assert max(distance(model.fk(controller.commanded_q), desired)) < 3e-6
        if sent is not None:
            speed = np.abs(np.diff(np.concatenate([sent[-1:], targets[0]]), axis=0)).max() * 240
            assert speed <= model.spec.velocity_limits.max()
        sent = targets[-1]
        assert np.abs(controller.commanded_q - before).max() < 2 * 0.35


@pytest.mark.parametrize("n", [0, -1])
def test_a_move_of_no_period_is_refused_and_changes_nothing(controller, n):
    before = controller.commanded_T_world_tool
    with pytest.raises(InvalidInput, match="n: expected at least 1"):
        controller.move(before @ pose([0.01, 0, 0]), before, n)
    np.testing.assert_array_equal(controller.commanded_T_world_tool, before)


# --- errors leave it as it was ------------------------------------------------------------------


def assert_unchanged_by(controller, error, match, *move):
    q, T = controller.commanded_q, controller.commanded_T_world_tool
    with pytest.raises(error, match=match):
        controller.move(*move)
    np.testing.assert_array_equal(controller.commanded_q, q)
    np.testing.assert_array_equal(controller.commanded_T_world_tool, T)


def test_an_unreachable_pose_changes_nothing(controller):
    far = controller.commanded_T_world_tool
    far[:3, 3] = [1.6, 0, 0.3]
    assert_unchanged_by(controller, Unreachable, "is out of reach", far, far, 1)


def test_a_move_that_fails_halfway_changes_nothing(controller, model):
    start, far = controller.commanded_T_world_tool, controller.commanded_T_world_tool
    far[:3, 3] = [1.6, 0, 0.3]
    model.ik(interpolate(start, far, 1 / 40), controller.commanded_q, 0.35)
    refused = (Unreachable, MotionRejected)
    assert_unchanged_by(controller, refused, "out of reach|exceeds", far, far, 40)


def test_a_joint_jump_changes_nothing(model):
    controller = ToolController(model, ControllerConfig(max_joint_step=1e-3))
    T = controller.commanded_T_world_tool
    away = T @ pose([0.015, 0, 0])
    assert_unchanged_by(
        controller, MotionRejected, "joint jump: a step of .* exceeds 0.00 rad", away, T, 1
    )


@pytest.mark.parametrize("bad", [np.eye(3), 2 * np.eye(4), np.full((4, 4), np.nan)])
def test_a_desired_pose_that_is_none_changes_nothing(controller, bad):
    T = controller.commanded_T_world_tool
    assert_unchanged_by(controller, InvalidInput, "desired_T_world_tool: ", bad, T, 1)


@pytest.mark.parametrize("bad", [np.eye(3), 2 * np.eye(4), np.full((4, 4), np.nan)])
def test_a_measured_pose_that_is_none_changes_nothing(controller, bad):
    # Were it let through, NaN would silently switch the clamp off.
    away = controller.commanded_T_world_tool @ pose([0.1, 0, 0])
    assert_unchanged_by(controller, InvalidInput, "measured_T_world_tool: ", away, bad, 1)


# --- following a planned motion -----------------------------------------------------------------


@PROPERTY
@given(away=offsets(0.01, 0.04), q_away=st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6))
def test_what_is_followed_is_commanded_as_it_is(model, away, q_away):
    controller = make_controller(model)
    measured = controller.commanded_T_world_tool
    # The joints are the planner's business: they are not solved for again.
    q = model.spec.home + q_away
    controller.follow(np.atleast_2d(q), measured @ away, measured)
    np.testing.assert_array_equal(controller.commanded_q, q)
    np.testing.assert_array_equal(controller.commanded_T_world_tool, measured @ away)


def test_a_motion_is_followed_from_its_start_to_its_end(controller, model):
    T = controller.commanded_T_world_tool
    line = straight_line(model, model.spec.home, T, T @ pose([0.05, 0, -0.05], [0, 0, 0.2]), 1.0)
    times = line.times(30)
    for time, q in zip(times, line.joints(times), strict=True):
        # The tool lags a little behind.
        measured = line.T_world_tool(time - 0.05)
        controller.follow(np.atleast_2d(q), line.T_world_tool(time), measured)
        np.testing.assert_allclose(
            model.fk(controller.commanded_q), controller.commanded_T_world_tool, atol=3e-5
        )
    np.testing.assert_array_equal(controller.commanded_q, line.path.positions(np.ones(1))[0])
    np.testing.assert_array_equal(controller.commanded_T_world_tool, line.T_world_tool(9.0))


def test_after_following_moves_go_on_from_there(controller, model):
    T = controller.commanded_T_world_tool
    near = T @ pose([0, 0, 0.01])
    q = model.ik(near, model.spec.home)
    controller.follow(np.atleast_2d(q), near, T)
    targets = controller.move(near @ pose([0.005, 0, 0]), near, 3)
    np.testing.assert_allclose(targets[0], np.tile(q, (8, 1)), atol=0.02)
    fresh = make_controller(model)
    fresh.reset(q, near)
    np.testing.assert_array_equal(fresh.move(near @ pose([0.005, 0, 0]), near, 3), targets)


@PROPERTY
@given(away=offsets(0.05, 0.2), q_away=st.floats(-0.1, 0.1))
def test_what_the_clamp_would_change_is_not_followed(model, away, q_away):
    controller = make_controller(model)
    q_before, T_before = controller.commanded_q, controller.commanded_T_world_tool
    T = T_before @ away
    far, turned = distance(T_before, T)
    if far <= LEAD and turned <= LEAD_ANGLE:
        controller.follow(q_before[None] + q_away, T, T_before)
        np.testing.assert_array_equal(controller.commanded_T_world_tool, T)
    else:
        with pytest.raises(MotionRejected, match="tool lags behind: .* mm and .* deg; allow more"):
            controller.follow(q_before[None] + q_away, T, T_before)
        np.testing.assert_array_equal(controller.commanded_q, q_before)
        np.testing.assert_array_equal(controller.commanded_T_world_tool, T_before)


@pytest.mark.parametrize(
    ("lag", "message"),
    [
        (pose([0, 0.0201, 0]), "^tool lags behind: 20 mm and 0 deg; allow more time$"),
        (pose(rotvec=[0, 0, np.deg2rad(7)]), "^tool lags behind: 0 mm and 7 deg; allow more time$"),
        (pose([0.3, 0, 0.4], [1, 0, 0]), "^tool lags behind: 500 mm and 57 deg; allow more time$"),
    ],
)
def test_a_rejection_says_how_far_the_tool_lags_behind(controller, model, lag, message):
    T, q = controller.commanded_T_world_tool, controller.commanded_q
    with pytest.raises(MotionRejected, match=message):
        controller.follow(q[None] + 0.1, T @ lag, T)
    np.testing.assert_array_equal(controller.commanded_q, q)
    np.testing.assert_array_equal(controller.commanded_T_world_tool, T)


def test_another_lead_may_be_configured_for_what_is_followed(model):
    config = ControllerConfig(max_lead=0.005, max_lead_deg=1.0)
    controller = ToolController(model, config)
    T, q = controller.commanded_T_world_tool, controller.commanded_q
    controller.follow(np.atleast_2d(q), T @ pose([0.0049, 0, 0]), T)
    for away in (pose([0.0051, 0, 0]), pose(rotvec=[np.deg2rad(1.1), 0, 0])):
        controller = ToolController(model, config)
        with pytest.raises(MotionRejected, match="tool lags behind"):
            controller.follow(np.atleast_2d(q), T @ away, T)


@pytest.mark.parametrize(
    ("q", "T", "measured", "message"),
    [
        (np.zeros(5), np.eye(4), np.eye(4), r"targets: expected shape .* got \(1, 5\)"),
        (np.full(6, np.nan), np.eye(4), np.eye(4), "targets: has NaN or infinite entries"),
        (np.zeros(6), np.eye(3), np.eye(4), r"T_world_tool: expected pose shape \(4, 4\)"),
        (np.zeros(6), 2 * np.eye(4), np.eye(4), "^T_world_tool: not a rigid transform"),
        # Were it let through, NaN would silently switch the check off.
        (np.zeros(6), np.eye(4), np.full((4, 4), np.nan), "^measured_T_world_tool: has NaN"),
        (np.zeros(6), np.eye(4), np.eye(3), "^measured_T_world_tool: expected pose shape"),
    ],
)
def test_what_is_no_configuration_or_pose_is_not_followed(controller, q, T, measured, message):
    q_before, T_before = controller.commanded_q, controller.commanded_T_world_tool
    with pytest.raises(InvalidInput, match=message):
        controller.follow(np.atleast_2d(q), T, measured)
    np.testing.assert_array_equal(controller.commanded_q, q_before)
    np.testing.assert_array_equal(controller.commanded_T_world_tool, T_before)


def test_what_was_followed_can_not_be_changed_from_outside(controller, model):
    q, T = np.array(model.spec.home), controller.commanded_T_world_tool
    controller.follow(np.atleast_2d(q), T, T)
    q[:], T[:] = 0, 0
    np.testing.assert_array_equal(controller.commanded_q, model.spec.home)
    check_pose("commanded", controller.commanded_T_world_tool)


# --- reset --------------------------------------------------------------------------------------


def test_a_new_controller_is_at_home(model):
    controller = ToolController(model)
    np.testing.assert_array_equal(controller.commanded_q, model.spec.home)
    np.testing.assert_array_equal(controller.commanded_T_world_tool, model.fk(model.spec.home))


def test_reset_to_joints_commands_the_pose_that_they_give(controller, model):
    q = model.spec.home + 0.1
    controller.reset(q)
    np.testing.assert_array_equal(controller.commanded_q, q)
    np.testing.assert_array_equal(controller.commanded_T_world_tool, model.fk(q))


def test_reset_keeps_the_commanded_pose_that_the_joints_stand_for(controller, model):
    q = model.spec.home + 0.1
    T = model.fk(q) @ pose([1e-7, 0, 0])
    controller.reset(q, T)
    np.testing.assert_array_equal(controller.commanded_T_world_tool, T)
    np.testing.assert_array_equal(controller.commanded_q, q)


def test_after_a_reset_nothing_of_the_past_remains(model):
    used, fresh = make_controller(model), make_controller(model)
    T = used.commanded_T_world_tool
    for _ in range(5):
        used.move(used.commanded_T_world_tool @ pose([0.01, 0.005, 0], [0, 0.03, 0]), T, 3)
    for controller in (used, fresh):
        controller.reset(model.spec.home + 0.05)
    T = fresh.commanded_T_world_tool
    desired = T @ pose([0, 0.01, 0.01], [0.02, 0, 0])
    np.testing.assert_array_equal(used.move(desired, T, 3), fresh.move(desired, T, 3))


@pytest.mark.parametrize("q", [np.zeros(3), np.full(6, np.nan)], ids=["short", "NaN"])
@pytest.mark.parametrize("with_pose", [False, True])
def test_a_reset_to_what_is_no_configuration_is_refused_and_changes_nothing(
    controller, q, with_pose
):
    q_before, T_before = controller.commanded_q, controller.commanded_T_world_tool
    with pytest.raises(InvalidInput, match="q"):
        controller.reset(q, T_before if with_pose else None)
    np.testing.assert_array_equal(controller.commanded_q, q_before)
    np.testing.assert_array_equal(controller.commanded_T_world_tool, T_before)


def test_a_reset_to_what_is_no_pose_is_refused_and_changes_nothing(controller, model):
    before = controller.commanded_q
    with pytest.raises(InvalidInput, match="T_world_tool_commanded: not a rigid transform"):
        controller.reset(model.spec.home + 0.1, np.zeros((4, 4)))
    np.testing.assert_array_equal(controller.commanded_q, before)


def test_what_the_controller_gives_out_can_not_change_it(controller):
    controller.commanded_q[:] = 0
    controller.commanded_T_world_tool[:] = 0
    assert (controller.commanded_q != 0).any()
    check_pose("commanded", controller.commanded_T_world_tool)


# --- configuration ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "unit"), [("max_lead", "m"), ("max_lead_deg", "deg"), ("max_joint_step", "rad")]
)
@pytest.mark.parametrize("bad", [0, -1, np.nan, np.inf])
def test_a_bound_that_is_not_positive_is_refused(name, unit, bad):
    with pytest.raises(InvalidInput, match=f"{name}: expected a finite number > 0 {unit}, got"):
        ControllerConfig(**{name: bad})


def test_the_lead_is_20_mm_and_5_degrees_unless_specified_otherwise():
    config = ControllerConfig()
    assert (config.max_lead, config.max_lead_deg) == (0.020, 5.0)


def test_the_command_continues_from_what_was_really_sent(controller, model):
    T = controller.commanded_T_world_tool
    (targets,) = controller.move(T @ pose([0.01, 0, 0]), T, 1)
    controller.acknowledge(targets[-1])
    np.testing.assert_allclose(controller.commanded_T_world_tool, T @ pose([0.01, 0, 0]))
    short = 0.5 * (model.spec.home + targets[-1])
    controller.acknowledge(short)
    np.testing.assert_array_equal(controller.commanded_q, short)
    np.testing.assert_allclose(controller.commanded_T_world_tool, model.fk(short))
    with pytest.raises(InvalidInput, match="q: expected shape"):
        controller.acknowledge(short[:-1])
