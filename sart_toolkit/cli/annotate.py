"""`sart annotate`: the window, the text mode, and suggestions saved at once."""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

from sart_toolkit import doctor
from sart_toolkit.annotate.session import ACTIONS, KEYS, AnnotateConfig, AnnotationSession
from sart_toolkit.annotate.suggest import SuggestConfig
from sart_toolkit.cli.arguments import Annotate, Suggest
from sart_toolkit.cli.console import say
from sart_toolkit.collision.cloud import CloudConfig
from sart_toolkit.collision.world import CollisionWorld, make_world
from sart_toolkit.data.records import Annotation, Demonstration
from sart_toolkit.data.storage import (
    Journal,
    check_writable,
    load_annotation,
    load_demonstration,
)
from sart_toolkit.errors import (
    InvalidInput,
    Mismatch,
    MissingCapability,
    OutputExists,
    SartError,
)
from sart_toolkit.robots import get_robot
from sart_toolkit.tasks import get_task

Result = dict[str, Any]
_WITHOUT = "or work without a window: --text, or --suggest-all --no-window"


def suggest_config(args: Suggest | Annotate) -> SuggestConfig:
    """The margins and limits that were given."""
    return SuggestConfig(margin=args.margin, min_radius=args.min_radius, max_radius=args.max_radius)


def world_of(args: Suggest | Annotate, demonstration: Demonstration) -> CollisionWorld:
    """Where the obstacles are, from the source that was asked for."""
    robot, scene = get_robot(demonstration.robot), get_task(demonstration.task).scene
    cloud = CloudConfig(unknown=args.unknown)
    return make_world(args.source, demonstration, robot, scene, args.slip_tolerance, cloud)


def describe_spheres(annotation: Annotation) -> list[Result]:
    """The spheres in a few words each."""
    return [
        {
            "waypoint": sphere.waypoint,
            "radius_mm": round(sphere.radius * 1e3, 2),
            "limited_by": sphere.limited_by,
        }
        for sphere in annotation.spheres
    ]


def annotate_verb(args: Annotate) -> Result:
    """`sart annotate`."""
    headless = args.no_window and not args.text
    if headless and not args.suggest_all:
        raise InvalidInput("--no-window: leaves nothing to do; add --suggest-all, or --text")
    with _window_probe(wanted=not (args.text or args.no_window)) as probe:
        demonstration = load_demonstration(args.demo)
        config = AnnotateConfig(suggest_config(args))
        out = args.out or args.demo.with_name(f"{args.demo.stem}.annotation.json")
        journal_path = out.with_name(f"{out.name}.journal")
        if headless and journal_path.exists() and not args.overwrite:
            raise OutputExists(
                f"{journal_path}: holds an interrupted session's changes; go on with `sart "
                "annotate`, or add --overwrite"
            )
        check_writable(out, overwrite=args.overwrite or not headless)
        annotation = (
            None if args.overwrite or not out.exists() else _annotation_at(out, demonstration)
        )
        world = world_of(args, demonstration)
        if probe is not None and not (finding := probe.result()).ok:
            raise MissingCapability(f"no window: {finding.detail}; {finding.remedy}; {_WITHOUT}")
    journal = Journal(journal_path)
    if args.overwrite:
        journal.clear()
    session = AnnotationSession(demonstration, world, config, annotation, out, journal)
    with closing(session):
        session.shown = args.show
        if session.message:
            say(session.message)
        if args.suggest_all:
            session.perform("suggest-all")
            _check_done(session)
        if args.text:
            _text_mode(session)
        elif headless:
            session.perform("save")
            _check_done(session)
        else:
            _window_mode(session)
    if session.dirty and not session.done:
        say(f"not saved: type the same command again to go on ({journal_path} keeps it)")
    return {
        "annotation": str(out) if out.exists() else None,
        "saved": not session.dirty,
        "spheres": describe_spheres(load_annotation(out)) if out.exists() else [],
        "presses": session.presses,
        "seconds_spent": round(session.seconds, 1),
    }


@contextlib.contextmanager
def _window_probe(wanted: bool) -> Iterator[Future[doctor.Finding] | None]:
    """The doctor's answer about windows, found while other things are read.

    Without a display, or with a broken driver, Open3D ends its process: that has to be another.
    """
    if not wanted:
        yield None
        return
    (probe,) = (probe for probe in doctor.PROBES if probe.name == "Open3D window")
    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(doctor.run_probe, probe)


def _annotation_at(path: Path, demonstration: Demonstration) -> Annotation:
    annotation = load_annotation(path)
    try:
        annotation.check_matches(demonstration)
    except Mismatch as error:
        raise Mismatch(
            f"{path}: {error}; begin anew with --overwrite, or choose another --out"
        ) from error
    return annotation


def _check_done(session: AnnotationSession) -> None:
    if session.refused:
        raise InvalidInput(session.message)


def _window_mode(session: AnnotationSession) -> None:
    window = importlib.import_module("sart_toolkit.annotate.open3d_window")
    robot, scene = get_robot(session.demonstration.robot), get_task(session.demonstration.task)
    window.annotate_in_window(session, robot, scene.scene)


def _text_mode(session: AnnotationSession) -> None:
    """Do what is typed or piped in, until the person leaves or the input ends.

    From a pipe, the first word that can't be done is an error.
    """
    typed = sys.stdin.isatty()
    if typed:
        with contextlib.suppress(ImportError):
            # Lines can be edited and called back.
            importlib.import_module("readline")
        say("words or keys, several a line; `help` lists them")
        _say_state(session)
    while not session.done:
        try:
            line = input("annotate> ") if typed else input()
        except EOFError:
            return
        try:
            _do_line(session, line)
        except SartError as error:
            if not typed:
                raise
            say(str(error))


def _do_line(session: AnnotationSession, line: str) -> None:
    words = iter(line.split())
    for word in words:
        if word in ("help", "?"):
            _say_help()
            continue
        if word == "list":
            for sphere in session.spheres:
                say(f"{sphere.waypoint:>5}  {session.describe(sphere)}; {session.verdict(sphere)}")
            continue
        name = KEYS.get(word.upper() if len(word) == 1 else word.title(), word)
        value = None
        if name in ACTIONS and ACTIONS[name].takes_number:
            value = _number(name, next(words, ""))
        session.perform(name, value)
        if session.refused:
            raise InvalidInput(f"{word}: {session.message}")
        say(session.message)
        if session.done:
            return
    _say_state(session)


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InvalidInput(f"{name}: expected a number after it, got {text!r}") from None


def _say_state(session: AnnotationSession) -> None:
    state = session.state()
    unsaved = " | not saved" if session.dirty else ""
    say(
        f"{state['waypoint']} | {state['phase']}, clearance {state['clearance']} | "
        f"sphere: {state['sphere']} | {state['verdict']}{unsaved}"
    )


def _say_help() -> None:
    for name, action in ACTIONS.items():
        word = f"{name} NUMBER" if action.takes_number else name
        say(f"{word:<14}{' '.join(k for k in action.keys if len(k) == 1):<3}{action.help}")
    say(f"{'list':<17}all spheres\n{'help':<17}this list")
