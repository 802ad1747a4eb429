"""Records: actions lead along commands, spheres decide t*, hashes follow content, copies are kept.

The synthetic robots here wander at random: nothing but the records themselves is under test.
"""

import dataclasses

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from sart_toolkit.data import records
from sart_toolkit.data.records import (
    DEFAULT_RATES,
    Annotation,
    CameraRecord,
    Demonstration,
    Episode,
    PrecisionSphere,
    Provenance,
    Rates,
    Steps,
    actions_from_commands,
    apply_action,
    convergence_waypoint,
    digest,
    library_versions,
)
from sart_toolkit.errors import InvalidInput, Mismatch
from sart_toolkit.poses import apply_motion, exp_rotation, pose

PROPERTY = settings(deadline=None, derandomize=True, max_examples=50)

seeds = st.integers(0, 2**32 - 1)


def random_walk(n, rng, step=0.05, turn=0.5):
    """`n` poses, each a random motion away from the one before."""
    Ts = [pose(rng.uniform(-1, 1, 3), rng.uniform(-1.5, 1.5, 3))]
    for _ in range(n - 1):
        motion = np.concatenate([rng.normal(0, step, 3), rng.normal(0, turn, 3)])
        Ts.append(apply_motion(Ts[-1], motion))
    return np.stack(Ts)


def make_camera(n, rng):
    return CameraRecord(
        rgb=rng.integers(0, 256, (n, 4, 6, 3), np.uint8),
        depth=rng.uniform(0, 2, (n, 4, 6)).astype(np.float32),
        intrinsics=np.diag([6.0, 6.0, 1.0]),
        frame="tool",
        T_frame_camera=pose([0.05, 0, -0.1], [0.1, 0, 0]),
    )


def make_steps(n, rng):
    return Steps(
        joint_positions=rng.normal(size=(n, 6)),
        joint_velocities=rng.normal(size=(n, 6)),
        commanded_joint_positions=rng.normal(size=(n, 6)),
        measured_Ts_world_tool=random_walk(n, rng),
        commanded_Ts_world_tool=random_walk(n, rng),
        measured_gripper=rng.uniform(0, 1, n),
        commanded_gripper=rng.uniform(0, 1, n),
        contact_force=np.full(n, np.nan),
        cameras={"wrist": make_camera(n, rng)},
    )


def make_demonstration(n=6, seed=0):
    rng = np.random.default_rng(seed)
    return Demonstration(
        task="walk",
        task_parameters={"placement": {"x": 0.01}, "speed": 2},
        robot="none",
        backend="synthetic",
        steps=make_steps(n, rng),
        timestamps=np.arange(n) / 10,
        body_Ts_world={"block": random_walk(n, rng)},
        success=np.arange(n) == n - 1,
        touching=((),) * n,
        raw_commands=rng.normal(size=(3 * n, 7)),
        states=tuple(rng.bytes(int(size)) for size in rng.integers(0, 9, n)),
        operator="test",
        device="none",
        seconds=1.0,
    )


def make_episode(demonstration, t_star, n=4, seed=1):
    rng = np.random.default_rng(seed)
    provenance = Provenance(
        demonstration.content_hash(),
        0,
        0,
        3,
        t_star,
        random_walk(1, rng)[0],
        seed,
        "sart",
        "paper",
    )
    return Episode(make_steps(n, rng), provenance)


def along_x(xs):
    """A demonstration whose measured tool is at `xs` on the x axis."""
    demonstration = make_demonstration(len(xs))
    Ts = np.stack([pose([x, 0, 0]) for x in xs])
    steps = dataclasses.replace(demonstration.steps, measured_Ts_world_tool=Ts)
    return dataclasses.replace(demonstration, steps=steps)


def sphere_at(demonstration, waypoint, radius=0.05, **others):
    T_world_key = demonstration.steps.measured_Ts_world_tool[waypoint]
    return PrecisionSphere(waypoint, T_world_key, radius, **others)


# --- actions ------------------------------------------------------------------------------------


def assert_actions_lead_along(actions, Ts_world_tool, gripper):
    """Each commanded pose and gripper target follows from the action at the one before."""
    assert actions.shape == (len(Ts_world_tool), 7)
    for t, action in enumerate(actions[:-1]):
        T, g = apply_action(Ts_world_tool[t], action)
        np.testing.assert_allclose(T, Ts_world_tool[t + 1], rtol=0, atol=1e-9)
        assert g == gripper[t + 1]


