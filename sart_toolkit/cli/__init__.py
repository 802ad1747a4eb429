"""The `sart` command: `sart run peg_in_hole --out runs/peg` and its single steps."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence

import tyro

from sart_toolkit.cli.arguments import Doctor, Verb
from sart_toolkit.cli.console import say
from sart_toolkit.errors import SartError

_INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> None:
    """Parse, run the verb, and exit: 0 done, 2 bad input, 130 interrupted."""
    verb = tyro.cli(
        Verb,
        prog="sart",
        args=argv,
        description="Teach a robot a skill from one demonstration.",
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    logging.basicConfig(level=logging.WARNING, format="sart: %(message)s")
    try:
        # The verbs pull in torch and the simulator; help and mistakes should not wait for them.
        if isinstance(verb, Doctor):
            from sart_toolkit.cli.doctor import run_doctor

            run_doctor(verb)
        else:
            from sart_toolkit.cli.verbs import run_verb

            run_verb(verb)
    except SartError as error:
        say(f"sart: error: {error}")
        sys.exit(2)
    except ImportError as error:
        say(f"sart: error: {error}; `sart doctor` tells what is missing and how to mend it")
        sys.exit(2)
    except KeyboardInterrupt:
        say("sart: interrupted; finished parts are kept, type the same command again to go on")
        sys.exit(_INTERRUPTED)
