"""Clouds from sensors as they are: what is declared is enough, and what shows nothing is dropped.

The synthetic images show boxes over a floor, cast ray by ray, and no robot.
"""

from __future__ import annotations

import dataclasses
import json
import logging

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sart_toolkit.benchmark.noise import as_measured
from sart_toolkit.collision.cloud import SceneCloud, fuse_cloud, surface_errors
from sart_toolkit.collision.obstacles import CloudObstacles, hull_part
from sart_toolkit.collision.parts import coal_geometry, coal_transform, convex_distance
from sart_toolkit.collision.sensor import SENSORS, CloudConfig, SensorErrors, sensor_errors
from sart_toolkit.data.records import CameraRecord
from sart_toolkit.errors import InvalidInput, Mismatch, UnknownName
from sart_toolkit.poses import inverse, pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scenes.spec import Body, SceneSpec

FLOOR, PIXELS = -0.20, 64
BLOCK = Body("block", (Shape("box", (0.08, 0.06, 0.05)),), pose([0.50, 0.0, FLOOR + 0.10]))
# Half a pixel wide where it is seen.
WIRE = Body("wire", (Shape("box", (0.003, 0.16, 0.003)),), pose([0.47, 0.0, FLOOR + 0.16]))
# Fills the view of most images.
LID = Body("lid", (Shape("box", (0.5, 0.5, 0.01)),), pose([0.50, 0.0, FLOOR + 0.12]))
GROUND = Body("ground", (Shape("box", (4.0, 4.0, 0.2)),), pose([0, 0, FLOOR - 0.1]))
HAND_EYE = (0.002, 0.3)


@pytest.fixture(scope="module")
def robot(peg_task):
    return get_robot(peg_task.robot)


@pytest.fixture(scope="module")
def shown(peg_demonstration):
    """Makes demonstrations of a dozen waypoints whose depth shows a floor and some bodies."""

    def shown(*bodies, frame="tool", still=False):
        every = np.linspace(0, len(peg_demonstration) - 1, 12).astype(int)
        steps = peg_demonstration.steps
        rows = {
            f.name: getattr(steps, f.name)[every]
            for f in dataclasses.fields(steps)
            if f.name != "cameras"
        }
        # The camera looks from above at what the tool comes down to, a little from the side.
        Ts = rows["measured_Ts_world_tool"]
        Ts = np.stack([T @ pose([0.01 * (i % 3), 0, 0]) for i, T in enumerate(Ts)])
        rows["measured_Ts_world_tool"] = Ts
        T_tool_camera = steps.cameras["wrist"].T_frame_camera
        f = 0.5 * PIXELS / np.tan(np.deg2rad(30))
        K = np.array([[f, 0, (PIXELS - 1) / 2], [0, f, (PIXELS - 1) / 2], [0, 0, 1.0]])
        v, u = np.mgrid[:PIXELS, :PIXELS].reshape(2, -1)
        rays = np.stack([u, v, np.ones(u.size)], axis=1) @ np.linalg.inv(K).T
        depth = np.zeros((len(Ts), PIXELS, PIXELS), np.float32)
        for t, T_tool in enumerate(Ts):
            T = (Ts[0] if still else T_tool) @ T_tool_camera
            z = np.stack([cast(body, T, rays) for body in (GROUND, *bodies)]).min(0)
            depth[t] = np.where(np.isfinite(z), z, 0).reshape(PIXELS, PIXELS)
        rgb = np.full((*depth.shape, 3), 90, np.uint8)
        T_frame = T_tool_camera if frame == "tool" else Ts[0] @ T_tool_camera
        camera = CameraRecord(rgb, depth, K, frame, T_frame)
        return dataclasses.replace(
            peg_demonstration,
            steps=dataclasses.replace(steps, **rows, cameras={"wrist": camera}),
            timestamps=np.arange(len(Ts)) / 10,
            success=np.zeros(len(Ts), bool),
            touching=((),) * len(Ts),
            body_Ts_world={},
            states=(),
        )

    return shown


