"""Annotating a demonstration without a viewer: what is selected, the spheres, what each key does.

Window, text mode and tests drive the same `AnnotationSession` by the actions of one table.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sart_toolkit.annotate.suggest import (
    SuggestConfig,
    Suggestion,
    suggest_annotation,
    suggest_radius,
    suggestion_settings,
)
from sart_toolkit.annotate.verdict import Verdict, unproved, verdict_of
from sart_toolkit.collision.world import CollisionWorld
from sart_toolkit.data.records import (
    Annotation,
    Demonstration,
    PrecisionSphere,
    convergence_waypoint,
)
from sart_toolkit.data.sampling import SamplingConfig, sample_in_region, sample_pose
from sart_toolkit.data.storage import Journal, save_annotation
from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, SartError, unknown_name
from sart_toolkit.poses import Array, check_positive

Spheres = tuple[PrecisionSphere, ...]
_JUMP = 10


@dataclass(frozen=True)
class AnnotateConfig:
    """What the keys do; lengths in [m].

    `suggest`: margins and limits of what is suggested. `coarse`, `fine`: by how much a key changes
    a radius, from `smallest` to `largest`. `first_radius`: that of a sphere put by hand, less
    where only less is safe. `ghosts`: how many sampled poses are shown, drawn by `sampling`.
    """

    suggest: SuggestConfig = field(default_factory=SuggestConfig)
    coarse: float = 0.01
    fine: float = 0.001
    first_radius: float = 0.04
    smallest: float = 0.001
    largest: float = 0.5
    ghosts: int = 3
    sampling: SamplingConfig = field(default_factory=SamplingConfig)

    def __post_init__(self) -> None:
        for name in ("coarse", "fine", "first_radius", "smallest", "largest"):
            check_positive(name, getattr(self, name), "m")
        if not self.smallest <= self.first_radius <= self.largest:
            raise InvalidInput(
                f"first_radius: expected {self.smallest} to {self.largest} m, got "
                f"{self.first_radius}"
            )
        if self.ghosts < 0:
            raise InvalidInput(f"ghosts: expected a whole number >= 0, got {self.ghosts}")


class AnnotationSession:
    """A person at work on the spheres of one demonstration.

    Everything is done by `perform` with the name of an action, or `press` with a key. What can't
    be done changes nothing but `message`. Every change of the spheres can be undone.

    Attributes:
        demonstration: what is annotated.
        config: what the keys do.
        out: the file that is saved to.
        selected: the waypoint on display.
        spheres: in order of their waypoints.
        message: what the last action did, or why it couldn't.
        refused: whether the last action couldn't be done.
        presses: how many actions were performed, those before an interruption included.
        done: whether the person has left.
        shown: what is to be drawn around the robot.
        follow: whether the view follows the tool.
        view_resets: how often the view was asked back to its start.
    """

    def __init__(
        self,
        demonstration: Demonstration,
        world: CollisionWorld,
        config: AnnotateConfig | None = None,
        annotation: Annotation | None = None,
        out: Path | None = None,
        journal: Journal | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin with an annotation's spheres or with none, and with what a journal has kept.

        Args:
            demonstration: the recorded demonstration.
            world: where the obstacles are.
            config: what the keys do.
            annotation: the one to continue.
            out: file to save to.
            journal: where each action is kept at once; what an interrupted session left in it is
                done again.
            clock: seconds that pass.

        Raises:
            Mismatch: annotation or journal belong to another demonstration.
            BrokenFile: the journal holds something else.
            CannotWrite: the journal can't be written.
        """
        if annotation is not None:
            annotation.check_matches(demonstration)
        self.demonstration = demonstration
        self.config = config or AnnotateConfig()
        self.out = out
        self.selected = 0
        self.spheres: Spheres = () if annotation is None else annotation.spheres
        self.message = ""
        self.refused = False
        self.presses = 0
        self.done = False
        self.shown: Literal["cloud", "scene"] = "cloud"
        self.follow = False
        self.view_resets = 0
        self._world = world
        self._hash = demonstration.content_hash()
        self._base = self._saved = self.spheres
        self._base_settings = {} if annotation is None else annotation.settings
        # The waypoint of each change, and the spheres before (or after) it.
        self._undo: list[tuple[int, Spheres]] = []
        self._redo: list[tuple[int, Spheres]] = []
        self._found: dict[int, Suggestion] = {}
        self._leaving = False
        self._clock = clock
        self._seconds = 0.0 if annotation is None else annotation.seconds
        self._journal = journal
        if journal is not None:
            try:
                self._recover(journal)
            except SartError:
                journal.close()
                raise
        self._started = clock()

    # --- what views show ------------------------------------------------------------------------

    @property
    def last(self) -> int:
        """The last waypoint, which no sphere can be about."""
        return len(self.demonstration) - 1

    @property
    def seconds(self) -> float:
        """Wall-clock seconds spent on these spheres, earlier sessions included."""
        return self._seconds + self._clock() - self._started

    @property
    def dirty(self) -> bool:
        """Whether there are changes that aren't saved."""
        return not _same(self.spheres, self._saved)

    @property
    def sphere(self) -> PrecisionSphere | None:
        """The sphere about the selected waypoint."""
        return next((s for s in self.spheres if s.waypoint == self.selected), None)

    @property
    def governing(self) -> PrecisionSphere | None:
        """The sphere about the selected waypoint, or else the last one before it."""
        before = [s for s in self.spheres if s.waypoint <= self.selected]
        return before[-1] if before else None

    def convergence(self, sphere: PrecisionSphere) -> int:
        """The waypoint t* from which a sphere's segments start."""
        return convergence_waypoint(self.demonstration, sphere)

    def largest_safe(self, t: int) -> Suggestion:
        """The largest radius about waypoint `t` that is proved clear, computed once."""
        if t not in self._found:
            config = dataclasses.replace(self.config.suggest, min_radius=self.config.smallest)
            self._found[t] = suggest_radius(self._world, self.demonstration, t, config)
        return self._found[t]

    def verdict(self, sphere: PrecisionSphere) -> Verdict:
        """What geometry says of a sphere."""
        found = self.largest_safe(sphere.waypoint)
        return verdict_of(sphere, found, self.config.suggest.margin)

    @property
    def unproved(self) -> list[str]:
        """The spheres that aren't proved clear, in words: segments from them may be rejected."""
        verdicts = [(sphere, self.verdict(sphere)) for sphere in self.spheres]
        return [unproved(sphere, verdict) for sphere, verdict in verdicts if not verdict.proved]

    @functools.cached_property
    def clearances(self) -> Array:
        """How far `(T,)` [m] the tool was from the nearest obstacle at each waypoint."""
        joints = self.demonstration.steps.joint_positions
        return np.array([self._world.tool_clearance(t, q) for t, q in enumerate(joints)])

    def ghosts(self, sphere: PrecisionSphere) -> Array:
        """A few tool poses `(n, 4, 4)` as the augmentation would draw them; always the same."""
        rng = np.random.default_rng([0, sphere.waypoint])
        draw = sample_in_region if sphere.kind == "free_space" else sample_pose
        drawn = [draw(sphere, rng, self.config.sampling) for _ in range(self.config.ghosts)]
        return np.array(drawn).reshape(-1, 4, 4)

    def state(self) -> dict[str, str]:
        """The selected waypoint in words, by what each line is about."""
        t, steps = self.selected, self.demonstration.steps
        phase = self._world.phases[t]
        doing = [f"holds {', '.join(sorted(phase.grasped))}"] if phase.grasped else []
        doing += [f"touches {' / '.join(min(phase.contacts))}"] if phase.contacts else []
        lines = {
            "waypoint": f"{t} of {self.last}, {self.demonstration.timestamps[t]:.1f} s",
            "gripper": f"{steps.measured_gripper[t]:.2f} (0 open, 1 closed)",
            "phase": "; ".join(doing) or "free",
            "clearance": f"{1e3 * self.clearances[t]:.1f} mm",
        }
        sphere = self.sphere
        if sphere is None:
            lines["sphere"] = "none here"
            lines["verdict"] = self._outlook(t)
        else:
            lines["sphere"] = self.describe(sphere)
            lines["verdict"] = str(self.verdict(sphere))
        return lines

    def describe(self, sphere: PrecisionSphere) -> str:
        """A sphere's radius, who set it, and where its segments start."""
        by = "suggested" if sphere.source == "suggested" else "by hand"
        kind = "region, " if sphere.kind == "free_space" else ""
        return f"{1e3 * sphere.radius:.1f} mm, {kind}{by}, t* {self.convergence(sphere)}"

    def _outlook(self, t: int) -> str:
        if t == self.last:
            return "no room: the demonstration ends here"
        found = self.largest_safe(t)
        if not found.radius:
            return f"no room: {found.limited_by}"
        return f"up to {1e3 * found.radius:.1f} mm is safe ({found.limited_by})"

    def prepare(self) -> bool:
        """Compute one thing ahead that a key may ask for; False where nothing is left.

        To be called while nobody presses a key.
        """
        ahead = [t for t in range(self.last) if t not in self._found]
        if ahead:
            self.largest_safe(min(ahead, key=lambda t: abs(t - self.selected)))
            return True
        if "_suggested" not in self.__dict__:
            _ = self._suggested
            return True
        return False

    # --- what is done ---------------------------------------------------------------------------

    def press(self, key: str) -> bool:
        """Do what a key is for; False where it is for nothing.

        Args:
            key: one of the names that `ACTIONS` lists, such as "Page Down".
        """
        name = KEYS.get(key)
        if name is not None:
            self.perform(name)
        return name is not None

    def perform(self, name: str, value: float | None = None) -> None:
        """Do one action; `message` says what it did.

        Args:
            name: the action's, as in `ACTIONS`.
            value: what it takes, where it takes a number.

        Raises:
            UnknownName: no such action.
        """
        if name not in ACTIONS:
            raise unknown_name("action", name, ACTIONS)
        action, before, saved = ACTIONS[name], self.spheres, self._saved
        if name != "quit":
            self._leaving = False
        try:
            if (value is None) == action.takes_number:
                raise InvalidInput(
                    f"{name}: expected {'a number' if action.takes_number else 'nothing'} after it"
                )
            self.message = action.do(self) if value is None else action.do(self, value)
            self.refused = False
        except SartError as error:
            self.message, self.refused = str(error), True
        self.presses += 1
        if self._journal is not None and not self.done:
            row: dict[str, Any] = {
                "action": name, "selected": self.selected, "seconds": round(self.seconds, 3)
            }  # fmt: skip
            if self.spheres is not before:
                row["spheres"] = [_row(s) for s in self.spheres]
            if self._saved is not saved:
                row["saved"] = True
            try:
                self._journal.append(row)
            except SartError as error:
                self.message += f" (a crash would lose this: {error})"

    def annotation(self) -> Annotation:
        """The spheres as they are, with the seconds spent.

        Raises:
            InvalidInput: there is none.
        """
        if not self.spheres:
            raise InvalidInput("nothing to save: there is no sphere yet; add one first")
        base = [_row(s) for s in self._base]
        own = any(s.source == "suggested" and _row(s) not in base for s in self.spheres)
        found = suggestion_settings(self._world, self.config.suggest)
        settings = found if own else self._base_settings
        return Annotation(self.spheres, self._hash, round(self.seconds, 1), settings)

    def close(self) -> None:
        """Let go of the journal, which stays where there are changes that aren't saved."""
        if self._journal is not None:
            self._journal.close(remove=self.done or not self.dirty)

    # --- actions --------------------------------------------------------------------------------

    def _select(self, t: float) -> str:
        if not 0 <= t <= self.last or t != int(t):
            raise InvalidInput(f"waypoint {t:g}: expected 0 to {self.last}; choose another")
        self.selected = int(t)
        return f"waypoint {self.selected}"

    def _step(self, steps: int) -> str:
        return self._select(min(max(self.selected + steps, 0), self.last))

    def _to_sphere(self, way: int) -> str:
        ahead = [s.waypoint for s in self.spheres if way * (s.waypoint - self.selected) > 0]
        if not ahead:
            raise InvalidInput(f"no {'next' if way > 0 else 'previous'} sphere")
        return self._select(min(ahead, key=lambda t: abs(t - self.selected)))

    def _to_convergence(self) -> str:
        sphere = self.governing
        if sphere is None:
            raise InvalidInput("no sphere here or before; add one first")
        t = self.convergence(sphere)
        self._select(t)
        return f"waypoint {t}: where the segments of the sphere at {sphere.waypoint} start"

    def _change(self, spheres: Spheres) -> None:
        """Put other spheres in place of those there are; to be undone."""
        self._undo.append((self.selected, self.spheres))
        self._redo.clear()
        self.spheres = spheres

    def _put(self, sphere: PrecisionSphere) -> None:
        others = [s for s in self.spheres if s.waypoint != sphere.waypoint]
        self._change(tuple(sorted([*others, sphere], key=lambda s: s.waypoint)))

    def _here(self) -> PrecisionSphere:
        if self.sphere is None:
            raise InvalidInput(f"no sphere at waypoint {self.selected}; add one first")
        return self.sphere

    def _may_start(self) -> None:
        if self.selected == self.last:
            raise InvalidInput(
                f"waypoint {self.last}: no sphere can be about the last; choose an earlier one"
            )

    def _add(self) -> str:
        self._may_start()
        if self.sphere is not None:
            raise InvalidInput(f"waypoint {self.selected}: there is a sphere already")
        # Whole millimetres are what a person would choose.
        safe = np.floor(1e3 * self.largest_safe(self.selected).radius + 1e-9) / 1e3
        config = self.config
        radius = min(config.first_radius, safe) if safe >= config.smallest else config.smallest
        T_key = self.demonstration.steps.measured_Ts_world_tool[self.selected]
        self._put(PrecisionSphere(self.selected, T_key, float(radius)))
        return f"added a sphere of {1e3 * radius:.0f} mm"

    def _remove(self) -> str:
        sphere = self._here()
        self._change(tuple(s for s in self.spheres if s is not sphere))
        return f"removed the sphere at waypoint {sphere.waypoint}"

    def _set_radius(self, millimetres: float) -> str:
        sphere, radius = self._here(), round(millimetres / 1e3, 6)
        low, high = self.config.smallest, self.config.largest
        if not low <= radius <= high:
            raise InvalidInput(
                f"radius: expected {1e3 * low:g} to {1e3 * high:g} mm, got {millimetres:g} mm"
            )
        # The certificate was another radius's.
        self._put(
            dataclasses.replace(
                sphere, radius=radius, source="human", clearance=None, limited_by=None
            )
        )
        return f"radius {1e3 * radius:.1f} mm"

    def _grow(self, by: float) -> str:
        sphere = self._here()
        radius = min(max(sphere.radius + by, self.config.smallest), self.config.largest)
        if radius == sphere.radius:
            raise InvalidInput(f"radius: {1e3 * radius:g} mm is the limit")
        return self._set_radius(1e3 * radius)

    def _suggestion(self) -> PrecisionSphere:
        """The suggested sphere about the selected waypoint."""
        self._may_start()
        config = dataclasses.replace(self.config.suggest, min_radius=self.config.smallest)
        found = suggest_annotation(self.demonstration, self._world, [self.selected], config)
        return found.spheres[0]

    def _suggest(self) -> str:
        sphere = self._suggestion()
        self._put(sphere)
        return f"suggested {1e3 * sphere.radius:.1f} mm, limited by {sphere.limited_by}"

    def _snap(self) -> str:
        here = self._here()
        sphere = dataclasses.replace(self._suggestion(), kind=here.kind)
        if _row(sphere) == _row(here):
            return f"{1e3 * sphere.radius:.1f} mm is the largest that is safe already"
        self._put(sphere)
        return f"radius {1e3 * sphere.radius:.1f} mm, the largest that is safe"

    @functools.cached_property
    def _suggested(self) -> Spheres | SartError:
        """The spheres that tile the demonstration, or why there are none."""
        try:
            return suggest_annotation(
                self.demonstration, self._world, None, self.config.suggest
            ).spheres
        except InvalidInput as error:
            return error

    def _suggest_all(self) -> str:
        if isinstance(self._suggested, SartError):
            raise self._suggested
        n, before = len(self._suggested), len(self.spheres)
        self._change(self._suggested)
        instead = f" in place of {before}; undo brings them back" if before else ""
        return f"suggested {n} spheres{instead}"

    def _toggle_region(self) -> str:
        sphere = self._here()
        region = sphere.kind == "ball"
        self._put(dataclasses.replace(sphere, kind="free_space" if region else "ball"))
        if region:
            return "a free-space region for the planner (sart augment --strategy sart_planned)"
        return "a ball again"

    def _undo_one(self) -> str:
        return self._travel(self._undo, self._redo, "undo", "undone")

    def _redo_one(self) -> str:
        return self._travel(self._redo, self._undo, "redo", "done again")

    def _travel(
        self,
        source: list[tuple[int, Spheres]],
        target: list[tuple[int, Spheres]],
        what: str,
        past: str,
    ) -> str:
        if not source:
            raise InvalidInput(f"nothing to {what}")
        waypoint, spheres = source.pop()
        target.append((waypoint, self.spheres))
        self.spheres, self.selected = spheres, waypoint
        return f"{past}: the change at waypoint {waypoint}"

    def _save(self) -> str:
        if self.out is None:
            raise InvalidInput("nowhere to save to; give the session a file")
        annotation = self.annotation()
        save_annotation(self.out, annotation)
        self._saved = self.spheres
        said = f"saved {len(self.spheres)} spheres to {self.out}, {annotation.seconds:.0f} s spent"
        doubtful = self.unproved
        if doubtful:
            said += f"; NOT proved clear: {'; '.join(doubtful)}"
        return said

    def _quit(self) -> str:
        if self.dirty and not self._leaving:
            self._leaving = True
            return "there are changes that aren't saved: save them, or quit again to drop them"
        self.done = True
        return "changes dropped" if self.dirty else "goodbye"

    def _reset_view(self) -> str:
        self.follow = False
        self.view_resets += 1
        return "view as at the start"

    def _toggle_follow(self) -> str:
        self.follow = not self.follow
        return "the view follows the tool" if self.follow else "the view stays"

    def _toggle_shown(self) -> str:
        self.shown = "scene" if self.shown == "cloud" else "cloud"
        return f"shows the {self.shown}"

    # --- interruptions --------------------------------------------------------------------------

    def _recover(self, journal: Journal) -> None:
        """Do again what an interrupted session left in its journal, or begin a new one."""
        remedy = f"remove {journal.path}, or choose another --out"
        rows = journal.rows
        if len(rows) < 2:
            journal.clear()
            journal.append(
                {"demonstration_hash": self._hash, "spheres": [_row(s) for s in self.spheres]}
            )
            return
        if rows[0].get("demonstration_hash") != self._hash:
            raise Mismatch(f"{journal.path}: was kept for another demonstration; {remedy}")
        on_disk = self.spheres
        try:
            self._rebase(rows[0]["spheres"])
            for row in rows[1:]:
                self._replay(row)
        except (SartError, LookupError, TypeError, ValueError) as error:
            raise BrokenFile(f"{journal.path}: not a journal ({error!r}); {remedy}") from error
        if not _same(self._saved, on_disk):
            # The file was changed since: one undo leads to what it holds.
            recovered = [_row(s) for s in self.spheres]
            row = {
                "action": "recover", "base": [_row(s) for s in on_disk], "spheres": recovered,
                "selected": self.selected, "seconds": self._seconds,
            }  # fmt: skip
            self._replay(row)
            journal.append(row)
        self.presses = len(rows) - 1
        unsaved = "not saved yet" if self.dirty else "all saved"
        self.message = (
            f"recovered the {self.presses} key presses of an interrupted session; {unsaved}"
        )

    def _rebase(self, rows: list[dict[str, Any]]) -> None:
        """Begin the history with the spheres that a file held."""
        self.spheres = self._saved = self._spheres_of(rows)
        self._undo, self._redo = [], []

    def _replay(self, row: dict[str, Any]) -> None:
        """Do again what one row of a journal records."""
        if "base" in row:
            self._rebase(row["base"])
        if row["action"] == "undo" and self._undo:
            self._undo_one()
        elif row["action"] == "redo" and self._redo:
            self._redo_one()
        if "spheres" in row:
            spheres = self._spheres_of(row["spheres"])
            if not _same(self.spheres, spheres):
                self._change(spheres)
        if row.get("saved"):
            self._saved = self.spheres
        self._select(row["selected"])
        self._seconds = float(row["seconds"])

    def _spheres_of(self, rows: list[dict[str, Any]]) -> Spheres:
        Ts = self.demonstration.steps.measured_Ts_world_tool
        return tuple(PrecisionSphere(T_world_key=Ts[row["waypoint"]], **row) for row in rows)


