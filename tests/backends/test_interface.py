"""What every backend promises, whatever simulator or robot is behind it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sart_toolkit.backends import BACKENDS, make_backend
from sart_toolkit.backends.interface import Backend
from sart_toolkit.errors import BrokenFile, InvalidInput, MissingCapability, UnknownName
from sart_toolkit.poses import inverse, pose
from sart_toolkit.records import CONTROL_HZ
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scene.clearance import ClearanceModel
from sart_toolkit.scene.spec import Body, SceneSpec

few = settings(max_examples=8, deadline=None, derandomize=True)
joints = st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6).map(np.array)


# --- states -------------------------------------------------------------------------------------


@few
@given(joints, st.floats(0, 1), st.floats(-0.2, 0.2), st.floats(-3, 3))
def test_reset_puts_everything_exactly_where_the_state_says(benches, dq, gripper, x, yaw):
    for bench in benches:
        state = bench.scene.initial_state(
            bench.home.q + dq, gripper, {"block": pose([0.6, x, 0], [0, 0, yaw])}
        )
        bench.backend.reset(state)
        seen = bench.backend.observe()
        np.testing.assert_allclose(seen.q, state.q, atol=1e-12)
        assert seen.gripper == pytest.approx(gripper, abs=1e-12)
        for name, T in state.Ts_world_body.items():
            np.testing.assert_allclose(seen.Ts_world_body[name], T, atol=1e-12)
        assert not seen.dq.any() and seen.time == 0.0


def test_what_follows_a_reset_depends_on_the_state_alone(bench, another):
    fresh = another()
    fresh.reset()
    expected = fresh.continuation()
    bench.needs("has_contacts")
    assert bench.move_tool(bench.above_block(-0.002)), "the history has a contact in it"
    bench.command(bench.q + 0.05, 0.9)
    bench.reset()
    assert bench.continuation() == expected


histories = st.lists(
    st.one_of(
        st.tuples(st.just("joints"), joints),
        st.tuples(st.just("press"), st.floats(-0.003, 0.05)),
        st.tuples(st.just("reset"), joints),
    ),
    max_size=3,
)


def _live(bench, history):
    for kind, value in history:
        if kind == "joints":
            bench.command(bench.q + 0.2 * value, 0.8)
        elif kind == "press":
            bench.reset()
            bench.move_tool(bench.above_block(value))
        else:
            bench.reset(bench.home.q + value, 0.1)
            bench.command(bench.q, 0.3)


@few
@given(history=histories, past=histories)
def test_a_restored_state_is_the_saved_one_whatever_happened_in_between(benches, past, history):
    for bench in benches:
        bench.reset()
        _live(bench, past)
        state = bench.backend.save()
        expected = [bench.digest(("wrist", "side")), *bench.continuation()]
        _live(bench, history)
        bench.backend.restore(state)
        assert [bench.digest(("wrist", "side")), *bench.continuation()] == expected


def test_a_state_saved_in_contact_continues_identically_in_another_backend(bench, another):
    bench.needs("can_restore")
    bench.move_tool(bench.above_block(-0.002))
    state = bench.backend.save()
    expected = bench.continuation()
    other = another()
    other.reset(other.home.q + 0.1)
    other.backend.restore(state)
    assert other.continuation() == expected
    assert any(touched for touched in expected if isinstance(touched, list))


_CONTINUE = """
import json, runpy, sys
bench = runpy.run_path(sys.argv[1])["make_bench"](*sys.argv[3:])
bench.backend.restore(open(sys.argv[2], "rb").read())
print()
print(json.dumps([bench.continuation()], default=vars))
"""


def test_a_restored_state_continues_identically_in_a_new_process(bench, tmp_path):
    bench.needs("can_restore")
    bench.move_tool(bench.above_block(-0.002))
    path = tmp_path / "state"
    path.write_bytes(bench.backend.save())
    backend = bench.backend
    words = [Path(__file__).with_name("conftest.py"), path, backend.name, backend.robot.name]
    result = subprocess.run(
        [sys.executable, "-c", _CONTINUE, *map(str, words)], capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    seen = json.loads(result.stdout.splitlines()[-1])
    assert seen == json.loads(json.dumps([bench.continuation()], default=vars))


def test_saving_changes_nothing(bench):
    bench.needs("can_restore")
    expected = bench.continuation()
    bench.reset()
    bench.backend.save()
    assert bench.continuation() == expected


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda state: b"", id="empty"),
        pytest.param(lambda state: b"a\nb\nc", id="something else"),
        pytest.param(lambda state: state[: len(state) // 2], id="cut in half"),
        pytest.param(lambda state: state[:-1], id="last byte gone"),
    ],
)
def test_a_damaged_state_is_refused_and_changes_nothing(bench, damage):
    bench.needs("can_restore")
    state = bench.backend.save()
    bench.move_tool(bench.above_block(0.1), 5)
    before = bench.digest(())
    with pytest.raises(BrokenFile, match="saved state"):
        bench.backend.restore(damage(state))
    assert bench.digest(()) == before


def test_a_state_with_any_changed_bit_is_refused(bench):
    bench.needs("can_restore")
    state = bench.backend.save()
    rng = np.random.default_rng(0)
    # Half of the flips near the front, where a header would be.
    for place in [*rng.integers(400, size=100), *rng.integers(len(state), size=100)]:
        damaged = bytearray(state)
        damaged[place] ^= 1 << rng.integers(8)
        with pytest.raises(BrokenFile, match="saved state"):
            bench.backend.restore(bytes(damaged))


def _with_taller_block(scene: SceneSpec) -> SceneSpec:
    table, block, ball = scene.bodies
    taller = Body("block", (Shape("box", (0.06, 0.06, 0.08)),), block.T_world_body)
    return SceneSpec((table, taller, ball), scene.held, scene.cameras)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda s: SceneSpec(s.bodies[:2], s.held, s.cameras), id="a body fewer"),
        pytest.param(lambda s: SceneSpec(s.bodies, (), s.cameras), id="nothing held"),
        pytest.param(_with_taller_block, id="a body of another shape"),
    ],
)
def test_a_state_of_another_scene_is_refused_and_changes_nothing(bench, change):
    bench.needs("can_restore")
    robot = bench.backend.robot
    scene = change(bench.scene)
    other = make_backend(bench.backend.name, robot, scene, 16)
    other.reset(scene.initial_state(robot.home + 0.1, 0.5))
    before = other.observe()
    with pytest.raises(BrokenFile, match="saved state"):
        other.restore(bench.backend.save())
    np.testing.assert_array_equal(other.observe().q, before.q)
    other.close()


def test_resetting_needs_exactly_the_bodies_of_the_scene(bench):
    bodies = dict(bench.home.Ts_world_body)
    more = SceneSpec((*bench.scene.bodies, Body("cup", bench.scene.bodies[1].shapes)))
    with pytest.raises(UnknownName, match="'cup'"):
        bench.backend.reset(more.initial_state(bench.home.q, 0.5, bodies))
    fewer = SceneSpec(bench.scene.bodies[1:])
    with pytest.raises(UnknownName, match="'table'"):
        bench.backend.reset(fewer.initial_state(bench.home.q, 0.5))


# --- motion -------------------------------------------------------------------------------------


@few
@given(joints)
def test_commanded_joints_are_reached_within_limits_with_the_tool_where_kinematics_say(benches, dq):
    for bench in benches:
        bench.reset()
        for s in np.linspace(0, 1, 20):
            bench.command(bench.home.q + s * dq)
        bench.command(bench.home.q + dq)
        seen = bench.backend.observe()
        np.testing.assert_allclose(seen.q, bench.home.q + dq, atol=1e-3)
        assert (seen.q >= bench.model.lower).all() and (seen.q <= bench.model.upper).all()
        np.testing.assert_allclose(seen.T_world_tool, bench.model.fk(seen.q), atol=1e-6)
        held = bench.model.fk(seen.q, "stick")
        np.testing.assert_allclose(seen.Ts_world_body["stick"], held, atol=1e-6)


def test_a_joint_at_its_limit_stays_within_it(bench):
    for limit, sign in ((bench.model.upper, -1), (bench.model.lower, 1)):
        q = bench.home.q.copy()
        q[-1] = limit[-1] + sign * 0.05
        bench.reset(q)
        for s in np.linspace(0, 1, 10):
            bench.command(np.append(q[:-1], limit[-1] + sign * 0.05 * (1 - s)))
        assert sign * (bench.backend.observe().q[-1] - limit[-1]) >= -1e-4


def test_joints_follow_the_commanded_ones_at_the_commanded_speed(bench):
    speed = np.linspace(0.2, 0.8, len(bench.home.q))
    for i in range(1, 16):
        bench.command(bench.home.q + speed * i / CONTROL_HZ)
        np.testing.assert_allclose(bench.backend.observe().q, bench.q, rtol=0, atol=1e-5)
    np.testing.assert_allclose(bench.backend.observe().dq, speed, rtol=0.001)


def test_time_advances_by_exactly_one_control_period(bench):
    times = []
    for _ in range(2 * CONTROL_HZ):
        bench.command(bench.home.q)
        times.append(bench.backend.observe().time)
    np.testing.assert_allclose(np.diff([0.0, *times]), 1 / CONTROL_HZ, rtol=0, atol=1e-12)
    assert times[-1] == pytest.approx(2.0, abs=1e-12)


def test_the_gripper_opens_and_closes_as_far_as_commanded(bench):
    robot = bench.backend.robot

    def opening(Ts):
        return np.linalg.norm(Ts["speck0"][:3, 3] - Ts["speck1"][:3, 3])

    openings = []
    for command in (0.0, 1.0, 0.3, 0.8, 0.55):
        for _ in range(40):
            bench.command(bench.home.q, command)
        seen = bench.backend.observe()
        assert seen.gripper == pytest.approx(command, abs=1e-3)
        model = RobotModel(robot, bench.scene.held, command)
        expected = {name: model.fk(seen.q, name) for name in ("speck0", "speck1")}
        assert opening(seen.Ts_world_body) == pytest.approx(opening(expected), abs=1e-4)
        openings.append(opening(seen.Ts_world_body))
    assert openings[0] > openings[2] > openings[4] > openings[3] > openings[1]
    if robot.name == "ur5e_2f85":
        assert openings[0] - openings[1] == pytest.approx(0.085, abs=0.001)


@pytest.mark.parametrize(
    ("q", "gripper", "message"),
    [
        (lambda q: q[:-1], 0.5, r"q: expected shape"),
        (lambda q: np.append(q, 0.0), 0.5, r"q: expected shape"),
        (lambda q: q * np.nan, 0.5, "q: has NaN"),
        (lambda q: q + 100.0, 0.5, r"rad is outside its limits \["),
        (lambda q: q - 100.0, 0.5, r"rad is outside its limits \["),
        (lambda q: q, -0.01, "gripper: expected 0"),
        (lambda q: q, 1.01, "gripper: expected 0"),
        (lambda q: q, np.nan, "gripper: expected 0"),
    ],
)
def test_a_bad_command_is_refused_and_changes_nothing(bench, q, gripper, message):
    expected = bench.continuation()
    bench.reset()
    with pytest.raises(InvalidInput, match=message):
        bench.backend.command(q(bench.home.q), gripper)
    assert bench.continuation() == expected


def test_a_state_with_joints_of_the_wrong_number_or_outside_limits_is_refused(bench):
    for q, message in ((bench.home.q[:-1], "expected shape"), (bench.home.q + 100, "limits")):
        with pytest.raises(InvalidInput, match=message):
            bench.backend.reset(bench.scene.initial_state(q, 0.5))


# --- contacts -----------------------------------------------------------------------------------


def test_nothing_touches_in_free_space_though_the_arm_stands_on_the_table(bench):
    bench.needs("has_contacts")
    assert bench.move_tool(bench.above_block(0.05)) == []


def test_contact_is_reported_when_bodies_touch_and_not_a_millimetre_before(bench):
    bench.needs("has_contacts")
    assert bench.move_tool(bench.above_block(0.001)) == []
    touched = bench.move_tool(bench.above_block(-0.001))
    assert {(contact.a, contact.b) for contact in touched} == {("block", "stick")}
    assert all(contact.force > 1.0 for contact in touched[-5:])
    assert all(0.0 <= contact.penetration < 0.002 for contact in touched)
    bench.move_tool(bench.above_block(0.005))
    assert bench.command(bench.q) == []


def test_contacts_are_those_of_the_last_step(bench):
    bench.needs("has_contacts")
    bench.move_tool(bench.above_block(-0.003))
    # A stiff arm on a stiff block may bounce: wait for a period with contact.
    assert any(bench.command(bench.q) for _ in range(20))
    assert bench.backend.contacts()
    bench.move_tool(bench.above_block(0.01))
    assert bench.backend.contacts() == []
    assert any(bench.move_tool(bench.above_block(-0.003)))
    bench.reset()
    assert bench.backend.contacts() == []


def test_contacts_agree_with_the_geometry_at_random_configurations(bench):
    bench.needs("has_contacts")
    clearances = ClearanceModel(RobotModel(bench.model.spec, bench.scene.held, 0.5), bench.scene)
    bodies = bench.home.Ts_world_body
    rng = np.random.default_rng(0)
    kinds = set()
    for _ in range(60):
        q = bench.home.q + rng.uniform(-1.2, 1.2, len(bench.home.q))
        arm = clearances.arm_distance(q, bodies)
        tool = min(clearances.tool_distances(q, bodies).values(), key=lambda pair: pair.distance)
        nearest = min(arm, tool, key=lambda pair: pair.distance)
        if abs(nearest.distance) < 0.003:
            continue
        bench.reset(q)
        touched = {(contact.a, contact.b) for contact in bench.command(q)}
        assert bool(touched) == (nearest.distance < 0), (nearest, touched)
        scene = {body.name for body in bench.scene.bodies}
        assert not any({a, b} <= scene for a, b in touched)
        kinds.add("free" if not touched else "scene" if nearest.b in scene else "arm")
    assert kinds == {"free", "scene", "arm"}


# --- pictures -----------------------------------------------------------------------------------


def _ray_cast(bench, view, intrinsics):
    """Depth `(H, W)` [m] of table, block and ball alone; infinite where a ray meets none."""
    size = len(view.depth)
    rows, columns = np.mgrid[:size, :size]
    rays = np.stack([columns, rows, np.ones((size, size))], -1) @ np.linalg.inv(intrinsics).T
    T = view.T_world_camera
    rays, eye = rays @ T[:3, :3].T, T[:3, 3]
    x, y, _ = bench.home.Ts_world_body["block"][:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        table = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
        slabs = (np.array([[x - 0.03, y - 0.03, 0], [x + 0.03, y + 0.03, 0.04]]) - eye)[
            :, None, None
        ] / rays
        enter, leave = slabs.min(0).max(-1), slabs.max(0).min(-1)
        block = np.where((enter < leave) & (enter > 0), enter, np.inf)
        to_ball = bench.home.Ts_world_body["ball"][:3, 3] - eye
        a, b = (rays**2).sum(-1), rays @ to_ball
        root = b**2 - a * (to_ball @ to_ball - 0.015**2)
        ball = np.where(root > 0, (b - np.sqrt(root)) / a, np.inf)
    return np.minimum(np.minimum(table, block), ball)


@pytest.mark.parametrize("size", [33, 64, 128])
def test_depth_in_metres_is_the_distance_to_the_bodies_seen(bench, size):
    bench.needs("renders")
    seen = bench.backend.observe(("wrist", "side"), size)
    for name, view in seen.cameras.items():
        expected = _ray_cast(bench, view, bench.backend.cameras[name].intrinsics(size, size))
        difference = view.depth - expected
        # The robot hides some; at an edge a pixel may show either body.
        behind = difference > 2e-4
        agrees = np.abs(difference) < 2e-4
        assert behind.mean() < 0.02, name
        assert agrees.mean() > 0.5, name


@pytest.mark.parametrize("size", [64, 128, 225])
@pytest.mark.parametrize("camera", ["wrist", "side"])
def test_the_ball_is_drawn_where_the_intrinsics_project_it(bench, camera, size):
    bench.needs("renders")
    seen = bench.backend.observe((camera,), size)
    view = seen.cameras[camera]
    p = inverse(view.T_world_camera) @ seen.Ts_world_body["ball"][:, 3]
    u, v, _ = bench.backend.cameras[camera].intrinsics(size, size) @ (p[:3] / p[2])
    r, g, b = view.rgb.astype(int).transpose(2, 0, 1)
    rows, columns = np.nonzero((r > 30) & (g < 0.3 * r) & (b < 0.3 * r))
    assert len(rows) > 8
    assert (columns.mean(), rows.mean()) == pytest.approx((u, v), abs=0.35)
    at = view.depth[round(v), round(u)]
    assert at == pytest.approx(p[2] - 0.015, abs=0.004)


def test_the_wrist_camera_moves_with_the_tool_and_scene_cameras_stay(bench):
    bench.needs("renders")
    spec = bench.backend.cameras
    for dq in (0.0, 0.1):
        bench.reset(bench.home.q + dq)
        seen = bench.backend.observe(("wrist", "side"), 8)
        wrist = bench.model.fk(bench.q, spec["wrist"].frame) @ spec["wrist"].T_frame_camera
        np.testing.assert_allclose(seen.cameras["wrist"].T_world_camera, wrist, atol=1e-6)
        np.testing.assert_array_equal(
            seen.cameras["side"].T_world_camera, spec["side"].T_frame_camera
        )


def test_depth_is_zero_where_nothing_was_hit(bench):
    bench.needs("renders")
    assert not bench.backend.observe(("sky",)).cameras["sky"].depth.any()


def test_pictures_come_at_any_size_and_at_the_backend_s_own_by_default(bench):
    bench.needs("renders")
    for size in (1, 16, 33, 128, None):
        view = bench.backend.observe(("wrist",), size).cameras["wrist"]
        n = size or bench.backend.image_size
        assert view.rgb.shape == (n, n, 3) and view.rgb.dtype == np.uint8
        assert view.depth.shape == (n, n) and view.depth.dtype == np.float32
    assert bench.backend.observe().cameras == {}


@pytest.mark.parametrize("size", [0, -1])
def test_a_picture_without_pixels_is_refused(bench, size):
    bench.needs("renders")
    with pytest.raises(InvalidInput, match="image_size"):
        make_backend(bench.backend.name, bench.backend.robot, bench.scene, size)
    with pytest.raises(InvalidInput, match="image_size"):
        bench.backend.observe(("wrist",), size)


def test_an_unknown_camera_is_refused_with_the_nearest_name(bench):
    with pytest.raises(UnknownName, match="did you mean 'wrist'"):
        bench.backend.observe(("wirst",))


# --- the rest -----------------------------------------------------------------------------------


def test_closing_twice_does_nothing(another):
    made, kept = another(16), another(16)
    made.backend.close()
    made.backend.close()
    # Neither call reached the simulator of somebody else.
    assert np.isfinite(kept.backend.observe().T_world_tool).all()


def test_what_a_backend_cannot_do_raises_instead_of_doing_nothing(bench):
    backend = bench.backend
    for capability, attempt in (
        ("can_restore", backend.save),
        ("can_restore", lambda: backend.restore(b"")),
        ("has_contacts", backend.contacts),
        ("renders", lambda: backend.observe(("wrist",))),
    ):
        if not getattr(backend.capabilities, capability):
            with pytest.raises(MissingCapability, match="use another backend"):
                attempt()


def test_an_unknown_backend_is_refused_with_the_nearest_name():
    with pytest.raises(UnknownName, match="did you mean 'pybullet'"):
        make_backend("pybulet", get_robot("ur5e_2f85"), SceneSpec(()))


@pytest.mark.parametrize("name", BACKENDS)
def test_capabilities_can_be_read_before_connecting(name):
    module, attribute = BACKENDS[name].split(":")
    pytest.importorskip(module)
    backend = getattr(sys.modules[module], attribute)
    assert issubclass(backend, Backend) and backend.name == name
    assert all(isinstance(value, bool) for value in vars(backend.capabilities).values())