def cast(body, T_world_camera, rays):
    """The depth at which rays enter a box, infinite where they don't."""
    T = inverse(body.T_world_body) @ T_world_camera
    start, along = T[:3, 3], rays @ T[:3, :3].T
    half = np.array(body.shapes[0].size) / 2
    with np.errstate(divide="ignore"):
        a, b = (-half - start) / along, (half - start) / along
    enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def off_surface(cloud, *bodies):
    """How far seen points are from the bodies or the ground [m], and the points themselves."""
    seen = cloud.where(~cloud.behind)
    scene = SceneSpec((GROUND, *bodies))
    Ts = {body.name: body.T_world_body for body in scene.bodies}
    return surface_errors(seen, scene, Ts), seen


# --- flying pixels and lone points ----------------------------------------------------------------


@pytest.mark.parametrize("share", [0.002, 0.02])
def test_flying_pixels_are_dropped_and_surfaces_stay(shown, robot, share):
    demonstration = shown(BLOCK)
    errors = SensorErrors(flying=share)
    noisy = as_measured(demonstration, errors, 0.05, np.random.default_rng(0))
    free = CloudConfig(unknown="free")
    believed, _ = off_surface(fuse_cloud(noisy, robot, (), config=free), BLOCK)
    config = dataclasses.replace(free, sensor=errors)
    found, cloud = off_surface(fuse_cloud(noisy, robot, (), config=config), BLOCK)
    assert (believed > 0.02).sum() >= 10
    # What is left is beside the block, where no other image looks.
    assert (found > 0.02).sum() <= 0.2 * (believed > 0.02).sum()
    assert np.percentile(found, 99) < 0.004
    whole = fuse_cloud(demonstration, robot, (), config=free).points
    block = whole[np.abs(whole - BLOCK.T_world_body[:3, 3]).max(1) < 0.05]
    assert len(block) > 100 and cKDTree(cloud.points).query(block)[0].max() < 0.012


def test_a_wire_thinner_than_a_pixel_is_no_flying_pixel(shown, robot):
    demonstration = shown(BLOCK, WIRE)
    config = CloudConfig(unknown="free", sensor=SensorErrors(flying=0.02))
    for each in (CloudConfig(unknown="free"), config):
        cloud = fuse_cloud(demonstration, robot, (), config=each)
        along = np.linspace(-0.03, 0.03, 20)[:, None] * [0, 1, 0] + WIRE.T_world_body[:3, 3]
        # A point of the wire in each centimetre of it.
        assert cKDTree(cloud.points).query(along)[0].max() < 0.01


def test_a_lone_pixel_that_nothing_else_looks_at_is_dropped_and_a_patch_is_not(shown, robot):
    demonstration = shown()
    camera = demonstration.steps.cameras["wrist"]
    depth = np.array(camera.depth)
    depth[0, 20, 20] = 0.10
    depth[0, 40:44, 40:44] = 0.10
    steps = demonstration.steps
    with_both = dataclasses.replace(
        demonstration,
        steps=dataclasses.replace(
            steps, cameras={"wrist": dataclasses.replace(camera, depth=depth)}
        ),
    )
    config = CloudConfig(unknown="free", sensor=SensorErrors(flying=0.02))

    def high(config):
        cloud = fuse_cloud(with_both, robot, (), [0], config)
        return cloud.points[cloud.points[:, 2] > FLOOR + 0.05]

    alone, kept = high(CloudConfig(unknown="free")), high(config)
    assert 0 < len(kept) < len(alone)
    assert np.ptp(kept[:, :2], axis=0).max() < 0.015 < np.ptp(alone[:, :2], axis=0).max()


# --- what is declared -----------------------------------------------------------------------------


