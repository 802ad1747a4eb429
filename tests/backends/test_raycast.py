"""What rays find: the nearest surface, at its depth, in its colour, wherever bodies are."""

import itertools
import subprocess
import sys

import numpy as np
import pytest

from sart_toolkit.backends import raycast
from sart_toolkit.backends.raycast import RayCaster
from sart_toolkit.poses import inverse, pose
from sart_toolkit.robots.spec import CameraSpec, Shape
from sart_toolkit.robots.visuals import body_meshes
from sart_toolkit.scenes.spec import Light

SIZE = 48, 32
FLAT = Light(intensity=0.0, ambient=1.0)
RED, GREEN, BLUE = (1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)


def _camera(**changes):
    return CameraSpec("camera", "world", np.eye(4), **{"fov_y_deg": 60.0, "far": 10.0, **changes})


def _see(bodies, Ts, light=FLAT, camera=None, size=SIZE, T_world_camera=None, carried=None):
    """An image from the origin along z; bodies are of one shape each."""
    caster = RayCaster({name: body_meshes([shape]) for name, shape in bodies.items()}, light)
    T = np.eye(4) if T_world_camera is None else T_world_camera
    return caster.view(camera or _camera(), T, size, Ts, carried)


def _shown(image, rgba):
    return (image.rgb == np.round(255 * np.array(rgba[:3]))).all(axis=2)


def _random_pose(rng, far):
    return pose([*rng.uniform(-0.3, 0.3, 2), far], rng.normal(size=3))


def _points(image, camera):
    """What pixels show `(H, W, 3)` [m], in the camera's frame."""
    height, width = image.depth.shape
    K = camera.intrinsics(width, height)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=2)
    return rays * image.depth[..., None]


def _outside(shape, p):
    """How far points `(n, 3)` in a shape's frame are outside of it [m]; negative inside."""
    if shape.kind == "box":
        return (np.abs(p) - np.array(shape.size) / 2).max(axis=1)
    if shape.kind == "sphere":
        return np.linalg.norm(p, axis=1) - shape.size[0]
    return np.maximum(
        np.hypot(p[:, 0], p[:, 1]) - shape.size[0], np.abs(p[:, 2]) - shape.size[1] / 2
    )


@pytest.mark.parametrize(
    ("shape", "facet"),
    [
        (Shape("box", (0.2, 0.3, 0.4)), 1e-6),
        (Shape("cylinder", (0.2, 0.3)), 0.2 * (1 - np.cos(np.pi / 48)) + 1e-6),
        (Shape("sphere", (0.2,)), 2e-3),
    ],
)
def test_what_is_seen_lies_on_the_surface_that_faces_the_camera(shape, facet):
    rng, camera = np.random.default_rng(0), _camera()
    for _ in range(10):
        T = _random_pose(rng, 0.8)
        image = _see({"body": shape}, {"body": T})
        hit = image.depth > 0
        assert 20 < hit.sum() < hit.size
        p = _points(image, camera)[hit] @ inverse(T)[:3, :3].T + inverse(T)[:3, 3]
        out = _outside(shape, p)
        assert out.max() < 1e-6 and out.min() > -facet
        # A little before it there is nothing of it yet.
        nearer = 0.999 * _points(image, camera)[hit] @ inverse(T)[:3, :3].T + inverse(T)[:3, 3]
        assert (_outside(shape, nearer) > out - 1e-6).all()


def test_what_is_nearer_hides_what_is_farther_whatever_their_order():
    bodies = {
        "far": Shape("box", (9, 9, 0.1), rgba=RED),
        "near": Shape("sphere", (0.1,), rgba=BLUE),
    }
    Ts = {"far": pose([0, 0, 2]), "near": pose([0, 0, 1])}
    images = [
        _see({name: bodies[name] for name in names}, Ts)
        for names in (("far", "near"), ("near", "far"))
    ]
    np.testing.assert_array_equal(images[0].rgb, images[1].rgb)
    np.testing.assert_array_equal(images[0].depth, images[1].depth)
    assert _shown(images[0], BLUE)[16, 24] and _shown(images[0], RED)[0, 0]
    assert images[0].depth[0, 0] == pytest.approx(1.95, abs=1e-6)


