"""What only SAPIEN has: its linkage, dry friction, rebuilt physics, and a probe for images."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys

import coal
import numpy as np
import pytest

from sart_toolkit.backends import make_backend
from sart_toolkit.collision.parts import primitive
from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.errors import CannotWrite, InvalidInput, MissingCapability, SartError
from sart_toolkit.poses import distance, interpolate, pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Attachment, Shape
from sart_toolkit.scenes.spec import Body, Detent, Joint, SceneSpec
from sart_toolkit.workers import worker_map

pytest.importorskip("sapien")

from sart_toolkit.backends import sapien_renderer
from sart_toolkit.backends.sapien import SapienBackend

ROBOTS = ("ur5e_2f85", "ur5e_hande")
BOX_HEIGHT, BOX_MASS = 0.06, 1.0


def _upright(robot):
    """The tool's pose at home, and a frame below it: z up, y along which the fingers close."""
    T_tool = RobotModel(robot).fk(robot.home)
    T = np.eye(4)
    T[:3, 1] = T_tool[:3, 0]
    T[:3, 0] = np.cross(T[:3, 1], T[:3, 2])
    T[:2, 3] = T_tool[:2, 3]
    return T_tool, T


def _grasp_scene(robot) -> SceneSpec:
    """A table, and on it a box of 1 kg between the open fingers; a drawer aside."""
    _, T = _upright(robot)
    T[2, 3] = BOX_HEIGHT / 2
    return SceneSpec(
        (
            Body("table", (Shape("box", (2.4, 2.4, 0.1), pose([0.5, 0, -0.05])),)),
            Body("box", (Shape("box", (0.04, 0.03, BOX_HEIGHT)),), T, mass=BOX_MASS),
            Body("cabinet", (Shape("box", (0.2, 0.2, 0.2)),), pose([0.3, 0.7, 0.1])),
            Body(
                "drawer",
                (Shape("box", (0.19, 0.19, 0.1)),),
                mass=0.5,
                joint=Joint(
                    "cabinet", np.eye(4), np.array([1.0, 0, 0]), 0.0, 0.3, "prismatic", 2.0
                ),
            ),
        ),
        held=(
            Attachment("tag", robot.tool_frame, (Shape("box", (0.01,) * 3, pose([0.06, 0, 0])),)),
        ),
    )


def _grasp(backend, lift: float = 0.0) -> list:
    """Close on the box, then lift it [m]: each period's observation and contacts."""
    model = RobotModel(backend.robot)
    backend.reset(backend.scene.initial_state(backend.robot.home, 0.0))
    start, _ = _upright(backend.robot)
    down = start.copy()
    down[2, 3] = 0.045
    up = down.copy()
    up[2, 3] += lift
    q, seen = backend.robot.home, []
    for T_from, T_to, g_from, g_to, periods in (
        (start, down, 0.0, 0.0, 30),
        (down, down, 0.0, 1.0, 30),
        (down, up, 1.0, 1.0, 30 if lift else 0),
    ):
        for s in np.linspace(0, 1, periods + 1)[1:]:
            q = model.ik(interpolate(T_from, T_to, s), q)
            backend.command(q, g_from + s * (g_to - g_from))
            backend.step()
            seen.append((backend.observe(), backend.contacts()))
    return seen


def _wave(backend, periods: int = 30) -> list:
    """What follows while the arm waves and the gripper stays closed."""
    q, seen = backend.observe().q, []
    for i in range(1, periods + 1):
        backend.command(q + 0.004 * i * np.cos(np.arange(6)), 1.0)
        backend.step()
        seen.append((backend.observe(), backend.contacts()))
    return seen


def _digest(seen) -> str:
    sha = hashlib.sha256()
    for o, contacts in seen:
        poses = [T for _, T in sorted(o.Ts_world_body.items())]
        for part in (o.q, o.dq, np.array([o.gripper, o.time]), o.T_world_tool, *poses):
            sha.update(np.ascontiguousarray(part).tobytes())
        sha.update(repr(contacts).encode())
    return sha.hexdigest()


