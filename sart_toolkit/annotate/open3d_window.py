"""The annotator's window, the only module that needs Open3D.

It draws what an `AnnotationSession` says and hands it the keys; nothing is decided here.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import textwrap
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from sart_toolkit.annotate.drawing import (
    ACCENT,
    BACKDROP,
    CLEARANCES,
    COLOURS,
    FAINT,
    INK,
    NEAR,
    PAPER,
    PATH_COLOURS,
    RIGHT,
    TITLE,
    TOWARDS_EYE,
    fine_cloud,
    ghost_gripper,
    ghost_meshes,
    gripper_at,
    heading_of,
    message_of,
    path_colours,
    start_view,
)
from sart_toolkit.annotate.session import ACTIONS, AnnotationSession
from sart_toolkit.annotate.verdict import Word
from sart_toolkit.collision.cloud import SceneCloud
from sart_toolkit.data.records import Image, PrecisionSphere
from sart_toolkit.errors import InvalidInput, MissingExtra
from sart_toolkit.poses import Array
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.robots.visuals import DrawnMesh, RobotVisuals, body_meshes
from sart_toolkit.scenes.spec import SceneSpec

try:
    import open3d
except ModuleNotFoundError as error:
    raise MissingExtra(
        "the window needs Open3D: pip install sart_toolkit[annotate], or work without a window: "
        "--text, or --suggest-all --no-window"
    ) from error

gui = open3d.visualization.gui
rendering = open3d.visualization.rendering

_TRIAD_COLOURS = np.eye(3) * 0.75 + 0.1
_TOWARDS_LIGHT = np.array([0.48, -0.40, 0.78])
# Two requests to close the window within so many seconds are one.
_ONE_PRESS = 0.3
# Spheres listed, columns of keys.
_ROWS, _KEY_COLUMNS = 10, 4


@dataclass(frozen=True)
class WindowConfig:
    """How the window draws.

    `width`, `height` [pixels]. While keys are pressed no more than `moving_points` of the cloud are
    drawn; all of them once nothing has been pressed for `idle_s` [s].
    """

    width: int = 1280
    height: int = 800
    moving_points: int = 6_000
    idle_s: float = 0.5

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 400 or self.moving_points < 1 or not self.idle_s > 0:
            raise InvalidInput(
                "window: expected at least 400 x 400 pixels, a point and an idle time > 0, got "
                f"{self.width} x {self.height}, {self.moving_points} and {self.idle_s} s"
            )


def annotate_in_window(
    session: AnnotationSession,
    robot: RobotSpec,
    scene: SceneSpec,
    cloud: SceneCloud | None = None,
    config: WindowConfig | None = None,
) -> None:
    """Show a session in a window until the person leaves it.

    Args:
        session: what is shown and done.
        robot: the robot that was steered.
        scene: what is fixed to it, and the bodies to draw where the demonstration has them.
        cloud: points to draw; fused from the demonstration's images if left out.
        config: how it is drawn.
    """
    if cloud is None:
        cloud = fine_cloud(session.demonstration, robot, scene)
    drawn = RobotVisuals(RobotModel(robot, scene.held))
    with _quiet_stdout():
        window = AnnotationWindow(session, drawn, scene, cloud, config or WindowConfig())
        window.run()


@contextlib.contextmanager
def _quiet_stdout() -> Iterator[None]:
    """Lead what the renderer prints to stderr: results go to stdout."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        # What Python or C++ has not written yet must not follow once stdout is itself again.
        sys.stdout.flush()
        ctypes.CDLL(None).fflush(None)
        os.dup2(kept, 1)
        os.close(kept)