@pytest.mark.parametrize("draw", range(4))
@pytest.mark.parametrize(
    "declared",
    [
        sensor_errors("exact", HAND_EYE),
        sensor_errors("exact", (0.0, 0.0), 0.01),
        sensor_errors("d405", HAND_EYE, 0.01),
    ],
    ids=["hand-eye", "scale", "all of a D405"],
)
def test_no_point_is_farther_from_the_true_surface_than_its_ball_says(shown, robot, declared, draw):
    noisy = as_measured(shown(BLOCK), declared, 0.0, np.random.default_rng(draw))
    config = CloudConfig(unknown="free", sensor=declared)
    found, cloud = off_surface(fuse_cloud(noisy, robot, (), config=config), BLOCK)
    assert len(cloud) > 1000
    inside = found <= cloud.inflation
    # Single pixels at depth edges, half of which show nothing real, are only dropped mostly.
    assert inside.all() if not declared.flying else inside.mean() > 0.999
    # Balls are no larger than what was declared explains, and differ from point to point.
    assert cloud.inflation.max() < 0.0012 + 0.002 + 0.017 * 0.8 + 0.004
    assert np.ptp(cloud.inflation) > 1e-4


def test_without_errors_declared_points_stand_for_balls_of_one_size(shown, robot):
    cloud = fuse_cloud(shown(BLOCK), robot, ())
    assert (cloud.inflation == cloud.config.inflation).all()


def test_a_point_seen_from_near_stands_for_a_smaller_ball(shown, robot):
    sensor = sensor_errors("exact", HAND_EYE, 0.01)
    config = CloudConfig(unknown="free", sensor=sensor)
    demonstration = shown(BLOCK)
    last = len(demonstration) - 1
    far = fuse_cloud(demonstration, robot, (), [0], config)
    both = fuse_cloud(demonstration, robot, (), [0, last], config)
    block = [np.abs(c.points - BLOCK.T_world_body[:3, 3]).max(1) < 0.05 for c in (far, both)]
    assert both.inflation[block[1]].min() < far.inflation[block[0]].min() - 0.0005


# --- balls of several sizes -----------------------------------------------------------------------


def test_no_ball_counts_as_smaller_than_it_is():
    rng = np.random.default_rng(5)
    points, radii = rng.normal(scale=0.06, size=(400, 3)), rng.uniform(0.001, 0.008, 400)
    cloud = SceneCloud(
        points, np.zeros(points.shape, np.uint8), np.zeros(400, bool), CloudConfig(), radii
    )
    obstacles = CloudObstacles(cloud)
    step = (0.008 - 0.001) / 5
    p = rng.normal(scale=0.1, size=(50, 3))
    exact = (np.linalg.norm(p[:, None] - points, axis=2) - radii).min(1)
    found = obstacles.clearances(p)
    assert (found <= exact + 1e-9).all() and (found >= exact - step).all()
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.01
    cube = hull_part("cube", 1, corners)
    for _ in range(10):
        T = pose(rng.normal(scale=0.15, size=3), rng.normal(size=3))
        one_by_one = np.array([
            convex_distance(
                coal_geometry(Shape("sphere", (radius,))), coal_transform(pose(point)),
                cube.geometry, coal_transform(T @ cube.T_joint_part),
            )
            for point, radius in zip(points, radii, strict=True)
        ])  # fmt: skip
        least = obstacles.distance(cube, T)
        assert one_by_one.min() - step - 1e-4 <= least <= one_by_one.min() + 2e-6
        # None that is within 5 mm of the nearest is missed.
        near = (one_by_one <= least + 0.005).sum()
        assert len(obstacles.separations(cube, T, 0.005)) >= near


def test_a_ball_without_size_is_refused():
    with pytest.raises(InvalidInput, match="inflation: expected more than 0 m, got 0"):
        SceneCloud(
            np.zeros((2, 3)), np.zeros((2, 3), np.uint8), np.zeros(2, bool), CloudConfig(),
            np.array([0.001, 0.0]),
        )  # fmt: skip


# --- images that contradict each other ------------------------------------------------------------


def test_a_camera_in_the_world_that_is_recorded_on_the_tool_is_refused(shown, robot):
    # Its images don't change while the tool moves.
    with pytest.raises(Mismatch, match=r"camera 'wrist': \d+ of \d+ pairs .* recorded on what it"):
        fuse_cloud(shown(BLOCK, still=True), robot, ())


