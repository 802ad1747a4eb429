"""Joint paths round obstacles: RRTConnect, shortcuts, then a smooth spline that is proved clear.

The planner is OMPL's, an extra: `pip install 'sart_toolkit[planning]'`. It is bounded by the edges
that it may check and never by the clock, so that a path follows from the arguments alone, however
busy the machine is.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import BSpline

from sart_toolkit.collision.certificate import Certificate, certify
from sart_toolkit.collision.model import PlacedModel, gap_text
from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.errors import InvalidInput, MissingExtra, MotionRejected, Unreachable
from sart_toolkit.motion.path import PolylinePath, SplinePath
from sart_toolkit.motion.timing import Motion, timed
from sart_toolkit.poses import Array, check_pose, check_positive, distance, interpolate
from sart_toolkit.robots.model import RobotModel

_DEGREE = 5
# Control points of the smooth path. The fewest make the smoothest; the most follow its corners.
_CONTROL_POINTS = (8, 11, 15, 20, 27, 36, 48, 64, 86, 115, 154)
# Distances that may be computed for one edge; some 200 settle most.
_EDGE_CHECKS = 1000
# How near to a joint limit [rad] a path may be planned.
_FROM_LIMIT = 0.01
# Another branch of the arm has some joint farther from the start than this [rad].
_BRANCH = np.pi / 2
_GOAL_SEEDS = 8
# Strides that are measured in each recorded step.
_STRIDES = 3
# What is spared beyond the margin is cut to this where no path is found else.
_NARROW = 0.2


@dataclass(frozen=True)
class PlanConfig:
    """How a path is looked for, and how hard.

    Joints stay within `window` [rad] of the range between start and goal, and within their limits.
    The trees grow by edges of up to `edge` [rad], each proved to keep `spare` [m] beyond the
    margin, or half of what start or goal has beyond it where that is less. Of `attempts` paths
    the shortest is taken, each after `shortcuts` rounds of shortening. After `max_edges` edges no
    further path is looked for. From one recorded step to the next the tool moves no farther than
    `stride` [m] and turns no farther than `stride_deg`, well within a `ToolController`'s lead.
    """

    window: float = 1.2
    edge: float = 0.3
    spare: float = 0.006
    attempts: int = 3
    shortcuts: int = 3
    max_edges: int = 600
    stride: float = 0.016
    stride_deg: float = 4.0

    def __post_init__(self) -> None:
        units = {"window": "rad", "edge": "rad", "spare": "m", "stride": "m", "stride_deg": "deg"}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            check_positive(field.name, value, units.get(field.name, ""))
            if field.name not in units and value != int(value):
                raise InvalidInput(f"{field.name}: expected a whole number, got {value!r}")


def check_planner() -> None:
    """Return if OMPL is installed.

    Raises:
        MissingExtra: it isn't.
    """
    try:
        from ompl import geometric  # noqa: F401
    except ImportError as error:
        raise MissingExtra(
            f"planning needs OMPL ({error}); pip install 'sart_toolkit[planning]'"
        ) from error


def plan_motion(
    placed: PlacedModel,
    q_start: Array,
    T_world_goal: Array,
    duration: float,
    margin: float,
    rng: np.random.Generator,
    config: PlanConfig | None = None,
    record_hz: int = DEFAULT_RATES.record_hz,
) -> tuple[Motion, Certificate]:
    """A motion round obstacles to a tool pose, and the proof that its path is clear.

    See `plan_path` for the path and `timed` for its course in time.

    Args:
        placed: robot and scene.
        q_start: joint configuration `(n,)` at the start.
        T_world_goal: tool pose `(4, 4)` at the end; the arm stays on the start's branch.
        duration: seconds from rest to rest, if the joints' limits and the tool's strides allow.
        margin: clearance [m] to keep, >= 0.
        rng: decides the path.
        config: how it is looked for.
        record_hz: recorded steps a second.

    Raises:
        MissingExtra: OMPL isn't installed.
        InvalidInput: not a configuration or a pose, or a bad duration or margin.
        Unreachable: no configuration on the start's branch reaches the goal.
        MotionRejected: the goal is too close to something, no path is found, or it can't be timed.
    """
    config = config or PlanConfig()
    duration = check_positive("duration", duration, "s")
    check_planner()
    model = placed.kinematics
    goals = _goal_configurations(model, q_start, check_pose("T_world_goal", T_world_goal))
    clear = [q for q in goals if _room(placed, q, margin) >= 0]
    if not clear:
        raise _too_close("sampled pose", placed, goals[0], margin, "use a smaller radius")
    path, certificate = plan_path(placed, q_start, clear[0], margin, rng, config)
    T_at = functools.partial(_tool_pose, model, path)
    motion = timed(model, path, duration, T_at, record_hz)
    excess = _longest_stride(motion, config, record_hz)
    if excess > 1:
        # Ramps don't grow with the duration, so that speeds fall by more than this.
        slower = float(np.ceil(motion.duration * excess * record_hz)) / record_hz
        motion = timed(model, path, slower, T_at, record_hz)
    return motion, certificate


def plan_path(
    placed: PlacedModel,
    q_start: Array,
    q_goal: Array,
    margin: float,
    rng: np.random.Generator,
    config: PlanConfig | None = None,
) -> tuple[SplinePath, Certificate]:
    """A smooth joint path round obstacles, exactly from start to goal, and the proof that it is so.

    RRTConnect (Kuffner and LaValle, ICRA 2000) finds straight joint motions, each of them
    certified; they are shortened, and become the control polygon of a clamped quintic B-spline,
    which is certified as a whole. The fewer control points, the smoother the spline and the more it
    cuts corners: the fewest with which it is clear are taken. Where the straight joint motion is
    clear it is the path.

    Args:
        placed: robot and scene.
        q_start: joint configuration `(n,)` at the start.
        q_goal: joint configuration `(n,)` at the end.
        margin: clearance [m] to keep, >= 0.
        rng: decides the path, which doesn't depend on what was planned before.
        config: how it is looked for.

    Raises:
        MissingExtra: OMPL isn't installed.
        InvalidInput: the margin is negative, or not a configuration within limits.
        MotionRejected: start or goal is closer than the margin to something, or no path is found.
    """
    check_planner()
    config = config or PlanConfig()
    model = placed.kinematics
    start, goal = model.check_limits(q_start), model.check_limits(q_goal)
    rooms = [_room(placed, q, margin) for q in (start, goal)]
    if rooms[0] < 0:
        raise _too_close("start", placed, start, margin, "start elsewhere")
    if rooms[1] < 0:
        raise _too_close("goal", placed, goal, margin, "choose another")
    spare = min(config.spare, *(room / 2 for room in rooms))
    for clearance in (margin + spare, margin + _NARROW * spare):
        found = _polylines(placed, start, goal, clearance, rng, config)
        if found:
            shortest = min(found, key=lambda corners: _lengths(model, corners).sum())
            return _smooth(placed, shortest, margin, clearance)
    raise MotionRejected(
        f"no path found: after {2 * config.max_edges} edges; use a smaller radius or other "
        "waypoints"
    )


def _goal_configurations(model: RobotModel, q_start: Array, T_world_goal: Array) -> list[Array]:
    """Joint configurations `(n,)` on the start's branch that reach a pose, the nearest first.

    Inverse kinematics starts from the start, and from poses on the straight line to the goal.

    Raises:
        Unreachable: there are none.
    """
    start = model.check_limits(q_start)
    T_world_start = model.fk(start)
    seeds, refused = [start], None
    for s in np.arange(1, _GOAL_SEEDS) / _GOAL_SEEDS:
        with contextlib.suppress(Unreachable):
            seeds.append(model.ik(interpolate(T_world_start, T_world_goal, float(s)), seeds[-1]))
    found: list[Array] = []
    for seed in seeds:
        try:
            q = model.ik(T_world_goal, seed)
        except Unreachable as error:
            refused = error
            continue
        new = all(np.abs(q - other).max() > 1e-3 for other in found)
        if new and np.abs(q - start).max() <= _BRANCH:
            found.append(q)
    if not found:
        raise refused or Unreachable(
            "goal: only another branch of the arm reaches it; choose a pose nearer to the start"
        )
    return sorted(found, key=lambda q: float(np.linalg.norm(q - start)))


def _tool_pose(model: RobotModel, path: SplinePath, s: float) -> Array:
    return model.fk(path.positions(np.array([s]))[0])


def _longest_stride(motion: Motion, config: PlanConfig, record_hz: int) -> float:
    """The tool's longest stride during one recorded step, as a share of what is allowed."""
    period, largest = 1 / record_hz, np.deg2rad(config.stride_deg)
    ends = np.append(np.arange(period, motion.duration, period / _STRIDES), motion.duration)
    strides = [
        distance(motion.T_world_tool(end - period), motion.T_world_tool(end)) for end in ends
    ]
    return max(max(far / config.stride, turn / largest) for far, turn in strides)


