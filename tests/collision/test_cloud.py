"""Clouds: on the scene, never on the robot, forgetful of what moved; distances that miss no point.

The synthetic images show boxes over a floor, cast ray by ray, and no robot.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sart_toolkit.collision.cloud import (
    CloudConfig,
    GraspedObject,
    SceneCloud,
    fuse_cloud,
    grasped_object,
    surface_errors,
)
from sart_toolkit.collision.obstacles import CloudObstacles, hull_part
from sart_toolkit.collision.parts import (
    coal_geometry,
    coal_transform,
    convex_distance,
    robot_parts,
)
from sart_toolkit.data.records import CameraRecord
from sart_toolkit.errors import InvalidInput, Mismatch, UnknownName
from sart_toolkit.poses import inverse, pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scenes.spec import Body, SceneSpec

FLOOR = -0.20
# Beside the peg's path and in the camera's view.
BOX = pose([0.50, 0.03, FLOOR + 0.15])
SIZE = (0.06, 0.05, 0.04)
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.01


@pytest.fixture(scope="module")
def robot(peg_task):
    return get_robot(peg_task.robot)


@pytest.fixture(scope="module")
def way_down(peg_demonstration):
    """The tool's poses in peg-in-hole."""
    return peg_demonstration.steps.measured_Ts_world_tool


@pytest.fixture(scope="module")
def recorded(peg_demonstration, peg_task, robot):
    """The cloud of the recorded peg-in-hole demonstration."""
    return fuse_cloud(peg_demonstration, robot, peg_task.scene.held)


@pytest.fixture(scope="module")
def rendered(peg_demonstration):
    """Makes demonstrations whose depth shows a floor and, at each waypoint, boxes at poses.

    `Ts` are the tool's poses where they aren't those of peg-in-hole, straight down.
    """

    def rendered(boxes_at, size=48, Ts=None):
        steps = peg_demonstration.steps
        if Ts is not None:
            steps = dataclasses.replace(steps, measured_Ts_world_tool=Ts)
        T_tool_camera = steps.cameras["wrist"].T_frame_camera
        f = 0.5 * size / np.tan(np.deg2rad(30))
        K = np.array([[f, 0, (size - 1) / 2], [0, f, (size - 1) / 2], [0, 0, 1.0]])
        v, u = np.mgrid[:size, :size].reshape(2, -1)
        rays = np.stack([u, v, np.ones(u.size)], axis=1) @ np.linalg.inv(K).T
        depth = np.zeros((len(steps), size, size), np.float32)
        for t, T_tool in enumerate(steps.measured_Ts_world_tool):
            T = T_tool @ T_tool_camera
            z = [(FLOOR - T[2, 3]) / (rays @ T[2, :3])]
            for T_box in boxes_at(t):
                z.append(cast(inverse(T_box) @ T, rays))
            z = np.stack(z)
            z[z <= 0] = np.inf
            nearest = z.min(0)
            depth[t] = np.where(np.isfinite(nearest), nearest, 0).reshape(size, size)
        rgb = np.full((*depth.shape, 3), 90, np.uint8)
        camera = CameraRecord(rgb, depth, K, "tool", T_tool_camera)
        return dataclasses.replace(
            peg_demonstration, steps=dataclasses.replace(steps, cameras={"wrist": camera})
        )

    return rendered


def cast(T_box_camera, rays):
    """The depth at which rays enter the box, infinite where they don't."""
    start, along = T_box_camera[:3, 3], rays @ T_box_camera[:3, :3].T
    half = np.array(SIZE) / 2
    a, b = (-half - start) / along, (half - start) / along
    enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
    return np.where(enter < leave, enter, np.inf)


def on_box(points, T_box, within=0.004):
    """Which points are on the box, or inside."""
    p = (points - T_box[:3, 3]) @ T_box[:3, :3]
    return (np.abs(p) <= np.array(SIZE) / 2 + within).all(1)


def seen(cloud):
    return cloud.points[~cloud.behind]


def cloud_of(points, inflation=0.001):
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    return SceneCloud(
        points,
        np.zeros(points.shape, np.uint8),
        np.zeros(len(points), bool),
        CloudConfig(inflation=inflation),
    )


# --- the cloud ----------------------------------------------------------------------------------


