"""The hardware backend over an emulated UR5e with its gripper and camera."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sart_toolkit.backends import get_backend
from sart_toolkit.backends.hardware import (
    ForceHardwareBackend,
    HardwareBackend,
    cell_backend,
    without_motion,
)
from sart_toolkit.backends.interface import SensesForce
from sart_toolkit.data.storage import load_demonstration
from sart_toolkit.errors import InvalidInput, MissingFile, RobotStopped
from sart_toolkit.hardware.cell import Cell, Limits, Part, Workspace
from sart_toolkit.hardware.robotiq import RobotiqSocket
from sart_toolkit.pipeline import check_names, record
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.spec import SceneSpec
from sart_toolkit.testing.emulated import (
    FAULTS,
    EmulatedBackend,
    EmulatedCamera,
    EmulatedWorld,
    Emulation,
)

EMPTY = SceneSpec(())
ROBOT = get_robot("ur5e_2f85")
PERIOD = 1 / 30


@pytest.fixture(scope="module")
def model():
    return RobotModel(ROBOT)


@pytest.fixture(scope="module")
def shared_world():
    world = EmulatedWorld(ROBOT, EMPTY, 32, Emulation(seed=1))
    yield world
    world.close()


@pytest.fixture
def world(shared_world):
    """The arm at home, all being well, nothing noted yet."""
    shared_world.forget_faults()
    shared_world.reset(EMPTY.initial_state(ROBOT.home, 0.0))
    shared_world.calls.clear()
    shared_world.sent.clear()
    return shared_world


def box(model, half=0.6, **given):
    p = model.fk(ROBOT.home)[:3, 3]
    return Limits(Workspace(p - half, p + half), **{"speed_scale": 1.0, **given})


@pytest.fixture
def connect(world, model):
    """Makes backends on the world's cell, closed at the end."""
    made = []

    def make(kind=ForceHardwareBackend, **given):
        cell = world.cell(box(model, **given))
        kind = type("Made", (kind,), {"cell": cell, "clock": staticmethod(world.now)})
        made.append(kind(ROBOT, EMPTY, 32))
        return made[-1]

    yield make
    for backend in made:
        backend.close()


def sway(backend, periods, first=0, amplitude=0.2):
    """Move the arm to and fro, and the gripper."""
    for i in range(first, first + periods):
        t = (i + np.arange(1, 9) / 8) * PERIOD
        rows = ROBOT.home + amplitude * np.sin(t)[:, None] ** 3 * np.ones(6)
        backend.command(rows, 0.5 * (i > 5))
        backend.step()


# --- what it measures and how it moves ----------------------------------------------------------


def test_it_goes_where_it_is_commanded_and_tells_where_it_was(connect, world, model):
    backend = connect()
    sway(backend, 30)
    for _ in range(30):
        backend.command(backend.robot.home + 0.2 * np.sin(1.0) ** 3, 0.5)
        backend.step()
    seen = backend.observe()
    np.testing.assert_allclose(seen.q, ROBOT.home + 0.2 * np.sin(1.0) ** 3, atol=1e-3)
    np.testing.assert_allclose(seen.T_world_tool, model.fk(seen.q))
    assert seen.gripper == pytest.approx(0.5, abs=0.02) and np.abs(seen.dq).max() < 1e-3
    assert seen.time == pytest.approx(2.0, abs=0.1)
    np.testing.assert_array_equal(seen.joint_path[-1], seen.q)
    assert len(seen.joint_path) > 100
    assert backend.force() < 5


@pytest.mark.parametrize("rate_hz", [125, 500])
def test_what_is_sent_keeps_velocity_acceleration_jerk_step_and_workspace(model, rate_hz):
    """Also where commands jump about, and lead out of the workspace."""
    world = EmulatedWorld(ROBOT, EMPTY, 32, Emulation(rate_hz))
    cell = world.cell(box(model, half=0.06, most_lag=1.0))
    body = {"cell": cell, "clock": staticmethod(world.now)}
    backend = type("Made", (ForceHardwareBackend,), body)(ROBOT, EMPTY, 32)
    rng, q = np.random.default_rng(0), ROBOT.home
    for _ in range(60):
        wanted = q + rng.uniform(-0.012, 0.012, 6)
        q = backend.command(wanted, 0.0).q
        backend.step()
    backend.close()
    rows = np.array([q for _, q in world.sent])
    world.close()
    assert len(rows) > rate_hz
    for order, limit in enumerate(
        (ROBOT.velocity_limits, ROBOT.acceleration_limits, ROBOT.jerk_limits), 1
    ):
        found = np.abs(np.diff(rows, order, axis=0)) * rate_hz**order
        assert (found <= limit * (1 + 1e-6)).all()
    assert max(cell.limits.workspace.outside(model.fk(q)[:3, 3]) for q in rows) <= 0


