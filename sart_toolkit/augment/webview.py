"""What is generated, as it comes, on a page in a browser."""

from __future__ import annotations

import collections
import logging
import time
from pathlib import Path
from typing import Any, Self

import numpy as np

from sart_toolkit.annotate.drawing import COLOURS, INK, fine_cloud
from sart_toolkit.annotate.webscene import WebScene, joined, place_ball
from sart_toolkit.augment import get_strategy
from sart_toolkit.augment.allocation import Allocation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.planner import draw_proposal
from sart_toolkit.augment.strategies import Proposal
from sart_toolkit.data.manifest import KEPT, AttemptKey, episode_name
from sart_toolkit.data.storage import load_episode
from sart_toolkit.data.writer import Sources
from sart_toolkit.poses import Array
from sart_toolkit.record.webpage import WebPage, coloured, facts, message, panel, to_bytes
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.robots.visuals import RobotVisuals
from sart_toolkit.scenes.spec import SceneSpec

_log = logging.getLogger(__name__)
# The page is drawn no more often than once in so many seconds.
_PERIOD = 0.5
# The last segments and, of these, sampled tools that are drawn, kept and rejected.
_SEGMENTS, _GHOSTS = 400, 5
_KEPT, _REJECTED, _HERE = COLOURS["safe"], COLOURS["colliding"], COLOURS["region"]


class GenerationView:
    """Shows a generation on a page; it goes on whatever becomes of the page.

    What can't be shown is logged once as a warning, and nothing is shown from then on.

    Attributes:
        how_to_open: what to do to see the page; empty where there is none.
    """

    def __init__(
        self,
        sources: Sources,
        config: AugmentConfig,
        robot: RobotSpec,
        scene: SceneSpec,
        out: Path,
        host: str | None = None,
        port: int | None = None,
    ) -> None:
        """Open the page; closed by `with`.

        Args:
            sources: what is generated from.
            config: what is generated.
            robot: the demonstrations'.
            scene: what is fixed to it, and the bodies to draw where a demonstration has them.
            out: the dataset's directory, where kept episodes are found.
            host: the address at which to be reached; this computer only if left out.
            port: 8080 if left out.
        """
        self.how_to_open = ""
        self._page: WebPage | None = None
        self._shown: GenerationPage | None = None
        try:
            self._page = WebPage("sart augment", "", host, port)
            self._shown = GenerationPage(self._page, sources, config, robot, scene, out)
            self.how_to_open = self._page.how_to_open
        except Exception as error:
            self._give_up(error)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            if self._shown is not None:
                self._shown.draw()
            if self._page is not None:
                self._page.close()
        except Exception as error:
            self._give_up(error)

    def __call__(self, key: AttemptKey, outcome: str) -> None:
        """Show how an attempt ended; a generation's `watch`."""
        if self._shown is None:
            return
        try:
            self._shown.attempted(key, outcome)
        except Exception as error:
            self._give_up(error)

    def _give_up(self, error: Exception) -> None:
        self._shown = None
        _log.warning("no page in the browser: %s; the generation goes on without", error)


