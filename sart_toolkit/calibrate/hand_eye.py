"""Where a camera is, from images of a board and the robot's poses: hand-eye calibration.

With C_i the board in the camera of view i, T_i the tool in the world, X the camera in the frame
that it is mounted on and Z the board in the other one, X C_i = S_i Z, where S_i is the inverse of
T_i for a camera on the tool and T_i for one that stands in the world. A first guess is the closed
form for A X = X B of pairs of views (rotations by Park and Martin, IEEE T-RA 1994, then
translations by least squares). Then X and Z, the scale of the squares and, where they aren't given,
the intrinsics are those that bring the board's corners nearest to where the images show them.

What the robot's poses are off by moves all corners of a view together, so that views and not
corners are what is independent: the covariance is the jackknife's, each view left out in turn (the
cluster-robust estimate CR3 of Bell and McCaffrey, 2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import f as f_distribution
from scipy.stats import t as t_distribution

from sart_toolkit.calibrate.board import Board, FoundCorners, opencv
from sart_toolkit.calibrate.calibration import Calibration
from sart_toolkit.data.records import CameraFrame, DepthImage, Image
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import (
    Array,
    apply_motion,
    check_array,
    check_pose,
    check_positive,
    inverse,
    log_rotation,
)


@dataclass(frozen=True)
class BoardView:
    """An image of the board and where the tool was: `rgb (H, W, 3)`, `T_world_tool (4, 4)`.

    `depth (H, W)` [m] where there is any; `name` is what messages call it.
    """

    name: str
    T_world_tool: Array
    rgb: Image
    depth: DepthImage | None = None

    def __post_init__(self) -> None:
        check_pose(f"{self.name}: T_world_tool", self.T_world_tool)
        rgb = np.asarray(self.rgb)
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            raise InvalidInput(
                f"{self.name}: expected uint8 of shape (H, W, 3), got {rgb.dtype} {rgb.shape}"
            )
        if self.depth is not None and np.shape(self.depth) != rgb.shape[:2]:
            raise InvalidInput(
                f"{self.name}: depth: expected shape {rgb.shape[:2]}, got {np.shape(self.depth)}"
            )


@dataclass(frozen=True)
class CalibrateConfig:
    """What is asked of views, and what is taken to be known.

    `least_views`: so many have to show the board. `least_turn_deg`: the tool has to turn by so much
    about a second axis, root mean square over pairs of views. `limit`: where the robot's motion has
    the squares, or the images the focal length, off by more than this fraction, what was said of
    them is wrong. `probability`: with which the camera is no farther from where it is said to be
    than the errors declared.
    """

    least_views: int = 8
    least_turn_deg: float = 3.0
    limit: float = 0.01
    probability: float = 0.99

    def __post_init__(self) -> None:
        if self.least_views < 6:
            raise InvalidInput(f"least_views: expected at least 6, got {self.least_views}")
        for name in ("least_turn_deg", "limit"):
            check_positive(name, getattr(self, name))
        if not 0.5 <= self.probability < 1:
            raise InvalidInput(f"probability: expected 0.5 to 1, got {self.probability}")


# A view this many times as far off as the median one contradicts the others, if by a pixel.
_CONTRADICTS = 4.0
# Of views that show the board, no more than this share may contradict the others.
_MOST_LEFT_OUT = 0.25
# Corners this far off on average, as a fraction of the image's width, belong to other poses.
_UNRELATED = 0.01
# Turns near half a one have no certain axis [rad].
_HALF_TURN = 2.8
_N_POSES, _SCALE, _N_INTRINSICS = 12, 12, 4


class _Seen(NamedTuple):
    """A view that shows the board: `S (4, 4)` of the module's equation."""

    view: BoardView
    S: Array
    found: FoundCorners


