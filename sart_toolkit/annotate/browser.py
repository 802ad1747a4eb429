"""The annotator as a page in a browser, for computers without a desktop.

It draws what an `AnnotationSession` says and hands it keys, buttons and sliders; nothing is decided
here.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from sart_toolkit.annotate.drawing import (
    ACCENT,
    COLOURS,
    INK,
    NEAR,
    RIGHT,
    TITLE,
    TOWARDS_EYE,
    fine_cloud,
    heading_of,
    message_of,
    path_colours,
)
from sart_toolkit.annotate.session import ACTIONS, KEYS, AnnotationSession
from sart_toolkit.annotate.webscene import WebScene, legend, place_ball
from sart_toolkit.collision.cloud import SceneCloud
from sart_toolkit.data.records import PrecisionSphere
from sart_toolkit.record.webpage import (
    LET_GO,
    WebPage,
    beside,
    coloured,
    facts,
    message,
    panel,
)
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.robots.visuals import RobotVisuals
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
_CSS = """
.sart .verdict { font-weight: 600; }
.sart .spheres { max-height: 11em; overflow-y: auto; font-variant-numeric: tabular-nums; }
.sart .spheres td:first-child { color: inherit; }
.sart .spheres .here { background: #e4e8ee; }
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
        self._session, self._page = session, page
        self._resets = session.view_resets
        # The radius [mm] that a slider or handle is being dragged to, and since when.
        self._tried: float | None = None
        self._tried_at = 0.0
        self._balls: list[tuple[Any, Any]] = []
        self._scene = WebScene(page, robot, scene, session.demonstration, cloud)
        self._add_geometry()
        self._panel = _Panel(page, session)
        for key, name in KEYS.items():
            page.add_key(key, name, ACTIONS[name].help)
        self._scene.look_at_start()
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

    def _add_geometry(self) -> None:
        page, session, add = self._page, self._session, self._page.server.scene
        Ts = session.demonstration.steps.measured_Ts_world_tool
        self._scene.add_path("/path", Ts, path_colours(session.clearances))
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
        with self._page.server.atomic():
            self._scene.show_waypoint(session.demonstration, t, session.shown == "cloud")
            spheres = [self._as_tried(sphere) for sphere in session.spheres]
            self._draw_spheres(spheres)
            self._draw_here()
            self._panel.update(spheres, self._page.waiting)
        if session.view_resets != self._resets:
            self._resets = session.view_resets
            self._scene.look_at_start()
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
        session = self._session
        governing = session.governing
        for i in range(len(self._balls), len(spheres)):
            self._balls.append(self._scene.add_ball(f"/spheres/{i}"))
        for i, (ball, rings) in enumerate(self._balls):
            ball.visible = rings.visible = i < len(spheres)
            if i >= len(spheres):
                continue
            current = governing is not None and spheres[i].waypoint == governing.waypoint
            # Many transparent balls, one within the other, hide what is in them.
            ball.visible = current
            rings.thickness = 2.5 if current else 1.2
            colour = COLOURS[session.verdict(spheres[i]).word]
            place_ball((ball, rings), spheres[i].T_world_key[:3, 3], spheres[i].radius, colour)

    def _draw_here(self) -> None:
        """Handle and sampled poses of the sphere here, t* of the current one."""
        session = self._session
        here, governing = session.sphere, session.governing
        shown = None if here is None else self._as_tried(here)
        self._handle_ball.visible = self._radius_label.visible = shown is not None
        if shown is not None:
            self._handle_ball.position = shown.T_world_key[:3, 3] + shown.radius * RIGHT
            self._radius_label.text = f"{1e3 * shown.radius:.1f} mm"
        ghosts = np.empty((0, 4, 4)) if shown is None else session.ghosts(shown)
        self._scene.show_ghosts("/ghosts", session.demonstration, session.selected, ghosts)
        self._t_star.visible = self._t_star_label.visible = governing is not None
        if governing is not None:
            t_star = session.convergence(governing)
            Ts = session.demonstration.steps.measured_Ts_world_tool
            self._t_star.position = Ts[t_star][:3, 3]
            self._t_star_label.text = f"t* {t_star}"


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
            rows = [(", ".join(a.keys), a.help) for a in ACTIONS.values() if a.keys]
            gui.add_html(panel(facts(rows)))

    def update(self, spheres: list[PrecisionSphere], waiting: bool) -> None:
        """Say what the session says, of spheres as they are shown."""
        session = self._session
        here = next((s for s in spheres if s.waypoint == session.selected), None)
        state = session.state()
        if here is not None:
            state |= {"sphere": session.describe(here), "verdict": str(session.verdict(here))}
        verdict = state.pop("verdict")
        colour = INK if here is None else COLOURS[session.verdict(here).word]
        image = None if self._images is None else self._images[session.selected]
        self._state.content = panel(
            message(message_of(session)),
            beside(image, facts(state)),
            f'<div class="verdict">{coloured(verdict, colour)}</div>',
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

    def _listed(self, spheres: list[PrecisionSphere]) -> str:
        session, rows = self._session, []
        for sphere in spheres:
            word = session.verdict(sphere).word
            here = ' class="here"' if sphere.waypoint == session.selected else ""
            rows.append(
                f"<tr{here}><td>{sphere.waypoint}</td><td>{1e3 * sphere.radius:.1f} mm</td>"
                f"<td>{coloured(word, COLOURS[word])}</td></tr>"
            )
        return panel(
            f"<b>{heading_of(session)}</b>",
            f'<div class="spheres"><table>{"".join(rows)}</table></div>',
            legend(),
        )