@PROPERTY
@given(st.integers(1, 12), seeds, st.sampled_from([0.0, 0.1, 1.5]))
def test_a_commanded_pose_and_its_action_give_the_next_commanded_pose(n, seed, turn):
    rng = np.random.default_rng(seed)
    Ts, gripper = random_walk(n, rng, turn=turn), rng.uniform(0, 1, n)
    actions = actions_from_commands(Ts, gripper)
    assert_actions_lead_along(actions, Ts, gripper)
    np.testing.assert_array_equal(actions[-1], [0, 0, 0, 0, 0, 0, gripper[-1]])


def test_a_demonstrations_actions_follow_its_commands_and_not_its_measurements():
    demonstration = make_demonstration()
    steps = demonstration.steps
    assert_actions_lead_along(
        demonstration.actions, steps.commanded_Ts_world_tool, steps.commanded_gripper
    )


@PROPERTY
@given(st.integers(2, 8), st.integers(1, 6), seeds, st.data())
def test_actions_lead_along_an_episode_and_across_its_join(n, segment, seed, data):
    demonstration = make_demonstration(n, seed)
    t_star = data.draw(st.integers(0, n - 1))
    episode = make_episode(demonstration, t_star, segment, seed + 1)
    Ts, gripper = episode.commands(demonstration)
    assert len(Ts) == len(gripper) == len(episode) + len(demonstration) - t_star
    np.testing.assert_array_equal(Ts[:segment], episode.steps.commanded_Ts_world_tool)
    np.testing.assert_array_equal(
        Ts[segment:], demonstration.steps.commanded_Ts_world_tool[t_star:]
    )
    actions = episode.actions(demonstration)
    assert_actions_lead_along(actions, Ts, gripper)
    at_join, g = apply_action(episode.steps.commanded_Ts_world_tool[-1], actions[segment - 1])
    np.testing.assert_allclose(
        at_join, demonstration.steps.commanded_Ts_world_tool[t_star], rtol=0, atol=1e-9
    )
    assert g == demonstration.steps.commanded_gripper[t_star]
    np.testing.assert_array_equal(actions[segment:], demonstration.actions[t_star:])


@pytest.mark.parametrize(("target", "given"), [(-0.3, 0.0), (0.4, 0.4), (1.2, 1.0)])
def test_an_action_never_commands_the_gripper_beyond_its_range(target, given):
    assert apply_action(np.eye(4), np.array([0, 0, 0, 0, 0, 0, target]))[1] == given


# --- t* -----------------------------------------------------------------------------------------


@PROPERTY
@given(st.integers(2, 15), seeds, st.floats(0.005, 0.5), st.data())
def test_t_star_is_the_first_later_waypoint_outside_the_sphere(n, seed, radius, data):
    demonstration = make_demonstration(n, seed)
    sphere = sphere_at(demonstration, data.draw(st.integers(0, n - 2)), radius)
    expected = n - 1
    for t in range(sphere.waypoint + 1, n):
        offset = demonstration.steps.measured_Ts_world_tool[t] - sphere.T_world_key
        if np.linalg.norm(offset[:3, 3]) > radius:
            expected = t
            break
    assert convergence_waypoint(demonstration, sphere) == expected


def test_t_star_is_the_last_waypoint_where_the_sphere_is_never_left():
    demonstration = along_x([0.0, 0.1, 0.2, 0.1, 0.0])
    assert convergence_waypoint(demonstration, sphere_at(demonstration, 1, 0.5)) == 4


def test_t_star_ignores_waypoints_before_the_key_and_on_the_sphere():
    demonstration = along_x([3.0, 0.0, 0.25, 0.5, 0.25, 0.75, 0.0])
    assert convergence_waypoint(demonstration, sphere_at(demonstration, 1, 0.5)) == 5


# --- spheres and annotations --------------------------------------------------------------------


@pytest.mark.parametrize("radius", [0, -0.01, np.nan, np.inf, -np.inf, "wide", None])
def test_a_radius_that_is_not_finite_and_positive_is_refused(radius):
    with pytest.raises(InvalidInput, match="radius of the sphere at waypoint 3: expected a finite"):
        PrecisionSphere(3, np.eye(4), radius)