class AnnotationWindow:
    """Session, 3D view and side panel in one window."""

    def __init__(
        self,
        session: AnnotationSession,
        robot: RobotVisuals,
        scene: SceneSpec,
        cloud: SceneCloud | None,
        config: WindowConfig,
    ) -> None:
        """Open the window; a display must be there."""
        self._session, self._robot, self._scene, self._config = session, robot, scene, config
        self._application = gui.Application.instance
        self._application.initialize()
        mono = self._application.add_font(
            gui.FontDescription(gui.FontDescription.MONOSPACE, point_size=14)
        )
        small = self._application.add_font(gui.FontDescription(point_size=13))
        self._window = self._application.create_window(TITLE, config.width, config.height)
        self._view = gui.SceneWidget()
        self._view.scene = rendering.Open3DScene(self._window.renderer)
        self._view.scene.set_background([*BACKDROP, 1.0])
        # Colours as they are, and a fraction of the time on a CPU.
        drawing = self._view.scene.view
        drawing.set_post_processing(False)
        drawing.set_sample_count(1)
        drawing.set_ambient_occlusion(False)
        drawing.set_antialiasing(False)
        drawing.set_shadowing(False, drawing.ShadowType.PCF)
        lights = self._view.scene.scene
        lights.set_sun_light([-0.5, 0.6, -0.6], [1.0, 1.0, 1.0], 80_000)
        lights.enable_sun_light(True)
        lights.set_indirect_light_intensity(60_000)
        self._moving = False
        self._last_key = self._last_close = 0.0
        self._resets = session.view_resets
        self._drawn: dict[int, tuple[Word, bool]] = {}
        self._ghost_gripper: float | None = None
        self._labels: list[Any] = []
        self._panel = _Panel(self._window, session, mono, small)
        self._add_geometry(cloud)
        for child in (self._view, *self._panel.widgets):
            self._window.add_child(child)
        self._window.set_on_layout(self._layout)
        self._window.set_on_key(self._on_key)
        self._window.set_on_close(self._on_close)
        self._reset_camera()
        self._update()

    def run(self) -> None:
        """Show the window until the session is done."""
        try:
            # Tick by tick, so that Ctrl-C gets through and what comes next is computed ahead.
            while self._application.run_one_tick():
                self._idle()
        finally:
            if not self._session.done:
                self._window.set_on_close(lambda: True)
                self._window.close()
                self._application.run_one_tick()

    # --- keys -----------------------------------------------------------------------------------

    def _on_key(self, event: Any) -> bool:
        key = _KEY_NAMES.get(int(event.key))
        if key is None or event.type != gui.KeyEvent.Type.DOWN:
            return False
        self._moving, self._last_key = True, time.monotonic()
        self._session.press(key)
        self._update()
        if self._session.done:
            self._window.close()
        return True

    def _on_close(self) -> bool:
        # Open3D closes the window on Escape, when it goes down and when it comes up: asked once.
        if not self._session.done and time.monotonic() - self._last_close > _ONE_PRESS:
            self._session.perform("quit")
            self._update()
        self._last_close = time.monotonic()
        return self._session.done

    def _idle(self) -> None:
        waited = time.monotonic() - self._last_key
        if self._moving and waited > self._config.idle_s:
            self._moving = False
            self._show_obstacles()
            self._draw_governing()
            self._window.post_redraw()
        elif not self._moving:
            self._session.prepare()

    # --- drawing --------------------------------------------------------------------------------

    def _add_geometry(self, cloud: SceneCloud | None) -> None:
        add = self._view.scene.add_geometry
        self._clouds: list[str] = []
        if cloud is not None:
            order = np.random.default_rng(0).permutation(len(cloud))
            n = self._config.moving_points
            for name, rows, size in (("whole", order, 2), ("thin", order[:n], 4)):
                add(name, _point_cloud(cloud, rows), _plain(size))
                self._clouds.append(name)
        self._bodies: list[tuple[str, str]] = []
        for body in self._scene.bodies:
            if body.name in self._session.demonstration.body_Ts_world:
                T = self._session.demonstration.body_Ts_world[body.name][0]
                for i, mesh in enumerate(body_meshes(body.shapes)):
                    name = f"body {body.name} {i}"
                    add(name, _shaded(mesh, T), _plain())
                    self._bodies.append((name, body.name))
        steps = self._session.demonstration.steps
        gripper = gripper_at(self._session.demonstration, 0)
        Ts_joint = self._robot.poses_at(steps.joint_positions[0], gripper)
        for joint, meshes in self._robot.bodies.items():
            for i, mesh in enumerate(meshes):
                add(f"robot {joint} {i}", _shaded(mesh, Ts_joint[joint]), _plain())
        Ts = self._session.demonstration.steps.measured_Ts_world_tool
        add("path", _path(Ts[:, :3, 3], path_colours(self._session.clearances)), _line_material(5))
        add("triads", _triads(Ts, 0.008), _line_material(1.5))
        add("triad", _triads(np.eye(4)[None], 0.05), _line_material(4))
        add("convergence", _ball(0.004, ACCENT), _plain())

    def _update(self) -> None:
        """Draw what the session says now."""
        session, scene = self._session, self._view.scene
        steps, t = session.demonstration.steps, session.selected
        gripper = gripper_at(session.demonstration, t)
        q = steps.joint_positions[t]
        Ts_joint = self._robot.poses_at(q, gripper)
        for joint, meshes in self._robot.bodies.items():
            for i in range(len(meshes)):
                scene.set_geometry_transform(f"robot {joint} {i}", Ts_joint[joint])
        for name, body in self._bodies:
            T = session.demonstration.body_Ts_world[body][t]
            scene.set_geometry_transform(name, T)
        scene.set_geometry_transform("triad", steps.measured_Ts_world_tool[t])
        self._show_obstacles()
        self._draw_spheres()
        self._draw_governing()
        self._panel.update()
        if session.view_resets != self._resets:
            self._resets = session.view_resets
            self._reset_camera()
        elif session.follow:
            self._look_at(steps.measured_Ts_world_tool[t][:3, 3], NEAR)
        self._window.post_redraw()

    def _show_obstacles(self) -> None:
        scene, clouds = self._view.scene, self._session.shown == "cloud" and bool(self._clouds)
        for name in self._clouds:
            scene.show_geometry(name, clouds and name == ("thin" if self._moving else "whole"))
        for name, _ in self._bodies:
            scene.show_geometry(name, not clouds)

    def _draw_spheres(self) -> None:
        session, scene = self._session, self._view.scene
        for i in range(max(len(session.spheres), len(self._drawn))):
            ball, rings = f"sphere {i}", f"rings {i}"
            if i >= len(session.spheres):
                scene.show_geometry(ball, False)
                scene.show_geometry(rings, False)
                continue
            sphere = session.spheres[i]
            # Transparency is expensive on a CPU: only the current sphere has it.
            style = session.verdict(sphere).word, sphere is session.governing
            if self._drawn.get(i) != style:
                colour, glass = COLOURS[style[0]], style[1]
                for name in (ball, rings):
                    scene.remove_geometry(name)
                if glass:
                    scene.add_geometry(ball, _ball(1.0, colour), _transparent(0.45))
                scene.add_geometry(rings, _rings(colour), _line_material(2.5 if glass else 1.5))
                self._drawn[i] = style
            T = np.diag([*[sphere.radius] * 3, 1.0])
            T[:3, 3] = sphere.T_world_key[:3, 3]
            for name in (ball, rings):
                scene.show_geometry(name, True)
                scene.set_geometry_transform(name, T)

    def _draw_governing(self) -> None:
        """Convergence waypoint and sampled poses of the current sphere, and the labels."""
        session, scene = self._session, self._view.scene
        for label in self._labels:
            self._view.remove_3d_label(label)
        self._labels = []
        sphere, positions = session.governing, session.demonstration.steps.measured_Ts_world_tool
        scene.show_geometry("convergence", sphere is not None)
        here = session.sphere
        if here is not None:
            beside = (here.radius + 0.01) * RIGHT
            self._label(here.T_world_key[:3, 3] + beside, f"{1e3 * here.radius:.1f} mm", INK)
        for i in range(session.config.ghosts):
            if scene.has_geometry(f"ghost {i}"):
                scene.show_geometry(f"ghost {i}", False)
        if here is not None and not self._moving:
            self._draw_ghosts(here)
        if sphere is not None:
            t_star = session.convergence(sphere)
            T = np.eye(4)
            T[:3, 3] = positions[t_star][:3, 3]
            scene.set_geometry_transform("convergence", T)
            self._label(T[:3, 3] - 0.07 * RIGHT, f"t* {t_star}", ACCENT)

    def _label(self, p: Array, text: str, colour: Sequence[float]) -> None:
        label = self._view.add_3d_label(p, text)
        label.color = gui.Color(*colour)
        self._labels.append(label)

    def _draw_ghosts(self, sphere: PrecisionSphere) -> None:
        scene, demonstration = self._view.scene, self._session.demonstration
        gripper = ghost_gripper(demonstration, sphere.waypoint)
        if gripper != self._ghost_gripper:
            tool = open3d.geometry.TriangleMesh()
            for mesh in ghost_meshes(self._robot, demonstration, sphere.waypoint):
                tool += _shaded(mesh, np.eye(4))
            tool.paint_uniform_color(FAINT)
            tool = _textured(tool)
            for i in range(self._session.config.ghosts):
                scene.remove_geometry(f"ghost {i}")
                scene.add_geometry(f"ghost {i}", tool, _transparent(0.25))
            self._ghost_gripper = gripper
        for i, T in enumerate(self._session.ghosts(sphere)):
            scene.show_geometry(f"ghost {i}", True)
            scene.set_geometry_transform(f"ghost {i}", T)

    # --- camera and layout ----------------------------------------------------------------------

    def _reset_camera(self) -> None:
        p = self._session.demonstration.steps.measured_Ts_world_tool[:, :3, 3]
        self._view.setup_camera(50.0, self._view.scene.bounding_box, p.mean(0))
        self._look_at(*start_view(self._session.demonstration))

    def _look_at(self, p: Array, distance: float) -> None:
        self._view.look_at(p, p + distance * TOWARDS_EYE, [0, 0, 1])
        self._view.center_of_rotation = p

    def _layout(self, context: Any) -> None:
        self._view.frame = self._panel.layout(self._window.content_rect)


