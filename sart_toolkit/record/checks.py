"""Whether a recording can be learned from: checked when it is made, and when it is read."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from sart_toolkit.data.records import Demonstration
from sart_toolkit.errors import InvalidInput
from sart_toolkit.motion.config import ControllerConfig
from sart_toolkit.poses import Array, check_positive
from sart_toolkit.robots.spec import RobotSpec

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CheckConfig:
    """What a recording must keep to.

    Refused, as what is trained would be wrong: one shorter than `least_seconds` [s]; time between
    two steps that isn't positive, or off the recording's period by `missing` of it or more, so that
    steps are missing; a joint that moves faster than its limit by a factor `over_limit`; a tool, or
    its command, that goes farther in a step than a controller's greatest lead in each of its
    control periods; nothing that moves by more than `still` [m], `still_deg` [deg] or
    `still_gripper`.

    Warned of, as it is only poor: time between steps that is off by `uneven` of the period; a
    command that goes farther in a step than the greatest lead, which no rollout can follow; and
    standing still, within the same bounds, for `idle_seconds` [s] or longer.
    """

    least_seconds: float = 1.0
    missing: float = 0.5
    uneven: float = 0.1
    over_limit: float = 1.05
    still: float = 0.001
    still_deg: float = 0.5
    still_gripper: float = 0.01
    idle_seconds: float = 2.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            check_positive(name, getattr(self, name))


@dataclass(frozen=True)
class Findings:
    """What is wrong with a recording: `problems` forbid learning from it, `warnings` don't."""

    problems: tuple[str, ...]
    warnings: tuple[str, ...]


def inspect_recording(
    demonstration: Demonstration,
    robot: RobotSpec | None = None,
    config: CheckConfig | None = None,
) -> Findings:
    """What is wrong with a recording, each with its figures and where it is.

    Args:
        demonstration: the recording.
        robot: its robot, whose joint velocity limits it is compared with; left out, they aren't.
        config: what it must keep to.
    """
    config = config or CheckConfig()
    problems, warnings = _timing(demonstration, config)
    for found in (_jumps(demonstration, robot, config), _stillness(demonstration, config)):
        problems += found[0]
        warnings += found[1]
    return Findings(tuple(problems), tuple(warnings))


def check_recording(
    demonstration: Demonstration,
    robot: RobotSpec | None = None,
    config: CheckConfig | None = None,
    name: str = "demonstration",
) -> None:
    """Return if a recording can be learned from; what is only poor in it is logged as a warning.

    Args:
        demonstration: the recording.
        robot: its robot, whose joint velocity limits it is compared with; left out, they aren't.
        config: what it must keep to.
        name: what the messages call it.

    Raises:
        InvalidInput: it can't; the message has all that is wrong.
    """
    found = inspect_recording(demonstration, robot, config)
    for warning in found.warnings:
        _log.warning("%s: %s", name, warning)
    if found.problems:
        raise InvalidInput(f"{name}: {'; '.join(found.problems)}; record it again")


_Found = tuple[list[str], list[str]]


def _timing(demonstration: Demonstration, config: CheckConfig) -> _Found:
    """Its length, and whether its steps follow each other at the recording's rate."""
    problems: list[str] = []
    warnings: list[str] = []
    rates, times, n = demonstration.rates, demonstration.timestamps, len(demonstration)
    period = 1.0 / rates.record_hz
    if (n - 1) * period < config.least_seconds - 1e-9:
        problems.append(
            f"has {n} steps, {(n - 1) * period:.1f} s at {rates.record_hz} Hz; a segment to rejoin "
            f"it needs at least {config.least_seconds:g} s"
        )
    gaps = np.diff(times)
    far = np.linalg.norm(
        np.diff(demonstration.steps.commanded_Ts_world_tool[:, :3, 3], axis=0), axis=1
    )
    # A rate that isn't the recording's is one thing to say, not one for each step.
    usual = float(np.median(gaps))
    if usual > 0 and abs(usual / period - 1) >= config.missing:
        problems.append(
            f"its steps are {usual:.3g} s apart, the recording's rate says {period:.3g} s"
        )
        period = usual
    for t in np.flatnonzero(gaps <= 0):
        problems.append(
            f"time doesn't advance between steps {t} and {t + 1}: {times[t]:.3f} s, then "
            f"{times[t + 1]:.3f} s"
        )
    for t in np.flatnonzero((gaps > 0) & (np.abs(gaps / period - 1) >= config.missing)):
        lost = max(0, round(gaps[t] / period) - 1)
        what = f"{_frames(lost)} missing" if lost else "two steps are too close"
        problems.append(
            f"{what} between t={times[t]:.1f} s and {times[t + 1]:.1f} s; an action of "
            f"{1e3 * far[t]:.0f} mm would be trained there"
        )
    off = np.abs(gaps / period - 1)
    uneven = (off >= config.uneven) & (off < config.missing)
    if uneven.any():
        warnings.append(
            f"time advances unevenly: by {gaps[uneven].min():.3f} to {gaps[uneven].max():.3f} s at "
            f"{uneven.sum()} of {n - 1} steps, expected {period:.3f} s"
        )
    periods, expected = len(demonstration.raw_commands), (n - 1) * rates.control_per_record
    if periods and abs(periods - expected) > rates.control_per_record:
        lost = periods // rates.control_per_record + 1 - n
        missing = f": {_frames(lost)} missing" if lost > 0 else ""
        problems.append(
            f"was steered for {periods} control periods, its {n} steps are of {expected}{missing}"
        )
    return problems, warnings