def calibrate_camera(
    views: Sequence[BoardView],
    board: Board,
    camera: str = "wrist",
    frame: CameraFrame = "tool",
    intrinsics: Array | None = None,
    config: CalibrateConfig | None = None,
) -> Calibration:
    """Where a camera is mounted, and how far it may be from there.

    Args:
        views: images that show the board, from 8 poses that turn about two axes or more.
        board: the board, fixed in the world; in the gripper, if the camera stands in the world.
        camera: what the camera is called.
        frame: what it is mounted on, the tool or the world.
        intrinsics: `(3, 3)` [pixels], of images without distortion; estimated if left out.
        config: what is asked of the views.

    Raises:
        InvalidInput: too few views, too few that show the board, rotations too similar, or the
            robot's motion contradicts the size of the squares, the intrinsics or the poses.
        MissingExtra: OpenCV isn't installed.
        UnknownName: the board's dictionary doesn't exist.
    """
    config = config or CalibrateConfig()
    if intrinsics is not None:
        intrinsics = check_array("intrinsics", intrinsics, (3, 3))
    seen, unseen = _find_board(views, board, frame, config)
    _check_turns(seen, frame, config)
    height, width = seen[0].view.rgb.shape[:2]
    start = _estimated_intrinsics(seen, board) if intrinsics is None else intrinsics
    X, Z = _closed_form(seen, board, start)
    problem = _Problem(seen, board, X, Z, start, intrinsics is None)
    solved, contradicting = _without_outliers(problem, width)
    _check_given(solved, board, intrinsics, config)
    errors = _errors(solved, config)
    depth_scale, depth_error = _depth_scale(solved, board, config)
    return Calibration(
        camera=camera,
        frame=frame,
        T_frame_camera=solved.problem.X(solved.x),
        intrinsics=solved.problem.K(solved.x),
        image_size=(width, height),
        hand_eye=errors.distance,
        hand_eye_deg=float(np.rad2deg(errors.angle)),
        axis_errors=_three(errors.axes[:3]),
        axis_errors_deg=_three(np.rad2deg(errors.axes[3:])),
        square_scale=solved.scale,
        rms_pixels=solved.rms,
        views=len(solved.problem.seen),
        left_out=(*unseen, *contradicting),
        board=board,
        depth_scale=depth_scale,
        depth_scale_error=depth_error,
    )


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


# --- views --------------------------------------------------------------------------------------


def _find_board(
    views: Sequence[BoardView], board: Board, frame: CameraFrame, config: CalibrateConfig
) -> tuple[list[_Seen], list[str]]:
    """The views that show the board, and the names of those that don't."""
    if len(views) < config.least_views:
        raise InvalidInput(
            f"views: {len(views)} images, at least {config.least_views} are needed; take more from "
            "other sides, 15 to 25 are good"
        )
    sizes = {view.rgb.shape[:2] for view in views}
    if len(sizes) > 1:
        texts = ", ".join(f"{width}x{height}" for height, width in sorted(sizes))
        raise InvalidInput(f"views: images of several sizes, {texts}; take all with one camera")
    seen, unseen = [], []
    for view in views:
        found = board.find(view.rgb)
        if found is None:
            unseen.append(view.name)
        else:
            S = inverse(view.T_world_tool) if frame == "tool" else view.T_world_tool
            seen.append(_Seen(view, S, found))
    if len(seen) < config.least_views:
        raise InvalidInput(
            f"board: {len(seen)} of {len(views)} images show it, at least {config.least_views} "
            f"are needed; expected {board.columns} x {board.rows} squares and {board.dictionary}: "
            "check these against the board, and light, sharpness and distance"
        )
    return seen, unseen


def _pairs(seen: Sequence[_Seen]) -> list[tuple[int, int]]:
    """Pairs of views between which the tool turned, but not by about half a turn."""
    n = len(seen)
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n)]
    turns = [np.linalg.norm(_turn(seen[i].S, seen[j].S)) for i, j in pairs]
    return [pair for pair, turn in zip(pairs, turns, strict=True) if 0.01 < turn < _HALF_TURN]


def _turn(S_a: Array, S_b: Array) -> Array:
    """The rotation vector of A = S_a S_b^-1, as X has it."""
    return log_rotation(S_a[:3, :3] @ S_b[:3, :3].T)


