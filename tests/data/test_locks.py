"""One process at a time writes an output; links to outputs are followed, not replaced."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from sart_toolkit.data import storage
from sart_toolkit.data.result_log import ResultLog
from sart_toolkit.data.storage import (
    Journal,
    OutputLock,
    check_writable,
    clear_directory,
    remove_temporary_files,
    write_json,
    write_text,
)
from sart_toolkit.errors import CannotWrite, InvalidInput, Mismatch, OutputExists

_HOLDER = """
import sys
from pathlib import Path
from sart_toolkit.data.storage import OutputLock
lock = OutputLock(Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def held_elsewhere():
    """Has another process hold the lock of an output; that process."""
    started = []

    def hold(path: Path) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", _HOLDER, str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        return process

    yield hold
    for process in started:
        process.kill()
        process.communicate()


def test_an_output_that_another_process_writes_is_refused_until_that_is_killed(
    tmp_path, held_elsewhere
):
    out = tmp_path / "new" / "out.json"
    process = held_elsewhere(out)
    for _ in range(2):
        with pytest.raises(CannotWrite, match=r"out.json: another process is using it; end that"):
            OutputLock(out)
    process.kill()
    process.wait()
    OutputLock(out).close()
    assert not list(out.parent.glob(".*"))


@pytest.mark.parametrize("make", [lambda out: Journal(out), lambda out: ResultLog(out, {}, False)])
def test_what_is_made_bit_by_bit_is_locked_too(tmp_path, held_elsewhere, make):
    held_elsewhere(tmp_path / "out.json")
    with pytest.raises(CannotWrite, match="another process is using it"):
        make(tmp_path / "out.json")
    assert not (tmp_path / "out.json.journal").exists()


def test_a_link_and_what_it_points_to_are_one_output(tmp_path):
    (tmp_path / "link").symlink_to("folder/out.json")
    with OutputLock(tmp_path / "link"), pytest.raises(CannotWrite, match="another process"):
        OutputLock(tmp_path / "folder" / ".." / "folder" / "out.json")


def test_only_a_part_of_what_holds_the_lock_may_go_on_under_it(tmp_path):
    out = tmp_path / "out"
    with OutputLock(out):
        with OutputLock(out, nested=True):
            pass
        with pytest.raises(CannotWrite):
            OutputLock(out)
    with OutputLock(out, nested=True), pytest.raises(CannotWrite):
        OutputLock(out)


def test_a_lock_leaves_nothing_behind(tmp_path):
    with OutputLock(tmp_path / "a" / "b" / "out.json"):
        assert (tmp_path / "a" / "b" / ".out.json.lock").exists()
    assert list(tmp_path.iterdir()) == []
    with OutputLock(tmp_path / "a" / "out.json"):
        write_text(tmp_path / "a" / "out.json", "")
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["out.json"]


def test_a_lock_file_that_was_removed_on_release_is_not_taken_for_the_lock(tmp_path, monkeypatch):
    """A second process opens the file just before the first one removes and releases it."""
    out, first = tmp_path / "out", OutputLock(tmp_path / "out")
    flock, descriptors = storage.fcntl.flock, []

    def late(descriptor, operation):
        first.close()
        descriptors.append(descriptor)
        flock(descriptor, operation)

    monkeypatch.setattr(storage.fcntl, "flock", late)
    with OutputLock(out):
        assert len(descriptors) == 2
        assert os.path.samestat(os.fstat(descriptors[1]), os.stat(tmp_path / ".out.lock"))


def test_of_many_at_once_one_has_it(tmp_path):
    inside, most, taken = [0], [0], [0]

    def work() -> None:
        for _ in range(200):
            try:
                lock = OutputLock(tmp_path / "out")
            except CannotWrite:
                continue
            with lock:
                inside[0] += 1
                taken[0] += 1
                most[0] = max(most[0], inside[0])
                inside[0] -= 1

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1] and taken[0] > 1 and list(tmp_path.iterdir()) == []


def test_a_directory_in_which_another_process_writes_is_not_cleared(tmp_path, held_elsewhere):
    write_json(tmp_path / "run" / "run.json", {})
    write_text(tmp_path / "run" / "dataset" / "manifest.jsonl", "rows")
    held_elsewhere(tmp_path / "run" / "dataset")
    with pytest.raises(CannotWrite, match=r"run/dataset: another process is using it"):
        clear_directory(tmp_path / "run", "run.json", overwrite=True)
    assert (tmp_path / "run" / "dataset" / "manifest.jsonl").exists()