def test_every_point_of_a_recorded_demonstration_is_on_the_scene_and_none_on_the_robot(
    recorded, peg_demonstration, peg_task
):
    Ts = {name: Ts[0] for name, Ts in peg_demonstration.body_Ts_world.items()}
    errors = surface_errors(recorded, peg_task.scene, Ts)[~recorded.behind]
    assert len(errors) > 2000
    assert np.percentile(errors, 95) < 1e-3
    assert errors.max() < 4e-3


def test_a_recorded_cloud_shows_the_block_in_its_colour_and_the_table(recorded):
    p, colours = seen(recorded), recorded.colours[~recorded.behind].astype(int)
    top = (np.abs(p[:, 2] - 0.04) < 1e-3) & (np.abs(p[:, 0] - 0.5) < 0.05)
    assert top.sum() > 50
    assert np.median(colours[top, 0] - colours[top, 2]) > 60
    assert (np.abs(p[:, 2]) < 1e-3).sum() > 1000


def test_fusing_twice_gives_the_same_bytes(recorded, peg_demonstration, peg_task, robot):
    again = fuse_cloud(peg_demonstration, robot, peg_task.scene.held)
    for name in ("points", "colours", "behind"):
        assert getattr(again, name).tobytes() == getattr(recorded, name).tobytes()


def test_no_cell_of_the_grid_holds_two_seen_points(recorded):
    cells = np.rint(seen(recorded) / recorded.config.voxel)
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_what_stays_is_in_the_cloud_and_what_left_is_not(rendered, robot):
    def still(cloud):
        return on_box(seen(cloud), BOX).sum()

    stays = fuse_cloud(rendered(lambda t: [BOX]), robot, ())
    leaves = rendered(lambda t: [BOX] if t < 15 else [])
    assert still(stays) > 30
    assert still(fuse_cloud(leaves, robot, ())) == 0
    assert still(fuse_cloud(leaves, robot, (), range(15))) > 30


def test_a_later_image_does_not_take_away_the_edges_of_what_stays(rendered, robot, way_down):
    demonstration = rendered(lambda t: [BOX], 96, from_two_sides(way_down))
    free = CloudConfig(unknown="free")
    both = seen(fuse_cloud(demonstration, robot, (), [0, 1], free))
    one = seen(fuse_cloud(demonstration, robot, (), [0], free))
    on_it = one[on_box(one, BOX)]
    assert cKDTree(both).query(on_it)[0].max() < 0.004


def test_what_comes_later_is_in_the_cloud(rendered, robot):
    comes = rendered(lambda t: [BOX] if t >= 15 else [])
    assert on_box(seen(fuse_cloud(comes, robot, ())), BOX).sum() > 30


def test_a_noisy_pixel_that_other_images_see_through_is_dropped(rendered, robot):
    demonstration = rendered(lambda t: [])
    camera = demonstration.steps.cameras["wrist"]
    depth = np.array(camera.depth)
    depth[0, 10:14, 20:24] -= 0.1
    noisy = with_depth(demonstration, depth)
    assert np.abs(seen(fuse_cloud(noisy, robot, (), [0]))[:, 2] - FLOOR).max() > 0.05
    assert np.abs(seen(fuse_cloud(noisy, robot, ()))[:, 2] - FLOOR).max() < 1e-3


def with_depth(demonstration, depth):
    steps = demonstration.steps
    camera = dataclasses.replace(steps.cameras["wrist"], depth=depth)
    return dataclasses.replace(
        demonstration, steps=dataclasses.replace(steps, cameras={"wrist": camera})
    )


def test_a_depth_that_is_no_number_counts_as_nothing(rendered, robot):
    demonstration = rendered(lambda t: [BOX])
    depth = np.array(demonstration.steps.cameras["wrist"].depth)
    depth[:, :10], depth[:, 10:20], depth[:, 20:24] = np.nan, np.inf, -1.0
    holes = np.array(depth)
    holes[:, :24] = 0.0
    a = fuse_cloud(with_depth(demonstration, depth), robot, ())
    b = fuse_cloud(with_depth(demonstration, holes), robot, ())
    assert a.points.tobytes() == b.points.tobytes()