def _check_turns(seen: Sequence[_Seen], frame: CameraFrame, config: CalibrateConfig) -> None:
    turns = np.array([_turn(seen[i].S, seen[j].S) for i, j in _pairs(seen)]).reshape(-1, 3)
    spread = turns.T @ turns / max(len(turns), 1)
    second = float(np.rad2deg(np.sqrt(max(np.linalg.eigvalsh(spread)[1], 0.0))))
    if second < config.least_turn_deg:
        what = "the tool" if frame == "tool" else "the tool with the board"
        raise InvalidInput(
            f"views: rotations too similar: about a second axis {what} turned by {second:.1f} deg "
            f"between them, at least {config.least_turn_deg:g} deg are needed; tilt it by 15 to 30 "
            "deg to all sides"
        )


def _estimated_intrinsics(seen: Sequence[_Seen], board: Board) -> Array:
    """A first guess `(3, 3)` from the images alone."""
    cv2 = opencv()
    height, width = seen[0].view.rgb.shape[:2]
    corners = board.corners().astype(np.float32)
    flags = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    try:
        _, K, _, _, _ = cv2.calibrateCamera(
            [corners[each.found.numbers] for each in seen],
            [each.found.pixels.astype(np.float32) for each in seen],
            (width, height), None, None, flags=flags,
        )  # fmt: skip
    except cv2.error as error:
        raise InvalidInput(
            "views: tell nothing of the focal length; tilt the camera to the board, or give the "
            "intrinsics"
        ) from error
    return np.asarray(K, dtype=np.float64)


def _board_in_camera(each: _Seen, board: Board, K: Array) -> Array:
    """The board's pose `(4, 4)` in the camera, from one image."""
    cv2 = opencv()
    corners = board.corners()[each.found.numbers]
    _, rotation, translation = cv2.solvePnP(corners, each.found.pixels, K, None)
    C = np.eye(4)
    C[:3, :3], C[:3, 3] = cv2.Rodrigues(rotation)[0], np.ravel(translation)
    return C


# --- solving ------------------------------------------------------------------------------------


def _closed_form(seen: Sequence[_Seen], board: Board, K: Array) -> tuple[Array, Array]:
    """A first guess at X and Z."""
    Cs = [_board_in_camera(each, board, K) for each in seen]
    turned = _pairs(seen)
    As = [seen[i].S @ inverse(seen[j].S) for i, j in turned]
    Bs = [Cs[i] @ inverse(Cs[j]) for i, j in turned]
    a = np.array([log_rotation(A[:3, :3]) for A in As])
    b = np.array([log_rotation(B[:3, :3]) for B in Bs])
    X = np.eye(4)
    X[:3, :3] = _nearest_rotation(a.T @ b)
    left = np.concatenate([A[:3, :3] - np.eye(3) for A in As])
    right = np.concatenate([X[:3, :3] @ B[:3, 3] - A[:3, 3] for A, B in zip(As, Bs, strict=True)])
    X[:3, 3] = np.linalg.lstsq(left, right)[0]
    Zs = np.array([inverse(each.S) @ X @ C for each, C in zip(seen, Cs, strict=True)])
    Z = np.eye(4)
    Z[:3, :3] = _nearest_rotation(Zs[:, :3, :3].sum(axis=0))
    Z[:3, 3] = np.median(Zs[:, :3, 3], axis=0)
    return X, Z