def test_at_a_tenth_of_its_speed_time_passes_as_much_slower(connect, world):
    backend = connect(speed_scale=0.1)
    before = world.time
    sway(backend, 3)
    # All but what is sent ahead.
    ahead = backend.cell.control.buffer
    assert world.time - before == pytest.approx(1.0 - 10 * ahead, abs=0.05)
    assert backend.observe().time == pytest.approx(0.1 - ahead, abs=0.01)


def test_a_jump_is_refused_before_it_is_sent(connect, world):
    backend = connect()
    with pytest.raises(InvalidInput, match="shoulder_pan_joint would jump by 0.500 rad"):
        backend.command(ROBOT.home + [0.5, 0, 0, 0, 0, 0], 0.0)
    assert world.sent == []


def test_at_the_border_of_its_workspace_it_stays_and_may_come_back(connect, model):
    backend = connect(half=0.06)
    q, held = ROBOT.home.copy(), False
    for _ in range(60):
        sent = backend.command(q + [0.02, 0, 0, 0, 0, 0], 0.0).q
        held = held or np.array_equal(sent, q)
        q = sent
        backend.step()
    assert held
    back = backend.command(q - [0.02, 0, 0, 0, 0, 0], 0.0).q
    assert back[0] < q[0]


def test_an_image_is_of_the_moment_that_all_of_an_observation_tells(connect, world, model):
    backend = connect()
    sway(backend, 35)
    seen = backend.observe(("wrist",))
    view, camera = seen.cameras["wrist"], backend.cameras["wrist"]
    assert view.rgb.shape == (32, 32, 3) and (view.depth > 0).any()
    T = model.fk(seen.q, camera.frame) @ camera.T_frame_camera
    np.testing.assert_allclose(view.T_world_camera, T, atol=1e-9)
    # Where the arm really was then, not where it is now.
    now = world.observe().q
    assert np.abs(seen.q - now).max() > 1e-3
    assert 0.02 < backend.delays["wrist"] < 0.09


def test_nothing_is_taken_over_and_nothing_moves_without_motion(connect, world):
    backend = connect(without_motion(ForceHardwareBackend))
    sway(backend, 3)
    backend.observe(("wrist",))
    backend.close()
    called = {call.name for call in world.calls}
    assert not {"RTDEControlInterface", "servoJ"} & called and "receive.disconnect" in called
    np.testing.assert_array_equal(world.q, ROBOT.home)
    assert world.gripper_target == 0.0


def test_a_backend_senses_force_if_its_arm_does():
    limits = Limits(Workspace(-np.ones(3), np.ones(3)))
    assert issubclass(cell_backend(Cell("r", Part("arm", "ur_rtde"), limits)), SensesForce)
    lerobot = cell_backend(Cell("r", Part("arm", "lerobot"), limits))
    assert issubclass(lerobot, HardwareBackend) and not issubclass(lerobot, SensesForce)
    assert lerobot.no_images and lerobot.tracking_error == limits.tracking_error


