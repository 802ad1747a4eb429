"""Other appearance: within what was asked for, the same for a seed, and nothing else changes."""

import dataclasses
import json
from contextlib import closing

import numpy as np
import pytest

from sart_toolkit.backends import BACKENDS, make_backend
from sart_toolkit.errors import InvalidInput, UnknownName
from sart_toolkit.poses import distance
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.appearance import Appearance, AppearanceConfig, randomise_appearance
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.tasks.task import Placement


@pytest.fixture(params=TASKS)
def task(request):
    return get_task(request.param)


def test_the_appearance_varies_within_what_was_asked_for(task):
    robot, config = get_robot(task.robot), AppearanceConfig()
    for seed in range(20):
        varied, scene = randomise_appearance(robot, task.scene, np.random.default_rng(seed))
        for old, new in zip(task.scene.bodies, scene.bodies, strict=True):
            colours = np.array([[s.rgba for s in body.shapes] for body in (old, new)])
            assert np.abs(colours[0] - colours[1]).max() <= config.colour + 1e-12
            assert (colours >= 0).all() and (colours <= 1).all()
        light = scene.light
        assert abs(light.intensity / task.scene.light.intensity - 1) <= config.light
        assert abs(light.ambient / task.scene.light.ambient - 1) <= config.ambient
        turned = np.rad2deg(np.arccos(light.direction @ task.scene.light.direction))
        assert turned <= np.sqrt(3) * config.light_deg
        cameras = [r.cameras[0].T_frame_camera for r in (robot, varied)]
        far, turn = distance(*cameras)
        assert far <= np.sqrt(3) * config.camera
        assert 0 < np.rad2deg(turn) <= np.sqrt(3) * config.camera_deg


def test_nothing_but_the_appearance_changes_and_shapes_of_one_colour_stay_alike(task):
    robot = get_robot(task.robot)
    varied, scene = randomise_appearance(robot, task.scene, np.random.default_rng(0))
    for old, new in zip(task.scene.bodies, scene.bodies, strict=True):
        shapes = [
            dataclasses.replace(s, rgba=o.rgba) for s, o in zip(new.shapes, old.shapes, strict=True)
        ]
        assert repr(dataclasses.replace(new, shapes=tuple(shapes))) == repr(old)
        alike = {}
        for was, now in zip(old.shapes, new.shapes, strict=True):
            assert alike.setdefault(was.rgba, now.rgba) == now.rgba
    assert scene.held == task.scene.held
    assert dataclasses.replace(varied, cameras=robot.cameras) is not varied


def test_a_seed_gives_the_same_appearance_and_another_seed_another(task):
    robot = get_robot(task.robot)
    a, b, c = (
        randomise_appearance(robot, task.scene, np.random.default_rng(seed))[1]
        for seed in (1, 1, 2)
    )
    assert repr(a) == repr(b) != repr(c)


@pytest.mark.parametrize("name", BACKENDS)
def test_a_state_is_restored_in_a_scene_of_another_appearance(name, peg_task):
    robot = get_robot(peg_task.robot)
    plain = make_backend(name, robot, peg_task.scene, 48)
    varied = make_backend(
        name, *randomise_appearance(robot, peg_task.scene, np.random.default_rng(3)), 48
    )
    plain.reset(peg_task.scene.initial_state(robot.home, 0.5))
    varied.restore(plain.save())
    a, b = plain.observe(("wrist",)), varied.observe(("wrist",))
    np.testing.assert_array_equal(a.q, b.q)
    difference = np.abs(a.cameras["wrist"].rgb.astype(int) - b.cameras["wrist"].rgb)
    assert difference.mean() > 2
    plain.close()
    varied.close()


def test_an_appearance_is_the_same_after_it_was_written_and_read(peg_task):
    robot = get_robot(peg_task.robot)
    appearance = Appearance((3, 1), AppearanceConfig(colour=0.3))
    again = Appearance.from_json(json.loads(json.dumps(appearance.to_json())))
    assert again == appearance
    looks = [a.applied(robot, peg_task.scene) for a in (appearance, again)]
    assert repr(looks[0]) == repr(looks[1])
    assert repr(looks[0]) != repr(Appearance((3, 1)).applied(robot, peg_task.scene))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("red", "appearance: expected seed and config"),
        ({"seed": [0]}, "appearance: expected seed and config"),
        ({"seed": [0], "config": {"colours": 1.0}}, "appearance: expected seed and config"),
        ({"seed": [0], "config": {}, "more": 1}, "appearance: expected seed and config"),
        ({"seed": [-1], "config": {}}, "seed: expected whole numbers >= 0"),
        ({"seed": [0], "config": {"light": -1.0}}, "light: expected a finite number >= 0"),
        ({"seed": [0], "config": {"light": "much"}}, "appearance: expected seed and config"),
    ],
)
def test_a_noted_appearance_that_is_none_is_refused(value, message):
    with pytest.raises(InvalidInput, match=message):
        Appearance.from_json(value)


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(AppearanceConfig)])
@pytest.mark.parametrize("value", [-0.1, np.nan])
def test_a_bad_spread_is_refused(name, value):
    with pytest.raises(InvalidInput, match=f"{name}: expected a finite number >= 0"):
        AppearanceConfig(**{name: value})