def test_points_are_within_depth_range_and_reach(rendered, robot):
    demonstration = rendered(lambda t: [BOX])
    config = CloudConfig(far=0.45, reach=0.25, unknown="free")
    cloud = fuse_cloud(demonstration, robot, (), config=config)
    steps = demonstration.steps
    Ts = steps.measured_Ts_world_tool
    from_tool = np.linalg.norm(cloud.points[:, None] - Ts[:, :3, 3], axis=2).min(1)
    assert from_tool.max() <= 0.25
    Ts_camera = Ts @ steps.cameras["wrist"].T_frame_camera
    z = np.stack([((cloud.points - T[:3, 3]) @ T[:3, :3])[:, 2] for T in Ts_camera])
    assert z.min(0).max() <= 0.45
    assert len(cloud) < len(fuse_cloud(demonstration, robot, (), config=CloudConfig()))


def test_the_robots_own_pixels_are_dropped_wherever_it_is(rendered, robot, peg_task):
    def peg_at(t):
        return [Ts[t] @ pose([0, 0, 0.03])]

    Ts = rendered(lambda t: []).steps.measured_Ts_world_tool
    demonstration = rendered(peg_at)
    # What is drawn in the peg's place is up to 15 mm larger than it.
    bare = fuse_cloud(demonstration, robot, (), [0], CloudConfig(self_margin=0.001))
    held = fuse_cloud(demonstration, robot, peg_task.scene.held, [0], CloudConfig(self_margin=0.02))
    assert on_box(seen(bare), peg_at(0)[0]).sum() > 30
    assert on_box(seen(held), peg_at(0)[0]).sum() == 0


# --- unknown space ------------------------------------------------------------------------------


def test_space_behind_a_surface_is_filled_to_the_depth_asked(rendered, robot):
    demonstration = rendered(lambda t: [BOX])
    cloud = fuse_cloud(demonstration, robot, (), config=CloudConfig(behind=0.02))
    filled = cloud.points[cloud.behind]
    assert len(filled) > 100
    assert on_box(filled, BOX).any()
    near, _ = cKDTree(seen(cloud)).query(filled)
    assert near.max() <= 0.02 + 2 * cloud.config.voxel
    free = fuse_cloud(demonstration, robot, (), config=CloudConfig(unknown="free"))
    assert not free.behind.any()
    assert free.points.tobytes() == np.ascontiguousarray(seen(cloud)).tobytes()


def from_two_sides(Ts):
    """Tool poses, those at odd waypoints swung down to the side of the box by 57 degrees."""
    about = pose(BOX[:3, 3]) @ pose(rotvec=[0, 1.0, 0]) @ pose(-BOX[:3, 3])
    return np.stack([about @ T if t % 2 else T for t, T in enumerate(Ts)])


def test_nothing_is_filled_in_where_another_image_sees_through(rendered, robot, way_down):
    demonstration = rendered(lambda t: [BOX], 96, from_two_sides(way_down))

    def shadow(waypoints):
        """Cells filled in under the box, farther from it and the floor than depths are trusted."""
        cloud = fuse_cloud(demonstration, robot, (), waypoints, CloudConfig(behind=0.08))
        p = cloud.points[cloud.behind]
        p = p[~on_box(p, BOX, 0.016) & (p[:, 2] > FLOOR + 0.02)]
        return {tuple(cell) for cell in np.rint(p / 0.004).astype(int)}

    one, both = shadow([0]), shadow([0, 1])
    assert len(one) > 500
    # From its side the other image sees about half of the space under the box.
    assert len(one & both) < 0.7 * len(one)


def test_nothing_is_filled_in_where_the_robot_itself_was(rendered, robot, peg_task, way_down):
    T_peg = way_down[-1] @ pose([0, 0, 0.02])
    demonstration = rendered(lambda t: [T_peg] if t == 0 else [])
    # The last image tells nothing but where the robot was.
    depth = np.array(demonstration.steps.cameras["wrist"].depth)
    depth[-1] = 0.0
    demonstration = with_depth(demonstration, depth)

    def in_peg(waypoints):
        cloud = fuse_cloud(demonstration, robot, peg_task.scene.held, waypoints)
        p = (cloud.points[cloud.behind] - T_peg[:3, 3]) @ T_peg[:3, :3]
        return (np.abs(p) < [0.015, 0.015, 0.04]).all(1).sum()

    assert in_peg([0]) > 10
    assert in_peg([0, len(demonstration) - 1]) == 0


