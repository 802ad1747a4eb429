"""The `sart` command: `sart run peg_in_hole --out runs/peg` and its single steps."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections.abc import Sequence

from sart_toolkit.cli.console import say, show
from sart_toolkit.cli.verbs import VERBS, find_verb, overview
from sart_toolkit.errors import SartError

_INTERRUPTED = 130
_HELP = ("--help", "-h")


def main(argv: Sequence[str] | None = None) -> None:
    """Parse, run the verb, and exit: 0 done, 2 bad input, 130 interrupted."""
    logging.basicConfig(level=logging.WARNING, format="sart: %(message)s")
    logging.getLogger("sart_toolkit.pipeline").setLevel(logging.INFO)
    try:
        _run(list(sys.argv[1:] if argv is None else argv))
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
    except KeyboardInterrupt:
        say("sart: interrupted; finished parts are kept, type the same command again to resume")
        sys.exit(_INTERRUPTED)


def _run(words: list[str]) -> None:
    if words == ["--version"]:
        from importlib.metadata import version

        print(f"sart_toolkit {version('sart_toolkit')}")
        return
    if not words or words[0] in _HELP:
        print(overview())
        sys.exit(0 if words else 2)
    if words[0] == "benchmark" and words[1:2] and words[1] in _HELP:
        print(overview("benchmark"))
        sys.exit(0)
    name, rest = find_verb(words)
    args = VERBS[name].parse(name, rest)
    show(VERBS[name](args), args.json)