def test_bodies_through_each_other_show_where_each_is_nearer():
    tall, wide = Shape("box", (0.1, 1, 0.1), rgba=RED), Shape("box", (1, 0.1, 0.2), rgba=GREEN)
    image = _see({"tall": tall, "wide": wide}, dict.fromkeys(("tall", "wide"), pose([0, 0, 1])))
    assert _shown(image, GREEN)[16, 24] and _shown(image, GREEN)[16, 10]
    assert _shown(image, RED)[4, 24]


@pytest.mark.parametrize("seed", range(5))
def test_faces_met_as_planes_are_those_that_triangles_give(monkeypatch, seed):
    rng = np.random.default_rng(seed)
    bodies = {f"box {i}": Shape("box", tuple(rng.uniform(0.1, 0.5, 3)), rgba=c)
              for i, c in enumerate((RED, GREEN, BLUE))}  # fmt: skip
    Ts = {name: _random_pose(rng, 1.0) for name in bodies}
    light = Light(rng.normal(size=3))
    planes = _see(bodies, Ts, light)
    monkeypatch.setattr(raycast, "_MOST_PLANES", 0)
    triangles = _see(bodies, Ts, light)
    np.testing.assert_allclose(planes.depth, triangles.depth, atol=1e-5)
    assert np.abs(planes.rgb.astype(int) - triangles.rgb).max() <= 1


def test_nothing_is_seen_before_near_or_beyond_far_or_behind():
    camera = _camera(near=0.5, far=1.5)
    boxes = {name: Shape("box", (0.1, 0.1, 0.1)) for name in "abcd"}
    Ts = {"a": pose([0, 0, 0.3]), "b": pose([0, 0, 2]), "c": pose([0, 0, -1]), "d": pose([3, 0, 1])}
    image = _see(boxes, Ts, camera=camera)
    assert not image.depth.any()
    assert (image.rgb == 255).all()


@pytest.mark.parametrize("kind", ["box", "cylinder"])
def test_what_reaches_past_the_camera_is_seen_as_far_as_it_is_before_it(kind):
    """A floor below the camera, with corners behind it."""
    size = {"box": (8, 0.2, 8), "cylinder": (4, 0.2)}[kind]
    turn = [np.pi / 2, 0, 0] if kind == "cylinder" else [0, 0, 0]
    image = _see({"floor": Shape(kind, size)}, {"floor": pose([0, 1.1, 1], turn)})
    rays = _points(image, _camera())[31, 24]
    assert rays[1] == pytest.approx(1.0, abs=1e-5)
    assert (image.depth[22:, 20:28] > 0).all() and not image.depth[:16].any()


def test_round_bodies_are_shaded_smoothly():
    light = Light(np.array([0.0, 0.0, -1.0]), intensity=1.0, ambient=0.0)
    ball = {"ball": Shape("sphere", (0.3,), rgba=(1, 1, 1, 1))}
    image = _see(ball, {"ball": pose([0, 0, 1])}, light, size=(128, 128))
    row = image.rgb[64, image.depth[64] > 0, 0].astype(int)
    assert np.abs(np.diff(row[4:-4])).max() < 24 and row.max() > 250
    p = _points(image, _camera())[64, image.depth[64] > 0] - [0, 0, 1]
    np.testing.assert_allclose(row, 255 * np.clip(-p[:, 2] / 0.3, 0, 1), atol=6)


def test_bodies_that_move_with_the_camera_look_as_any_others():
    rng = np.random.default_rng(2)
    bodies = {
        "hand": Shape("cylinder", (0.05, 0.3), rgba=RED),
        "held": Shape("box", (0.1, 0.1, 0.2), rgba=GREEN),
        "table": Shape("box", (3, 3, 0.1), rgba=BLUE),
    }
    light = Light(rng.normal(size=3), shadows=True)
    caster = RayCaster({name: body_meshes([shape]) for name, shape in bodies.items()}, light)
    near = {"hand": _random_pose(rng, 0.5), "held": _random_pose(rng, 0.6)}
    for _ in range(3):
        T = _random_pose(rng, 0.0)
        Ts = {**{name: T @ Tn for name, Tn in near.items()}, "table": T @ pose([0, 0, 1.5])}
        alone = caster.view(_camera(), T, SIZE, Ts)
        together = caster.view(_camera(), T, SIZE, {"table": Ts["table"]}, near)
        off = np.abs(alone.rgb.astype(int) - together.rgb).max(axis=2)
        assert (off > 1).mean() < 0.005
        assert (np.abs(alone.depth - together.depth) > 1e-5).mean() < 0.005
        # The second of the same is the first, to the bit.
        again = caster.view(_camera(), T, SIZE, {"table": Ts["table"]}, near)
        np.testing.assert_array_equal(again.rgb, together.rgb)