@pytest.mark.parametrize("waypoint", [1.5, True, "1", np.nan, np.inf, None, [1]])
def test_a_waypoint_that_is_no_whole_number_is_refused(waypoint):
    with pytest.raises(InvalidInput, match="waypoint: expected a whole number, got"):
        PrecisionSphere(waypoint, np.eye(4), 0.1)


def test_a_negative_waypoint_is_refused():
    with pytest.raises(InvalidInput, match="waypoint: expected an index >= 0, got -1"):
        PrecisionSphere(-1, np.eye(4), 0.1)


@pytest.mark.parametrize(("waypoint", "radius"), [(2.0, 0.05), (np.int64(2), np.float32(0.05))])
def test_a_sphere_holds_a_plain_int_and_float_whatever_number_it_was_given(waypoint, radius):
    demonstration = along_x([0.0, 0.0, 0.0, 0.0, 0.1])
    sphere = sphere_at(demonstration, waypoint=2)
    sphere = dataclasses.replace(sphere, waypoint=waypoint, radius=radius)
    assert (type(sphere.waypoint), type(sphere.radius)) == (int, float)
    assert convergence_waypoint(demonstration, sphere) == 4


def test_a_sphere_of_unknown_kind_or_source_is_refused():
    with pytest.raises(InvalidInput, match="kind: expected 'ball' or 'free_space', got 'cube'"):
        PrecisionSphere(0, np.eye(4), 0.1, kind="cube")
    with pytest.raises(InvalidInput, match="source: expected 'human' or 'suggested', got 'oracle'"):
        PrecisionSphere(0, np.eye(4), 0.1, source="oracle")


def test_a_sphere_around_what_is_no_pose_is_refused():
    with pytest.raises(InvalidInput, match="T_world_key: not a rigid transform"):
        PrecisionSphere(0, 2 * np.eye(4), 0.1)


def test_an_annotation_without_spheres_is_refused():
    with pytest.raises(InvalidInput, match="annotation: has no sphere"):
        Annotation((), "hash")


@pytest.mark.parametrize("waypoints", [(2, 1), (1, 1), (0, 3, 2)])
def test_spheres_out_of_order_or_repeated_are_refused(waypoints):
    spheres = tuple(PrecisionSphere(w, np.eye(4), 0.1) for w in waypoints)
    with pytest.raises(InvalidInput, match="waypoints must increase without repeats, got"):
        Annotation(spheres, "hash")


def test_an_annotation_matches_the_demonstration_it_was_made_for():
    demonstration = make_demonstration()
    spheres = tuple(sphere_at(demonstration, w) for w in (0, 2, 4))
    Annotation(spheres, demonstration.content_hash()).check_matches(demonstration)


@pytest.mark.parametrize("made_for", ["another hash", 5, None])
def test_an_annotation_of_another_demonstration_is_a_mismatch(made_for):
    demonstration = make_demonstration()
    with pytest.raises((Mismatch, InvalidInput), match="annotation|demonstration_hash"):
        Annotation((sphere_at(demonstration, 0),), made_for).check_matches(demonstration)


@pytest.mark.parametrize("waypoint", [5, 6, 99])
def test_a_sphere_at_or_after_the_last_waypoint_is_a_mismatch(waypoint):
    demonstration = make_demonstration(6)
    annotation = Annotation(
        (PrecisionSphere(waypoint, np.eye(4), 0.1),), demonstration.content_hash()
    )
    with pytest.raises(Mismatch, match=f"sphere at waypoint {waypoint}: .* is 4; choose"):
        annotation.check_matches(demonstration)


@pytest.mark.parametrize("change", [pose([0.001, 0, 0]), pose(rotvec=[0, 0, 0.01])])
def test_a_key_pose_that_is_not_at_its_waypoint_is_a_mismatch(change):
    demonstration = make_demonstration()
    moved = PrecisionSphere(1, demonstration.steps.measured_Ts_world_tool[1] @ change, 0.1)
    with pytest.raises(Mismatch, match="T_world_key differs from the measured tool pose"):
        Annotation((moved,), demonstration.content_hash()).check_matches(demonstration)