# --- what is grasped ----------------------------------------------------------------------------


T_TOOL_BOX = pose([0.01, -0.03, 0.10])


@pytest.fixture(scope="module", params=["down", "up", "along"])
def grasping(request, rendered, way_down):
    """A box that stands until waypoint 12 and then goes with the tool, down, up or sideways."""
    Ts = np.array(way_down)
    if request.param == "up":
        Ts = Ts[::-1]
    if request.param == "along":
        # The floor is near enough to be taken for a part of the box.
        Ts[:, :3, 3] = [0.5, 0, FLOOR + 0.14] + 0.004 * np.arange(len(Ts))[:, None] * [0, 1, 0]
    return rendered(lambda t: [Ts[max(t, 12)] @ T_TOOL_BOX], Ts=Ts)


@pytest.mark.parametrize("before", [range(12), None], ids=["seen before", "held from the start"])
def test_what_was_grasped_is_found_in_the_tool_frame(grasping, robot, before):
    demonstration = grasping
    config = CloudConfig(unknown="free")
    found = grasped_object(demonstration, robot, (), range(12, len(demonstration)), before, config)
    assert len(found.points) > 30
    assert on_box(found.points, T_TOOL_BOX).all()
    # Its width is seen in full, to a pixel or two.
    assert np.ptp(found.points[:, 0]) > SIZE[0] - 0.012


def test_an_object_held_from_the_start_is_taken_to_be_as_deep_as_the_unknown(grasping, robot):
    demonstration = grasping
    after = range(12, len(demonstration))
    visible = grasped_object(demonstration, robot, (), after, config=CloudConfig(unknown="free"))
    deep = grasped_object(demonstration, robot, (), after)
    assert len(deep.points) == 2 * len(visible.points)
    shift = deep.points[len(visible.points) :] - visible.points
    np.testing.assert_allclose(np.linalg.norm(shift, axis=1), 0.03)
    # Away from the camera, which is at positive y, and no deeper along the tool.
    assert (shift[:, 1] < 0).all()
    np.testing.assert_allclose(shift[:, 2], 0, atol=1e-12)


def test_what_was_taken_out_of_sight_is_found_where_images_see_through(rendered, robot, way_down):
    T_box = way_down[12] @ T_TOOL_BOX
    taken = rendered(lambda t: [T_box] if t < 12 else [])
    found = grasped_object(taken, robot, (), range(12, len(taken)), range(12))
    assert len(found.points) > 30
    assert on_box(found.points, T_TOOL_BOX).all()


def test_nothing_is_grasped_where_all_stays_or_the_tool_does_not_move(rendered, grasping, robot):
    still = rendered(lambda t: [BOX])
    assert grasped_object(still, robot, (), range(12, len(still)), range(12)) is None
    assert grasped_object(grasping, robot, (), range(12, 13), range(12)) is None


def test_what_was_grasped_is_no_part_of_the_scene_before_or_after(grasping, robot):
    demonstration = grasping
    n = len(demonstration)
    found = grasped_object(demonstration, robot, (), range(12, n), range(12))
    cloud = fuse_cloud(demonstration, robot, (), grasped=[found])
    assert np.abs(seen(cloud)[:, 2] - FLOOR).max() < 1e-3
    smeared = fuse_cloud(demonstration, robot, ())
    assert (seen(smeared)[:, 2] > FLOOR + 0.01).sum() > 30


def test_a_cloud_without_a_hull_keeps_all_that_is_farther_than_the_margin():
    cloud = cloud_of([[0, 0, 0], [0.0145, 0, 0], [0.02, 0, 0], [0.0, 0.05, 0]])
    assert len(cloud.without(CUBE, 0.005)) == 2
    # Two voxels.
    assert len(cloud.without(CUBE)) == 2
    assert len(cloud.without(CUBE, 0.02)) == 1


# --- distances ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cube():
    """A cube of 2 cm about its joint."""
    return hull_part("cube", 1, CUBE)