def _nearest_rotation(M: Array) -> Array:
    """The rotation R `(3, 3)` with the greatest trace of R^T M."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)


class _Problem:
    """Corners of all views as a function of what is sought.

    Unknowns: motions `(6,)` of X and of Z from their first guesses, the logarithm of the squares'
    scale, then where they are estimated focal lengths and centre of the image, as fractions of the
    first guess at the focal length.
    """

    def __init__(
        self,
        seen: Sequence[_Seen],
        board: Board,
        X: Array,
        Z: Array,
        K: Array,
        with_intrinsics: bool,
    ) -> None:
        self.seen, self.with_intrinsics = seen, with_intrinsics
        self._board, self._X, self._Z, self._K = board, X, Z, K
        self._S = np.array([each.S for each in seen])
        self._points = np.concatenate([board.corners()[each.found.numbers] for each in seen])
        self._pixels = np.concatenate([each.found.pixels for each in seen])
        self.view = np.repeat(np.arange(len(seen)), [len(each.found.numbers) for each in seen])

    @property
    def n(self) -> int:
        """How many unknowns there are."""
        return _N_POSES + 1 + _N_INTRINSICS * self.with_intrinsics

    def X(self, x: Array) -> Array:
        """The camera's pose `(4, 4)` in its frame."""
        return apply_motion(self._X, x[:6])

    def K(self, x: Array) -> Array:
        """The intrinsics `(3, 3)`."""
        K = self._K.copy()
        if self.with_intrinsics:
            f = self._K[0, 0]
            K[[0, 1, 0, 1], [0, 1, 2, 2]] += f * x[_SCALE + 1 :]
        return K

    def Cs(self, x: Array) -> Array:
        """The board's poses `(n, 4, 4)` in the camera."""
        return np.asarray(inverse(self.X(x)) @ self._S @ apply_motion(self._Z, x[6:12]))

    def misfits(self, x: Array) -> Array:
        """How far corners `(m, 2)` [pixels] are from where the images show them."""
        C = self.Cs(x)[self.view]
        p = (C[:, :3, :3] @ (np.exp(x[_SCALE]) * self._points)[:, :, None])[:, :, 0] + C[:, :3, 3]
        # A board behind the camera is far off, not on the other side.
        z = np.maximum(p[:, 2:], 1e-3)
        K = self.K(x)
        return np.asarray(p[:, :2] / z * np.diag(K)[:2] + K[:2, 2] - self._pixels)

    def continued(self, x: Array, seen: Sequence[_Seen], with_intrinsics: bool) -> _Problem:
        """One of other views and unknowns, what was found being its first guess."""
        Z = apply_motion(self._Z, x[6:12])
        return _Problem(seen, self._board, self.X(x), Z, self.K(x), with_intrinsics)


class _Solved(NamedTuple):
    """A solution: `x (n,)`, Jacobian `(2 m, n)` and `misfits (m, 2)` [pixels] of the corners."""

    problem: _Problem
    x: Array
    jacobian: Array
    misfits: Array

    @property
    def rms(self) -> float:
        """The root mean square of the misfits [pixels]."""
        return float(np.sqrt(np.mean(self.misfits**2)))

    @property
    def scale(self) -> float:
        """How much larger the squares are than was said."""
        return float(np.exp(self.x[_SCALE]))


def _solve(problem: _Problem) -> _Solved:
    found = least_squares(
        lambda x: problem.misfits(x).ravel(), np.zeros(problem.n), method="lm", x_scale="jac"
    )
    return _Solved(problem, found.x, np.asarray(found.jac), problem.misfits(found.x))


def _without_outliers(problem: _Problem, width: int) -> tuple[_Solved, list[str]]:
    """The solution without views that contradict the others, and the names of these."""
    contradicting: list[str] = []
    most = int(_MOST_LEFT_OUT * len(problem.seen))
    while True:
        solved = _solve(problem)
        n = len(problem.seen)
        squares = np.bincount(problem.view, (solved.misfits**2).mean(axis=1), n)
        rms = np.sqrt(squares / np.bincount(problem.view, minlength=n))
        worst = int(np.argmax(rms))
        if rms[worst] <= max(1.0, _CONTRADICTS * float(np.median(rms))):
            break
        if len(contradicting) == most:
            break
        contradicting.append(problem.seen[worst].view.name)
        rest = [each for i, each in enumerate(problem.seen) if i != worst]
        problem = problem.continued(solved.x, rest, problem.with_intrinsics)
    if solved.rms > max(1.0, _UNRELATED * width):
        raise InvalidInput(
            f"views: poses and images don't belong together, corners are off by {solved.rms:.1f} "
            "pixels; check the units of the poses (m, rad), that each image has its own pose, "
            "that the board didn't move, and what the camera is mounted on"
        )
    return solved, contradicting


# --- how far off it is --------------------------------------------------------------------------


def _covariance(solved: _Solved) -> Array:
    """The covariance `(n, n)` of what was found, views being independent of each other."""
    J, n = solved.jacobian, len(solved.problem.seen)
    H, rows = J.T @ J, np.repeat(solved.problem.view, 2)
    moved = np.zeros((n, J.shape[1]))
    for view in range(n):
        Ji, ri = J[rows == view], solved.misfits.ravel()[rows == view]
        # One step of Gauss and Newton without it.
        moved[view] = np.linalg.solve(H - Ji.T @ Ji, Ji.T @ ri)
    return np.asarray((n - 1) / n * moved.T @ moved)