# --- records refuse what does not fit -----------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rgb": np.zeros((2, 4, 6, 3))}, r"rgb: expected uint8 of shape .* got float64"),
        ({"rgb": np.zeros((4, 6, 3), np.uint8)}, r"rgb: expected uint8 of shape \(T, H, W, 3\)"),
        ({"rgb": np.zeros((2, 4, 6, 4), np.uint8)}, r"rgb: expected .* got uint8 \(2, 4, 6, 4\)"),
        ({"depth": np.zeros((2, 4, 5))}, r"depth: expected shape \(2, 4, 6\), got \(2, 4, 5\)"),
        ({"intrinsics": np.eye(2)}, r"intrinsics: expected shape \(3, 3\)"),
        ({"T_frame_camera": np.zeros((4, 4))}, "T_frame_camera: not a rigid transform"),
    ],
)
def test_a_camera_record_that_does_not_fit_is_refused(change, message):
    camera = make_camera(2, np.random.default_rng(0))
    with pytest.raises(InvalidInput, match=message):
        dataclasses.replace(camera, **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joint_positions": np.zeros((3, 6))}, r"joint_positions: expected shape \(4, 'n'\)"),
        ({"joint_velocities": np.full((4, 6), np.nan)}, "joint_velocities: has NaN"),
        ({"commanded_joint_positions": np.zeros(4)}, "commanded_joint_positions: expected shape"),
        ({"measured_Ts_world_tool": np.eye(4)}, "measured_Ts_world_tool: expected pose shape"),
        ({"commanded_Ts_world_tool": np.eye(4)[None]}, "commanded_Ts_world_tool: expected 4 poses"),
        ({"commanded_gripper": np.zeros(5)}, r"commanded_gripper: expected shape \(4,\)"),
        ({"measured_gripper": np.full(4, np.inf)}, "measured_gripper: has NaN or infinite"),
        ({"contact_force": np.zeros(3)}, r"contact_force: expected shape \(4,\), got \(3,\)"),
        (
            {"cameras": {"wrist": make_camera(3, np.random.default_rng(0))}},
            "camera 'wrist': expected 4 images, got 3",
        ),
    ],
)
def test_steps_that_do_not_fit_together_are_refused(change, message):
    steps = make_steps(4, np.random.default_rng(0))
    with pytest.raises(InvalidInput, match=message):
        dataclasses.replace(steps, **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": make_steps(1, np.random.default_rng(0))}, "needs at least 2 steps, got 1"),
        ({"timestamps": np.zeros(5)}, r"timestamps: expected shape \(6,\), got \(5,\)"),
        ({"raw_commands": np.zeros((9, 6))}, r"raw_commands: expected shape \('n', 7\)"),
        ({"success": np.zeros(5, bool)}, r"success: expected shape \(6,\), got \(5,\)"),
        ({"body_Ts_world": {"lid": np.zeros((6, 4, 4))}}, "lid: not a rigid transform"),
        ({"body_Ts_world": {"lid": np.eye(4)[None]}}, "lid: expected 6 poses, got 1"),
        ({"states": (b"a", b"b")}, "states: expected none or 6, got 2"),
    ],
)
def test_a_demonstration_that_does_not_fit_together_is_refused(change, message):
    with pytest.raises(InvalidInput, match=message):
        dataclasses.replace(make_demonstration(6), **change)


def test_a_sampled_pose_that_is_no_pose_is_refused():
    with pytest.raises(InvalidInput, match="T_world_sampled: not a rigid transform"):
        Provenance("hash", 0, 0, 0, 1, 2 * np.eye(4), 0, "sart", "paper")


# --- records keep copies ------------------------------------------------------------------------


def arrays_of(record):
    """Every array inside a record, by path."""
    found = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray):
            found[field.name] = value
        elif dataclasses.is_dataclass(value):
            found |= {f"{field.name}.{k}": v for k, v in arrays_of(value).items()}
        elif isinstance(value, dict):
            for key, item in value.items():
                if isinstance(item, np.ndarray):
                    found[f"{field.name}.{key}"] = item
                elif dataclasses.is_dataclass(item):
                    found |= {f"{field.name}.{key}.{k}": v for k, v in arrays_of(item).items()}
    return found


def test_no_array_of_a_record_can_be_written():
    demonstration = make_demonstration()
    episode = make_episode(demonstration, 3)
    arrays = arrays_of(demonstration) | arrays_of(episode) | arrays_of(sphere_at(demonstration, 0))
    assert {"steps.cameras.wrist.rgb", "body_Ts_world.block", "raw_commands"} <= set(arrays)
    assert [name for name, array in arrays.items() if array.flags.writeable] == []