def test_the_distance_to_a_point_is_that_to_its_ball(cube):
    obstacles = CloudObstacles(cloud_of([[0.0, 0.0, 0.05]], inflation=0.002))
    T = pose([0.0, 0.003, 0.0])
    (found,) = obstacles.separations(cube, T, 0.0)
    assert found.distance == obstacles.distance(cube, T) == pytest.approx(0.038, abs=1e-6)
    np.testing.assert_allclose(found.p_ball, [0, 0, 0.048], atol=1e-6)
    np.testing.assert_allclose(found.p_part, [0, 0, 0.01], atol=1e-6)


def test_a_point_inside_a_part_is_as_deep_as_the_nearest_face_and_its_ball(cube):
    obstacles = CloudObstacles(cloud_of([[0.0, 0.0, 0.007]], inflation=0.002))
    (found,) = obstacles.separations(cube, np.eye(4), 0.0)
    assert found.distance == pytest.approx(-0.005, abs=1e-5)
    # The ball has to go up by that, and the cube down.
    np.testing.assert_allclose(found.p_ball, [0, 0, 0.005], atol=1e-5)
    np.testing.assert_allclose(found.p_part, [0, 0, 0.01], atol=1e-5)


@pytest.mark.parametrize("within", [0.0, 0.01, 0.05])
def test_no_point_that_is_near_enough_is_missed(peg_model, within):
    rng = np.random.default_rng(3)
    parts = robot_parts(peg_model)
    chosen = [parts[i] for i in (3, 8, 12, 19)]
    for part in chosen:
        centre = part.points.mean(0)
        p = centre + rng.normal(scale=0.12, size=(300, 3))
        T = pose(rng.normal(size=3), rng.normal(size=3))
        cloud = cloud_of(p @ T[:3, :3].T + T[:3, 3])
        obstacles = CloudObstacles(cloud)
        exact = np.array([one_by_one(obstacles, part, T, q) for q in cloud.points])
        found = obstacles.separations(part, T, within)
        distances = [each.distance for each in found]
        assert distances == sorted(distances)
        wanted = np.sort(exact[exact <= exact.min() + within - 1e-6])
        np.testing.assert_allclose(distances[: len(wanted)], wanted, atol=2e-6)
        assert len(distances) >= len(wanted)
        assert obstacles.distance(part, T) == pytest.approx(exact.min(), abs=2e-6)


def one_by_one(obstacles, part, T, p):
    return convex_distance(
        coal_geometry(Shape("sphere", (obstacles._radii[0],))),
        coal_transform(pose(p)),
        part.geometry,
        coal_transform(T @ part.T_joint_part),
    )


def test_clearances_are_distances_of_bare_points_from_the_nearest_ball():
    obstacles = CloudObstacles(cloud_of([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], inflation=0.002))
    p = np.array([[[0.0, 0.0, 0.1], [1.0, 0.001, 0.0]]])
    np.testing.assert_allclose(obstacles.clearances(p), [[0.098, -0.001]], atol=1e-12)


def test_a_cloud_without_points_is_no_obstacle_but_a_mistake():
    with pytest.raises(InvalidInput, match="cloud: expected at least one point, got none; look"):
        CloudObstacles(cloud_of([]))


# --- the yardstick ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "size", "p", "error"),
    [
        ("box", (0.2, 0.2, 0.2), (0.13, 0.14, 0), 0.05),
        ("box", (0.2, 0.2, 0.2), (0.0, 0.07, 0.02), 0.03),
        ("sphere", (0.1,), (0, 0.06, 0.08), 0.0),
        ("sphere", (0.1,), (0, 0.03, 0.04), 0.05),
        ("cylinder", (0.1, 0.2), (0, 0.13, 0.14), 0.05),
        ("cylinder", (0.1, 0.2), (0, 0.05, 0.09), 0.01),
        ("cylinder", (0.1, 0.2), (0.06, 0.08, 0.03), 0.0),
    ],
)
def test_a_points_error_is_its_distance_to_the_nearest_surface(kind, size, p, error):
    T = pose([1, 2, 3], [0.3, -0.2, 0.9])
    shift = pose([0.1, 0, 0])
    body = Body("body", (Shape(kind, size, shift), Shape("sphere", (0.1,), pose([9, 9, 9]))))
    cloud = cloud_of((T @ shift @ [*p, 1])[:3])
    (found,) = surface_errors(cloud, SceneSpec((body,)), {"body": T})
    assert found == pytest.approx(error, abs=1e-9)


# --- errors -------------------------------------------------------------------------------------


