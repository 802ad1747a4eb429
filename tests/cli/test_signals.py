"""Asked to end by any signal, `sart` says what is kept and what resumes it, and leaves no process.

SIGKILL, at random moments: `tools/kill.py`, of which a small run is made here.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sart_toolkit.cli import main
from sart_toolkit.data.assets import asset
from sart_toolkit.data.dataset import load_dataset

SART = [sys.executable, "-m", "sart_toolkit"]


def living(session: int) -> list[str]:
    """The processes of a session that have not ended."""
    stats = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            stats.append(stat.read_text())
        except OSError:
            continue
    fields = [stat.rpartition(")")[2].split() for stat in stats]
    return [row[1] for row in fields if int(row[3]) == session and row[0] not in "ZX"]


@pytest.fixture(scope="module")
def whole_hash(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Of the dataset that is generated without interruption."""
    out = tmp_path_factory.mktemp("whole") / "data"
    main(augmenting(out))
    return load_dataset(out).content_hash


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "whom", "code"), [(signal.SIGTERM, "parent", 143), (signal.SIGINT, "all", 130)]
)
def test_a_signal_ends_a_cluster_of_the_command_s_own(
    number: signal.Signals,
    whom: str,
    code: int,
    tmp_path: Path,
    wait_until: Callable[..., None],
    whole_hash: str,
) -> None:
    pytest.importorskip("ray")
    out, home = tmp_path / "data", tmp_path / "home"
    home.mkdir()
    words = [*SART, *augmenting(out), "--workers", "2", "--executor", "ray"]
    manifest = out / "manifest.jsonl"
    with subprocess.Popen(
        [*words, "--ray-address", "local"],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "HOME": str(home)},
    ) as process:
        wait_until(lambda: manifest.exists() and '"kept"' in manifest.read_text(), 120.0)
        assert len(living(process.pid)) > 3
        send = os.killpg if whom == "all" else os.kill
        send(process.pid, number)
        said = process.communicate(timeout=60)[1]
    assert process.returncode == code and "Traceback" not in said
    wait_until(lambda: not living(process.pid), 15.0)
    (line,) = [line for line in said.splitlines() if "finished parts are kept" in line]
    assert line.endswith("--workers 2 --executor ray --ray-address local")
    kept = manifest.read_text()
    main(augmenting(out))
    assert manifest.read_text().startswith(kept)
    assert load_dataset(out).content_hash == whole_hash


def augmenting(out: Path) -> list[str]:
    inputs = [str(asset(f"peg_in_hole/{name}")) for name in ("demo.h5", "annotation.json")]
    return ["augment", *inputs, "--out", str(out), "--n", "9"]


@pytest.mark.parametrize(
    ("number", "whom", "code"),
    [(signal.SIGTERM, "all", 143), (signal.SIGHUP, "parent", 129), (signal.SIGINT, "all", 130)],
)
def test_a_signal_ends_all_processes_and_what_is_said_then_resumes(
    number: signal.Signals,
    whom: str,
    code: int,
    tmp_path: Path,
    wait_until: Callable[..., None],
    whole_hash: str,
) -> None:
    out = tmp_path / "data"
    words = [*SART, *augmenting(out), "--workers", "2", "--overwrite"]
    manifest = out / "manifest.jsonl"
    with subprocess.Popen(
        words, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        wait_until(lambda: manifest.exists() and '"kept"' in manifest.read_text(), 120.0)
        send = os.killpg if whom == "all" else os.kill
        send(process.pid, number)
        said = process.communicate(timeout=60)[1]
    wait_until(lambda: not living(process.pid), 5.0)
    assert process.returncode == code and "Traceback" not in said
    (line,) = [line for line in said.splitlines() if "finished parts are kept" in line]
    by = "interrupted" if number == signal.SIGINT else f"ended by {number.name}"
    assert line.startswith(f"sart: {by}; finished parts are kept, to resume type: sart augment")
    kept = manifest.read_text()
    again = shlex.split(line.partition("type: sart ")[2])
    assert "--overwrite" not in again
    main(again)
    assert manifest.read_text().startswith(kept)
    assert load_dataset(out).content_hash == whole_hash


def test_what_resumes_nothing_does_not_say_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def ended(*_: object, **__: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr("sart_toolkit.annotate.suggest.suggest_annotation", ended)
    demo = asset("peg_in_hole/demo.h5")
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as exit_:
        main(["suggest", str(demo), "--out", str(tmp_path / "a.json")])
    assert exit_.value.code == 143 and list(tmp_path.iterdir()) == []
    said = capsys.readouterr().err
    assert "ended by SIGTERM; an unfinished result isn't kept, type the same command again" in said
    assert signal.getsignal(signal.SIGTERM) is before


def test_signals_that_were_ignored_stay_ignored(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`nohup sart ...` outlives its terminal."""

    def hung_up() -> str:
        os.kill(os.getpid(), signal.SIGHUP)
        return "still here"

    monkeypatch.setattr("sart_toolkit.cli.overview", hung_up)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        main(["--help"])
    except SystemExit as exit_:
        assert exit_.code == 0
    finally:
        signal.signal(signal.SIGHUP, before)
    assert "still here" in capsys.readouterr().out


@pytest.mark.slow
def test_killed_at_a_random_moment_each_command_resumes_to_the_same(tmp_path: Path) -> None:
    tool = Path(__file__).parents[2] / "tools" / "kill.py"
    words = [sys.executable, str(tool), "--kills", "1", "--out", str(tmp_path / "kill.json")]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    rows = [line.split() for line in done.stdout.splitlines()[-4:]]
    assert [row[0] for row in rows] == ["augment", "train", "evaluate", "benchmark"]
    assert all(row[1] == "1" and row[3] == "0" for row in rows)