@pytest.fixture(scope="module", params=ROBOTS)
def holding(request):
    """A backend that holds the box in the air, and the state in which it does."""
    robot = get_robot(request.param)
    backend = SapienBackend(robot, _grasp_scene(robot), 32)
    _grasp(backend, 0.1)
    state = backend.save()
    yield backend, state
    backend.close()


def _alone(body: Body, *others: Body, gravity=(0, 0, -9.81)) -> SapienBackend:
    scene = SceneSpec((*others, body), gravity=np.array(gravity))
    return SapienBackend(get_robot("ur5e_hande"), scene, 16)


def _run(backend, seconds: float, state=None):
    backend.reset(state or backend.scene.initial_state(backend.robot.home, 0.0))
    for _ in range(round(seconds * DEFAULT_RATES.control_hz)):
        backend.step()
    return backend.observe()


# --- gripper ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ROBOTS)
def test_a_box_of_a_kilogram_is_grasped_and_lifted_without_slipping(name):
    robot = get_robot(name)
    backend = SapienBackend(robot, _grasp_scene(robot), 32)
    seen = _grasp(backend, 0.1)
    (grasped, _), (lifted, touched) = seen[59], seen[-1]
    rise = lifted.Ts_world_body["box"][2, 3] - grasped.Ts_world_body["box"][2, 3]
    assert rise == pytest.approx(0.1, abs=1e-3)
    before, after = (
        np.linalg.inv(o.T_world_tool) @ o.Ts_world_body["box"] for o, _ in seen[59::30]
    )
    assert distance(before, after)[0] < 1e-3
    left, right = sorted(robot.gripper.finger_links)
    assert [(c.a, c.b) for c in touched] == [("box", left), ("box", right)]
    # Virtual work: both fingers' forces times their way are the driver's force times its own.
    way = 0.085 / 2 if name == "ur5e_2f85" else robot.gripper.closed_position
    expected = robot.gripper.force * robot.gripper.closed_position / (2 * way)
    for contact in touched:
        assert contact.force == pytest.approx(expected, rel=0.1)
        assert contact.penetration < 5e-4
    backend.close()


@pytest.mark.parametrize("name", ROBOTS)
def test_one_finger_that_is_stopped_stops_the_other(name):
    robot = get_robot(name)
    _, T = _upright(robot)
    T[:3, 3] += 0.005 * T[:3, 1]
    T[2, 3] = RobotModel(robot).fk(robot.home)[2, 3]
    wall = Body("wall", (Shape("box", (0.1, 0.02, 0.02)),), T)
    backend = SapienBackend(robot, SceneSpec((wall,)), 32)
    backend.reset(backend.scene.initial_state(robot.home, 0.0))
    for i in range(60):
        backend.command(robot.home, min(1.0, i / 30))
        backend.step()
    parts, now = backend._robot, backend._now
    s = np.array([now.q[j - 1] / ratio for j, ratio in parts.linkage.items()])
    closed = robot.gripper.closed_position
    assert 0.1 * closed < s.mean() < 0.9 * closed
    assert np.ptp(s) < 0.02 * closed
    backend.close()


@pytest.mark.parametrize("name", ROBOTS)
def test_the_gripper_moves_no_faster_than_its_speed(name):
    robot = get_robot(name)
    backend = SapienBackend(robot, SceneSpec(()), 32)
    backend.reset(backend.scene.initial_state(robot.home, 0.0))
    backend.command(robot.home, 1.0)
    seen = []
    for _ in range(DEFAULT_RATES.control_hz):
        backend.step()
        seen.append(backend.observe().gripper)
    steps = np.diff(seen) * robot.gripper.closed_position * DEFAULT_RATES.control_hz
    assert steps.max() == pytest.approx(robot.gripper.speed, rel=0.02)
    assert seen[-1] == pytest.approx(1.0, abs=1e-3)
    backend.close()


