"""`sart annotate`: the window, the text mode, and suggestions saved at once."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sart_toolkit import doctor, pipeline
from sart_toolkit.cli.arguments import Annotate
from sart_toolkit.cli.console import say
from sart_toolkit.cli.sensor import declared_sensor
from sart_toolkit.cli.suggest import describe_spheres
from sart_toolkit.cli.web import check_web
from sart_toolkit.data.records import Annotation, Demonstration
from sart_toolkit.data.storage import (
    Journal,
    OutputLock,
    check_writable,
    load_annotation,
    load_demonstration,
)
from sart_toolkit.errors import (
    InvalidInput,
    Mismatch,
    MissingCapability,
    OutputExists,
)

if TYPE_CHECKING:
    from sart_toolkit.annotate.session import AnnotationSession
    from sart_toolkit.collision.sensor import SensorErrors

_WITHOUT = "or work without a window: --web, --text, or --suggest-all --no-window"


def annotate_verb(args: Annotate) -> dict[str, Any]:
    """`sart annotate`."""
    pipeline.check_names(task=args.task, robot=args.robot, backend=args.backend)
    check_web(args, "--text" if args.text else "--no-window" if args.no_window else "")
    sensor = declared_sensor(args, [args.demo])
    headless = args.no_window and not args.text
    if headless and not args.suggest_all:
        raise InvalidInput("--no-window: leaves nothing to do; add --suggest-all, or --text")
    out = args.out or args.demo.with_name(f"{args.demo.stem}.annotation.json")
    with OutputLock(out) as lock:
        return _annotate(args, out, headless, lock, sensor)


def _annotate(
    args: Annotate, out: Path, headless: bool, lock: OutputLock, sensor: SensorErrors | None
) -> dict[str, Any]:
    with _window_probe(wanted=not (args.text or args.no_window or args.web)) as probe:
        demonstration = pipeline.noted(load_demonstration(args.demo), args.task, args.robot)
        # Not before the demonstration is read: these imports take a second.
        from sart_toolkit.annotate.session import AnnotateConfig, AnnotationSession
        from sart_toolkit.record.checks import check_recording

        robot = pipeline.robot_of(demonstration, args.robot)
        check_recording(demonstration, robot, name=str(args.demo))
        config = AnnotateConfig(
            pipeline.suggest_config(
                demonstration,
                args.backend,
                args.margin,
                min_radius=args.min_radius,
                max_radius=args.max_radius,
            )  # fmt: skip
        )
        journal_path = out.with_name(f"{out.name}.journal")
        if headless and journal_path.exists() and not args.overwrite:
            raise OutputExists(
                f"{journal_path}: holds an interrupted session's changes; resume it with `sart "
                "annotate`, or add --overwrite"
            )
        check_writable(out, overwrite=args.overwrite or not headless)
        annotation = (
            None if args.overwrite or not out.exists() else _annotation_at(out, demonstration)
        )
        world = pipeline.world_of(
            demonstration, args.source, args.unknown, args.slip_tolerance, args.task, args.robot,
            sensor,
        )  # fmt: skip
        if probe is not None and not (finding := probe.result()).ok:
            raise MissingCapability(f"no window: {finding.detail}; {finding.remedy}; {_WITHOUT}")
    journal = Journal(journal_path, lock)
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
            from sart_toolkit.cli.words import annotate_in_words

            annotate_in_words(session)
        elif headless:
            session.perform("save")
            _check_done(session)
        elif args.web:
            _web_mode(session, args)
        else:
            _window_mode(session)
    doubtful = [] if session.dirty else session.unproved
    for sphere in [] if args.text else doubtful:
        # In the text mode saving has said so.
        say(f"sart: warning: not proved clear: {sphere}; segments from it may be rejected")
    if session.dirty and not session.done:
        say(f"not saved: type the same command again to resume ({journal_path} keeps it)")
    return {
        "annotation": str(out) if out.exists() else None,
        "saved": not session.dirty,
        "spheres": describe_spheres(load_annotation(out)) if out.exists() else [],
        "not_proved_clear": doubtful,
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
            f"{path}: {error}; start again with --overwrite, or choose another --out"
        ) from error
    return annotation


def _check_done(session: AnnotationSession) -> None:
    if session.refused:
        raise InvalidInput(session.message)


def _window_mode(session: AnnotationSession) -> None:
    window = importlib.import_module("sart_toolkit.annotate.open3d_window")
    demonstration = session.demonstration
    scene = pipeline.task_of(demonstration).scene
    window.annotate_in_window(session, pipeline.robot_of(demonstration), scene)


def _web_mode(session: AnnotationSession, args: Annotate) -> None:
    browser = importlib.import_module("sart_toolkit.annotate.browser")
    demonstration = session.demonstration
    scene, robot = pipeline.task_of(demonstration).scene, pipeline.robot_of(demonstration)
    browser.annotate_in_browser(session, robot, scene, args.host, args.port, say)
