"""A hand moves the emulated arm while it records; however that ends, the arm is held again."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sart_toolkit.annotate.suggest import SuggestConfig, suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.augment.planner import world_of
from sart_toolkit.backends.hardware import HardwareBackend
from sart_toolkit.cli import main
from sart_toolkit.collision.sensor import CloudConfig
from sart_toolkit.data.storage import load_demonstration
from sart_toolkit.errors import InvalidInput, MissingCapability, RobotStopped
from sart_toolkit.hardware.cell import Workspace
from sart_toolkit.pipeline import record
from sart_toolkit.poses import apply_motion, distance
from sart_toolkit.record.checks import check_recording
from sart_toolkit.record.desk import RecordingDesk
from sart_toolkit.record.devices.hand_guiding import HandGuiding
from sart_toolkit.record.devices.manual import Control
from sart_toolkit.record.session import (
    DeviceSetup,
    End,
    SessionConfig,
    SessionState,
    TeleopSession,
)
from sart_toolkit.tasks.task import Placement
from sart_toolkit.testing.emulated import FAULTS, EmulatedBackend

GUIDED = SessionConfig(cameras=("wrist",), guided=True)
PERIOD = 1 / 30


@pytest.fixture(scope="module")
def hand(peg_demonstration):
    """Where a hand leads the joints: as the scripted operator went."""
    steps, times = peg_demonstration.steps, peg_demonstration.timestamps
    return lambda t: np.array([np.interp(t, times, q) for q in steps.joint_positions.T])


@pytest.fixture
def kind(peg_task, peg_model):
    """Emulated cells at the task's start."""
    start = peg_task.initial_state(peg_model, Placement())
    return type("Cell", (EmulatedBackend,), {"start": start})


@pytest.fixture
def guided(kind, peg_task, peg_model, hand):
    """Backend, desk and what was saved at it; a hand holds the arm."""
    backend = kind(peg_model.spec, peg_task.scene, 48)
    backend.world.guide(hand)
    setup = DeviceSetup(backend, peg_task, peg_model, backend.start, np.random.default_rng(0))
    device, saved = HandGuiding(setup), []
    device.connect()
    desk = RecordingDesk(TeleopSession(backend, peg_task, peg_model, config=GUIDED), device,
                         saved.append)  # fmt: skip
    yield backend, desk, saved
    backend.close()


def names(world):
    return [call.name for call in world.calls]


def ticks(desk, seconds):
    for _ in range(round(seconds / PERIOD)):
        desk.tick()