def test_a_body_between_light_and_floor_shades_it_and_no_body_shades_itself_in_the_light():
    light = Light(np.array([0.0, -1.0, -1.0]), intensity=0.5, ambient=0.5, shadows=True)
    bodies = {
        "wall": Shape("box", (4, 4, 0.1), rgba=(1, 1, 1, 1)),
        "ball": Shape("sphere", (0.2,), rgba=RED),
    }
    image = _see(bodies, {"wall": pose([0, 0, 2]), "ball": pose([0, -0.7, 1.3])}, light)
    K = _camera().intrinsics(*SIZE)
    # The ball's centre, moved along the light onto the wall at 1.95.
    u, v = np.round(K[:2, :2] @ [0, (-0.7 + 0.65) / 1.95] + K[:2, 2]).astype(int)
    assert image.rgb[v, u].tolist() == [128] * 3
    lit = round(255 * (0.5 + 0.5 * np.sqrt(0.5)))
    assert (np.abs(image.rgb[:, 2, 0].astype(int) - lit) <= 1).all()
    red = (image.rgb[..., 0] > 0) & (image.rgb[..., 1] == 0)
    normals = (_points(image, _camera())[red] - [0, -0.7, 1.3]) / 0.2
    facing = np.clip(normals @ light.direction, 0, None)
    np.testing.assert_allclose(image.rgb[red][:, 0], 255 * (0.5 + 0.5 * facing), atol=8)
    assert (facing > 0.2).sum() > 5


_DRAW = """
import hashlib, numpy as np
from sart_toolkit.backends import make_backend
from sart_toolkit.robots import get_robot
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement
from sart_toolkit.robots.model import RobotModel
task = get_task("lid_opening")
robot = get_robot(task.robot)
state = task.initial_state(RobotModel(robot, task.scene.held), Placement())
backend = make_backend("pybullet", robot, task.scene, 64)
{before}
view = backend.draw(state, backend.cameras["wrist"], 64, 64)
print(hashlib.sha256(view.rgb.tobytes() + view.depth.tobytes()).hexdigest())
"""


def test_a_state_is_drawn_to_the_same_bytes_in_any_process_whatever_was_drawn_before():
    before = (
        "",
        "import dataclasses; backend.draw(dataclasses.replace(state, q=state.q + 0.2), "
        "backend.cameras['wrist'], 64, 64)",
    )
    runs = [
        subprocess.run(
            [sys.executable, "-c", _DRAW.format(before=each)], capture_output=True, check=True
        ).stdout
        for each in before
    ]
    assert len(set(runs)) == 1 and len(runs[0]) == 65


def test_no_gap_shows_between_the_faces_of_a_body():
    """A box before a wall of another colour: no pixel of the wall within its outline."""
    rng = np.random.default_rng(3)
    for turn, kind in itertools.product(range(6), ("box", "cylinder", "sphere")):
        size = {"box": (0.3, 0.3, 0.3), "cylinder": (0.2, 0.3), "sphere": (0.2,)}[kind]
        T = pose([0, 0, 0.8], rng.normal(size=3)) if turn else pose([0, 0, 0.8])
        body, wall = Shape(kind, size, rgba=RED), Shape("box", (9, 9, 0.1), rgba=GREEN)
        image = _see({"body": body, "wall": wall}, {"body": T, "wall": pose([0, 0, 3])},
                     size=(129, 129))  # fmt: skip
        red = _shown(image, RED)
        assert (red | _shown(image, GREEN)).all()
        for line in (*red, *red.T):
            # A convex body's pixels of a line are one run.
            assert np.abs(np.diff(line.astype(int))).sum() <= 2
