"""The annotator as a page in a browser, for computers without a desktop.

It draws what an `AnnotationSession` says and hands it keys, buttons and sliders; nothing is decided
here.
"""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image as PillowImage

from sart_toolkit.annotate.drawing import (
    ACCENT,
    CLEARANCES,
    COLOURS,
    FAINT,
    INK,
    NEAR,
    PATH_COLOURS,
    RIGHT,
    TITLE,
    TOWARDS_EYE,
    fine_cloud,
    ghost_gripper,
    ghost_meshes,
    gripper_at,
    path_colours,
    start_view,
)
from sart_toolkit.annotate.session import ACTIONS, KEYS, AnnotationSession
from sart_toolkit.collision.cloud import SceneCloud
from sart_toolkit.data.records import PrecisionSphere
from sart_toolkit.record.webpage import LET_GO, WebPage, place, wxyz
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.robots.visuals import RobotVisuals, body_meshes
from sart_toolkit.scenes.spec import SceneSpec

# The actions that have keys, as rows of buttons.
BUTTONS = {
    "suggest": ("suggest-all", "suggest", "snap"),
    "sphere": ("add", "remove", "region"),
    "radius": ("shrink", "narrower", "wider", "grow"),
    "waypoint": ("behind", "back", "next", "ahead"),
    "go to": ("start", "end", "converge"),
    "other sphere": ("previous", "following"),
    "change": ("undo", "redo"),
    "view": ("show", "follow", "view"),
    "file": ("save", "quit"),
}
# A radius that is dragged is only drawn until it is let go, or has rested for so long [s]: that is
# one change, not many.
_REST = 5.0
# A wrist image is shown so many pixels wide.
_IMAGE = 144
_CSS = """
.sart { font-size: 13px; line-height: 1.45; padding: 2px 8px; }
.sart .message { background: #21262f; color: #fff; border-radius: 4px; padding: 6px 9px; }
.sart .now { display: flex; gap: 10px; margin: 8px 0; }
.sart img { flex: none; border-radius: 4px; image-rendering: auto; }
.sart td { vertical-align: top; padding: 0 8px 0 0; }
.sart td:first-child { color: #6b7380; }
.sart .verdict { font-weight: 600; }
.sart .spheres { max-height: 11em; overflow-y: auto; font-variant-numeric: tabular-nums; }
.sart .spheres td:first-child { color: inherit; }
.sart .spheres .here { background: #e4e8ee; }
@media (max-width: 36em) { .sart img { width: 96px; height: 96px; } }
"""


