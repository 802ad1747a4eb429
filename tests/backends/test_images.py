"""Both simulators draw the same: who is seen where, how far, and how bright."""

import dataclasses
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from sart_toolkit.backends import make_backend
from sart_toolkit.poses import pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import CameraSpec, Shape, look_at
from sart_toolkit.scenes.spec import Body, Light, SceneSpec
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.tasks.task import Placement

OVERVIEW = CameraSpec(
    "overview",
    "world",
    look_at(np.array([1.2, 0.9, 0.8]), np.array([0.4, 0.0, 0.2]), np.array([0.0, 0.0, 1.0])),
    fov_y_deg=50.0,
)


def _need_sapien():
    renderer = pytest.importorskip("sart_toolkit.backends.sapien_renderer")
    if why := renderer.why_no_images():
        pytest.skip(f"SAPIEN can't draw here: {why}")


@pytest.fixture(
    params=["pybullet", pytest.param("sapien", marks=pytest.mark.render)],
)
def backend_name(request):
    if request.param == "sapien":
        _need_sapien()
    return request.param


def _number(shapes, numbers):
    """Shapes, each in a colour of its own."""
    return tuple(
        dataclasses.replace(shape, rgba=(*np.array([n % 7, n // 7 % 7, n // 49]) * 40 / 255, 1.0))
        for shape in shapes
        for n in [next(numbers)]
    )


def _numbered(task):
    """Robot and scene of a task where each link's and each shape's colour says which it is."""
    robot, numbers = get_robot(task.robot), iter(range(1, 343))
    links = ET.parse(RobotModel(robot, task.scene.held).urdf).getroot().findall("link")
    colour = {link.get("name"): _number([Shape("sphere", (1.0,))], numbers)[0] for link in links}
    robot = dataclasses.replace(
        robot,
        link_colours={name: shape.rgba for name, shape in colour.items()},
        attachments=tuple(
            dataclasses.replace(a, shapes=_number(a.shapes, numbers)) for a in robot.attachments
        ),
    )
    scene = dataclasses.replace(
        task.scene,
        bodies=tuple(
            dataclasses.replace(body, shapes=_number(body.shapes, numbers))
            for body in task.scene.bodies
        ),
        held=tuple(
            dataclasses.replace(a, shapes=_number(a.shapes, numbers)) for a in task.scene.held
        ),
        light=Light(intensity=0.0, ambient=1.0),
    )
    return robot, scene


def _by_both(robot, scene, state):
    """Images by the wrist camera and from outside, of PyBullet and of SAPIEN."""
    views = []
    for kind in ("pybullet", "sapien"):
        backend = make_backend(kind, robot, scene)
        cameras = backend.cameras["wrist"], OVERVIEW
        views.append([backend.draw(state, camera, 160, 128) for camera in cameras])
        backend.close()
    return list(zip(*views, strict=True))


@pytest.mark.render
@pytest.mark.parametrize("name", TASKS)
def test_both_simulators_see_the_same_bodies_at_the_same_depth(name):
    _need_sapien()
    task = get_task(name)
    robot, scene = _numbered(task)
    state = task.initial_state(RobotModel(robot, scene.held), Placement())
    for ours, theirs in _by_both(robot, scene, state):
        same = (ours.rgb == theirs.rgb).all(axis=2)
        assert len(np.unique(ours.rgb[same], axis=0)) > 5
        # On edges, and where two bodies share a face, either may be seen.
        assert same.mean() > 0.99
        off = np.abs(ours.depth - theirs.depth)[same]
        assert np.percentile(off, 90) < 1e-5
        # Round bodies have other facets.
        assert off.max() < 3e-3


@pytest.mark.render
@pytest.mark.parametrize("shadows", [False, True])
def test_both_simulators_show_the_same_colours(shadows):
    _need_sapien()
    task = get_task("bottle_placing")
    scene = dataclasses.replace(task.scene, light=Light(shadows=shadows))
    robot = get_robot(task.robot)
    state = task.initial_state(RobotModel(robot, scene.held), Placement())
    for ours, theirs in _by_both(robot, scene, state):
        off = np.abs(ours.rgb.astype(int) - theirs.rgb).max(axis=2)
        # Shadows have soft edges in SAPIEN.
        assert (off > 4).mean() < (0.05 if shadows else 0.002)


@pytest.mark.parametrize("shadows", [False, True])
def test_a_face_shows_its_colour_as_the_light_has_it_and_less_in_shadow(backend_name, shadows):
    colour = np.array([0.2, 0.5, 0.8])
    light = Light(np.array([1.0, 0, 1]), intensity=0.5, ambient=0.4, shadows=shadows)
    floor = Body("floor", (Shape("box", (2, 2, 0.1), pose([-1.5, 0, -0.05]), (*colour, 1)),))
    post = Body("post", (Shape("box", (0.1, 0.1, 0.2), pose([-1.5, 0, 0.4])),))
    eye, up = np.array([-1.5, 0, 1.5]), np.array([0, 1.0, 0])
    camera = CameraSpec("above", "world", look_at(eye, np.array([-1.5, 0, 0]), up), 40.0)
    scene = SceneSpec((floor, post), cameras=(camera,), light=light)
    backend = make_backend(backend_name, get_robot("ur5e_hande"), scene, 64)
    backend.reset(scene.initial_state(backend.robot.home, 0.0))
    rgb = backend.observe(("above",)).cameras["above"].rgb
    # The post's shadow falls 0.3 to 0.5 m towards -x, which is left in the image.
    lit = 255 * colour * (0.4 + 0.5 * np.cos(np.pi / 4))
    np.testing.assert_allclose(rgb[32, 60], lit, atol=1)
    np.testing.assert_allclose(rgb[32, 9], 255 * colour * 0.4 if shadows else lit, atol=1)
    backend.close()