def test_after_a_reset_the_gripper_squeezes_with_its_target(holding):
    backend, state = holding
    backend.restore(state)
    now = backend.observe()
    poses = {"box": now.Ts_world_body["box"]}
    squeezed = backend.scene.initial_state(now.q, now.gripper, poses, gripper_target=1.0)
    slack = backend.scene.initial_state(now.q, now.gripper - 0.05, poses)
    fall = {}
    for name, start in (("squeezed", squeezed), ("slack", slack)):
        seen = _run(backend, 0.3, start)
        fall[name] = poses["box"][2, 3] - seen.Ts_world_body["box"][2, 3]
    assert fall["squeezed"] < 1e-3 < 0.05 < fall["slack"]


# --- states -------------------------------------------------------------------------------------


def test_a_restored_state_is_observed_exactly_and_continues_alike_whatever_came_before(holding):
    backend, state = holding
    backend.restore(state)
    expected = _digest([(backend.observe(), []), *_wave(backend)])
    backend.reset(backend.scene.initial_state(backend.robot.home + 0.1, 0.3))
    _wave(backend, 5)
    backend.restore(state)
    assert _digest([(backend.observe(), []), *_wave(backend)]) == expected
    other = SapienBackend(backend.robot, backend.scene, 32)
    _grasp(other)
    other.restore(state)
    assert _digest([(other.observe(), []), *_wave(other)]) == expected
    other.close()


_CONTINUE = """
import runpy, sys
names = runpy.run_path(sys.argv[1])
robot = names["get_robot"](sys.argv[2])
backend = names["SapienBackend"](robot, names["_grasp_scene"](robot), 32)
backend.restore(open(sys.argv[3], "rb").read())
print(names["_digest"]([(backend.observe(), []), *names["_wave"](backend)]))
"""