def test_a_camera_on_the_tool_that_is_recorded_in_the_world_is_refused(shown, robot):
    with pytest.raises(Mismatch, match=r"contradict each other from where they are said to be"):
        fuse_cloud(shown(BLOCK, frame="world"), robot, ())


def test_what_moved_before_the_camera_is_no_reason_to_refuse_its_images(shown, robot):
    demonstration, fallen = shown(BLOCK), shown(LID)
    steps = demonstration.steps
    camera, after = (d.steps.cameras["wrist"] for d in (demonstration, fallen))
    for first in (2, 6, 10):
        depth = np.concatenate([camera.depth[:first], after.depth[first:]])
        falls = dataclasses.replace(
            demonstration,
            steps=dataclasses.replace(
                steps, cameras={"wrist": dataclasses.replace(camera, depth=depth)}
            ),
        )
        assert len(fuse_cloud(falls, robot, ())) > 1000
        assert len(fuse_cloud(falls, robot, (), [first - 1, first])) > 500


def test_a_camera_in_the_world_that_is_recorded_there_shows_the_same_scene(shown, robot):
    demonstration = shown(BLOCK, frame="world", still=True)
    found, cloud = off_surface(fuse_cloud(demonstration, robot, ()), BLOCK)
    assert len(cloud) > 500 and found.max() < 0.002


@pytest.mark.parametrize(
    ("errors", "declared", "warns"),
    [
        ((0.0, 0.0, 0.03), (0.0, 0.0, 0.0), True),
        ((0.0, 0.0, 0.03), (0.0, 0.0, 0.03), False),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), False),
    ],
)
def test_images_that_differ_by_more_than_was_declared_are_warned_about(
    shown, robot, caplog, errors, declared, warns
):
    actual, said = (SensorErrors(a, b, c) for a, b, c in (errors, declared))
    noisy = as_measured(shown(BLOCK), actual, 0.0, np.random.default_rng(0))
    with caplog.at_level(logging.WARNING):
        fuse_cloud(noisy, robot, (), config=CloudConfig(sensor=said))
    assert any("declare more" in message for message in caplog.messages) == warns


# --- settings -------------------------------------------------------------------------------------


def test_settings_of_a_cloud_survive_json():
    config = CloudConfig(unknown="free", sensor=sensor_errors("d435", HAND_EYE, 0.01))
    assert CloudConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


@pytest.mark.parametrize("change", [{"sensor": {"hole": 1.0}}, {"voxels": 1.0}])
def test_settings_that_are_unknown_are_refused(change):
    with pytest.raises(InvalidInput, match="cloud: a setting is missing or wrong"):
        CloudConfig.from_json(CloudConfig().to_json() | change)


@pytest.mark.parametrize("name", ["hand_eye", "hand_eye_deg", "depth_scale", "noise", "flying"])
@pytest.mark.parametrize("value", [-0.1, np.nan, 1e3])
def test_an_error_that_is_negative_or_absurd_is_refused(name, value):
    with pytest.raises(InvalidInput, match=f"{name}: expected a number from 0 to"):
        SensorErrors(**{name: value})


def test_a_sensor_that_nobody_knows_is_refused():
    with pytest.raises(UnknownName, match="unknown sensor 'd453': did you mean 'd435'"):
        sensor_errors("d453")


def test_bounds_grow_with_distance_as_the_calibration_says():
    errors = sensor_errors("exact", HAND_EYE, 0.01)
    found = errors.systematic(np.array([0.0, 0.5]))
    np.testing.assert_allclose(
        found, [0.002, 0.002 + 0.5 * (0.3 * np.pi / 180 + 0.01 / 0.99)], 1e-5
    )
    z = np.array([0.2, 0.4])
    assert (SENSORS["d435"].noise_bound(z) > SENSORS["d405"].noise_bound(z)).all()