class _Panel:
    """Wrist image, words about the waypoint, spheres, messages and keys."""

    def __init__(self, window: Any, session: AnnotationSession, mono: int, small: int) -> None:
        self._session, self._window = session, window
        self._em = em = window.theme.font_size
        camera = next(iter(session.demonstration.steps.cameras.values()), None)
        self._images = None if camera is None else camera.rgb
        self._size = round(14 * em)
        self._side = gui.Vert(0.3 * em, gui.Margins(0.8 * em))
        self._side.background_color = gui.Color(*PAPER)
        self._image = gui.ImageWidget(_image(np.full((1, 1, 3), 230, np.uint8), self._size))
        self._side.add_fixed(0.8 * em)
        row = gui.Horiz()
        row.add_stretch()
        row.add_child(self._image)
        row.add_stretch()
        self._side.add_child(row)
        row = gui.Horiz(em)
        _label(row, "\n".join(self._state_lines()), FAINT)
        self._state = _label(row, "", INK)
        self._side.add_child(row)
        self._verdict = _label(self._side, "\n", INK)
        self._head = _label(self._side, "", INK)
        self._rows = [_label(self._side, "", INK, mono) for _ in range(_ROWS)]
        self._side.add_stretch()
        row = gui.Horiz(0.5 * em)
        _label(row, "path, clear by", FAINT, small)
        for clearance, colour in zip(CLEARANCES, PATH_COLOURS, strict=True):
            _label(row, f"{1e3 * clearance:.0f} mm", colour, small)
        _label(row, "or more", FAINT, small)
        self._side.add_child(row)
        self._message_box = gui.Vert(0, gui.Margins(0.6 * em, 0.4 * em))
        self._message_box.background_color = gui.Color(*INK)
        self._message = _label(self._message_box, "", (1, 1, 1))
        self._keys = gui.Horiz(0.5 * em, gui.Margins(0.6 * em, 0.3 * em))
        self._keys.background_color = gui.Color(*PAPER)
        rows = [(a.keys[0], a.help) for a in ACTIONS.values() if a.keys]
        self._n_key_rows = -(-len(rows) // _KEY_COLUMNS)
        for first in range(0, len(rows), self._n_key_rows):
            keys, texts = zip(*rows[first : first + self._n_key_rows], strict=True)
            _label(self._keys, "\n".join(keys), INK, small)
            _label(self._keys, "\n".join(texts), FAINT, small)
            self._keys.add_stretch()
        self.widgets = (self._side, self._message_box, self._keys)

    def _state_lines(self) -> dict[str, str]:
        state = self._session.state()
        return {name: state[name] for name in state if name != "verdict"}

    def update(self) -> None:
        """Say what the session says."""
        session = self._session
        if self._images is not None:
            self._image.update_image(_image(self._images[session.selected], self._size))
        self._state.text = "\n".join(
            textwrap.shorten(line, 30, placeholder=" ...") for line in self._state_lines().values()
        )
        here = session.sphere
        self._verdict.text = textwrap.fill(session.state()["verdict"], 40)
        colour = INK if here is None else COLOURS[session.verdict(here).word]
        self._verdict.text_color = gui.Color(*colour)
        self._head.text = heading_of(session)
        # As many as there is room for, those about the selected waypoint among them.
        before = sum(s.waypoint <= session.selected for s in session.spheres)
        first = max(0, min(before - _ROWS // 2, len(session.spheres) - _ROWS))
        for i, label in enumerate(self._rows):
            label.text = ""
            for sphere in session.spheres[first + i : first + i + 1]:
                word = session.verdict(sphere).word
                mark, radius = ">" if sphere is here else " ", 1e3 * sphere.radius
                label.text = f"{mark}{sphere.waypoint:>4} {radius:>6.1f} mm  {word}"
                label.text_color = gui.Color(*COLOURS[word])
        self._message.text = message_of(session)
        self._window.set_needs_layout()

    def layout(self, area: Any) -> Any:
        """Panel to the right, message above, keys below; what is left is the view's."""
        em = self._em
        width, top, bottom = 22 * em, 2 * em, round((0.8 + 0.95 * self._n_key_rows) * em)
        left = area.width - width
        self._side.frame = gui.Rect(area.x + left, area.y, width, area.height)
        self._message_box.frame = gui.Rect(area.x, area.y, left, top)
        self._keys.frame = gui.Rect(area.x, area.y + area.height - bottom, left, bottom)
        return gui.Rect(area.x, area.y + top, left, area.height - top - bottom)


def _key_names() -> dict[int, str]:
    """The session's keys by Open3D's numbers."""
    names = {"+": ("PLUS", "EQUALS"), "-": ("MINUS", "UNDERSCORE")}
    found = {}
    for action in ACTIONS.values():
        for key in action.keys:
            for name in names.get(key, (key.upper().replace(" ", "_"),)):
                found[int(getattr(gui.KeyName, name))] = key
    # It closes the window, which asks to quit as well.
    del found[int(gui.KeyName.ESCAPE)]
    return found


_KEY_NAMES = _key_names()


def _label(parent: Any, text: str, colour: Sequence[float], font: int | None = None) -> Any:
    label = gui.Label(text)
    label.text_color = gui.Color(*colour)
    if font is not None:
        label.font_id = font
    parent.add_child(label)
    return label


def _image(rgb: Image, size: int) -> Any:
    """An image of so many pixels a side."""
    scaled = PillowImage.fromarray(rgb).resize((size, size), PillowImage.Resampling.BICUBIC)
    pixels: Any = np.array(scaled)
    return open3d.geometry.Image(pixels)


def _transparent(alpha: float) -> Any:
    """For meshes with colours of their own."""
    material = rendering.MaterialRecord()
    material.shader = "defaultLitTransparency"
    material.base_color = [1.0, 1.0, 1.0, alpha]
    material.base_roughness = 1.0
    return material


def _line_material(width: float) -> Any:
    material = rendering.MaterialRecord()
    material.shader = "unlitLine"
    material.line_width = width
    return material


def _plain(point_size: float = 1.0) -> Any:
    """For colours as they are, of meshes and of points."""
    material = rendering.MaterialRecord()
    # The one such shader that reads no texture, see `_textured`; "defaultUnlit" does.
    material.shader = "unlitPolygonOffset"
    material.point_size = point_size
    return material


def _shaded(mesh: DrawnMesh, T_world_mesh: Array) -> Any:
    """A mesh, its light drawn on once, where it stands at `T_world_mesh`.

    A light that is computed for every image takes a CPU twice as long as all the rest.
    """
    towards_light = T_world_mesh[:3, :3].T @ _TOWARDS_LIGHT
    bright = 0.72 + 0.28 * mesh.normals @ towards_light
    made = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices),
        open3d.utility.Vector3iVector(mesh.triangles.astype(np.int32)),
    )
    made.vertex_colors = open3d.utility.Vector3dVector(bright[:, None] * np.array(mesh.rgba[:3]))
    made.vertex_normals = open3d.utility.Vector3dVector(mesh.normals)
    return made


def _textured(mesh: Any) -> Any:
    """A mesh with texture coordinates that vary.

    Where they don't, Mesa's Vulkan driver reads textures, even plain white ones, at a level of
    detail of log2(0), and what is drawn is black and white noise.
    """
    uv = np.tile([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]], (len(mesh.triangles), 1))
    mesh.triangle_uvs = open3d.utility.Vector2dVector(uv)
    return mesh


