"""The `sart` command: `sart run peg_in_hole --out runs/peg` and its single steps."""

from __future__ import annotations

import contextlib
import logging
import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from types import FrameType

from sart_toolkit.cli.console import say, show
from sart_toolkit.cli.verbs import RESUMING, VERBS, find_verb, overview
from sart_toolkit.errors import SartError

_HELP = ("--help", "-h")


class _Ended(KeyboardInterrupt):
    """The process was asked to end, by a signal other than Ctrl-C's."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """SIGTERM and SIGHUP interrupt like Ctrl-C, unless whoever started this had them ignored."""
    numbers = []
    if threading.current_thread() is threading.main_thread():
        both = (signal.SIGTERM, signal.SIGHUP)
        numbers = [n for n in both if signal.getsignal(n) is signal.SIG_DFL]

    def end(number: int, frame: FrameType | None) -> None:
        raise _Ended(number)

    try:
        for number in numbers:
            signal.signal(number, end)
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def main(argv: Sequence[str] | None = None) -> None:
    """Parse, run the verb, and exit: 0 done, 2 bad input, 128 + its number ended by a signal."""
    with _ended_by_signals():
        _main(list(sys.argv[1:] if argv is None else argv))


def _main(words: list[str]) -> None:
    logging.basicConfig(level=logging.WARNING, format="sart: %(message)s")
    logging.getLogger("sart_toolkit.pipeline").setLevel(logging.INFO)
    try:
        _run(words)
        sys.stdout.flush()
    except BrokenPipeError:
        # Who reads, `head` say, has had enough. Nothing is left for Python to flush at its end.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except SartError as error:
        say(f"sart: error: {error}")
        sys.exit(2)
    except ImportError as error:
        say(f"sart: error: {error}; `sart doctor` says what is missing and how to fix it")
        sys.exit(2)
    except KeyboardInterrupt as error:
        number = error.number if isinstance(error, _Ended) else signal.SIGINT
        say(f"sart: {_what_is_kept(words, number)}")
        sys.exit(128 + number)


def _what_is_kept(words: list[str], number: int) -> str:
    """What an interrupted command leaves, and the command that resumes it."""
    by = signal.Signals(number).name
    interrupted = "interrupted" if number == signal.SIGINT else f"ended by {by}"
    resumes = any(words[: len(verb)] == verb for verb in map(str.split, RESUMING))
    if not resumes or "--dry-run" in words:
        return f"{interrupted}; an unfinished result isn't kept, type the same command again"
    # To overwrite again would drop what was kept since.
    again = shlex.join(["sart", *(word for word in words if word != "--overwrite")])
    return f"{interrupted}; finished parts are kept, to resume type: {again}"


def _run(words: list[str]) -> None:
    if words == ["--version"]:
        from importlib.metadata import version

        print(f"sart_toolkit {version('sart_toolkit')}")
        return
    if not words or words[0] in _HELP:
        print(overview())
        sys.exit(0 if words else 2)
    name, rest = find_verb(words)
    args = VERBS[name].parse(name, rest)
    show(VERBS[name](args), args.json)
