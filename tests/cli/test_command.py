"""The command itself: verbs, help, version, pipes, progress, and what it costs to be wrong."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import sart_toolkit
from sart_toolkit.cli import console, main
from sart_toolkit.cli.arguments import Record
from sart_toolkit.cli.console import ProgressDisplay
from sart_toolkit.cli.verbs import VERBS, find_verb
from sart_toolkit.data.storage import save_demonstration
from sart_toolkit.errors import InvalidInput, UnknownName

HEAVY = {"torch", "pybullet", "sapien", "open3d", "matplotlib", "pinocchio", "coal", "scipy"}
SART = [sys.executable, "-m", "sart_toolkit"]


def ended(capsys, *argv):
    """Exit code, stdout and stderr of a command."""
    capsys.readouterr()
    try:
        main([str(word) for word in argv])
        code = 0
    except SystemExit as exit_:
        code = exit_.code
    return code, *capsys.readouterr()


@pytest.fixture(scope="module")
def demo(tmp_path_factory, peg_demonstration):
    path = tmp_path_factory.mktemp("command") / "demo.h5"
    save_demonstration(path, peg_demonstration)
    return path


def test_the_version_is_the_package_s(capsys):
    code, out, _ = ended(capsys, "--version")
    assert code == 0 and out.strip() == f"sart_toolkit {version('sart_toolkit')}"


@pytest.mark.parametrize("words", [["--help"], ["-h"], []])
def test_the_overview_has_a_line_for_each_verb(capsys, words):
    code, out, _ = ended(capsys, *words)
    assert code == (0 if words else 2)
    assert all(f"  {name} " in out for name in VERBS)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["recrod", "x"], "unknown verb 'recrod': did you mean 'record'?"),
        (["benchmark", "operater"], "unknown benchmark 'operater': did you mean 'operator'?"),
        (["benchmark"], "benchmark: of what? add operator, replay"),
    ],
)
def test_a_misspelt_verb_is_one_line(capsys, words, message):
    code, _, err = ended(capsys, *words)
    assert code == 2 and message in err and len(err.strip().splitlines()) == 1
    with pytest.raises((UnknownName, InvalidInput), match=message[:20].replace("?", ".")):
        find_verb(words)


@pytest.mark.parametrize("name", VERBS)
def test_help_has_examples_and_nothing_of_the_parser_s_own(capsys, name):
    code, out, _ = ended(capsys, *name.split(), "--help")
    assert code == 0
    assert f"Example: sart {name}" in out
    for odd in ("{None}", "None|", "(default: )", "(default: None)", "|None", "tyro"):
        assert odd not in out
    code, out, _ = ended(capsys, "benchmark", "--help")
    assert code == 0 and "benchmark radii" in out and "  run " not in out


def test_who_reads_only_the_head_ends_it_quietly(demo):
    for words in (["--help"], ["info", str(demo)]):
        program = subprocess.Popen(
            [*SART, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        program.stdout.close()
        assert program.stderr.read() == ""
        program.stderr.close()
        assert program.wait() == 0


def imported(argv):
    """What a command imports, and its exit code."""
    code = (
        "import json, sys\n"
        "from sart_toolkit.cli import main\n"
        "code = 0\n"
        "try:\n    main(json.loads(sys.argv[1]))\n"
        "except SystemExit as exit_:\n    code = exit_.code\n"
        "print(json.dumps([code, sorted(sys.modules)]))\n"
    )
    run = [sys.executable, "-c", code, json.dumps([str(word) for word in argv])]
    said = subprocess.run(run, capture_output=True, text=True, check=True).stdout
    ended_with, modules = json.loads(said.strip().splitlines()[-1])
    return ended_with, set(modules)


@pytest.mark.parametrize(
    "argv",
    [
        ["run", "peg_in_hol", "--out", "x"],
        ["run", "peg_in_hole", "--out", "x", "--policy", "compact"],
        ["record", "peg_in_hole", "--out", "x", "--robot", "ur5"],
        ["record", "peg_in_hole", "--out", "x", "--backend", "pybulet"],
        ["record", "peg_in_hole", "--out", "x", "--device", "mouse"],
        ["record", "nowhere.py:Drawer", "--out", "x"],
        ["suggest", "nowhere.h5", "--out", "x"],
        ["annotate", "nowhere.h5", "--text"],
        ["augment", "nowhere.h5", "a.json", "--out", "x", "--strategy", "sert"],
        ["augment", "nowhere.h5", "a.json", "--out", "x"],
        ["augment", "nowhere.h5", "a.json", "--out", "x", "--dry-run"],
        ["validate", "nowhere"],
        ["validate", "nowhere", "--format", "lerobot"],
        ["export", "nowhere", "--format", "lerobot", "--out", "x"],
        ["export", "nowhere", "--format", "lerobo", "--out", "x"],
        ["import", "nowhere", "--out", "x"],
        ["train", "nowhere", "--out", "x"],
        ["evaluate", "nowhere", "--out", "x"],
        ["play", "nowhere.h5"],
        ["report", "nowhere"],
        ["benchmark", "operator", "--tasks", "pegs"],
        ["benchmark", "skill", "--out", "x", "--backends", "bullet"],
        ["benchmark", "tabel1", "--out", "x"],
        ["benchmark", "nowhere.toml", "--out", "x"],
        ["benchmark", "table1", "--out", "x", "--set", "strategy=sert"],
        ["compare", "nowhere", "there"],
        ["info", "nowhere"],
    ],
    ids=" ".join,
)
def test_a_mistake_imports_nothing_heavy(argv):
    code, modules = imported(argv)
    assert code == 2 and modules.isdisjoint(HEAVY)


def test_help_and_info_import_nothing_heavy(demo):
    for argv in (["--help"], ["--version"], ["run", "--help"], ["info", demo]):
        code, modules = imported(argv)
        assert code == 0 and modules.isdisjoint(HEAVY), argv


@pytest.mark.parametrize("argv", [["--help"], ["--version"], ["recrod"], ["run", "--help"]])
def test_what_only_says_something_does_not_even_import_numpy(argv):
    assert "numpy" not in imported(argv)[1]


@pytest.mark.parametrize("name", VERBS)
def test_every_verb_s_function_is_there(name):
    assert VERBS[name].summary.endswith(".")
    module, _, function = VERBS[name].target.partition(":")
    assert module.startswith("sart_toolkit.cli.") and function.endswith("_verb")


def test_flags_become_a_record():
    args = VERBS["record"].parse("record", ["drawer.py:Drawer", "--out", "d.h5"])
    assert isinstance(args, Record) and args.task == "drawer.py:Drawer" and args.robot is None


def test_piped_progress_is_a_plain_line_now_and_then(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    with ProgressDisplay() as progress:
        for second in range(25):
            now[0] = float(second)
            progress("augment", second, 30, "2 rejected")
        now[0] = 40.0
        progress("record", 12.3)
    assert capsys.readouterr().err.splitlines() == [
        "augment: 10 of 30 trajectories, 2 rejected",
        "augment: 20 of 30 trajectories, 2 rejected",
        "record: 12 s",
    ]


def test_on_a_terminal_progress_is_a_bar_for_each_stage(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with ProgressDisplay() as progress:
        progress("suggest", 1, 4)
        progress("suggest", 4, 4, "done")
        progress("augment", 1, 2, "0 rejected")
    err = capsys.readouterr().err
    assert "suggest" in err and "4/4" in err and "augment" in err and "0 rejected" in err


def _announced_stages() -> list[str]:
    """Every stage that a source of the package names to its ``progress`` callback."""
    sources = Path(sart_toolkit.__file__).parent.rglob("*.py")
    return sorted(
        {s for p in sources for s in re.findall(r'\bprogress\(\s*"(\w+)"', p.read_text())}
    )


def test_the_stages_are_found_in_the_sources() -> None:
    assert {"record", "read", "train", "evaluate"} <= set(_announced_stages())


@pytest.mark.parametrize("stage", _announced_stages())
def test_each_announced_stage_shows_a_bar_on_a_terminal(
    stage: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with ProgressDisplay() as progress:
        progress(stage, 1.0, 2.0)
    assert stage in capsys.readouterr().err
