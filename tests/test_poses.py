"""Poses: rotations and motions are inverted exactly, lines are straight, bad arrays are refused."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import example, given, settings
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import (
    angle_between,
    apply_motion,
    check_array,
    check_pose,
    check_poses,
    check_positive,
    distance,
    exp_rotation,
    frozen,
    interpolate,
    inverse,
    log_rotation,
    orthonormalised,
    pose,
    relative_motion,
    rpy_pose,
)

PROPERTY = settings(deadline=None, derandomize=True, max_examples=100)

positions = st.tuples(*[st.floats(-2, 2)] * 3).map(np.array)
fractions = st.floats(0, 1)


@st.composite
def axes(draw):
    """A unit vector."""
    azimuth, z = draw(st.floats(-np.pi, np.pi)), draw(st.floats(-1, 1))
    ring = np.sqrt(1 - z**2)
    return np.array([ring * np.cos(azimuth), ring * np.sin(azimuth), z])


def rotation_vectors(largest):
    return st.builds(lambda axis, angle: axis * angle, axes(), st.floats(0, largest))


poses = st.builds(pose, positions, rotation_vectors(np.pi))
# A rotation by more than pi less a little has a second, nearly equal rotation vector.
motions = st.builds(lambda p, v: np.concatenate([p, v]), positions, rotation_vectors(np.pi - 1e-3))


@PROPERTY
@given(rotation_vectors(3 * np.pi))
def test_exp_is_the_rotation_that_scipy_gives(rotvec):
    np.testing.assert_allclose(
        exp_rotation(rotvec), Rotation.from_rotvec(rotvec).as_matrix(), atol=1e-13
    )


@PROPERTY
@given(rotation_vectors(np.pi - 1e-3))
@example(np.zeros(3))
@example(np.array([1e-12, 0, 0]))
@example(np.array([0, 1e-6, 1e-6]))
@example(np.array([0, 0, 1e-4]))
def test_log_inverts_exp(rotvec):
    np.testing.assert_allclose(log_rotation(exp_rotation(rotvec)), rotvec, atol=1e-12)


@PROPERTY
@given(axes(), st.sampled_from([0, 1e-12, 1e-9, 1e-8, 1e-7, 3e-7, 9e-7, 2e-6, 1e-4, 1e-2, 1]))
def test_exp_inverts_log_up_to_a_half_turn(axis, short_of_pi):
    R = exp_rotation(axis * (np.pi - short_of_pi))
    rotvec = log_rotation(R)
    assert np.linalg.norm(rotvec) == pytest.approx(np.pi - short_of_pi, abs=1e-8)
    np.testing.assert_allclose(exp_rotation(rotvec), R, atol=1e-9)


@PROPERTY
@given(positions, rotation_vectors(np.pi))
def test_a_pose_holds_its_position_and_rotation(p, rotvec):
    T = check_pose("T", pose(p, rotvec))
    np.testing.assert_array_equal(T[:3, 3], p)
    np.testing.assert_array_equal(T[:3, :3], exp_rotation(rotvec))


@PROPERTY
@given(positions, st.tuples(*[st.floats(-np.pi, np.pi)] * 3))
def test_rpy_turns_about_the_fixed_axes_in_turn(p, rpy):
    T = rpy_pose(p, rpy)
    np.testing.assert_allclose(T[:3, :3], Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-13)
    np.testing.assert_array_equal(T[:3, 3], p)


@PROPERTY
@given(poses)
def test_a_pose_times_its_inverse_is_the_identity(T):
    np.testing.assert_allclose(T @ inverse(T), np.eye(4), atol=1e-13)
    np.testing.assert_allclose(inverse(inverse(T)), T, atol=1e-13)


@PROPERTY
@given(st.lists(poses, min_size=1, max_size=4))
def test_inverting_many_poses_inverts_each(some):
    Ts = np.stack(some)
    np.testing.assert_array_equal(inverse(Ts), np.stack([inverse(T) for T in some]))


@PROPERTY
@given(poses, poses)
def test_the_motion_between_two_poses_leads_from_one_to_the_other(T_from, T_to):
    reached = apply_motion(T_from, relative_motion(T_from, T_to))
    np.testing.assert_allclose(reached, T_to, atol=1e-9)


@PROPERTY
@given(poses, motions)
def test_an_applied_motion_is_found_again(T, motion):
    np.testing.assert_allclose(relative_motion(T, apply_motion(T, motion)), motion, atol=1e-9)


@PROPERTY
@given(poses, poses, motions)
def test_a_motion_is_reported_in_the_moving_frame(T, T_other, motion):
    moved = T_other @ apply_motion(T, motion)
    np.testing.assert_allclose(apply_motion(T_other @ T, motion), moved, atol=1e-12)


def test_poses_stay_rigid_over_thousands_of_motions():
    T = np.eye(4)
    for _ in range(5000):
        T = apply_motion(T, np.array([0.001, 0, 0, 0.01, 0.02, -0.03]))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-13)


@PROPERTY
@given(poses, poses)
def test_interpolation_begins_and_ends_at_its_poses(T_a, T_b):
    np.testing.assert_allclose(interpolate(T_a, T_b, 0.0), T_a, atol=1e-12)
    np.testing.assert_allclose(interpolate(T_a, T_b, 1.0), T_b, atol=1e-9)


@PROPERTY
@given(poses, motions, fractions)
def test_interpolated_positions_are_linear_and_rotations_geodesic(T_a, motion, s):
    T_b = apply_motion(T_a, motion)
    T = check_pose("T", interpolate(T_a, T_b, s))
    np.testing.assert_allclose(T[:3, 3], T_a[:3, 3] + s * (T_b[:3, 3] - T_a[:3, 3]), atol=1e-12)
    np.testing.assert_allclose(T[:3, :3], T_a[:3, :3] @ exp_rotation(s * motion[3:]), atol=1e-9)


def test_the_line_does_not_bend_as_a_screw_does():
    T_a, T_b = np.eye(4), pose([0.1, 0, 0], [0, 0, 0.2])
    screw = np.real(expm(0.5 * logm(T_b)))
    line = interpolate(T_a, T_b, 0.5)
    assert abs(screw[1, 3]) == pytest.approx(0.0025, abs=1e-4)
    assert abs(line[1, 3]) < 1e-15
    np.testing.assert_allclose(line[:3, :3], screw[:3, :3], atol=1e-9)


@PROPERTY
@given(rotation_vectors(np.pi), st.integers(0, 2**32 - 1))
def test_orthonormalising_removes_rounding_drift_and_nothing_else(rotvec, seed):
    R = exp_rotation(rotvec)
    drifted = R + 1e-7 * np.random.default_rng(seed).uniform(-1, 1, (3, 3))
    repaired = orthonormalised(drifted)
    np.testing.assert_allclose(repaired @ repaired.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(repaired, R, atol=1e-6)
    np.testing.assert_allclose(orthonormalised(R), R, atol=1e-15)


@PROPERTY
@given(poses, motions)
def test_distance_is_the_length_and_angle_of_the_motion(T, motion):
    expected = (np.linalg.norm(motion[:3]), np.linalg.norm(motion[3:]))
    T_moved = apply_motion(T, motion)
    assert distance(T, T_moved) == pytest.approx(expected, abs=1e-9)
    assert distance(T_moved, T) == pytest.approx(expected, abs=1e-9)
    assert angle_between(T[:3, :3], T_moved[:3, :3]) == pytest.approx(expected[1], abs=1e-9)


def test_a_frozen_array_is_a_read_only_copy():
    source = np.arange(3.0)
    array = frozen(source)
    source[0] = 7
    assert array[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 7


def test_a_checked_array_is_a_float64_copy():
    source = np.arange(6, dtype=np.float32).reshape(2, 3)
    array = check_array("x", source, (None, 3))
    source[0, 0] = 7
    assert array.dtype == np.float64
    np.testing.assert_array_equal(array, np.arange(6).reshape(2, 3))


@pytest.mark.parametrize("shape", [(3,), (2, 2), (1, 2, 3), ()])
def test_an_array_of_another_shape_is_refused_with_both_shapes(shape):
    with pytest.raises(InvalidInput, match=r"x: expected shape \('n', 3\), got \(") as caught:
        check_array("x", np.zeros(shape), (None, 3))
    assert str(shape) in str(caught.value)


@pytest.mark.parametrize("value", ["three", [1, "x", 2], [[1], [2, 3]], object()])
def test_what_is_not_numbers_is_refused(value):
    with pytest.raises(InvalidInput, match="x: expected numbers"):
        check_array("x", value, (3,))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_array_with_a_non_finite_entry_is_refused(bad):
    with pytest.raises(InvalidInput, match="x: has NaN or infinite entries"):
        check_array("x", [0.0, bad], (2,))


@PROPERTY
@given(poses)
def test_every_rigid_transform_passes_unchanged(T):
    np.testing.assert_array_equal(check_pose("T", T), T)
    np.testing.assert_array_equal(check_poses("Ts", T[None]), T[None])


@pytest.mark.parametrize("off", [0.0, 1e-9, 4e-7, 6e-7, 9e-7, 1.1e-6, 1e-3, 1e200, np.nan, np.inf])
@pytest.mark.parametrize("entry", [(0, 0), (1, 2), (2, 0), (0, 3), (3, 0), (3, 3)])
def test_one_pose_is_taken_or_refused_as_among_many(off, entry):
    T = pose([0.1, -0.2, 0.3], [0.4, -0.5, 0.6])
    T[entry] += off

    def taken(check):
        try:
            return np.asarray(check()).reshape(4, 4).tolist() == T.tolist()
        except InvalidInput:
            return False

    assert taken(lambda: check_pose("T", T)) == taken(lambda: check_poses("T", T[None]))
    T[0] *= -1
    assert not taken(lambda: check_pose("T", T))


@pytest.mark.parametrize("shape", [(3, 3), (4,), (), (2, 4, 4)])
def test_a_pose_of_another_shape_is_refused_with_its_shape(shape):
    with pytest.raises(InvalidInput, match=r"T: expected pose shape \(4, 4\)") as caught:
        check_pose("T", np.zeros(shape))
    assert str(shape) in str(caught.value) or shape == (2, 4, 4)


@pytest.mark.parametrize("shape", [(4, 4), (2, 3, 4), (0,)])
def test_poses_of_another_shape_are_refused(shape):
    with pytest.raises(InvalidInput, match=r"Ts: expected pose shape .* or \(n, 4, 4\)"):
        check_poses("Ts", np.zeros(shape))


def test_a_ragged_pose_is_refused():
    with pytest.raises(InvalidInput, match="T: "):
        check_pose("T", [[1, 0, 0, 0], [0, 1], [0, 0, 1, 0], [0, 0, 0, 1]])
    with pytest.raises(InvalidInput, match="Ts: "):
        check_poses("Ts", [np.eye(4).tolist(), [[1]]])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_non_finite_pose_is_refused(bad):
    T = np.eye(4)
    T[0, 3] = bad
    with pytest.raises(InvalidInput, match="T: has NaN or infinite entries"):
        check_pose("T", T)


@pytest.mark.parametrize(
    "T",
    [
        np.diag([1.0, 1.0, 1.001, 1.0]),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([1.0, 1.0, 1.0, 2.0]),
        np.eye(4)[[1, 0, 2, 3]],
        np.zeros((4, 4)),
        np.diag([1e200, 1.0, 1.0, 1.0]),
    ],
    ids=["scaled", "mirrored", "last row", "swapped axes", "zeros", "huge"],
)
def test_what_is_not_a_rigid_transform_is_refused(T):
    with pytest.raises(InvalidInput, match="T: not a rigid transform"):
        check_pose("T", T)
    with pytest.raises(InvalidInput, match="Ts: not a rigid transform"):
        check_poses("Ts", np.stack([np.eye(4), T]))


@PROPERTY
@given(st.floats(min_value=0, exclude_min=True, allow_infinity=False))
def test_a_positive_number_passes_as_a_float(value):
    assert check_positive("r", value) == value


@pytest.mark.parametrize("value", [0, -0.0, -1e-9, np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_and_positive_is_refused(value):
    with pytest.raises(InvalidInput, match="r: expected a finite number > 0 m, got"):
        check_positive("r", value, "m")


@pytest.mark.parametrize("value", ["wide", None, [1.0]])
def test_what_is_no_number_is_refused_as_a_positive_one(value):
    with pytest.raises(InvalidInput, match="r: expected a finite number > 0"):
        check_positive("r", value)