def test_a_record_does_not_follow_the_array_that_it_was_made_from():
    demonstration = make_demonstration()
    forces, Ts = np.zeros(6), np.tile(np.eye(4), (6, 1, 1))
    steps = dataclasses.replace(
        demonstration.steps, contact_force=forces, measured_Ts_world_tool=Ts
    )
    forces[:] = 9
    Ts[:, 0, 3] = 9
    assert steps.contact_force.max() == 0
    assert steps.measured_Ts_world_tool[:, 0, 3].max() == 0


# --- hashes -------------------------------------------------------------------------------------


def test_a_digest_depends_neither_on_order_nor_on_memory_layout():
    array = np.arange(24.0).reshape(4, 6)
    expected = digest({"a": array, "b": {"x": 1, "y": [2, None]}})
    assert digest({"b": {"y": [2, None], "x": 1}, "a": np.asfortranarray(array)}) == expected
    assert digest({"b": {"x": 1, "y": (2, None)}, "a": np.repeat(array, 2, 0)[::2]}) == expected


def test_a_digest_tells_shapes_dtypes_and_values_apart():
    array = np.arange(24.0)
    different = [array, array.reshape(4, 6), array.astype(np.float32), array + 1e-12, array[:-1]]
    assert len({digest({"a": a}) for a in different}) == len(different)


names = st.text(st.sampled_from("a1/\0"), max_size=3)
values = st.one_of(st.integers(0, 200), st.text(st.sampled_from('a1"'), max_size=3), st.none())


@PROPERTY
@given(st.dictionaries(names, values, max_size=3), st.dictionaries(names, values, max_size=3))
def test_a_digest_tells_any_two_contents_apart(parts, others):
    assert (digest(parts) == digest(others)) == (parts == others)


def test_a_digest_keeps_names_apart_from_values():
    assert digest({"a": 11}) != digest({"a1": 1})


def test_a_demonstrations_hash_follows_every_array_that_was_shown():
    demonstration = make_demonstration()
    hashes = {demonstration.content_hash()}
    names = [name for name in arrays_of(demonstration.steps) if "." not in name]
    for name in names:
        changed = np.array(getattr(demonstration.steps, name))
        if changed.ndim == 3:
            changed[2] = changed[2] @ pose([0.01, 0, 0])
        else:
            changed[2] = 0.123
        steps = dataclasses.replace(demonstration.steps, **{name: changed})
        hashes.add(dataclasses.replace(demonstration, steps=steps).content_hash())
    camera = demonstration.steps.cameras["wrist"]
    for name in arrays_of(camera):
        changed = np.array(getattr(camera, name))
        if name == "T_frame_camera":
            changed[:3, :3] = exp_rotation(np.array([0.2, 0, 0]))
        else:
            changed.flat[-1] += 1
        steps = dataclasses.replace(
            demonstration.steps, cameras={"wrist": dataclasses.replace(camera, **{name: changed})}
        )
        hashes.add(dataclasses.replace(demonstration, steps=steps).content_hash())
    bodies = demonstration.body_Ts_world
    assert bodies
    for change in (
        {"raw_commands": demonstration.raw_commands + 1},
        {"success": ~demonstration.success},
        {"task": "run"},
        {"task_parameters": {}},
        {"robot": "another"},
        {"timestamps": demonstration.timestamps + 0.1},
        {"body_Ts_world": {k: pose([0.3, 0, 0]) @ Ts for k, Ts in bodies.items()}},
        {"touching": (*demonstration.touching[:-1], (("a", "b"), ("c", "d"), ("e", "f")))},
    ):
        hashes.add(dataclasses.replace(demonstration, **change).content_hash())
    assert len(hashes) == 1 + len(names) + 4 + 8


def test_a_demonstrations_hash_leaves_out_who_made_it_when_and_where_its_parts_are():
    demonstration = make_demonstration()
    other = dataclasses.replace(
        demonstration,
        seconds=9.0,
        versions={"numpy": "0"},
        operator="someone else",
        references={"task": "my_task.py:TASK"},
    )
    assert other.content_hash() == demonstration.content_hash()


def test_a_demonstrations_hash_follows_its_states_its_backend_and_its_judge():
    demonstration = make_demonstration()
    changes = [{"states": ()}, {"backend": "another"}, {"judged_by": "nobody"}]
    hashes = {dataclasses.replace(demonstration, **change).content_hash() for change in changes}
    assert len(hashes | {demonstration.content_hash()}) == 4