def test_clearing_that_was_interrupted_can_be_done_again(tmp_path, monkeypatch):
    for name in ("a", "run.json", "z"):
        write_text(tmp_path / "run" / name, "")
    remove = storage.remove

    def interrupted(path):
        if path.name == "z":
            raise KeyboardInterrupt
        remove(path)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(storage, "remove", interrupted)
        clear_directory(tmp_path / "run", "run.json", overwrite=True)
    clear_directory(tmp_path / "run", "run.json", overwrite=True)
    assert list((tmp_path / "run").iterdir()) == []


# --- links --------------------------------------------------------------------------------------


@pytest.mark.parametrize("there", [True, False])
def test_writing_to_a_link_writes_what_it_points_to(tmp_path, there):
    target, link = tmp_path / "disk" / "target", tmp_path / "link.json"
    if there:
        write_text(target, "old")
    link.symlink_to("disk/target")
    check_writable(link, overwrite=True)
    write_json(link, {"new": 1})
    assert link.is_symlink() and not target.is_symlink() and '"new": 1' in target.read_text()
    assert [p.name for p in target.parent.iterdir()] == ["target"]
    with pytest.raises(OutputExists, match=r"link.json: already exists"):
        check_writable(link)


def test_a_linked_directory_is_cleared_and_the_link_stays(tmp_path):
    write_json(tmp_path / "disk" / "run.json", {})
    (tmp_path / "link").symlink_to("disk")
    clear_directory(tmp_path / "link", "run.json", overwrite=True)
    assert (tmp_path / "link").is_symlink() and list((tmp_path / "disk").iterdir()) == []


@pytest.mark.parametrize("write", [lambda p: write_json(p, {}), check_writable, OutputLock])
def test_a_link_to_itself_is_refused(tmp_path, write):
    (tmp_path / "link").symlink_to("link")
    with pytest.raises(CannotWrite, match="is a link to itself; remove it"):
        write(tmp_path / "link")
    assert os.readlink(tmp_path / "link") == "link"


# --- what is kept -------------------------------------------------------------------------------


def test_a_result_log_resumes_what_was_asked_for_and_nothing_else(tmp_path):
    out = tmp_path / "out.json"
    with ResultLog(out, {"seed": 0, "pair": (1, 2)}, overwrite=False) as log:
        log.add({"n": 1})
    with open(tmp_path / "out.json.journal", "a") as file:
        file.write('{"n": 2')
    with pytest.raises(Mismatch, match=r"holds results of .* add --overwrite"):
        ResultLog(out, {"seed": 1}, overwrite=False)
    with ResultLog(out, {"seed": 0, "pair": (1, 2)}, overwrite=False) as log:
        assert log.rows == [{"n": 1}]
        log.add({"n": 2})
        log.finish({"done": True})
    assert [p.name for p in tmp_path.iterdir()] == ["out.json"]
    with pytest.raises(OutputExists):
        ResultLog(out, {"seed": 0}, overwrite=False)
    with ResultLog(out, {"seed": 1}, overwrite=True) as log:
        assert log.rows == [] and out.exists()


@pytest.mark.parametrize("value", [float("nan"), object()])
def test_a_row_that_json_can_not_hold_is_refused_and_leaves_nothing(tmp_path, value):
    with ResultLog(tmp_path / "out.json", {}, overwrite=False) as log:
        with pytest.raises(InvalidInput, match="out.json.journal: can't be written as JSON"):
            log.add({"n": value})
        log.add({"n": 1})
        assert log.rows == [{"n": 1}]


def test_only_what_a_killed_writer_left_is_removed(tmp_path):
    with storage.replacing(tmp_path / "a" / "frames.bin") as temporary:
        temporary.write_text("half")
        write_text(tmp_path / "a" / ".hidden", "mine")
        with OutputLock(tmp_path / "a" / "x.abcdefgh"):
            left = temporary.with_name(temporary.name[:-12] + "abcd_123.bin")
            left.write_text("half")
            remove_temporary_files(tmp_path)
            assert (tmp_path / "a" / ".x.abcdefgh.lock").exists()
            temporary.write_text("whole")
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == [".hidden", "frames.bin"]