def annotate_in_browser(
    session: AnnotationSession,
    robot: RobotSpec,
    scene: SceneSpec,
    host: str | None = None,
    port: int | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> None:
    """Show a session on a page until the person leaves it; closing the browser doesn't.

    Args:
        session: what is shown and done.
        robot: the robot that was steered.
        scene: what is fixed to it, and the bodies to draw where the demonstration has them.
        host: the address at which to be reached; this computer only if left out.
        port: 8080 if left out.
        say: told how to open the page, once it is there.

    Raises:
        InvalidInput: the page can't be served at that address.
    """
    cloud = fine_cloud(session.demonstration, robot, scene)
    drawn = RobotVisuals(RobotModel(robot, scene.held))
    with WebPage(TITLE, _CSS, host, port) as page:
        shown = AnnotationPage(session, drawn, scene, cloud, page)
        say(page.how_to_open)
        shown.run()


class AnnotationPage:
    """Session, 3D view and panel on one page; all browsers that open it show the same."""

    def __init__(
        self,
        session: AnnotationSession,
        robot: RobotVisuals,
        scene: SceneSpec,
        cloud: SceneCloud | None,
        page: WebPage,
    ) -> None:
        """Fill a page."""
        self._session, self._robot, self._scene, self._page = session, robot, scene, page
        self._resets = session.view_resets
        # The radius [mm] that a slider or handle is being dragged to, and since when.
        self._tried: float | None = None
        self._tried_at = 0.0
        self._balls: list[tuple[Any, Any]] = []
        self._ghosts: Any = None
        self._ghost_gripper: float | None = None
        self._add_geometry(cloud)
        self._panel = _Panel(page, session)
        for key, name in KEYS.items():
            page.add_key(key, name, ACTIONS[name].help)
        self._look_at_start()
        self._update()

    def run(self) -> None:
        """Do what is done in the browsers until the session is done."""
        idle = 0.1
        while not self._session.done:
            inputs = self._page.take(idle if self._tried is None else 0.1)
            for name, value in inputs:
                self._handle(name, value)
            if not inputs and self._tried is not None:
                if time.monotonic() - self._tried_at > _REST:
                    self._keep_tried()
                    self._update()
            elif not inputs:
                idle = 0.0 if self._session.prepare() else 0.1
        time.sleep(0.1)

    # --- inputs ---------------------------------------------------------------------------------

    def _handle(self, name: str, value: float | None) -> None:
        if name == LET_GO and self._tried is None:
            return
        if name == "try radius" and self._session.sphere is not None and value is not None:
            low, high = 1e3 * self._session.config.smallest, 1e3 * self._session.config.largest
            self._tried, self._tried_at = min(max(value, low), high), time.monotonic()
        else:
            self._keep_tried()
            if name in ACTIONS:
                self._session.perform(name, value)
        self._update()

    def _keep_tried(self) -> None:
        if self._tried is not None:
            self._session.perform("radius", self._tried)
            self._tried = None

    # --- drawing --------------------------------------------------------------------------------

    def _add_geometry(self, cloud: SceneCloud | None) -> None:
        page, session, add = self._page, self._session, self._page.server.scene
        self._cloud: Any = None
        if cloud is not None:
            self._cloud = add.add_point_cloud(
                "/cloud",
                cloud.points,
                cloud.colours,
                point_size=cloud.config.voxel,
                point_shape="square",
                point_shading="flat",
                precision="float32",
            )
        self._bodies: dict[str, Any] = {}
        for body in self._scene.bodies:
            if body.name in session.demonstration.body_Ts_world:
                node = add.add_frame(f"/bodies/{body.name}", show_axes=False)
                for i, mesh in enumerate(body_meshes(body.shapes)):
                    page.add_mesh(f"/bodies/{body.name}/{i}", mesh)
                self._bodies[body.name] = node
        self._joints: dict[str, Any] = {}
        for joint, meshes in self._robot.bodies.items():
            self._joints[joint] = add.add_frame(f"/robot/{joint}", show_axes=False)
            for i, mesh in enumerate(meshes):
                page.add_mesh(f"/robot/{joint}/{i}", mesh)
        Ts = session.demonstration.steps.measured_Ts_world_tool
        colours = path_colours(session)
        add.add_line_segments(
            "/path/line",
            _pairs(Ts[:, :3, 3]),
            _pairs(colours),
            thickness=4,
            thickness_units="screen",
        )
        add.add_batched_axes(
            "/path/axes", wxyz(Ts), Ts[:, :3, 3], axes_length=0.008, axes_radius=0.0003
        )
        self._tool = add.add_frame("/tool", axes_length=0.05, axes_radius=0.0012)
        self._t_star = add.add_icosphere("/t_star", 0.004, ACCENT)
        self._t_star_label = add.add_label("/t_star/label", "", anchor="top-right")
        # To pull at, on the rim of the sphere at the selected waypoint.
        self._handle_ball = add.add_icosphere("/handle", 0.005, INK)
        self._radius_label = add.add_label("/handle/label", "", anchor="center-left")

        @self._handle_ball.on_drag
        async def _(event: Any) -> None:
            here = session.sphere
            if here is not None:
                pulled = np.array(event.end_position) - here.T_world_key[:3, 3]
                page.put("try radius", 1e3 * float(np.linalg.norm(pulled)))

    def _update(self) -> None:
        """Draw what the session says now, for all browsers at once."""
        session = self._session
        steps, t = session.demonstration.steps, session.selected
        gripper = gripper_at(session.demonstration, t)
        Ts_joint = self._robot.poses_at(steps.joint_positions[t], gripper)
        with self._page.server.atomic():
            for joint, node in self._joints.items():
                place(node, Ts_joint[joint])
            clouds = session.shown == "cloud" and self._cloud is not None
            if self._cloud is not None:
                self._cloud.visible = clouds
            for name, node in self._bodies.items():
                place(node, session.demonstration.body_Ts_world[name][t])
                node.visible = not clouds
            place(self._tool, steps.measured_Ts_world_tool[t])
            spheres = [self._as_tried(sphere) for sphere in session.spheres]
            self._draw_spheres(spheres)
            self._draw_here()
            self._panel.update(spheres, self._page.waiting)
        if session.view_resets != self._resets:
            self._resets = session.view_resets
            self._look_at_start()
        elif session.follow:
            p = steps.measured_Ts_world_tool[t][:3, 3]
            self._page.look(p + NEAR * TOWARDS_EYE, p)
        self._page.server.flush()

    def _as_tried(self, sphere: PrecisionSphere) -> PrecisionSphere:
        """A sphere as it would be if the radius that it is being dragged to were kept."""
        if self._tried is None or sphere is not self._session.sphere:
            return sphere
        return dataclasses.replace(
            sphere, radius=self._tried / 1e3, source="human", clearance=None, limited_by=None
        )

    def _draw_spheres(self, spheres: list[PrecisionSphere]) -> None:
        session, add = self._session, self._page.server.scene
        governing = session.governing
        for i in range(len(self._balls), len(spheres)):
            ball: Any = add.add_icosphere(f"/spheres/{i}/ball", opacity=0.35, subdivisions=4)
            rings = add.add_line_segments(
                f"/spheres/{i}/rings", _rings(), INK, thickness=2, thickness_units="screen"
            )
            self._balls.append((ball, rings))
        for i, (ball, rings) in enumerate(self._balls):
            ball.visible = rings.visible = i < len(spheres)
            if i >= len(spheres):
                continue
            colour = _bytes(COLOURS[session.verdict(spheres[i]).word])
            current = governing is not None and spheres[i].waypoint == governing.waypoint
            # Many transparent balls, one within the other, hide what is in them.
            ball.visible = current
            rings.thickness = 2.5 if current else 1.2
            for node in (ball, rings):
                node.position = spheres[i].T_world_key[:3, 3]
                node.scale = spheres[i].radius
            ball.color, rings.colors = colour, np.array(colour, np.uint8)

    def _draw_here(self) -> None:
        """Handle and sampled poses of the sphere here, t* of the current one."""
        session = self._session
        here, governing = session.sphere, session.governing
        shown = None if here is None else self._as_tried(here)
        self._handle_ball.visible = self._radius_label.visible = shown is not None
        if shown is not None:
            self._handle_ball.position = shown.T_world_key[:3, 3] + shown.radius * RIGHT
            self._radius_label.text = f"{1e3 * shown.radius:.1f} mm"
        if shown is not None and session.config.ghosts:
            self._draw_ghosts(shown)
        elif self._ghosts is not None:
            self._ghosts.visible = False
        self._t_star.visible = self._t_star_label.visible = governing is not None
        if governing is not None:
            t_star = session.convergence(governing)
            Ts = session.demonstration.steps.measured_Ts_world_tool
            self._t_star.position = Ts[t_star][:3, 3]
            self._t_star_label.text = f"t* {t_star}"

    def _draw_ghosts(self, sphere: PrecisionSphere) -> None:
        demonstration = self._session.demonstration
        Ts = self._session.ghosts(sphere)
        gripper = ghost_gripper(demonstration, sphere)
        if gripper != self._ghost_gripper:
            meshes = ghost_meshes(self._robot, demonstration, sphere)
            first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
            self._ghosts = self._page.server.scene.add_batched_meshes_simple(
                "/ghosts",
                np.concatenate([mesh.vertices for mesh in meshes]),
                np.concatenate([m.triangles + n for m, n in zip(meshes, first, strict=False)]),
                batched_wxyzs=wxyz(Ts),
                batched_positions=Ts[:, :3, 3],
                batched_colors=_bytes(FAINT),
                opacity=0.25,
                cast_shadow=False,
                receive_shadow=False,
            )
            self._ghost_gripper = gripper
        self._ghosts.visible = True
        self._ghosts.batched_wxyzs, self._ghosts.batched_positions = wxyz(Ts), Ts[:, :3, 3]

    def _look_at_start(self) -> None:
        at, distance = start_view(self._session.demonstration)
        self._page.look(at + distance * TOWARDS_EYE, at)


class _Panel:
    """Messages, wrist image, words about the waypoint, sliders, buttons, spheres and keys."""

    def __init__(self, page: WebPage, session: AnnotationSession) -> None:
        self._session = session
        config, gui = session.config, page.server.gui
        camera = next(iter(session.demonstration.steps.cameras.values()), None)
        self._images = None if camera is None else camera.rgb
        self._state = gui.add_html("")
        self._waypoint = page.add_slider("waypoint", "go", 0, session.last, 1)
        self._radius = page.add_slider(
            "radius [mm]",
            "try radius",
            1e3 * config.smallest,
            1e3 * config.suggest.max_radius,
            0.1,
        )
        for label, names in BUTTONS.items():
            page.add_buttons(label, names)
        self._spheres = gui.add_html("")
        with gui.add_folder("keys", expand_by_default=False):
            rows = "".join(
                f"<tr><td>{html.escape(', '.join(a.keys))}</td><td>{html.escape(a.help)}</td></tr>"
                for a in ACTIONS.values()
                if a.keys
            )
            gui.add_html(f'<div class="sart"><table>{rows}</table></div>')

    def update(self, spheres: list[PrecisionSphere], waiting: bool) -> None:
        """Say what the session says, of spheres as they are shown."""
        session = self._session
        here = next((s for s in spheres if s.waypoint == session.selected), None)
        state = session.state()
        if here is not None:
            state |= {"sphere": session.describe(here), "verdict": str(session.verdict(here))}
        verdict = state.pop("verdict")
        rows = "".join(
            f"<tr><td>{name}</td><td>{html.escape(line)}</td></tr>" for name, line in state.items()
        )
        colour = INK if here is None else COLOURS[session.verdict(here).word]
        message = session.message or "A suggests all spheres, Enter adds one here"
        self._state.content = (
            f'<div class="sart"><div class="message">{html.escape(message)}</div>'
            f'<div class="now">{self._image()}<table>{rows}</table></div>'
            f'<div class="verdict" style="color:{_css(colour)}">{html.escape(verdict)}</div></div>'
        )
        self._spheres.content = self._listed(spheres)
        if waiting:
            # A slider is being dragged on.
            return
        self._waypoint.value = session.selected
        self._radius.disabled = here is None
        if here is not None:
            self._radius.max = max(self._radius.max, 1e3 * here.radius)
            self._radius.value = round(1e3 * here.radius, 1)

    def _image(self) -> str:
        if self._images is None:
            return ""
        data = io.BytesIO()
        PillowImage.fromarray(self._images[self._session.selected]).save(data, "PNG")
        encoded = base64.b64encode(data.getvalue()).decode()
        return f'<img width="{_IMAGE}" height="{_IMAGE}" src="data:image/png;base64,{encoded}">'

    def _listed(self, spheres: list[PrecisionSphere]) -> str:
        session, rows = self._session, []
        for sphere in spheres:
            word = session.verdict(sphere).word
            here = ' class="here"' if sphere.waypoint == session.selected else ""
            rows.append(
                f"<tr{here}><td>{sphere.waypoint}</td><td>{1e3 * sphere.radius:.1f} mm</td>"
                f'<td style="color:{_css(COLOURS[word])}">{word}</td></tr>'
            )
        marks = ", ".join(
            f'<span style="color:{_css(colour)}">{1e3 * clearance:.0f} mm</span>'
            for clearance, colour in zip(CLEARANCES, PATH_COLOURS, strict=True)
        )
        unsaved = ", not saved" if session.dirty else ""
        return (
            f'<div class="sart"><b>{len(spheres)} spheres{unsaved}</b>'
            f'<div class="spheres"><table>{"".join(rows)}</table></div>'
            f"path: clear by {marks} or more</div>"
        )


def _pairs(points: Any) -> Any:
    """The ends `(n - 1, 2, ...)` of the segments between neighbours of `(n, ...)`."""
    return np.stack([points[:-1], points[1:]], axis=1)


def _rings() -> Any:
    """Three great circles of the unit sphere, as segments `(n, 2, 3)`."""
    angles = np.linspace(0, 2 * np.pi, 65)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(65)], axis=1)
    return np.concatenate([_pairs(np.roll(circle, turn, axis=1)) for turn in range(3)])


def _bytes(colour: Any) -> tuple[int, int, int]:
    r, g, b = (round(255 * channel) for channel in colour)
    return r, g, b


def _css(colour: Any) -> str:
    return "rgb({},{},{})".format(*_bytes(colour))