def _room(placed: PlacedModel, q: Array, margin: float) -> float:
    """How much farther [m] than the margin the nearest pair at `q` is apart.

    Raises:
        InvalidInput: the margin is negative or not finite.
    """
    if not (np.isfinite(margin) and margin >= 0):
        raise InvalidInput(f"margin: expected a finite number >= 0 m, got {margin}")
    nearest = placed.nearest(q)
    return np.inf if nearest is None else nearest.distance - margin


def _too_close(
    what: str, placed: PlacedModel, q: Array, margin: float, remedy: str
) -> MotionRejected:
    """The error that names the nearest pair at `q` and its distance."""
    nearest = placed.nearest(q)
    assert nearest is not None
    apart = gap_text(nearest.distance, margin)
    return MotionRejected(f"{what} too close {nearest.a} / {nearest.b}: {apart}; {remedy}")


def _polylines(
    placed: PlacedModel,
    start: Array,
    goal: Array,
    clearance: float,
    rng: np.random.Generator,
    config: PlanConfig,
) -> list[Array]:
    """Up to `attempts` paths as corners `(m, n)`, all edges proved clear; none if none is found.

    They share `max_edges` among them.
    """
    straight = np.array([start, goal])
    if certify(placed, PolylinePath(straight), clearance).verdict == "free":
        return [straight]
    found: list[Array] = []
    left = config.max_edges
    for _ in range(config.attempts):
        seed = int(rng.integers(1, 2**31))
        corners, checked = _connected(placed, start, goal, clearance, seed, left, config)
        if corners is not None:
            found.append(corners)
        left -= checked
        if left <= 0:
            break
    return found