def test_a_restored_grasp_continues_identically_in_a_new_process(holding, tmp_path):
    backend, state = holding
    path = tmp_path / "state"
    path.write_bytes(state)
    words = [sys.executable, "-c", _CONTINUE, __file__, backend.robot.name, str(path)]
    result = subprocess.run(words, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    backend.restore(state)
    expected = _digest([(backend.observe(), []), *_wave(backend)])
    assert result.stdout.split() == [expected]


def test_the_motion_after_a_restore_is_that_after_the_save_but_for_the_declared_drift(holding):
    backend, _ = holding
    _grasp(backend, 0.1)
    state, saved = backend.save(), backend.observe()
    live = _wave(backend)
    backend.restore(state)
    assert _digest([(backend.observe(), [])]) == _digest([(saved, [])])
    for (a, _), (b, _) in zip(live, _wave(backend), strict=True):
        for name, T in a.Ts_world_body.items():
            apart, angle = distance(T, b.Ts_world_body[name])
            assert apart <= backend.drift
            assert np.rad2deg(angle) <= backend.drift_deg


def test_two_backends_stepped_in_turn_do_what_each_does_alone():
    def make():
        return SapienBackend(get_robot("ur5e_hande"), _grasp_scene(get_robot("ur5e_hande")), 16)

    alone = _digest(_grasp(make()))
    a, b = make(), make()
    seen = []
    for i in range(10):
        b.reset(b.scene.initial_state(b.robot.home + 0.01 * i, 0.5))
        b.step()
    seen = _grasp(a)
    assert _digest(seen) == alone
    for _ in range(3):
        a.step()
        b.step()
    a.close()
    assert np.isfinite(b.observe().q).all()
    b.close()


def test_settings_of_sapien_that_others_made_stay():
    import sapien

    gravity = sapien.physx.get_scene_config().gravity.tolist()
    _alone(Body("ball", (Shape("sphere", (0.1,)),), mass=1.0), gravity=(0, 0, -1.6)).close()
    assert sapien.physx.get_scene_config().gravity.tolist() == gravity


def test_links_are_where_kinematics_say(holding):
    backend, state = holding
    backend.restore(state)
    _wave(backend, 10)
    backend.observe()
    poses = backend._robot.joint_poses()
    physics = backend._physics
    for joint, at in zip(physics._robot.active_joints, physics._order, strict=True):
        T = joint.child_link.entity.pose.to_transformation_matrix()
        np.testing.assert_allclose(T, poses[at + 1], atol=1e-5)


# --- bodies -------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [0.9, 0.97, 1.03, 1.1])
@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_dry_friction_breaks_away_at_the_effort_it_is_declared_with(kind, factor):
    mass, arm = 0.8, 0.1
    load = 9.81 * mass * (arm if kind == "revolute" else 1.0)
    axis = np.array([0.0, 1, 0] if kind == "revolute" else [0.0, 0, 1])
    frame = Body("frame", (Shape("box", (0.05,) * 3),), pose([-0.8, 0, 0.5]))
    joint = Joint("frame", np.eye(4), axis, -1.0, 1.0, kind, friction=factor * load)
    # Overlaps its parent: they must not collide.
    shape = Shape("sphere", (0.02,), pose([arm, 0, 0]))
    thin = Shape("box", (0.01,) * 3, collides=False)
    backend = _alone(Body("load", (shape, thin), mass=mass, joint=joint), frame)
    seen = _run(backend, 1.0)
    moved = abs(backend.scene.joint_position("load", seen.Ts_world_body))
    assert (moved > 0.02) if factor < 1 else (moved < 1e-5)
    assert backend.contacts() == []
    backend.close()


def test_springs_and_catches_act_on_joints_within_their_limits():
    frame = Body("frame", (Shape("box", (0.2,) * 3),), pose([-0.8, 0, 0.5]))

    def settle(start=0.0, **kwargs):
        joint = Joint("frame", np.eye(4), np.array([0.0, 0, 1]), -0.5, 1.0, friction=0.02, **kwargs)
        arm = Body("arm", (Shape("box", (0.2, 0.02, 0.02)),), mass=0.5, joint=joint)
        backend = _alone(arm, frame)
        state = backend.scene.initial_state(backend.robot.home, 0.0, joint_positions={"arm": start})
        seen = _run(backend, 3.0, state)
        backend.close()
        return backend.scene.joint_position("arm", seen.Ts_world_body)

    # Where it comes to rest, the spring is weaker than friction.
    assert settle(stiffness=0.5, rest=0.4) == pytest.approx(0.4, abs=0.02 / 0.5 + 1e-3)
    assert settle(detent=Detent(0.1, 0.3, 0.5)) == pytest.approx(0.1, abs=0.02)
    assert settle(0.3, detent=Detent(0.1, 0.15, 0.5)) == pytest.approx(0.3, abs=1e-5)
    assert settle(stiffness=0.5, rest=2.0) == pytest.approx(1.0, abs=1e-3)


def test_a_moving_joint_is_saved_with_its_velocity():
    frame = Body("frame", (Shape("box", (0.05,) * 3),), pose([-0.8, 0, 0.5]))
    joint = Joint("frame", np.eye(4), np.array([0.0, 1, 0]), -1.5, 1.5, friction=0.01)
    arm = Body("arm", (Shape("sphere", (0.02,), pose([0.1, 0, 0])),), mass=0.5, joint=joint)
    backend = _alone(arm, frame)
    _run(backend, 0.1)
    state = backend.save()
    ends = []
    for _ in range(2):
        for _ in range(3):
            backend.step()
        ends.append(backend.observe().Ts_world_body["arm"])
        backend.restore(state)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)
    backend.close()


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_the_friction_between_two_bodies_is_the_mean_of_their_coefficients(factor):
    slope = np.arctan(factor * (0.3 + 0.7) / 2)
    gravity = 9.81 * np.array([np.sin(slope), 0, -np.cos(slope)])
    floor = Body("floor", (Shape("box", (1, 1, 0.1)),), pose([-1.5, 0, 0.45]), friction=0.3)
    box = Body(
        "box", (Shape("box", (0.1, 0.1, 0.05)),), pose([-1.5, 0, 0.525]), mass=1.0, friction=0.7
    )
    backend = _alone(box, floor, gravity=gravity)
    seen = _run(backend, 1.0)
    slid = seen.Ts_world_body["box"][0, 3] + 1.5
    assert (slid > 0.02) if factor > 1 else (abs(slid) < 1e-4)
    backend.close()