def test_an_episodes_hash_follows_its_steps_and_its_provenance():
    episode = make_episode(make_demonstration(), 3)
    other_steps = make_steps(4, np.random.default_rng(7))
    changes = [{"steps": other_steps}]
    for change in ({"k": 4}, {"t_star": 2}, {"T_world_sampled": np.eye(4)}, {"certificate": {}}):
        changes.append({"provenance": dataclasses.replace(episode.provenance, **change)})
    hashes = {dataclasses.replace(episode, **change).content_hash() for change in changes}
    assert len(hashes | {episode.content_hash()}) == len(changes) + 1


def test_an_annotations_hash_follows_its_spheres_but_not_the_time_spent():
    demonstration = make_demonstration()
    annotation = Annotation((sphere_at(demonstration, 0),), demonstration.content_hash())
    (sphere,) = annotation.spheres
    hashes = {annotation.content_hash()}
    for change in ({"radius": 0.1}, {"kind": "free_space"}, {"source": "suggested"}):
        changed = dataclasses.replace(sphere, **change)
        hashes.add(dataclasses.replace(annotation, spheres=(changed,)).content_hash())
    hashes.add(dataclasses.replace(annotation, demonstration_hash="x").content_hash())
    assert len(hashes) == 5
    assert dataclasses.replace(annotation, seconds=9.0).content_hash() in hashes


def test_library_versions_name_what_is_installed_and_skip_what_is_not(monkeypatch):
    assert {"python", "numpy", "h5py"} <= set(library_versions())

    def absent(name):
        raise records.importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(records.importlib.metadata, "version", absent)
    # Without what it remembers.
    uncached = records._installed_version.__wrapped__
    monkeypatch.setattr(records, "_installed_version", uncached)
    assert set(library_versions()) == {"python"}


# --- rates and mounts ---------------------------------------------------------------------------


def test_rates_divide_each_other():
    rates = Rates(physics_hz=240, control_hz=60, record_hz=15)
    assert (rates.physics_per_control, rates.control_per_record) == (4, 4)
    assert Rates(240, 30, 10) == DEFAULT_RATES


@pytest.mark.parametrize(
    ("rates", "message"),
    [
        ((240, 50, 10), r"physics_hz: expected a multiple of control_hz \(50 Hz\), got 240 Hz"),
        ((240, 30, 20), r"control_hz: expected a multiple of record_hz \(20 Hz\), got 30 Hz"),
        ((240, 30, 0), "record_hz: expected a whole number >= 1, got 0"),
        ((240.0, 30, 10), "physics_hz: expected a whole number >= 1, got 240.0"),
        ((240, True, True), "control_hz: expected a whole number >= 1, got True"),
    ],
)
def test_rates_that_do_not_divide_are_refused(rates, message):
    with pytest.raises(InvalidInput, match=message):
        Rates(*rates)


def test_the_rates_are_part_of_what_was_shown():
    demo = make_demonstration()
    slow = dataclasses.replace(demo, rates=Rates(record_hz=5))
    assert slow.content_hash() != demo.content_hash()


def test_a_camera_is_on_the_tool_or_in_the_world():
    rng = np.random.default_rng(0)
    Ts = random_walk(3, rng)
    on_tool = make_camera(3, rng)
    np.testing.assert_allclose(on_tool.Ts_world_camera(Ts), Ts @ on_tool.T_frame_camera)
    np.testing.assert_allclose(on_tool.Ts_world_camera(Ts[1]), Ts[1] @ on_tool.T_frame_camera)
    fixed = dataclasses.replace(on_tool, frame="world")
    np.testing.assert_array_equal(
        fixed.Ts_world_camera(Ts), np.tile(fixed.T_frame_camera, (3, 1, 1))
    )
    np.testing.assert_array_equal(fixed.Ts_world_camera(Ts[1]), fixed.T_frame_camera)
    with pytest.raises(InvalidInput, match="frame: expected 'tool' or 'world', got 'wrist'"):
        dataclasses.replace(on_tool, frame="wrist")


def test_success_is_judged_by_the_task_a_person_or_nobody():
    with pytest.raises(InvalidInput, match="judged_by: expected one of .*, got 'me'"):
        dataclasses.replace(make_demonstration(), judged_by="me")