def _row(sphere: PrecisionSphere) -> dict[str, Any]:
    """What tells a sphere from others about the same demonstration."""
    names = (f.name for f in dataclasses.fields(sphere) if f.name != "T_world_key")
    return {name: getattr(sphere, name) for name in names}


def _same(a: Spheres, b: Spheres) -> bool:
    return [_row(s) for s in a] == [_row(s) for s in b]


@dataclass(frozen=True)
class Action:
    """One thing that a person can do: its keys, what they do in words, and how it is done.

    An action without keys takes a number and is there for scripts and the text mode.
    """

    keys: tuple[str, ...]
    help: str
    do: Callable[..., str]
    takes_number: bool = False


_Session = AnnotationSession
ACTIONS: Mapping[str, Action] = {
    "next": Action(("Right",), "next waypoint", lambda s: s._step(1)),
    "back": Action(("Left",), "previous waypoint", lambda s: s._step(-1)),
    "ahead": Action(("Page Down",), f"{_JUMP} waypoints on", lambda s: s._step(_JUMP)),
    "behind": Action(("Page Up",), f"{_JUMP} waypoints back", lambda s: s._step(-_JUMP)),
    "start": Action(("Home",), "first waypoint", lambda s: s._select(0)),
    "end": Action(("End",), "last waypoint", lambda s: s._select(s.last)),
    "following": Action(("N",), "next sphere", lambda s: s._to_sphere(1)),
    "previous": Action(("P",), "previous sphere", lambda s: s._to_sphere(-1)),
    "converge": Action(("C",), "convergence waypoint t*: next sphere", _Session._to_convergence),
    "add": Action(("Enter", "Space"), "add a sphere", _Session._add),
    "remove": Action(("Backspace", "Delete"), "remove it", _Session._remove),
    "grow": Action(("Up",), "radius up", lambda s: s._grow(s.config.coarse)),
    "shrink": Action(("Down",), "radius down", lambda s: s._grow(-s.config.coarse)),
    "wider": Action(("+",), "radius up a little", lambda s: s._grow(s.config.fine)),
    "narrower": Action(("-",), "radius down a little", lambda s: s._grow(-s.config.fine)),
    "snap": Action(("M",), "largest safe radius", _Session._snap),
    "suggest": Action(("S",), "suggest a sphere here", _Session._suggest),
    "suggest-all": Action(("A",), "suggest all spheres", _Session._suggest_all),
    "region": Action(("F",), "free-space region, or ball", _Session._toggle_region),
    "undo": Action(("Z",), "undo", _Session._undo_one),
    "redo": Action(("Y",), "redo", _Session._redo_one),
    "show": Action(("T",), "cloud, or the scene's meshes", _Session._toggle_shown),
    "follow": Action(("G",), "view follows the tool, or stays", _Session._toggle_follow),
    "view": Action(("V",), "view as at the start", _Session._reset_view),
    "save": Action(("W",), "save", _Session._save),
    "quit": Action(("Q", "Escape"), "quit", _Session._quit),
    "go": Action((), "to a waypoint", _Session._select, takes_number=True),
    "radius": Action((), "a radius in mm", _Session._set_radius, takes_number=True),
}
KEYS: Mapping[str, str] = {key: name for name, action in ACTIONS.items() for key in action.keys}
