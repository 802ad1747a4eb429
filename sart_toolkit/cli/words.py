"""`sart annotate --text`: words that are typed or piped in."""

from __future__ import annotations

import contextlib
import importlib
import sys

from sart_toolkit.annotate.session import ACTIONS, KEYS, AnnotationSession
from sart_toolkit.cli.console import say
from sart_toolkit.errors import InvalidInput, SartError


def annotate_in_words(session: AnnotationSession) -> None:
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
