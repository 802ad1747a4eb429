"""What pages draw in their 3D view: robot, bodies, cloud, paths, spheres, sampled tools."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sart_toolkit.annotate.drawing import (
    CLEARANCES,
    FAINT,
    INK,
    PATH_COLOURS,
    TOWARDS_EYE,
    ghost_gripper,
    ghost_meshes,
    gripper_at,
    start_view,
)
from sart_toolkit.collision.cloud import SceneCloud
from sart_toolkit.data.records import Demonstration
from sart_toolkit.poses import Array
from sart_toolkit.record.webpage import WebPage, coloured, place, to_bytes, wxyz
from sart_toolkit.robots.visuals import RobotVisuals, body_meshes
from sart_toolkit.scenes.spec import SceneSpec


class WebScene:
    """A demonstration's robot, scene and recorded cloud on a page.

    Attributes:
        cloud: whether there is one to show.
    """

    def __init__(
        self,
        page: WebPage,
        robot: RobotVisuals,
        scene: SceneSpec,
        demonstration: Demonstration,
        cloud: SceneCloud | None,
    ) -> None:
        """Draw them; they are put where they belong by `show`.

        Args:
            page: where.
            robot: the robot that was steered.
            scene: bodies, of which those are drawn whose poses the demonstration has.
            demonstration: where the view begins.
            cloud: points to draw, if there are any.
        """
        self._page, self._robot, self._demonstration = page, robot, demonstration
        self._add = page.server.scene
        self.cloud = cloud is not None
        self._points: Any = None
        if cloud is not None:
            self._points = self._add.add_point_cloud(
                "/cloud",
                cloud.points,
                cloud.colours,
                point_size=cloud.config.voxel,
                point_shape="square",
                point_shading="flat",
                precision="float32",
            )
        self._bodies: dict[str, Any] = {}
        for body in scene.bodies:
            if body.name in demonstration.body_Ts_world:
                node = self._add.add_frame(f"/bodies/{body.name}", show_axes=False)
                for i, mesh in enumerate(body_meshes(body.shapes)):
                    page.add_mesh(f"/bodies/{body.name}/{i}", mesh)
                self._bodies[body.name] = node
        self._joints: dict[str, Any] = {}
        for joint, meshes in robot.bodies.items():
            self._joints[joint] = self._add.add_frame(f"/robot/{joint}", show_axes=False)
            for i, mesh in enumerate(meshes):
                page.add_mesh(f"/robot/{joint}/{i}", mesh)
        self._tool = self._add.add_frame("/tool", axes_length=0.05, axes_radius=0.0012)
        self._ghosts: dict[str, Any] = {}
        self._ghost_gripper: dict[str, float] = {}

    def show(
        self,
        q: Array,
        gripper: float,
        T_world_tool: Array,
        body_Ts_world: Mapping[str, Array],
        cloud: bool,
        still: frozenset[str] | None = None,
    ) -> None:
        """Put everything where it was.

        Args:
            q: arm joints `(n,)` [rad].
            gripper: measured opening, in [0, 1].
            T_world_tool: measured tool pose `(4, 4)`.
            body_Ts_world: the poses `(4, 4)` of the bodies.
            cloud: whether to show the cloud, if there is one, in place of bodies.
            still: names of the bodies that it is in place of; all if left out.
        """
        clouds = cloud and self.cloud
        for joint, T in self._robot.poses_at(q, gripper).items():
            if joint in self._joints:
                place(self._joints[joint], T)
        for name, node in self._bodies.items():
            place(node, body_Ts_world[name])
            node.visible = not (clouds and (still is None or name in still))
        if self._points is not None:
            self._points.visible = clouds
        place(self._tool, T_world_tool)

    def show_waypoint(self, demonstration: Demonstration, t: int, cloud: bool) -> None:
        """Put everything where it was at a waypoint of a demonstration, see `show`."""
        steps = demonstration.steps
        self.show(
            steps.joint_positions[t],
            gripper_at(demonstration, t),
            steps.measured_Ts_world_tool[t],
            {name: Ts[t] for name, Ts in demonstration.body_Ts_world.items()},
            cloud,
        )

    def add_path(self, name: str, Ts_world_tool: Array, colours: Array) -> None:
        """Draw a tool path `(n, 4, 4)` in colours `(n, 3)`, in [0, 1], a triad at each pose."""
        positions = Ts_world_tool[:, :3, 3]
        self._add.add_line_segments(
            f"{name}/line",
            joined(positions),
            joined(np.asarray(colours)),
            thickness=4,
            thickness_units="screen",
        )
        self._add.add_batched_axes(
            f"{name}/axes", wxyz(Ts_world_tool), positions, axes_length=0.008, axes_radius=0.0003
        )

    def show_ghosts(
        self,
        name: str,
        demonstration: Demonstration,
        t: int,
        Ts_world_tool: Array,
        colour: tuple[float, ...] = FAINT,
    ) -> None:
        """Draw the tool, transparent, at poses `(n, 4, 4)`, its gripper as at a waypoint."""
        gripper = ghost_gripper(demonstration, t)
        if not len(Ts_world_tool):
            if name in self._ghosts:
                self._ghosts[name].visible = False
            return
        if gripper != self._ghost_gripper.get(name):
            meshes = ghost_meshes(self._robot, demonstration, t)
            first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
            self._ghosts[name] = self._add.add_batched_meshes_simple(
                name,
                np.concatenate([mesh.vertices for mesh in meshes]),
                np.concatenate([m.triangles + n for m, n in zip(meshes, first, strict=False)]),
                batched_wxyzs=wxyz(Ts_world_tool),
                batched_positions=Ts_world_tool[:, :3, 3],
                batched_colors=to_bytes(colour),
                opacity=0.25,
                cast_shadow=False,
                receive_shadow=False,
            )
            self._ghost_gripper[name] = gripper
        node = self._ghosts[name]
        node.visible = True
        node.batched_wxyzs, node.batched_positions = wxyz(Ts_world_tool), Ts_world_tool[:, :3, 3]

    def add_ball(self, name: str) -> tuple[Any, Any]:
        """A transparent unit ball and its rings, to be placed, scaled and coloured."""
        ball: Any = self._add.add_icosphere(f"{name}/ball", opacity=0.35, subdivisions=4)
        rings = self._add.add_line_segments(
            f"{name}/rings", _rings(), INK, thickness=2, thickness_units="screen"
        )
        return ball, rings

    def look_at_start(self) -> None:
        """Show the demonstrated path from where the view begins."""
        at, distance = start_view(self._demonstration)
        self._page.look(at + distance * TOWARDS_EYE, at)


def place_ball(
    nodes: tuple[Any, Any], p_world: Array, radius: float, colour: tuple[float, ...]
) -> None:
    """Put ball and rings about a point `(3,)` [m], with a radius [m] and a colour in [0, 1]."""
    ball, rings = nodes
    for node in nodes:
        node.position, node.scale = p_world, radius
    ball.color = to_bytes(colour)
    rings.colors = np.array(to_bytes(colour), np.uint8)


def legend() -> str:
    """What the colours of a path mean, as HTML."""
    marks = ", ".join(
        coloured(f"{1e3 * clearance:.0f} mm", colour)
        for clearance, colour in zip(CLEARANCES, PATH_COLOURS, strict=True)
    )
    return f"path: clear by {marks} or more"


def joined(points: Array) -> Array:
    """The ends `(n - 1, 2, ...)` of the segments between neighbours of `(n, ...)`."""
    return np.stack([points[:-1], points[1:]], axis=1)


def _rings() -> Array:
    """Three great circles of the unit sphere, as segments `(n, 2, 3)`."""
    angles = np.linspace(0, 2 * np.pi, 65)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(65)], axis=1)
    return np.concatenate([joined(np.roll(circle, turn, axis=1)) for turn in range(3)])