class GenerationPage:
    """Robot, spheres, and the last segments with the tools at the poses that were sampled."""

    def __init__(
        self,
        page: WebPage,
        sources: Sources,
        config: AugmentConfig,
        robot: RobotSpec,
        scene: SceneSpec,
        out: Path,
    ) -> None:
        """Fill a page; the arguments are those of `GenerationView`.

        Raises:
            SartError: something can't be drawn.
        """
        self._page, self._config, self._out = page, config, out
        self._demonstrations = [demonstration for demonstration, _ in sources]
        strategy = get_strategy(config.strategy)
        self._spheres = [strategy.spheres(*source) for source in sources]
        self._allocation = Allocation(sources, config)
        self._kept: collections.Counter[tuple[int, int]] = collections.Counter()
        self._rejected: collections.Counter[tuple[int, int]] = collections.Counter()
        self._reasons: collections.Counter[str] = collections.Counter()
        self._recent: dict[bool, collections.deque[tuple[AttemptKey, Proposal]]] = {
            kept: collections.deque(maxlen=_SEGMENTS) for kept in (True, False)
        }
        # The segments' tool positions `(n, 3)`, by attempt.
        self._paths: dict[AttemptKey, Array] = {}
        self._last: tuple[AttemptKey, str, Proposal] | None = None
        self._drawn_at = -np.inf
        first = self._demonstrations[0]
        cloud = None
        if config.obstacles == "cloud" or not first.body_Ts_world:
            cloud = fine_cloud(first, robot, scene)
        visuals = RobotVisuals(RobotModel(robot, scene.held))
        self._scene = WebScene(page, visuals, scene, first, cloud)
        self._balls: dict[tuple[int, int], tuple[Any, Any]] = {}
        # At the sphere of the last attempt.
        self._label = page.server.scene.add_label("/here", "", anchor="bottom-center")
        for source, demonstration in enumerate(self._demonstrations):
            Ts = demonstration.steps.measured_Ts_world_tool
            self._scene.add_path(f"/path/{source}", Ts, np.tile(INK, (len(Ts), 1)))
        for share in self._allocation.shares:
            at, name = share[:2], f"/spheres/{share.source}/{share.sphere}"
            sphere = self._spheres[share.source][share.sphere]
            self._balls[at] = self._scene.add_ball(name)
            place_ball(self._balls[at], sphere.T_world_key[:3, 3], sphere.radius, INK)
        self._state = page.server.gui.add_html("")
        self._scene.look_at_start()
        self.draw()

    def attempted(self, key: AttemptKey, outcome: str) -> None:
        """Take in how an attempt ended, and draw if that is due."""
        spheres, kept = self._spheres[key.source], outcome == KEPT
        demonstration = self._demonstrations[key.source]
        proposal, _ = draw_proposal(demonstration, spheres, key, self._config)
        (self._kept if kept else self._rejected)[key[:2]] += 1
        if not kept:
            self._reasons[outcome] += 1
        self._recent[kept].append((key, proposal))
        self._last = key, outcome, proposal
        if time.monotonic() - self._drawn_at >= _PERIOD:
            self.draw()

    def draw(self) -> None:
        """Show how things stand on all browsers at once."""
        self._drawn_at = time.monotonic()
        recent = [key for found in self._recent.values() for key, _ in found]
        for kept, found in self._recent.items():
            for key, proposal in found:
                if key not in self._paths:
                    self._paths[key] = self._path(key, proposal, kept)
        self._paths = {key: self._paths[key] for key in recent}
        with self._page.server.atomic():
            self._draw_last()
            for kept, colour in ((True, _KEPT), (False, _REJECTED)):
                self._draw_segments(kept, colour)
            self._state.content = self._words()
        self._page.server.flush()

    def _path(self, key: AttemptKey, proposal: Proposal, kept: bool) -> Array:
        """A segment's tool positions: measured where it was kept, else from where to where."""
        steps = self._demonstrations[key.source].steps
        if kept:
            episode = load_episode(self._out / episode_name(key))
            return episode.steps.measured_Ts_world_tool[:, :3, 3]
        ends = steps.commanded_Ts_world_tool[proposal.t_star], proposal.T_world_sampled
        return np.stack([T[:3, 3] for T in ends])

    def _draw_last(self) -> None:
        """The robot where the last attempt started, its sphere, and the last tools."""
        demonstration, at, t = self._demonstrations[0], None, 0
        self._label.visible = self._last is not None
        if self._last is not None:
            key, _, proposal = self._last
            demonstration, at, t = self._demonstrations[key.source], key[:2], proposal.t_star
            sphere = self._spheres[key.source][key.sphere]
            self._label.position = sphere.T_world_key[:3, 3] + [0.0, 0.0, sphere.radius]
            self._label.text = f"sphere {key.sphere}: {self._kept[at]} kept"
        self._scene.show_waypoint(demonstration, t, cloud=True)
        for other, (ball, rings) in self._balls.items():
            # Many transparent balls, one within the other, hide what is in them.
            ball.visible = other == at
            ball.color = to_bytes(_HERE)
            rings.colors = np.array(to_bytes(_HERE if other == at else INK), np.uint8)
        for kept, name, colour in ((True, "kept", _KEPT), (False, "rejected", _REJECTED)):
            last = list(self._recent[kept])[-_GHOSTS:]
            Ts = np.array([found.T_world_sampled for _, found in last]).reshape(-1, 4, 4)
            self._scene.show_ghosts(f"/ghosts/{name}", demonstration, t, Ts, colour)

    def _draw_segments(self, kept: bool, colour: tuple[float, float, float]) -> None:
        if not self._recent[kept]:
            return
        points = np.concatenate([joined(self._paths[key]) for key, _ in self._recent[kept]])
        self._page.server.scene.add_line_segments(
            "/segments/kept" if kept else "/segments/rejected",
            points.astype(np.float32),
            to_bytes(colour),
            thickness=2.5 if kept else 1.2,
            thickness_units="screen",
        )

    def _words(self) -> str:
        kept, rejected = self._kept.total(), self._rejected.total()
        said = "nothing attempted yet"
        if self._last is not None:
            key, outcome, proposal = self._last
            said = f"sphere {key.sphere}, attempt {key.k}, from t* {proposal.t_star}: {outcome}"
        several = len(self._demonstrations) > 1
        rows = [("sphere", "waypoint", "radius", "kept", "rejected")]
        for share in self._allocation.shares:
            at, sphere = share[:2], self._spheres[share.source][share.sphere]
            name = f"{share.source}, {share.sphere}" if several else f"{share.sphere}"
            rows.append(
                (
                    name,
                    f"{sphere.waypoint}",
                    f"{1e3 * sphere.radius:.1f} mm",
                    f"{self._kept[at]} of {share.wanted}",
                    f"{self._rejected[at]}",
                )
            )
        reasons = [(f"{n}", reason) for reason, n in self._reasons.most_common()]
        return panel(
            message(f"{kept} of {self._allocation.wanted} kept, {rejected} rejected"),
            f"<p>{facts([('last', said)])}</p>",
            facts(rows),
            f"<p>{facts(reasons)}</p>" if reasons else "",
            f"<p>segments: {coloured('kept, as measured', _KEPT)}, "
            f"{coloured('rejected, from end to end', _REJECTED)}; the last of each with the tool "
            "at the sampled pose</p>",
        )