def _connected(
    placed: PlacedModel,
    start: Array,
    goal: Array,
    clearance: float,
    seed: int,
    max_edges: int,
    config: PlanConfig,
) -> tuple[Array | None, int]:
    """The corners `(m, n)` of one path from RRTConnect, shortened, and how many edges were checked.

    It gives up after `max_edges`, without a path.
    """
    from ompl import base, geometric, util

    n, model = len(start), placed.kinematics
    checked = 0

    def clear(state: Any) -> bool:
        return placed.too_close(np.array(state[0:n]), clearance) is None

    class Edges(base.MotionValidator):
        """Takes an edge if it is proved clear: faster than many checks along it, and safer."""

        def checkMotion(self, a: Any, b: Any) -> bool:
            nonlocal checked
            checked += 1
            edge = PolylinePath(np.array([a[0:n], b[0:n]]))
            return certify(placed, edge, clearance, _EDGE_CHECKS).verdict == "free"

    low, high = np.minimum(start, goal), np.maximum(start, goal)
    # Start and goal themselves may be nearer to a limit.
    low = np.minimum(low, np.maximum(low - config.window, model.lower + _FROM_LIMIT))
    high = np.maximum(high, np.minimum(high + config.window, model.upper - _FROM_LIMIT))
    bounds = base.RealVectorBounds(n)
    for j in range(n):
        bounds.setLow(j, float(low[j]))
        bounds.setHigh(j, float(high[j]))
    with _seeded(util, seed):
        space = base.RealVectorStateSpace(n)
        space.setBounds(bounds)
        information = base.SpaceInformation(space)
        information.setStateValidityChecker(clear)
        information.setMotionValidator(Edges(information))
        information.setup()
        problem = base.ProblemDefinition(information)
        ends = space.allocState(), space.allocState()
        for state, q in zip(ends, (start, goal), strict=True):
            state[0:n] = q.tolist()
        problem.setStartAndGoalStates(*ends)
        planner = geometric.RRTConnect(information)
        planner.setProblemDefinition(problem)
        planner.setRange(config.edge)
        planner.setup()
        given_up = base.PlannerTerminationCondition(lambda: checked >= max_edges)
        if planner.solve(given_up).getStatus() != base.PlannerStatus.EXACT_SOLUTION:
            return None, checked
        path = problem.getSolutionPath()
        simplifier = geometric.PathSimplifier(information)
        for _ in range(config.shortcuts):
            simplifier.reduceVertices(path)
            simplifier.partialShortcutPath(path)
        corners = np.array([path.getState(i)[0:n] for i in range(path.getStateCount())])
    return corners, checked


@contextlib.contextmanager
def _seeded(util: Any, seed: int) -> Iterator[None]:
    """All random numbers of OMPL objects that are made inside follow from the seed; it is quiet.

    OMPL complains that a second seed comes too late, which is so for objects made before only:
    each takes its own seed from one generator when it is made, and that is seeded again.
    """
    level = util.getLogLevel()
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(seed)
    try:
        yield
    finally:
        util.setLogLevel(level)


def _lengths(model: RobotModel, corners: Array) -> Array:
    """Lengths `(m - 1,)` of a path's edges in seconds at the joints' greatest velocities."""
    return np.linalg.norm(np.diff(corners, axis=0) / model.spec.velocity_limits, axis=1)


def _smooth(
    placed: PlacedModel, corners: Array, margin: float, clearance: float
) -> tuple[SplinePath, Certificate]:
    """The smoothest spline along a path whose edges keep `clearance`, and its certificate.

    It keeps half of what they keep beyond the margin, if it can: what measures the path that is
    executed should find some room.

    Raises:
        MotionRejected: none can be proved to keep the margin.
    """
    lengths = _lengths(placed.kinematics, corners)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    at = at / at[-1] if at[-1] > 0 else np.linspace(0.0, 1.0, len(at))
    for wanted in ((margin + clearance) / 2, margin):
        for count in _CONTROL_POINTS:
            inner = np.linspace(0.0, 1.0, count - _DEGREE + 1)
            knots = np.concatenate([np.zeros(_DEGREE), inner, np.ones(_DEGREE)])
            # With control points at these, the knots' averages, a straight line is run through at
            # even speed.
            averages = sliding_window_view(knots[1:-1], _DEGREE).mean(1)
            control = np.stack([np.interp(averages, at, joint) for joint in corners.T], 1)
            path = SplinePath(BSpline(knots, control, _DEGREE))
            certificate = certify(placed, path, wanted)
            if certificate.verdict == "free":
                return path, dataclasses.replace(certificate, margin=margin)
    pair = " / ".join(certificate.pair)
    raise MotionRejected(
        f"no path found: none that is smooth keeps clear of {pair}; use a smaller radius"
    )
