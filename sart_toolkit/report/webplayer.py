"""The player as a page in a browser, for computers without a desktop."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

from sart_toolkit.annotate.drawing import ACCENT, INK, fine_cloud, path_colours
from sart_toolkit.annotate.webscene import WebScene, legend
from sart_toolkit.collision.cloud import SceneCloud
from sart_toolkit.collision.phases import Phase, demonstration_phases
from sart_toolkit.collision.world import CollisionWorld
from sart_toolkit.poses import Array
from sart_toolkit.record.webpage import WebPage, beside, facts, message, panel
from sart_toolkit.report.player import Playback, Player
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.robots.visuals import RobotVisuals
from sart_toolkit.scenes.spec import SceneSpec

# The keys, each with the player's name of it, the word on its button, and what it does.
KEYS = {
    "Space": ("space", "play", "stop, play"),
    "Home": ("home", "first", "first step"),
    "Left": ("left", "back", "one step back"),
    "Right": ("right", "on", "one step on"),
    "End": ("end", "last", "last step"),
    "T": ("t", "show", "cloud, or the scene's meshes"),
    "V": ("v", "view", "view as at the start"),
    "Escape": ("escape", "close", "close"),
}
BUTTONS = {
    "play": ("play",),
    "step": ("first", "back", "on", "last"),
    "view": ("show", "view"),
    "page": ("close",),
}
_BY_BUTTON = {button: name for name, button, _ in KEYS.values()}
# What moves and turns by less than this [m, rad] is in the cloud as it is.
_STILL = 0.001


def play_in_browser(
    playback: Playback,
    robot: RobotSpec,
    scene: SceneSpec,
    world: CollisionWorld | None,
    speed: float = 1.0,
    host: str | None = None,
    port: int | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> None:
    """Show a playback on a page until the person closes it; it begins once a browser is there.

    Args:
        playback: what is shown.
        robot: the demonstration's.
        scene: what is fixed to it, and the bodies to draw where the demonstration has them.
        world: where the obstacles were, for the path's colours; `None` where that isn't known.
        speed: times real time.
        host: the address at which to be reached; this computer only if left out.
        port: 8080 if left out.
        say: told how to open the page, once it is there.

    Raises:
        InvalidInput: the page can't be served at that address, or the speed is not positive.
    """
    cloud = fine_cloud(playback.demonstration, robot, scene)
    phases = demonstration_phases(playback.demonstration, robot, scene)
    drawn = RobotVisuals(RobotModel(robot, scene.held))
    clearances = None if world is None else playback.clearances(world)
    with WebPage(f"sart play {playback.title}", "", host, port) as page:
        shown = PlayPage(playback, drawn, scene, cloud, phases, clearances, page, speed)
        say(page.how_to_open)
        shown.run()


class PlayPage(Player):
    """Shows a playback on a page; all browsers that open it show the same step."""

    def __init__(
        self,
        playback: Playback,
        robot: RobotVisuals,
        scene: SceneSpec,
        cloud: SceneCloud | None,
        phases: Sequence[Phase],
        clearances: Array | None,
        page: WebPage,
        speed: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Fill a page.

        Args:
            playback: what is shown.
            robot: the demonstration's.
            scene: the bodies to draw.
            cloud: points to draw, if there are any.
            phases: the demonstration's.
            clearances: how far `(n,)` [m] the tool was from the nearest obstacle at each step, if
                known.
            page: where it is shown.
            speed: times real time.
            clock: returns the time [s].

        Raises:
            InvalidInput: the speed is not positive.
        """
        super().__init__(playback, speed, clock)
        self._page, self._phases, self._clearances = page, phases, clearances
        self._scene = WebScene(page, robot, scene, playback.demonstration, cloud)
        self._clouds = self._scene.cloud
        self._add_paths()
        gui = page.server.gui
        self._state = gui.add_html("")
        self._slider = page.add_slider("step", "go", 1, len(playback), 1)
        for label, names in BUTTONS.items():
            page.add_buttons(label, names)
        gui.add_html(
            panel(
                "path: how clear of obstacles isn't known" if clearances is None else legend(),
                "<hr>",
                facts((key, what) for key, (_, _, what) in KEYS.items()),
            )
        )
        for key, (name, _, what) in KEYS.items():
            page.add_key(key, name, what)
        self._scene.look_at_start()
        self._draw()

    def run(self) -> None:
        """Play until the page is closed by its key or button, from when a browser has it open."""
        while not (self._page.watched or self._page.waiting):
            time.sleep(0.05)
        self._due = self._clock() + self._period
        while not self.closed:
            inputs = self._page.take(self.wait)
            for name, value in inputs:
                self._handle(name, value)
            at = self.at
            self.advance()
            if inputs or at != self.at:
                self._draw()

    def _handle(self, name: str, value: float | None) -> None:
        name = _BY_BUTTON.get(name, name)
        if name == "go" and value is not None:
            self.go(round(value) - 1)
        elif name == "t":
            self._clouds = not self._clouds and self._scene.cloud
        elif name == "v":
            self._scene.look_at_start()
        else:
            self.key(name)

    def _add_paths(self) -> None:
        playback, n = self._playback, len(self._playback)
        Ts = np.stack([playback.joints(i)[1] for i in range(n)])
        known = self._clearances
        colours = np.tile(INK, (n, 1)) if known is None else path_colours(known)
        self._scene.add_path("/path", Ts, colours)
        bodies = [playback.bodies(i, self._phases) for i in range(n)]
        ranges = {name: np.ptp([at[name] for at in bodies], axis=0) for name in bodies[0]}
        self._still = frozenset(name for name, by in ranges.items() if (by < _STILL).all())
        if playback.split:
            add, t = self._page.server.scene, playback.waypoint(0)
            p = Ts[playback.split][:3, 3]
            add.add_icosphere("/t_star", 0.004, ACCENT, position=p)
            add.add_label("/t_star/label", f"joins at t* {t}", anchor="top-right")

    def _draw(self) -> None:
        """Show the step on all browsers at once."""
        playback, i = self._playback, self.at
        q, T_world_tool = playback.joints(i)
        measured, commanded = playback.gripper(i)
        force = playback.force(i)
        lines = {
            "step": f"{i + 1} of {len(playback)}",
            "from the": playback.part(i),
            "waypoint": str(playback.waypoint(i)) if i >= playback.split else "–",
            "clearance": self._clearance(i),
            "gripper": f"{measured:.2f}, commanded {commanded:.2f}",
            "force": "not measured" if np.isnan(force) else f"{force:.0f} N",
            "goal": "reached" if playback.success(i) else "–",
        }
        demonstration = playback.demonstration
        doing = "playing" if self.playing else "stopped"
        with self._page.server.atomic():
            self._scene.show(
                q,
                float(np.clip(measured, 0.0, 1.0)),
                T_world_tool,
                playback.bodies(i, self._phases),
                self._clouds,
                self._still,
            )
            self._state.content = panel(
                message(f"{doing}: {i / playback.hz:.1f} of {playback.seconds:.1f} s, {self.pace}"),
                beside(playback.image(i), facts(lines)),
                facts(
                    {
                        "camera": playback.camera,
                        "task": demonstration.task,
                        "on": demonstration.backend,
                        "by": demonstration.operator,
                    }
                ),
            )
            if not self._page.waiting:
                # Else the slider is being dragged on.
                self._slider.value = i + 1
        self._page.server.flush()

    def _clearance(self, i: int) -> str:
        if self._clearances is None:
            return "not known"
        return f"{1e3 * self._clearances[i]:.1f} mm"
