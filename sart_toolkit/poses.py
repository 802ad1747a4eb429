"""SE(3) arrays and their checks.

A pose is a float64 `(4, 4)` array; `T_a_b` maps coordinates in b to coordinates in a. Rotation
vectors are axis times angle [rad]. Quaternions never appear here.
"""

from __future__ import annotations

import math
import numbers
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sart_toolkit.errors import InvalidInput

Array = NDArray[np.float64]
_ORTHONORMAL_TOLERANCE, _LAST_ROW_TOLERANCE = 1e-6, 1e-12
_IDENTITY, _LAST_ROW = np.eye(3), np.array([0.0, 0.0, 0.0, 1.0])


def check_array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """A float64 copy of `value` with the given shape and only finite numbers.

    Args:
        name: what the array is, for the message.
        value: anything array-like.
        shape: expected shape; `None` stands for any length.

    Raises:
        InvalidInput: wrong shape, not numeric, or not finite.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"{name}: expected numbers, got {value!r}") from error
    expected = tuple("n" if n is None else n for n in shape)
    fits = array.ndim == len(shape) and all(
        want is None or want == got for want, got in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise InvalidInput(f"{name}: expected shape {expected}, got {array.shape}")
    if not np.isfinite(array).all():
        raise InvalidInput(f"{name}: has NaN or infinite entries; remove them")
    return array


def check_pose(name: str, value: ArrayLike) -> Array:
    """A float64 copy of one pose `(4, 4)`, its rotation orthonormal to 1e-6.

    Raises:
        InvalidInput: wrong shape, not finite, or not a rigid transform.
    """
    array = _as_array(name, value)
    if array.shape != (4, 4):
        raise InvalidInput(f"{name}: expected pose shape (4, 4) or (n, 4, 4), got {array.shape}")
    T = check_array(name, array, (4, 4))
    # One pose is checked in every control period: numbers one by one take a fraction of the time.
    x, y, z, (*last, one) = T.tolist()
    near = _ORTHONORMAL_TOLERANCE
    if not (
        all(abs(_dot(row, row) - 1.0) <= near for row in (x, y, z))
        and all(abs(_dot(*pair)) <= near for pair in ((x, y), (y, z), (z, x)))
        and max(*map(abs, last), abs(one - 1.0)) <= _LAST_ROW_TOLERANCE
        and x[0] * (y[1] * z[2] - y[2] * z[1])
        + x[1] * (y[2] * z[0] - y[0] * z[2])
        + x[2] * (y[0] * z[1] - y[1] * z[0])
        >= 0
    ):
        raise _not_rigid(name)
    return T


def check_poses(name: str, value: ArrayLike) -> Array:
    """A float64 copy of poses `(n, 4, 4)`, their rotations orthonormal to 1e-6.

    Raises:
        InvalidInput: wrong shape, not finite, or not rigid transforms.
    """
    array = _as_array(name, value)
    if array.ndim != 3 or array.shape[1:] != (4, 4):
        raise InvalidInput(f"{name}: expected pose shape (4, 4) or (n, 4, 4), got {array.shape}")
    poses = check_array(name, array, (None, 4, 4))
    rotations = poses[:, :3, :3]
    if (
        # A rotation's entries are at most 1; larger ones might overflow in the product.
        (np.abs(rotations) > 1 + _ORTHONORMAL_TOLERANCE).any()
        or (
            np.abs(rotations @ rotations.transpose(0, 2, 1) - _IDENTITY) > _ORTHONORMAL_TOLERANCE
        ).any()
        or (np.abs(poses[:, 3] - _LAST_ROW) > _LAST_ROW_TOLERANCE).any()
        or (np.linalg.det(rotations) < 0).any()
    ):
        raise _not_rigid(name)
    return poses


def _dot(a: list[float], b: list[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _not_rigid(name: str) -> InvalidInput:
    return InvalidInput(
        f"{name}: not a rigid transform (rotation not orthonormal, mirrored, or last row is"
        " not 0 0 0 1); pass a homogeneous matrix made of a rotation and a translation"
    )


def _as_array(name: str, value: ArrayLike) -> NDArray[Any]:
    try:
        return np.asarray(value)
    except ValueError as error:
        raise InvalidInput(f"{name}: expected an array, got rows of unequal length") from error


def check_positive(name: str, value: float, unit: str = "") -> float:
    """`value` as a float greater than 0.

    Raises:
        InvalidInput: NaN, infinite, zero or negative.
    """
    message = f"{name}: expected a finite number > 0{unit and ' ' + unit}, got {value!r}"
    if not isinstance(value, numbers.Real):
        raise InvalidInput(message)
    number = float(value)
    if not np.isfinite(number) or number <= 0:
        raise InvalidInput(message)
    return number


def pose(p: ArrayLike = (0, 0, 0), rotvec: ArrayLike = (0, 0, 0)) -> Array:
    """The pose `(4, 4)` with position `p` [m] and rotation vector `rotvec` [rad]."""
    T = np.eye(4)
    T[:3, :3] = exp_rotation(np.asarray(rotvec, dtype=np.float64))
    T[:3, 3] = p
    return T


def rpy_pose(p: ArrayLike = (0, 0, 0), rpy: ArrayLike = (0, 0, 0)) -> Array:
    """The pose `(4, 4)` with fixed-axis roll, pitch and yaw [rad] as URDF's origin means them."""
    roll, pitch, yaw = np.asarray(rpy, dtype=np.float64)
    T = pose(p)
    T[:3, :3] = (
        exp_rotation(np.array([0, 0, yaw]))
        @ exp_rotation(np.array([0, pitch, 0]))
        @ exp_rotation(np.array([roll, 0, 0]))
    )
    return T


