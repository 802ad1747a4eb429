"""The verbs of `sart`: what each takes, and the function that carries it out.

That function's module is imported once the words are parsed and the names in them are known.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import tyro

from sart_toolkit.benchmark.plans import PLANS
from sart_toolkit.cli import arguments
from sart_toolkit.errors import InvalidInput, unknown_name


@dataclass(frozen=True)
class Verb:
    """A verb: `arguments` is the dataclass of its flags, `target` the function that takes them."""

    arguments: type[Any]
    target: str

    @property
    def summary(self) -> str:
        """What it does, in a line."""
        return str(self.arguments.__doc__).partition("\n")[0]

    def parse(self, name: str, words: list[str]) -> Any:
        """Its flags from the words after its name."""
        return tyro.cli(
            self.arguments,
            prog=f"sart {name}",
            args=words,
            config=(tyro.conf.FlagCreatePairsOff,),
        )

    def __call__(self, args: Any) -> dict[str, Any]:
        """What came of it."""
        result: dict[str, Any] = pkgutil.resolve_name(self.target)(args)
        return result


VERBS: Mapping[str, Verb] = {
    "run": Verb(arguments.Run, "sart_toolkit.cli.run:run_verb"),
    "record": Verb(arguments.Record, "sart_toolkit.cli.record:record_verb"),
    "play": Verb(arguments.Play, "sart_toolkit.cli.play:play_verb"),
    "calibrate": Verb(arguments.Calibrate, "sart_toolkit.cli.calibrate:calibrate_verb"),
    "suggest": Verb(arguments.Suggest, "sart_toolkit.cli.suggest:suggest_verb"),
    "annotate": Verb(arguments.Annotate, "sart_toolkit.cli.annotate:annotate_verb"),
    "augment": Verb(arguments.Augment, "sart_toolkit.cli.augment:augment_verb"),
    "validate": Verb(arguments.Validate, "sart_toolkit.cli.augment:validate_verb"),
    "merge": Verb(arguments.Merge, "sart_toolkit.cli.combine:merge_verb"),
    "split": Verb(arguments.Split, "sart_toolkit.cli.combine:split_verb"),
    "export": Verb(arguments.Export, "sart_toolkit.cli.formats:export_verb"),
    "import": Verb(arguments.Import, "sart_toolkit.cli.formats:import_verb"),
    "train": Verb(arguments.Train, "sart_toolkit.cli.train:train_verb"),
    "evaluate": Verb(arguments.Evaluate, "sart_toolkit.cli.train:evaluate_verb"),
    "deploy": Verb(arguments.Deploy, "sart_toolkit.cli.deploy:deploy_verb"),
    "emulate": Verb(arguments.Emulate, "sart_toolkit.cli.emulate:emulate_verb"),
    "compare": Verb(arguments.Compare, "sart_toolkit.cli.compare:compare_verb"),
    "report": Verb(arguments.Report, "sart_toolkit.cli.run:report_verb"),
    "benchmark": Verb(arguments.Benchmark, "sart_toolkit.cli.benchmark:plan_verb"),
    "benchmark operator": Verb(
        arguments.BenchmarkOperator, "sart_toolkit.cli.benchmark:operator_verb"
    ),
    "benchmark replay": Verb(arguments.BenchmarkReplay, "sart_toolkit.cli.benchmark:replay_verb"),
    "benchmark segments": Verb(
        arguments.BenchmarkSegments, "sart_toolkit.cli.benchmark:segments_verb"
    ),
    "benchmark radii": Verb(arguments.BenchmarkRadii, "sart_toolkit.cli.benchmark:radii_verb"),
    "benchmark cloud": Verb(arguments.BenchmarkCloud, "sart_toolkit.cli.benchmark:cloud_verb"),
    "benchmark skill": Verb(arguments.BenchmarkSkill, "sart_toolkit.cli.benchmark:skill_verb"),
    "info": Verb(arguments.Info, "sart_toolkit.cli.info:info_verb"),
    "doctor": Verb(arguments.Doctor, "sart_toolkit.cli.doctor:doctor_verb"),
    "new robot": Verb(arguments.NewRobot, "sart_toolkit.cli.new:robot_verb"),
    "new task": Verb(arguments.NewTask, "sart_toolkit.cli.new:task_verb"),
    "new strategy": Verb(arguments.NewStrategy, "sart_toolkit.cli.new:strategy_verb"),
    "new backend": Verb(arguments.NewBackend, "sart_toolkit.cli.new:backend_verb"),
}

# What an interruption leaves of these is resumed by the same command.
RESUMING = ("run", "annotate", "augment", "merge", "split", "train", "evaluate", "benchmark")


def find_verb(words: list[str]) -> tuple[str, list[str]]:
    """The name of the verb that a command begins with, and the words after it.

    Raises:
        UnknownName: there is no such verb or benchmark; the message offers the nearest.
        InvalidInput: it isn't said of what.
    """
    first = {name.partition(" ")[0] for name in VERBS}
    if words[0] not in first:
        raise unknown_name("verb", words[0], first)
    second = [name.split()[1] for name in VERBS if name.startswith(f"{words[0]} ")]
    if not second:
        return words[0], words[1:]
    # Of these only `benchmark` is a verb by itself, too.
    plans = PLANS if words[0] in VERBS else ()
    if not words[1:] or (words[0] not in VERBS and words[1] in ("--help", "-h")):
        raise InvalidInput(f"{words[0]}: of what? add {', '.join([*second, *plans])}")
    if words[1] in second:
        return f"{words[0]} {words[1]}", words[2:]
    if not plans:
        raise unknown_name(words[0], words[1], second)
    # A plan may be named after flags, too.
    if not words[1].startswith("-") and words[1] not in PLANS and not words[1].endswith(".toml"):
        raise unknown_name(words[0], words[1], [*PLANS, *second])
    return words[0], words[1:]


def overview() -> str:
    """What `sart --help` says: each verb with a line."""
    width = max(map(len, VERBS))
    lines = [f"  {name:<{width}}  {verb.summary}" for name, verb in VERBS.items()]
    return "\n".join(
        [
            "usage: sart VERB ...",
            "",
            "Teach a robot a skill from one demonstration.",
            "",
            *lines,
            "",
            "sart VERB --help says what a verb takes, with examples; sart --version the version.",
            "Example: sart run peg_in_hole --out runs/peg",
        ]
    )
