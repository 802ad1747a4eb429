"""What an arm is sent keeps every limit, whatever is asked for; what is wrong stops it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sart_toolkit.errors import RobotStopped
from sart_toolkit.hardware.cell import Cell, Control, Part
from sart_toolkit.hardware.drivers import ArmState
from sart_toolkit.hardware.servo import Servo
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel

from .conftest import limits

MODEL = RobotModel(get_robot("ur5e_2f85"))
HOME = MODEL.spec.home


class Arm:
    """Is at once where it is sent; its time passes with each wait. `raising`: a call that fails."""

    def __init__(self, rate_hz, raising=None):
        self.time, self.period, self.raising = 0.0, 1 / rate_hz, raising
        self.sent, self.calls, self.state = [], [], {}

    def _called(self, name):
        self.calls.append(name)
        if name == self.raising:
            raise OSError("emulated failure")

    def connect(self):
        self._called("connect")

    def start(self):
        self._called("start")

    def read(self):
        self._called("read")
        q = self.sent[-1] if self.sent else HOME
        return ArmState(**{"q": q, "dq": np.zeros(6), "time": self.time, **self.state})

    def servo(self, q, period):
        self._called("servo")
        assert period == self.period
        self.sent.append(q)

    def guide(self):
        self._called("guide")

    def hold(self):
        self._called("hold")

    def wait(self):
        self._called("wait")
        self.time += self.period

    def stop(self):
        self._called("stop")

    def disconnect(self):
        self._called("disconnect")


def make(rate_hz=125, raising=None, half=1.5, **given):
    arm = Arm(rate_hz, raising)
    cell = Cell(
        "ur5e_2f85", Part("arm", "ur_rtde"), limits(MODEL, half, **given), control=Control(rate_hz)
    )
    return arm, Servo(arm, MODEL, cell, lambda: arm.time)


def run(servo, seconds):
    for _ in range(round(seconds / servo._period)):
        servo.tick()


def violations(rows, rate_hz):
    """The greatest finite differences of what was sent, as shares of their limits."""
    spec, rows = MODEL.spec, np.array(rows)
    all_limits = spec.velocity_limits, spec.acceleration_limits, spec.jerk_limits
    return [
        float((np.abs(np.diff(rows, order, axis=0)) * rate_hz**order / limit).max())
        for order, limit in enumerate(all_limits, 1)
    ]


@settings(max_examples=12, deadline=None)
@given(
    st.sampled_from([125, 500]),
    st.sampled_from([1.0, 0.1]),
    st.lists(
        st.tuples(
            st.lists(st.floats(-0.4, 0.4), min_size=6, max_size=6),
            # Late by so much, or not at all.
            st.sampled_from([0.0, 0.0, 0.02, 0.2]),
        ),
        min_size=1,
        max_size=8,
    ),
)
def test_what_is_sent_keeps_velocity_acceleration_and_jerk_whatever_is_asked_for_and_when(
    rate_hz, scale, wanted
):
    """Jumps, kinks and pauses included: at 125 and at 500 Hz, over 0 violations."""
    arm, servo = make(rate_hz, speed_scale=scale, most_lag=10.0)
    servo.start()
    for offsets, late in wanted:
        servo.push(HOME + np.array(offsets)[None], 1 / 30)
        run(servo, 1 / 30 / scale + late)
    run(servo, 3.0)
    assert max(violations(arm.sent, rate_hz)) <= 1 + 1e-6
    # And it comes to a rest where it was sent last.
    np.testing.assert_allclose(arm.sent[-1], HOME + np.array(wanted[-1][0]), atol=1e-9)
    np.testing.assert_array_equal(arm.sent[-1], arm.sent[-2])


@pytest.mark.parametrize("rate_hz", [125, 500])
def test_a_smooth_motion_is_followed_closely_and_a_little_late(rate_hz):
    arm, servo = make(rate_hz)
    servo.start()
    times = np.arange(1, 481) / 240
    rows = HOME + 0.3 * np.sin(times)[:, None] ** 3
    for period in rows.reshape(60, 8, 6):
        servo.push(period, 1 / 30)
    run(servo, 2.3)
    late = np.array(arm.sent)
    at = np.arange(1, len(late) + 1) / rate_hz - 2 / 125
    through = np.concatenate([HOME[None], rows])
    wanted = np.stack([np.interp(at, [0.0, *times], joint) for joint in through.T], axis=1)
    assert np.abs(late - wanted).max() < 5e-3
    assert servo.consumed == pytest.approx(2.0)


def test_at_a_tenth_of_the_speed_the_same_way_takes_ten_times_as_long():
    arm, servo = make(speed_scale=0.1)
    servo.start()
    servo.push(HOME + np.linspace(0, 0.1, 60)[1:, None], 1.0)
    run(servo, 5.0)
    assert servo.consumed == pytest.approx(0.5, abs=0.01)
    run(servo, 6.0)
    np.testing.assert_allclose(arm.sent[-1], HOME + 0.1)


# --- what stops it ------------------------------------------------------------------------------


def push_far(servo, d=0.4):
    servo.push(HOME + np.linspace(0, d, 241)[1:, None], 1.0)


@pytest.mark.parametrize("call", ["start", "read", "servo", "wait"])
def test_whatever_call_raises_the_arm_is_stopped_at_once_and_stays_so(call):
    arm, servo = make(raising=call)
    with pytest.raises(RobotStopped, match="emulated failure; then type the same command again"):
        servo.start()
        push_far(servo)
        run(servo, 1.0)
    assert arm.calls[arm.calls.index(call) + 1] == "stop"
    sent = len(arm.sent)
    with pytest.raises(RobotStopped, match="emulated failure"):
        servo.tick()
    assert len(arm.sent) == sent
    servo.close()
    assert arm.calls[-1] == "disconnect"


def test_a_stop_that_fails_still_disconnects():
    arm, servo = make(raising="stop")
    servo.start()
    servo.close()
    assert arm.calls[-2:] == ["stop", "disconnect"]


@pytest.mark.parametrize(
    ("state", "says"),
    [
        (
            {"trouble": "protective stop; clear the way"},
            "arm: protective stop; clear the way; then",
        ),
        ({"force": 51.0}, "51 N at the tool, expected at most 50 N"),
        ({"force": float("nan")}, "nan N at the tool"),
        ({"time": -1.0}, "its state is .* ms old, expected at most 30 ms"),
        ({"q": np.full(6, np.nan)}, "joints are no numbers"),
        ({"q": HOME - 0.5}, "_joint is 0.5. rad behind what it was sent"),
    ],
)
def test_a_state_in_which_it_must_not_move_stops_it_before_anything_is_sent(state, says):
    arm, servo = make()
    servo.start()
    push_far(servo)
    run(servo, 0.2)
    arm.state, sent = state, len(arm.sent)
    with pytest.raises(RobotStopped, match=says):
        servo.tick()
    assert len(arm.sent) == sent and arm.calls[-1] == "stop"


def test_an_arm_in_trouble_is_not_even_started():
    arm, servo = make()
    arm.state = {"trouble": "emergency stop; release it"}
    with pytest.raises(RobotStopped, match="emergency stop"):
        servo.start()
    assert "servo" not in arm.calls and arm.calls[-1] == "stop"


def test_the_tool_is_never_sent_out_of_the_workspace():
    arm, servo = make(half=0.05)
    servo.start()
    push_far(servo)
    with pytest.raises(RobotStopped, match="the tool would be .* mm outside the workspace"):
        run(servo, 1.0)
    box = servo._limits.workspace
    assert max(box.outside(MODEL.fk(q)[:3, 3]) for q in arm.sent) <= 0
    assert arm.calls[-1] == "stop"


def test_a_target_over_a_limit_would_be_refused(monkeypatch):
    """The last check before an arm is sent something doesn't trust what is before it."""
    arm, servo = make()
    servo.start()
    monkeypatch.setattr(servo, "_next", lambda: HOME + 0.05)
    with pytest.raises(
        RobotStopped, match="target refused: velocity of .*_joint is over its limit"
    ):
        servo.tick()
    assert arm.sent == []