def test_what_the_hand_did_becomes_measured_and_commanded_poses_and_commands(
    guided, hand, peg_demonstration, peg_model
):
    backend, desk, saved = guided
    desk.press(Control.NEXT)
    began = backend.world.time
    ticks(desk, 1.5)
    desk.device.key("space", True)
    ticks(desk, 1.5)
    # In real time.
    assert backend.world.time - began == pytest.approx(3.0, abs=0.02)
    for _ in range(2):
        desk.press(Control.NEXT)
    (demo,) = saved
    assert demo.device == "hand_guiding" and demo.judged_by == "person"
    steps, n = demo.steps, len(demo)
    np.testing.assert_allclose(np.diff(demo.timestamps), 0.1, atol=0.01)
    # Where the arm was led, late by what the emulated arm lags behind the hand.
    for commanded, t in zip(steps.commanded_joint_positions, demo.timestamps, strict=True):
        led = [hand(t + late) for late in np.linspace(-0.1, 0.02, 25)]
        assert min(np.abs(commanded - q).max() for q in led) < 2e-3
    assert distance(steps.commanded_Ts_world_tool[0], steps.commanded_Ts_world_tool[-1])[0] > 0.05
    # What was measured is of the image's moment, a little before.
    for t in range(n):
        measured, commanded = steps.measured_Ts_world_tool[t], steps.commanded_Ts_world_tool[t]
        assert distance(measured, commanded)[0] < 0.015
        T = peg_model.fk(steps.commanded_joint_positions[t])
        np.testing.assert_allclose(T, commanded, atol=1e-9)
    # Its commands, one a control period, lead from each commanded pose to the next.
    assert len(demo.raw_commands) == 3 * (n - 1)
    T = steps.commanded_Ts_world_tool[0]
    for i, row in enumerate(demo.raw_commands, 1):
        T = apply_motion(T, row[:6] * PERIOD)
        if i % 3 == 0:
            np.testing.assert_allclose(T, steps.commanded_Ts_world_tool[i // 3], atol=1e-8)
    assert steps.commanded_gripper[0] > 0.6 and steps.commanded_gripper[-1] == 0.0
    assert backend.world.gripper_target == 0.0


def test_the_arm_is_free_while_it_records_and_held_whenever_it_does_not(guided):
    backend, desk, _ = guided
    world, session = backend.world, desk.session
    assert not world.free
    desk.press(Control.NEXT)
    ticks(desk, 0.3)
    assert world.free and "servoJ" not in names(world)
    session.pause()
    assert not world.free and names(world).count("endTeachMode") == 1
    before = world.q.copy()
    # It answers to targets again, from where it is.
    for _ in range(5):
        backend.command(backend._target, 0.0)
        backend.step()
    np.testing.assert_allclose(world.q, before, atol=2e-3)
    desk.press(Control.NEXT)
    ticks(desk, 0.3)
    assert world.free
    desk.press(Control.REDO)
    assert not world.free and session.state is SessionState.READY and session.seconds == 0.0
    desk.press(Control.NEXT)
    ticks(desk, 0.3)
    desk.press(Control.NEXT)
    assert session.state is SessionState.ENDED and not world.free


@pytest.mark.parametrize("kind_of_fault", sorted({*FAULTS} - {"contact"}))
def test_a_fault_while_guided_ends_freedrive_and_keeps_what_was_recorded(guided, kind_of_fault):
    """Protective and emergency stop, a lost or silent arm, a lost camera or gripper."""
    backend, desk, saved = guided
    world, control = backend.world, backend.cell.control
    desk.press(Control.NEXT)
    ticks(desk, 0.5)
    fault = world.time + 0.21
    world.inject(kind_of_fault, fault)
    ticks(desk, 1.5)
    session = desk.session
    assert session.state is SessionState.ENDED and session.end is End.ROBOT_STOPPED
    late = {"camera_frozen": control.camera_silence, "arm_frozen": control.silence}
    ended = next(call.time for call in world.calls if call.name == "endTeachMode")
    assert ended - fault <= PERIOD + late.get(kind_of_fault, 0.0) + 1 / control.rate_hz
    # An arm that can't be asked any more ends it by its watchdog.
    world.advance(2 / 25)
    assert not world.free
    desk.press(Control.NEXT)
    (demo,) = saved
    assert 5 <= len(demo) <= 12 and len(demo.raw_commands) == 3 * (len(demo) - 1)


CALLS = (
    "isConnected", "getActualQ", "getTimestamp", "getSafetyMode", "kickWatchdog", "waitPeriod",
    "initPeriod", "teachMode", "endTeachMode", "servoStop", "stopScript", "control.disconnect",
)  # fmt: skip


@pytest.mark.parametrize("moment", ["from the start", "while it is guided"])
@pytest.mark.parametrize("call", CALLS)
def test_whichever_call_raises_while_guided_freedrive_is_ended(guided, call, moment):
    backend, desk, _ = guided
    world = backend.world
    world.inject(f"raise:{call}", world.time + 0.3 * (moment != "from the start"))
    desk.press(Control.NEXT)
    ticks(desk, 0.8)
    if desk.session.state is SessionState.RECORDING:
        desk.press(Control.NEXT)
    # The world goes on.
    HardwareBackend.close(backend)
    called = names(world)
    assert {"servoStop", "stopScript", "control.disconnect"} <= set(called)
    assert ("teachMode" in called) == ("endTeachMode" in called)
    world.advance(2 / 25)
    assert not world.free


@pytest.mark.parametrize("ending", [KeyboardInterrupt, SystemExit, ZeroDivisionError])
def test_ctrl_c_and_errors_end_freedrive(kind, tmp_path, hand, ending):
    worlds = []

    def steer(out, setup, device, placement, config):
        backend = setup.backend
        worlds.append(backend.world)
        session = TeleopSession(backend, setup.task, setup.model, placement, config)
        session.start()
        backend.world.guide(hand)
        for _ in range(10):
            session.advance(device.read(session.observation))
        assert backend.world.free
        raise ending

    with pytest.raises(ending):
        record("peg_in_hole", tmp_path / "demo.h5", backend=kind, device="hand_guiding",
               image_size=32, steer=steer)  # fmt: skip
    (world,) = worlds
    assert not world.free
    assert names(world)[-5:] == [
        "endTeachMode", "servoStop", "stopScript", "control.disconnect", "receive.disconnect",
    ]  # fmt: skip


def test_a_backend_that_is_forgotten_ends_freedrive(kind, peg_task, peg_model):
    backend = kind(peg_model.spec, peg_task.scene, 32)
    world = backend.world
    backend.guide()
    backend.step()
    assert world.free
    del backend
    assert not world.free and "endTeachMode" in names(world)
    world.close()


def test_a_hand_that_leaves_where_commands_may_lead_stops_the_recording(
    kind, peg_task, peg_model, hand
):
    bottom = peg_model.fk(kind.start.q)[2, 3] - 0.04
    workspace = Workspace(np.array([-2.0, -2.0, bottom]), np.array([2.0, 2.0, 2.0]))
    limits = dataclasses.replace(EmulatedBackend.limits, workspace=workspace)
    backend = type("Narrow", (kind,), {"limits": limits})(peg_model.spec, peg_task.scene, 32)
    backend.world.guide(hand)
    backend.guide()
    with pytest.raises(RobotStopped, match="guided [0-9]+ mm past where commands end, 20 mm in"):
        for _ in range(150):
            backend.step()
    assert not backend.world.free
    backend.close()


def test_a_hand_is_not_slowed_down_by_the_cell_s_speed(kind, peg_task, peg_model, hand):
    limits = dataclasses.replace(EmulatedBackend.limits, speed_scale=0.1)
    backend = type("Slow", (kind,), {"limits": limits})(peg_model.spec, peg_task.scene, 32)
    backend.world.guide(hand)
    backend.command(backend.observe().q, 0.0)
    backend.step()
    seen, began = backend.observe().time, backend.world.time
    backend.guide()
    for _ in range(30):
        backend.step()
    assert backend.world.time - began == pytest.approx(1.0, abs=0.02)
    there = backend.observe()
    assert there.time - seen == pytest.approx(1.0, abs=0.02)
    assert np.abs(there.dq).max() < 2.0
    backend.hold()
    began = backend.world.time
    for _ in range(3):
        backend.command(backend.observe().q, 0.0)
        backend.step()
    assert backend.world.time - began > 0.6
    assert backend.observe().time - there.time == pytest.approx(0.1, abs=0.05)
    backend.close()


def test_only_an_arm_that_lets_itself_be_guided_is(peg_setup, peg_task, peg_model, peg_backend):
    with pytest.raises(MissingCapability, match="lacks the ability Guides.*by hand"):
        HandGuiding(peg_setup)
    with pytest.raises(MissingCapability, match="lacks the ability Guides.*guide its arm"):
        TeleopSession(peg_backend, peg_task, peg_model, config=GUIDED)


def test_directions_mean_nothing_to_a_hand(guided, kind, tmp_path):
    device = guided[1].device
    assert not any(device.key(name, True) for name in ("1", "f", "w"))
    with pytest.raises(InvalidInput, match="--frame: a hand moves the arm itself"):
        record("peg_in_hole", tmp_path / "demo.h5", backend=kind, device="hand_guiding",
               image_size=32, by_hand=["frame"])  # fmt: skip


@pytest.mark.slow
def test_a_guided_demonstration_is_suggested_and_augmented(
    guided, kind, peg_task, peg_model, tmp_path
):
    backend, desk, saved = guided
    desk.press(Control.NEXT)
    ticks(desk, 5.0)
    for _ in range(2):
        desk.press(Control.NEXT)
    assert peg_task.success(backend.world.observe())
    backend.close()
    (demo,) = saved
    check_recording(demo, peg_model.spec)
    config = AugmentConfig(
        n=3, obstacles="cloud", cloud=CloudConfig(sensor=kind.emulation.sensor), cameras=()
    )
    world = world_of(demo, peg_model.spec, peg_task.scene, config)
    room = SuggestConfig.for_tracking_error(kind.tracking_error)
    found = suggest_annotation(demo, world, config=room)
    annotation = dataclasses.replace(found, spheres=found.spheres[:1])

    dataset = augment_demonstration(
        demo, annotation, lambda: kind(peg_model.spec, peg_task.scene, 48), tmp_path / "dataset",
        config, ask=lambda _: None,
    )  # fmt: skip
    assert dataset.info["n_trajectories"] == 3


def test_it_is_recorded_at_the_command_line(kind, tmp_path, monkeypatch, capsys, hand):
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("sart_toolkit.record.window._SAVED_SHOWN", 0.0)
    pygame.display.init()
    made = []

    class Guided(kind):
        def __init__(self, *args):
            super().__init__(*args)
            self.world.guide(hand)
            made.append(self)

        def step(self):
            super().step()
            # The person's other hand, once the arm has gone some way.
            if self.world.time > 1.0 and not self.pressed:
                self.pressed = True
                press("right", "right", "right")

        pressed = False

    def press(*names):
        for name in names:
            key = pygame.key.key_code(name)
            for kind in (pygame.KEYDOWN, pygame.KEYUP):
                pygame.event.post(pygame.event.Event(kind, key=key))

    monkeypatch.setattr("sart_toolkit.pipeline.make_backend", lambda _, *args: Guided(*args))
    press("right")
    out = tmp_path / "demo.h5"
    main(["record", "peg_in_hole", "--backend", "pybullet", "--device", "hand_guiding",
          "--image-size", "32", "--out", str(out)])  # fmt: skip
    demo = load_demonstration(out)
    assert demo.device == "hand_guiding" and len(demo) > 5
    assert not made[0].world.free
    pygame.display.quit()
