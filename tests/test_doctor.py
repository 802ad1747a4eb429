"""The doctor reports on everything and survives what it reports on."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
import types
from pathlib import Path

import imageio_ffmpeg
import pytest
import torch

from sart_toolkit import doctor
from sart_toolkit.doctor import (
    Finding,
    Probe,
    ProbeFailed,
    diagnose,
    run_probe,
    source_commit,
)
from sart_toolkit.testing.desktop import Desktop


@pytest.fixture(scope="module")
def findings() -> list[Finding]:
    return diagnose()


@pytest.fixture
def made_up_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module `made_up` that probes' processes can import."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    return tmp_path / "made_up.py"


def test_everything_is_checked(findings: list[Finding]) -> None:
    assert {finding.name for finding in findings} == {
        "Python",
        "kinematics",
        "PyBullet",
        "SAPIEN physics",
        "SAPIEN rendering",
        "Open3D off-screen",
        "Open3D window",
        "pygame window",
        "browser page",
        "SpaceMouse",
        "CUDA",
        "threads",
        "disk",
        "ffmpeg",
    }


def test_every_finding_has_a_detail_and_a_broken_one_a_remedy(findings: list[Finding]) -> None:
    for finding in findings:
        assert finding.detail
        assert bool(finding.remedy) == (not finding.ok), finding


def test_what_the_tests_run_on_works_and_comes_first(findings: list[Finding]) -> None:
    required = [finding for finding in findings if finding.required]
    assert findings[: len(required)] == required
    assert {f.name for f in required} == {"Python", "disk", "kinematics", "PyBullet", "ffmpeg"}
    assert [finding for finding in required if not finding.ok] == []


def test_a_quick_check_tests_only_what_is_required() -> None:
    started = time.monotonic()
    findings = diagnose(full=False)
    assert time.monotonic() - started < 20.0
    assert {finding.required for finding in findings if finding.tested} == {True}
    untested = {finding.name: finding for finding in findings if not finding.tested}
    assert "CUDA" in untested and "SAPIEN rendering" in untested
    assert untested["CUDA"].detail == f"torch {torch.__version__}, not tested"


def test_a_quick_check_reports_what_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    probe = Probe("made up", "made_up:probe", extra="sapien", packages=("no-such", "nor-such"))
    monkeypatch.setattr(doctor, "PROBES", (probe,))
    (finding,) = [f for f in diagnose(full=False) if f.name == "made up"]
    assert not finding.ok and finding.detail == "no-such is not installed"
    assert "pip install sart_toolkit[sapien]" in finding.remedy


def test_a_probe_that_returns_is_ok_with_what_it_returned() -> None:
    finding = run_probe(Probe("made up", "platform:python_implementation", required=True))
    assert finding == Finding("made up", True, "CPython", required=True)


def test_a_probe_that_raises_is_not_ok_with_its_message(made_up_module: Path) -> None:
    made_up_module.write_text("def probe():\n    print('noise')\n    raise RuntimeError('no lamp')")
    finding = run_probe(Probe("made up", "made_up:probe", remedy="buy a lamp"))
    assert finding == Finding("made up", False, "no lamp", "buy a lamp")


@pytest.mark.parametrize(
    ("source", "detail"),
    [
        ("import os\nprobe = os.abort", "its process ended with SIGABRT: it said nothing"),
        (
            "import os, sys\ndef probe():\n    print('lamp broke', file=sys.stderr, flush=True)\n"
            "    os._exit(7)",
            "its process ended with exit code 7: lamp broke",
        ),
        (
            "import os\ndef probe():\n    os._exit(0)",
            "its process ended with exit code 0: it said nothing",
        ),
    ],
)
def test_a_probe_that_crashes_is_not_ok(made_up_module: Path, source: str, detail: str) -> None:
    made_up_module.write_text(source)
    finding = run_probe(Probe("made up", "made_up:probe", remedy="buy a lamp"))
    assert finding == Finding("made up", False, detail, "buy a lamp")


def test_a_probe_that_hangs_is_not_ok_and_leaves_no_process(made_up_module: Path) -> None:
    beat = made_up_module.with_name("beat")
    child = f"while true; do touch {beat}; sleep 0.05; done"
    made_up_module.write_text(
        f"import subprocess\ndef probe():\n    subprocess.run(['sh', '-c', {child!r}])"
    )
    finding = run_probe(Probe("made up", "made_up:probe", remedy="wait", timeout_s=3.0))
    assert finding == Finding("made up", False, "no answer within 3 s", "wait")
    assert beat.exists()
    beat.unlink()
    time.sleep(0.3)
    assert not beat.exists()


@pytest.mark.parametrize(
    ("source", "extra", "remedy"),
    [
        ("import no_such_package", "sapien", "pip install sart_toolkit[sapien]"),
        ("import no_such_package", "", "make setup"),
        ("raise ImportError('libusb-1.0.so.0: cannot open')", "annotate", "setup_debian.sh ann"),
        ("raise ImportError('libusb-1.0.so.0: cannot open')", "", "buy a lamp"),
    ],
)
def test_a_missing_package_or_library_has_its_own_remedy(
    made_up_module: Path, source: str, extra: str, remedy: str
) -> None:
    made_up_module.write_text(f"def probe():\n    {source}")
    finding = run_probe(Probe("made up", "made_up:probe", extra=extra, remedy="buy a lamp"))
    assert not finding.ok
    assert remedy in finding.remedy


def test_a_full_disk_is_not_ok(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doctor, "DISK_NEEDED_GB", 1e9)
    monkeypatch.setattr(doctor, "PROBES", ())
    (disk,) = [finding for finding in diagnose() if finding.name == "disk"]
    assert not disk.ok
    assert "GB free" in disk.detail
    assert "another disk" in disk.remedy


def test_a_read_only_folder_is_not_ok(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doctor.os, "access", lambda *_: False)
    monkeypatch.setattr(doctor, "PROBES", ())
    (disk,) = [finding for finding in diagnose() if finding.name == "disk"]
    assert not disk.ok
    assert "can't be written" in disk.detail


def test_torch_without_cuda_is_reported_from_a_missing_device(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.version, "cuda", None)
    with pytest.raises(ProbeFailed, match="built without CUDA"):
        doctor.probe_cuda()
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ProbeFailed, match="finds no CUDA device"):
        doctor.probe_cuda()


def test_a_cuda_device_that_computes_wrongly_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "Abacus")
    monkeypatch.setattr(torch, "ones", lambda *_, **__: torch.zeros(8))
    with pytest.raises(ProbeFailed, match="Abacus adds eight ones to 0"):
        doctor.probe_cuda()


def test_more_threads_than_cores_are_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "usable_cores", lambda: 0)
    with pytest.raises(ProbeFailed, match="usable cores: 0"):
        doctor.probe_threads()


def test_a_video_that_lost_frames_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imageio_ffmpeg, "count_frames_and_secs", lambda _: (4, 0.4))
    with pytest.raises(ProbeFailed, match="5 frames came out with 4"):
        doctor.probe_ffmpeg()


def test_a_window_without_a_display_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", types.ModuleType("open3d"))
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ProbeFailed, match="DISPLAY is not set"):
        doctor.probe_open3d_window()


@pytest.mark.window
def test_a_window_of_pygame_s_that_opened_is_reported_with_its_display(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("pygame")
    with Desktop(640, 480) as desktop:
        monkeypatch.setenv("DISPLAY", desktop.display)
        (probe,) = (probe for probe in doctor.PROBES if probe.name == "pygame window")
        finding = run_probe(probe)
    assert finding.ok and f"opens on display {desktop.display}" in finding.detail


def test_a_spacemouse_is_named_and_none_is_no_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    plugged = [{"vendor_id": 0x256F, "product_id": 0xC635, "product_string": "SpaceMouse Compact"}]
    hid = types.SimpleNamespace(enumerate=lambda: plugged)
    monkeypatch.setitem(sys.modules, "hid", hid)
    assert "finds SpaceMouse Compact" in doctor.probe_spacemouse()
    plugged.clear()
    assert "none plugged in" in doctor.probe_spacemouse()


def test_wrong_physics_and_an_empty_image_are_caught() -> None:
    with pytest.raises(ProbeFailed, match=r"is at 1\.000 m"):
        doctor._check_fall(1.0)
    with pytest.raises(ProbeFailed, match="does not show it"):
        doctor._check_image(False)


def _checkout(directory: Path) -> Path:
    """A Git repository with one commit and a package in it, as the toolkit would lie there."""
    package = directory / "sart_toolkit"
    package.mkdir(parents=True)
    (package / "doctor.py").write_text("")
    for words in (
        ["init", "-q"],
        ["add", "."],
        ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "one"],
    ):
        subprocess.run(["git", "-C", str(directory), *words], check=True)
    return package / "doctor.py"


@pytest.mark.skipif(shutil.which("git") is None, reason="no Git")
def test_the_commit_is_of_the_toolkit_s_own_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = _checkout(tmp_path / "own")
    monkeypatch.setattr(doctor, "__file__", str(module))
    commit = source_commit()
    assert commit is not None and len(commit) == 40
    module.write_text("changed = True")
    assert source_commit() == commit + "+"


@pytest.mark.skipif(shutil.which("git") is None, reason="no Git")
def test_a_toolkit_installed_inside_something_else_has_no_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = _checkout(tmp_path / "other")
    inside = module.parent / "site-packages" / "sart_toolkit"
    inside.mkdir(parents=True)
    monkeypatch.setattr(doctor, "__file__", str(inside / "doctor.py"))
    assert source_commit() is None
    monkeypatch.setattr(
        doctor, "__file__", str(tmp_path / "nowhere" / "sart_toolkit" / "doctor.py")
    )
    assert source_commit() is None