def test_a_body_without_a_pose_is_reported(recorded, peg_task):
    with pytest.raises(UnknownName, match="unknown body 'table'"):
        surface_errors(recorded, peg_task.scene, {"block": np.eye(4)})


def test_a_demonstration_without_a_camera_is_refused(peg_demonstration, robot):
    steps = dataclasses.replace(peg_demonstration.steps, cameras={})
    bare = dataclasses.replace(peg_demonstration, steps=steps)
    with pytest.raises(InvalidInput, match="with a wrist camera, got none; record it with one"):
        fuse_cloud(bare, robot, ())


def test_a_demonstration_without_depth_is_refused(peg_demonstration, robot):
    depth = np.zeros_like(peg_demonstration.steps.cameras["wrist"].depth)
    with pytest.raises(InvalidInput, match="depth .* got 0 in all; record with a depth camera"):
        fuse_cloud(with_depth(peg_demonstration, depth), robot, ())


def test_images_of_nothing_near_are_refused(peg_demonstration, peg_task, robot):
    held = peg_task.scene.held
    with pytest.raises(InvalidInput, match="within 0.01 m of the tool .* got nothing; look at"):
        fuse_cloud(peg_demonstration, robot, held, config=CloudConfig(reach=0.01))
    with pytest.raises(InvalidInput, match="0.05 to 0.06 m before the camera .* got nothing"):
        fuse_cloud(peg_demonstration, robot, held, config=CloudConfig(far=0.06))


@pytest.mark.parametrize("waypoints", [[-1], [0, 10_000]])
def test_a_waypoint_out_of_range_is_refused(peg_demonstration, robot, waypoints):
    with pytest.raises(InvalidInput, match=r"waypoint (-1|10000): expected 0 to \d+; choose"):
        fuse_cloud(peg_demonstration, robot, (), waypoints)
    with pytest.raises(InvalidInput, match=r"waypoint (-1|10000): expected 0 to \d+; choose"):
        grasped_object(peg_demonstration, robot, (), waypoints)


def test_no_waypoint_at_all_is_refused(peg_demonstration, robot):
    with pytest.raises(InvalidInput, match="waypoints: expected at least one, got none"):
        fuse_cloud(peg_demonstration, robot, (), [])


def test_another_robot_is_refused(peg_demonstration):
    with pytest.raises(Mismatch, match="recorded by 'ur5e_2f85', got 'ur5e_hande'"):
        fuse_cloud(peg_demonstration, get_robot("ur5e_hande"), ())


def test_a_grasped_object_is_made_of_points_and_waypoints():
    assert GraspedObject(CUBE, (1, 2)).points.shape == (8, 3)
    with pytest.raises(InvalidInput, match="waypoints of a grasped object: expected at least one"):
        GraspedObject(CUBE, ())
    with pytest.raises(InvalidInput, match="points: expected shape"):
        GraspedObject(np.zeros(3), (1,))


@pytest.mark.parametrize("points", [CUBE[:3], CUBE * [1, 1, 0]], ids=["three", "flat"])
def test_points_without_a_volume_are_no_hull(points):
    match = "hull of . points: expected at least 4 that are not in one plane"
    with pytest.raises(InvalidInput, match=match):
        hull_part("thing", 6, points)
    with pytest.raises(InvalidInput, match=match):
        cloud_of([[0, 0, 0]]).without(points)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"voxel": 0.0}, "voxel: expected a finite number > 0 m"),
        ({"inflation": -0.1}, "inflation: expected a finite number > 0 m"),
        ({"near": 0.9}, "far: expected more than near"),
        ({"unknown": "solid"}, "unknown: expected 'behind' or 'free', got 'solid'"),
    ],
)
def test_a_config_out_of_range_is_refused(change, match):
    with pytest.raises(InvalidInput, match=match):
        CloudConfig(**change)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"points": np.full((2, 3), np.nan)}, "points: has NaN"),
        ({"colours": np.zeros((2, 3))}, "colours: expected uint8 of shape"),
        ({"behind": np.zeros(3, bool)}, "behind: expected bool of shape"),
    ],
)
def test_a_cloud_of_the_wrong_shape_is_refused(change, match):
    with pytest.raises(InvalidInput, match=match):
        dataclasses.replace(cloud_of(np.zeros((2, 3))), **change)