def _ball(radius: float, colour: Sequence[float]) -> Any:
    made = open3d.geometry.TriangleMesh.create_sphere(radius, 30)
    made.compute_vertex_normals()
    made.paint_uniform_color(colour)
    return _textured(made)


def _rings(colour: Sequence[float]) -> Any:
    """Three great circles of the unit sphere."""
    n = 64
    angles = np.linspace(0, 2 * np.pi, n, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(n)], axis=1)
    points = np.concatenate([np.roll(circle, turn, axis=1) for turn in range(3)])
    pairs = [[k * n + i, k * n + (i + 1) % n] for k in range(3) for i in range(n)]
    return _lines(points, pairs, np.tile(colour, (3 * n, 1)))


def _point_cloud(cloud: SceneCloud, rows: NDArray[np.int64]) -> Any:
    made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points[rows]))
    made.colors = open3d.utility.Vector3dVector(cloud.colours[rows] / 255.0)
    return made


def _path(p: Array, colours: Array) -> Any:
    return _lines(p, [[i, i + 1] for i in range(len(p) - 1)], (colours[:-1] + colours[1:]) / 2)


def _triads(Ts: Array, length: float) -> Any:
    origins = Ts[:, :3, 3]
    ends = origins[:, None] + length * np.swapaxes(Ts[:, :3, :3], 1, 2)
    points = np.concatenate([origins[:, None], ends], axis=1).reshape(-1, 3)
    pairs = [[4 * i, 4 * i + axis] for i in range(len(Ts)) for axis in (1, 2, 3)]
    return _lines(points, pairs, np.tile(_TRIAD_COLOURS, (len(Ts), 1)))


def _lines(points: Array, pairs: list[list[int]], colours: Array) -> Any:
    made = open3d.geometry.LineSet(
        open3d.utility.Vector3dVector(points), open3d.utility.Vector2iVector(np.array(pairs))
    )
    made.colors = open3d.utility.Vector3dVector(colours)
    return made