def test_a_cell_s_file_names_a_backend(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(
        'robot = "ur5e_2f85"\n[arm]\ndriver = "ur_rtde"\nhost = "h"\n'
        "[limits]\nworkspace = { low = [0, 0, 0], high = [1, 1, 1] }\n"
    )
    check_names(backend=str(path))
    assert get_backend(str(path)).cell.robot == "ur5e_2f85"
    with pytest.raises(MissingFile, match="no such file"):
        check_names(backend=str(tmp_path / "other.toml"))


# --- what goes wrong ----------------------------------------------------------------------------

ARM_CALLS = (
    "RTDEReceiveInterface", "RTDEControlInterface", "isConnected", "getActualQ", "getActualQd",
    "getActualTCPForce", "getTimestamp", "getRobotMode", "getSafetyMode", "setWatchdog",
    "zeroFtSensor", "servoJ", "kickWatchdog", "waitPeriod", "initPeriod", "servoStop",
    "stopScript", "control.disconnect", "receive.disconnect",
)  # fmt: skip


@pytest.mark.parametrize("moment", ["from the start", "while it moves"])
@pytest.mark.parametrize("call", ARM_CALLS)
def test_whichever_call_of_the_arm_raises_it_is_stopped_and_disconnected(
    connect, world, call, moment
):
    if moment == "from the start":
        world.inject(f"raise:{call}", world.time)
        world.advance(0.01)
    ending = call in ("servoStop", "stopScript", "control.disconnect", "receive.disconnect")
    try:
        backend = connect()
        if moment == "while it moves":
            world.inject(f"raise:{call}", world.time + 0.3)
        sway(backend, 20)
        backend.close()
        starting = ("RTDEReceiveInterface", "RTDEControlInterface", "setWatchdog", "zeroFtSensor")
        assert ending or (moment == "while it moves" and call in starting)
    except RobotStopped as error:
        assert not ending and f"{call}: emulated failure" in str(error)
    called = [each.name for each in world.calls]
    if "RTDEControlInterface" in called and call != "RTDEControlInterface":
        assert {"servoStop", "stopScript", "control.disconnect"} <= set(called)


@pytest.mark.parametrize(
    ("part", "call"),
    [
        *((RobotiqSocket, name) for name in ("connect", "start", "move", "position", "disconnect")),
        *((EmulatedCamera, name) for name in ("connect", "newest", "read", "disconnect")),
    ],
)
def test_whichever_call_of_gripper_or_camera_raises_the_arm_is_stopped_and_all_disconnected(
    connect, world, monkeypatch, part, call
):
    raised, once = [], getattr(part, call)

    def fail(*args):
        raised.append(world.time)
        if call == "disconnect":
            once(*args)
        raise OSError("emulated failure")

    monkeypatch.setattr(part, call, fail)
    with pytest.raises(RobotStopped, match="emulated failure") as info:
        backend = connect()
        sway(backend, 10)
        backend.observe(("wrist",))
        backend.close()
        # What fails at the end keeps nobody from ending.
        raise RobotStopped("emulated failure at the end")
    assert raised and ("at the end" in str(info.value)) == (call == "disconnect")
    called = list(world.calls)
    if any(each.name == "RTDEControlInterface" for each in called):
        stop = next(each for each in called if each.name == "servoStop")
        assert call == "disconnect" or stop.time - raised[0] <= PERIOD


@pytest.mark.parametrize("kind", FAULTS)
@pytest.mark.parametrize("moment", [0.31, 0.5017])
def test_a_fault_stops_the_robot_within_a_control_period_and_it_can_be_used_again(
    connect, world, wait_until, kind, moment
):
    backend = connect()
    sway(backend, 3)
    fault = world.time + moment
    world.inject(kind, fault)
    with pytest.raises(RobotStopped, match="then type the same command again"):
        sway(backend, 60, first=3)
    assert stopped_at(world) - fault <= limit_of(kind, backend)
    with pytest.raises(RobotStopped):
        backend.step()
    backend.close()
    world.advance(0.5)
    before = world.q.copy()
    world.advance(0.2)
    np.testing.assert_array_equal(world.q, before)
    wait_until(lambda: world.connections == 0)
    # A person sees to it, and the same command resumes.
    world.reset(EMPTY.initial_state(ROBOT.home, 0.0))
    again = connect()
    sway(again, 5)


def stopped_at(world):
    """When the arm was sent its last target [s]."""
    return world.sent[-1][0]


def limit_of(kind, backend):
    """How late [s] the last target may be: a control period, but for what only silence tells."""
    control = backend.cell.control
    late = {"camera_frozen": control.camera_silence, "arm_frozen": control.silence}.get(kind, 0.0)
    return PERIOD + late + 1 / control.rate_hz


def test_what_was_recorded_until_the_robot_stopped_is_kept(tmp_path):
    made = []

    class Breaking(EmulatedBackend):
        def __init__(self, *args):
            super().__init__(*args)
            made.append(self.world)
            self.world.inject("protective_stop", self.world.time + 1.0)

    with pytest.raises(RobotStopped, match="protective stop; see what it touched"):
        record("peg_in_hole", tmp_path / "demo.h5", backend=Breaking, cameras=(), image_size=32)
    assert not (tmp_path / "demo.h5").exists()
    kept = load_demonstration(tmp_path / "demo.stopped.h5")
    assert 8 <= len(kept) <= 12
    np.testing.assert_allclose(kept.timestamps[-1], 0.1 * (len(kept) - 1), atol=0.05)


def test_a_closed_backend_moves_nothing(connect, world):
    backend = connect()
    backend.close()
    backend.close()
    with pytest.raises(RobotStopped, match="closed"):
        backend.step()
    assert "servoJ" not in {call.name for call in world.calls}


def test_a_limit_of_force_stops_it(connect, world):
    backend = connect(force=20.0)
    assert dataclasses.asdict(backend.cell.limits)["force"] == 20.0
    world.inject("contact", world.time + 0.2)
    with pytest.raises(RobotStopped, match="100 N at the tool, expected at most 20 N"):
        sway(backend, 20)