def inverse(T: Array) -> Array:
    """The inverse of poses `(..., 4, 4)`: `T_b_a` from `T_a_b`."""
    result = np.zeros_like(T)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    result[..., :3, :3] = Rt
    result[..., :3, 3] = -(Rt @ T[..., :3, 3, None])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def up_in_tool(Ts_world_tool: Array) -> Array:
    """The world's upward direction `(..., 3)` in the tool frames of poses `(..., 4, 4)`."""
    return Ts_world_tool[..., 2, :3]


def exp_rotation(rotvec: Array) -> Array:
    """The rotation matrix `(3, 3)` of a rotation vector `(3,)` [rad] (Rodrigues' formula)."""
    angle = float(np.sqrt(rotvec @ rotvec))
    x, y, z = rotvec
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-4:
        # sin(a)/a and (1 - cos(a))/a^2 by their series: the quotients lose digits near 0.
        a, b = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0
    else:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    return _IDENTITY + a * K + b * (K @ K)


def log_rotation(R: Array) -> Array:
    """The rotation vector `(3,)` [rad], angle in [0, pi], of a rotation matrix `(3, 3)`."""
    v = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.sqrt(v @ v))
    cosine = 0.5 * (float(R[0, 0] + R[1, 1] + R[2, 2]) - 1.0)
    angle = float(np.arctan2(sine, cosine))
    if sine > 1e-6:
        return v * (angle / sine)
    if cosine > 0:
        return v
    # Near pi the antisymmetric part vanishes: the symmetric part + I = 2 n n^T gives the axis.
    S = 0.5 * (0.5 * (R + R.T) + np.eye(3))
    column = int(np.argmax(np.diag(S)))
    n = S[:, column] / np.sqrt(S[column, column])
    return angle * (n if v @ n >= 0 else -n)


def relative_motion(T_world_from: Array, T_world_to: Array) -> Array:
    """The motion `(6,)` between poses: xyz [m], rotation vector [rad], in the first one's frame.

    `apply_motion(T_world_from, relative_motion(T_world_from, T_world_to))` is `T_world_to`.
    """
    R = T_world_from[:3, :3]
    motion = np.empty(6)
    motion[:3] = R.T @ (T_world_to[:3, 3] - T_world_from[:3, 3])
    motion[3:] = log_rotation(R.T @ T_world_to[:3, :3])
    return motion


def apply_motion(T_world_from: Array, motion: Array) -> Array:
    """The pose `(4, 4)` reached from a pose by a motion `(6,)` given in that pose's frame."""
    T = np.eye(4)
    R = T_world_from[:3, :3]
    T[:3, :3] = orthonormalised(R @ exp_rotation(motion[3:]))
    T[:3, 3] = T_world_from[:3, 3] + R @ motion[:3]
    return T


class StraightLine:
    """Poses on a straight line: p linear, R geodesic (not an SE(3) screw)."""

    def __init__(self, T_a: Array, T_b: Array) -> None:
        """From pose `T_a` to `T_b`, both `(4, 4)`."""
        self._p_a, self._p_b = T_a[:3, 3], T_b[:3, 3]
        R_a = orthonormalised(T_a[:3, :3])
        rotvec = log_rotation(R_a.T @ T_b[:3, :3])
        self._angle = float(np.sqrt(rotvec @ rotvec))
        x, y, z = rotvec / self._angle if self._angle > 0.0 else rotvec
        K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        self._R_a, self._R_a_K, self._R_a_KK = R_a, R_a @ K, R_a @ K @ K

    def __call__(self, s: float) -> Array:
        """The pose `(4, 4)` at fraction `s`; its rotation by Rodrigues' formula."""
        angle = s * self._angle
        # 1 - cos(angle), without the digits that it loses near 0.
        versine = 2.0 * math.sin(0.5 * angle) ** 2
        T = np.empty((4, 4))
        T[:3, :3] = self._R_a + math.sin(angle) * self._R_a_K + versine * self._R_a_KK
        T[:3, 3] = (1.0 - s) * self._p_a + s * self._p_b
        T[3] = _LAST_ROW
        return T


def interpolate(T_a: Array, T_b: Array, s: float) -> Array:
    """The pose at fraction `s` of the `StraightLine` between two poses."""
    return StraightLine(T_a, T_b)(s)


def orthonormalised(R: Array) -> Array:
    """The nearly orthonormal `(3, 3)` with its rounding drift removed (one Newton step)."""
    return R @ (1.5 * _IDENTITY - 0.5 * (R.T @ R))


def distance(T_a: Array, T_b: Array) -> tuple[float, float]:
    """Translation [m] and rotation angle [rad] between two poses."""
    motion = relative_motion(T_a, T_b)
    return float(np.linalg.norm(motion[:3])), float(np.linalg.norm(motion[3:]))


def angle_between(R_a: Array, R_b: Array) -> float:
    """The angle [rad] in [0, pi] of the rotation between two rotation matrices."""
    return float(np.linalg.norm(log_rotation(R_a.T @ R_b)))


def frozen(array: Any, dtype: Any = None) -> Any:
    """A read-only copy of an array, for frozen records."""
    copy = np.array(array, dtype=dtype, copy=True)
    copy.setflags(write=False)
    return copy