def test_what_lies_still_stays_and_is_reported_with_its_weight():
    floor = Body("floor", (Shape("box", (1, 1, 0.1)),), pose([-1.5, 0, 0.45]))
    can = Body("can", (Shape("cylinder", (0.03, 0.1)),), pose([-1.5, 0, 0.55]), mass=0.5)
    backend = _alone(can, floor)
    seen = _run(backend, 5.0)
    np.testing.assert_allclose(seen.Ts_world_body["can"], can.T_world_body, atol=1e-5)
    (contact,) = backend.contacts()
    assert (contact.a, contact.b) == ("can", "floor")
    assert contact.force == pytest.approx(0.5 * 9.81, rel=0.02)
    backend.close()


def test_contacts_name_held_bodies_and_links_that_are_fixed_to_others():
    robot = get_robot("ur5e_2f85")
    tool, _ = _upright(robot)
    shape = Shape("box", (0.02,) * 3)
    bodies = [
        Body("at_tag", (shape,), tool @ pose([0.06, 0, 0.005])),
        Body("at_camera", (shape,), RobotModel(robot).fk(robot.home, "wrist_camera")),
    ]
    held = (Attachment("tag", robot.tool_frame, (Shape("box", (0.01,) * 3, pose([0.06, 0, 0])),)),)
    backend = SapienBackend(robot, SceneSpec(tuple(bodies), held), 16)
    backend.reset(backend.scene.initial_state(robot.home, 0.0))
    backend.step()
    pairs = {(c.a, c.b) for c in backend.contacts()}
    assert {("at_tag", "tag"), ("at_camera", "wrist_camera")} <= pairs
    backend.close()


# --- images -----------------------------------------------------------------------------------


_WITHOUT_DRIVER = """
import numpy as np
from sart_toolkit.backends import make_backend
from sart_toolkit.errors import MissingCapability
from sart_toolkit.robots import get_robot
from sart_toolkit.scenes.spec import SceneSpec
robot = get_robot("ur5e_hande")
backend = make_backend("sapien", robot, SceneSpec(()), 16)
assert "draw here" in backend.no_images and not type(backend).no_images
backend.reset(backend.scene.initial_state(robot.home, 0.5))
backend.command(robot.home + 0.01, 0.5)
backend.step()
assert np.allclose(backend.observe().q, robot.home + 0.01, atol=1e-5)
try:
    backend.observe(("wrist",))
except MissingCapability as error:
    print(error)
"""


@pytest.mark.parametrize("variable", ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"])
def test_without_a_driver_physics_works_and_an_image_says_what_is_missing(variable):
    environment = {**os.environ, variable: "/no_such_driver.json"}
    strict = ["-W", "error", "-W", "ignore:Failed to find system libvulkan"]
    words = [sys.executable, *strict, "-c", _WITHOUT_DRIVER]
    result = subprocess.run(words, capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr
    assert "can't draw here (RuntimeError: failed to find a rendering device)" in result.stdout
    assert "setup_debian.sh sapien" in result.stdout
    assert result.stderr == ""


@pytest.mark.parametrize(("reason", "seconds"), [("", 3600), ("broken", 60)])
def test_the_probe_runs_once_for_all_processes_until_drivers_change_or_its_time_is_over(
    monkeypatch, tmp_path, reason, seconds
):
    probes = []
    monkeypatch.setenv("SART_CACHE", str(tmp_path))
    monkeypatch.setattr(sapien_renderer, "_probe", lambda: probes.append(1) or reason)

    def as_another_process(change=None):
        for path in tmp_path.glob("*/sapien-*.json"):
            if change:
                path.write_text(change(path.read_text()))
        sapien_renderer._why_no_images.cache_clear()
        return sapien_renderer.why_no_images()

    def older(by):
        return lambda text: json.dumps({**json.loads(text), "time": json.loads(text)["time"] - by})

    try:
        assert as_another_process() == as_another_process(older(seconds - 10)) == reason
        assert len(probes) == 1
        as_another_process(older(20))
        assert len(probes) == 2
        as_another_process(lambda text: text[:5])
        assert len(probes) == 3
        monkeypatch.setenv("VK_DRIVER_FILES", "another.json")
        as_another_process()
        assert len(probes) == 4
    finally:
        sapien_renderer._why_no_images.cache_clear()


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("import os; os.abort()", "its process ended with -6"),
        ("import time; time.sleep(60)", "no image within 0.5 s"),
        ("raise RuntimeError('no device')", "RuntimeError: no device"),
        ("", ""),
    ],
)
def test_a_driver_that_crashes_or_hangs_is_a_reason_not_a_crash(monkeypatch, program, reason):
    monkeypatch.setattr(sapien_renderer, "_PROBE", program)
    monkeypatch.setattr(sapien_renderer, "_PROBE_SECONDS", 0.5 if "sleep" in program else 30)
    assert sapien_renderer._probe() == reason