def test_limits_of_a_cell_are_checked_on_their_own():
    spec = dataclasses.replace(limits(MODEL), force=10.0)
    assert spec.workspace.outside(spec.workspace.low) == 0
    assert spec.workspace.outside(spec.workspace.high + 0.1) == pytest.approx(0.1)


# --- guided by hand -----------------------------------------------------------------------------


def test_while_guided_no_target_is_sent_and_what_is_given_takes_its_time():
    arm, servo = make(speed_scale=0.1)
    servo.start()
    servo.push(HOME[None] + 0.01, 1.0)
    run(servo, 0.1)
    sent = len(arm.sent)
    servo.guide()
    arm.state["force"], arm.state["q"] = 400.0, HOME + 0.5
    began = arm.time
    for i in range(1, 31):
        servo.push(HOME[None], 1 / 30)
        end = servo._pushed
        while servo.consumed < end:
            servo.tick()
        assert arm.time - began == pytest.approx(i / 30, abs=1.01 * arm.period)
    assert len(arm.sent) == sent
    # The hand's force is no longer one afterwards, and the motion begins where it left the arm.
    del arm.state["force"]
    assert servo.hold().q[0] == HOME[0] + 0.5
    run(servo, 0.1)
    np.testing.assert_array_equal(arm.sent[sent:], np.repeat(HOME[None] + 0.5, 12, axis=0))


@pytest.mark.parametrize("state", [{"trouble": "protective stop"}, {"time": -1.0}])
def test_what_is_wrong_while_guided_stops_it(state):
    arm, servo = make()
    servo.start()
    servo.guide()
    run(servo, 0.1)
    arm.state |= state
    with pytest.raises(RobotStopped):
        servo.tick()
    assert arm.calls[-1] == "stop"


@pytest.mark.parametrize("raising", ["guide", "hold", "read", "wait"])
def test_whichever_call_raises_while_guided_it_is_stopped(raising):
    arm, servo = make()
    servo.start()
    servo.guide()
    arm.raising = raising
    with pytest.raises(RobotStopped, match="emulated failure"):
        servo.tick()
        servo.hold()
    assert arm.calls[-1] == "stop"
    with pytest.raises(RobotStopped):
        servo.tick()


def test_an_arm_that_a_hand_may_move_is_held_once_nobody_follows_it_any_more():
    arm, servo = make()
    servo.start()
    servo.guide()
    servo.push(HOME[None], 0.5)
    began = arm.time
    with pytest.raises(RobotStopped, match="the program doesn't follow any more"):
        run(servo, 3.0)
    assert 1.4 < arm.time - began < 1.7 and arm.calls[-1] == "stop"