def _freedom(n_views: int) -> int:
    """Degrees of freedom: a view fixes six numbers, and two poses are sought."""
    return n_views - 2


class _Errors(NamedTuple):
    """`distance` [m], `angle` [rad], and `axes (6,)` along and about the camera's axes."""

    distance: float
    angle: float
    axes: Array


def _errors(solved: _Solved, config: CalibrateConfig) -> _Errors:
    covariance = _covariance(solved)[:6, :6]
    freedom = _freedom(len(solved.problem.seen))
    t = float(t_distribution.ppf((1 + config.probability) / 2, freedom))
    return _Errors(
        _largest_norm(covariance[:3, :3], freedom, config.probability),
        _largest_norm(covariance[3:, 3:], freedom, config.probability),
        t * np.sqrt(np.diag(covariance)),
    )


def _largest_norm(covariance: Array, freedom: int, probability: float) -> float:
    """What the norm of a normal vector stays below with a probability.

    Its square is about a scaled chi-square of the same mean and variance (Satterthwaite), an F for
    a covariance that is itself estimated.
    """
    total, squares = float(np.trace(covariance)), float(np.trace(covariance @ covariance))
    n = total**2 / squares
    return float(np.sqrt(total * f_distribution.ppf(probability, n, freedom)))


def _check_given(
    solved: _Solved, board: Board, intrinsics: Array | None, config: CalibrateConfig
) -> None:
    """Return if squares and intrinsics may be as large as was said.

    Raises:
        InvalidInput: the robot's motion has the squares, or the images the focal length, otherwise.
    """
    # With given intrinsics, a wrong focal length would show as a wrong size.
    free = _solve(solved.problem.continued(solved.x, solved.problem.seen, True))
    deviation = np.sqrt(np.diag(_covariance(free)))
    scale = free.scale
    if abs(scale - 1) > config.limit + 3 * deviation[_SCALE]:
        raise InvalidInput(
            f"board: squares of {board.square * 1e3:g} mm contradict the robot's motion, which "
            f"has them {board.square * scale * 1e3:.2f} mm wide; measure them (printers scale to "
            "fit the page), and check that the robot's poses are in metres"
        )
    if intrinsics is None:
        return
    f = free.problem.K(free.x)[0, 0]
    if abs(f / intrinsics[0, 0] - 1) > config.limit + 3 * deviation[_SCALE + 1]:
        raise InvalidInput(
            f"intrinsics: the images have a focal length of {f:.1f} pixels, given are "
            f"{intrinsics[0, 0]:.1f}; pass those of images of this size, or let them be estimated"
        )


def _depth_scale(
    solved: _Solved, board: Board, config: CalibrateConfig
) -> tuple[float | None, float | None]:
    """By what depth is to be divided to be the board's, and how far from 1 that is at most."""
    ratios = []
    K = solved.problem.K(solved.x)
    for each in solved.problem.seen:
        if each.view.depth is None:
            continue
        # The image alone, without what the robot's pose is off by.
        C = _board_in_camera(each, board, K)
        z = solved.scale * (board.corners()[each.found.numbers] @ C[2, :3] + C[2, 3])
        column, row = np.rint(each.found.pixels).astype(int).T
        measured = each.view.depth[row, column]
        if (measured > 0).any():
            ratios.append(float(np.median(measured[measured > 0] / z[measured > 0])))
    if len(ratios) < config.least_views:
        return None, None
    scale, n = float(np.mean(ratios)), len(ratios)
    if not 0.8 < scale < 1.25:
        raise InvalidInput(
            f"depth: is {scale:.4g} times what the board says; expected metres (PNGs in "
            "millimetres), aligned to the colour image"
        )
    deviation = np.hypot(
        np.std(ratios, ddof=1) / np.sqrt(n), np.sqrt(_covariance(solved)[_SCALE, _SCALE])
    )
    t = float(t_distribution.ppf((1 + config.probability) / 2, _freedom(n)))
    return scale, abs(scale - 1) + t * float(deviation)