def test_only_what_is_named_varies(task):
    robot = get_robot(task.robot)
    for name, value in (("colour", 0.2), ("light", 0.5), ("camera_deg", 2.0)):
        config = AppearanceConfig.only(**{name: value})
        varied, scene = randomise_appearance(robot, task.scene, np.random.default_rng(0), config)
        changed = {
            "colour": repr(scene.bodies) != repr(task.scene.bodies),
            "light": scene.light.intensity != task.scene.light.intensity,
            "camera_deg": distance(
                *(r.cameras[0].T_frame_camera for r in (robot, varied))
            )[1] > 1e-6,
        }  # fmt: skip
        assert changed == {other: other == name for other in changed}
    with pytest.raises(UnknownName, match="part of the appearance 'color': did you mean 'colour'"):
        AppearanceConfig.only(color=0.1)


def test_a_camera_offset_is_as_long_as_asked_for_in_any_direction(task):
    robot, config = get_robot(task.robot), AppearanceConfig.only(camera_offset=0.002)
    moved = []
    for seed in range(5):
        varied, _ = randomise_appearance(robot, task.scene, np.random.default_rng(seed), config)
        T, T_was = (r.cameras[0].T_frame_camera for r in (varied, robot))
        np.testing.assert_allclose(T[:3, :3], T_was[:3, :3], atol=1e-9)
        moved.append(T[:3, 3] - T_was[:3, 3])
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 0.002)
    assert np.ptp(moved, axis=0).min() > 1e-4


def test_distractors_lie_on_the_table_off_all_other_bodies_and_touch_nothing(task):
    robot, config = get_robot(task.robot), AppearanceConfig.only(distractors=6)
    model = RobotModel(robot, task.scene.held)
    placement = Placement(0.05, -0.05, 20.0)
    Ts = task.initial_state(model, placement).Ts_world_body
    _, scene = randomise_appearance(robot, task.scene, np.random.default_rng(3), config, Ts)
    added = {
        body.name: body.shapes[len(old.shapes) :]
        for old, body in zip(task.scene.bodies, scene.bodies, strict=True)
    }
    shapes = added.pop("table")
    assert len(shapes) == 6 and not any(added.values())
    assert not any(shape.collides for shape in shapes)
    for shape in shapes:
        corners = shape.corners()
        assert 0 <= corners[:, 2].min() < 0.005 and corners[:, 2].max() < 0.1
        for body in task.scene.bodies:
            if body.name != "table":
                points = [c for s in body.shapes for c in s.corners()]
                points = np.array(points) @ Ts[body.name][:3, :3].T + Ts[body.name][:3, 3]
                gaps = np.linalg.norm(points[:, None, :2] - corners[None, :, :2], axis=-1)
                assert gaps.min() > 0.005


@pytest.mark.parametrize(
    ("bodies", "complaint"),
    [((), "no body that never moves"), (("table",), "no object for them to lie around")],
)
def test_distractors_need_something_to_lie_on_and_around(bodies, complaint):
    task = get_task("peg_in_hole")
    kept = tuple(body for body in task.scene.bodies if body.name in bodies)
    scene = dataclasses.replace(task.scene, bodies=kept)
    config = AppearanceConfig.only(distractors=1)
    with pytest.raises(InvalidInput, match=complaint):
        randomise_appearance(get_robot(task.robot), scene, np.random.default_rng(0), config)


def test_the_wrist_camera_sees_distractors():
    task = get_task("peg_in_hole")
    robot = get_robot(task.robot)
    state = task.initial_state(RobotModel(robot, task.scene.held), Placement())
    config = AppearanceConfig.only(distractors=8)
    _, varied = randomise_appearance(
        robot, task.scene, np.random.default_rng(1), config, state.Ts_world_body
    )
    images = []
    for scene in (task.scene, varied):
        with closing(make_backend("pybullet", robot, scene, 64)) as backend:
            backend.reset(state)
            images.append(backend.observe(("wrist",)).cameras["wrist"].rgb.astype(int))
    assert (np.abs(images[0] - images[1]).max(axis=-1) > 20).sum() > 30


@pytest.mark.parametrize("distractors", [-1, 1.5])
def test_a_number_of_distractors_that_is_none_is_refused(distractors):
    with pytest.raises(InvalidInput, match="distractors: expected a"):
        AppearanceConfig(distractors=distractors)