def _frames(n: int) -> str:
    return "1 frame is" if n == 1 else f"{n} frames are"


def _jumps(demonstration: Demonstration, robot: RobotSpec | None, config: CheckConfig) -> _Found:
    """Whether joints and tool go no farther in a step than they can."""
    problems: list[str] = []
    warnings: list[str] = []
    steps, rates, times = demonstration.steps, demonstration.rates, demonstration.timestamps
    if robot is not None and steps.joint_positions.shape[1] == len(robot.velocity_limits):
        most = robot.velocity_limits / rates.record_hz
        moved = np.abs(np.diff(steps.joint_positions, axis=0))
        over = moved / most
        if over.max() > config.over_limit:
            t, joint = divmod(int(over.argmax()), over.shape[1])
            problems.append(
                f"joint {robot.arm_joints[joint]} moves by {moved[t, joint]:.2f} rad between "
                f"t={times[t]:.1f} s and {times[t + 1]:.1f} s, by its limit it can by "
                f"{most[joint]:.2f} rad in a step"
            )
    lead = ControllerConfig()
    for what, Ts in (
        ("the tool moves", steps.measured_Ts_world_tool),
        ("the commanded tool moves", steps.commanded_Ts_world_tool),
    ):
        far = np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1)
        turned = np.rad2deg(_angles(Ts[:-1, :3, :3], Ts[1:, :3, :3]))
        shares = np.maximum(far / lead.max_lead, turned / lead.max_lead_deg)
        t, periods = int(shares.argmax()), rates.control_per_record
        at = (
            f"{what} by {1e3 * far[t]:.0f} mm and {turned[t]:.0f} deg between t={times[t]:.1f} s "
            f"and {times[t + 1]:.1f} s"
        )
        if shares[t] > periods:
            problems.append(
                f"{at}, {1e3 * lead.max_lead * periods:g} mm and {lead.max_lead_deg * periods:g} "
                "deg are the most in a step: frames are missing, or a pose is wrong"
            )
        elif shares[t] > 1 and Ts is steps.commanded_Ts_world_tool:
            warnings.append(
                f"{at} ({int((shares > 1).sum())} steps alike), in a rollout a step leads by "
                f"{1e3 * lead.max_lead:g} mm and {lead.max_lead_deg:g} deg at most; go slower"
            )
    return problems, warnings


def _stillness(demonstration: Demonstration, config: CheckConfig) -> _Found:
    """Whether anything moves at all, and how long it stands still at one go."""
    steps, times, hz = demonstration.steps, demonstration.timestamps, demonstration.rates.record_hz
    n = len(demonstration)
    warnings: list[str] = []
    start = 0
    while start < n - 1:
        moves = np.flatnonzero(_moved(demonstration, start, config))
        end = int(moves[0]) if len(moves) else n - 1
        if start == 0 and not len(moves):
            Ts = steps.measured_Ts_world_tool
            far = np.linalg.norm(Ts[:, :3, 3] - Ts[0, :3, 3], axis=1).max()
            turned = np.rad2deg(_angles(Ts[:1, :3, :3], Ts[:, :3, :3]).max())
            return [
                f"nothing moves: for {n} steps the tool stays within {1e3 * far:.1f} mm and "
                f"{turned:.1f} deg of its start"
            ], []
        # The step to `end` moves, unless the recording ends there.
        still = end - start - (1 if len(moves) else 0)
        if still >= config.idle_seconds * hz - 1e-9:
            where = "at its start" if start == 0 else "" if len(moves) else "at its end"
            warnings.append(
                f"stands still for {still} steps, {still / hz:.1f} s, from t={times[start]:.1f} s"
                + (f", {where}" if where else "")
            )
            start = end
        else:
            start += 1
    return [], warnings


def _moved(demonstration: Demonstration, start: int, config: CheckConfig) -> Array:
    """Whether tool or gripper, measured or commanded, have moved at each step since `start`."""
    steps = demonstration.steps
    moved = np.zeros(len(demonstration), dtype=bool)
    for Ts in (steps.measured_Ts_world_tool, steps.commanded_Ts_world_tool):
        later = Ts[start:]
        far = np.linalg.norm(later[:, :3, 3] - later[0, :3, 3], axis=1)
        turned = np.rad2deg(_angles(later[:1, :3, :3], later[:, :3, :3]))
        moved[start:] |= (far > config.still) | (turned > config.still_deg)
    for gripper in (steps.measured_gripper, steps.commanded_gripper):
        moved[start:] |= np.abs(gripper[start:] - gripper[start]) > config.still_gripper
    return moved


def _angles(a: Array, b: Array) -> Array:
    """The angles [rad] between rotations `(n, 3, 3)`, either of which may be one."""
    cosines = (np.einsum("...ij,...ij->...", a, b) - 1) / 2
    angles: Array = np.arccos(np.clip(cosines, -1.0, 1.0))
    return angles