def test_a_device_that_is_gone_since_the_probe_is_named(monkeypatch):
    def gone():
        raise RuntimeError("no device")

    backend = SapienBackend(get_robot("ur5e_hande"), SceneSpec(()), 16)
    monkeypatch.setattr(backend, "no_images", "")
    monkeypatch.setattr(sapien_renderer.sapien.render, "RenderSystem", gone)
    with pytest.raises(MissingCapability, match=r"can't draw here \(no device\); install Mesa"):
        backend.observe(("wrist",))
    backend.close()


def test_shaders_that_cannot_be_kept_are_an_error_that_says_where(monkeypatch, tmp_path):
    (tmp_path / "sart_toolkit").write_text("a file, not a folder")
    monkeypatch.setenv("SART_CACHE", str(tmp_path))
    sapien_renderer._shader_folder.cache_clear()
    with pytest.raises(CannotWrite, match="set SART_CACHE"):
        sapien_renderer._shader_folder()
    sapien_renderer._shader_folder.cache_clear()


class _Worker:
    def __init__(self) -> None:
        self.backend = make_backend("sapien", get_robot("ur5e_hande"), SceneSpec(()), 16)

    def __call__(self, gripper: float) -> float:
        robot = self.backend.robot
        self.backend.reset(self.backend.scene.initial_state(robot.home, gripper))
        self.backend.step()
        cameras = ("wrist",) if not self.backend.no_images else ()
        return float(self.backend.observe(cameras).gripper)

    def close(self) -> None:
        self.backend.close()


def test_it_works_in_worker_processes():
    with worker_map(_Worker, 2) as run:
        assert list(run([0.2, 0.4])) == pytest.approx([0.2, 0.4], abs=1e-3)


# --- errors -------------------------------------------------------------------------------------


def test_after_closing_every_call_says_so():
    backend = SapienBackend(get_robot("ur5e_hande"), SceneSpec(()), 16)
    state = backend.scene.initial_state(backend.robot.home, 0.0)
    saved = backend.save()
    backend.close()
    backend.close()
    for attempt in (
        lambda: backend.reset(state),
        backend.observe,
        lambda: backend.command(backend.robot.home, 0.0),
        backend.step,
        backend.contacts,
        backend.save,
        lambda: backend.restore(saved),
    ):
        with pytest.raises(SartError, match="was closed; make a new one"):
            attempt()


def test_without_sapien_the_extra_is_named():
    program = (
        "import sys; sys.modules['sapien'] = None\n"
        "from sart_toolkit.backends import make_backend\n"
        "from sart_toolkit.errors import MissingExtra\n"
        "try: make_backend('sapien', None, None)\n"
        "except MissingExtra as error: print(error)"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "pip install 'sart_toolkit[sapien]'" in result.stdout, result.stderr


def test_a_shape_that_is_not_known_is_refused():
    with pytest.raises(InvalidInput, match="geometry Capsule is neither a mesh nor a box, sphere"):
        primitive(coal.Capsule(0.1, 0.2))
