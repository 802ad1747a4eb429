"""What works on this machine, and how to fix what does not."""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from sart_toolkit.errors import NoDisplay, SartError

DISK_NEEDED_GB = 2.0
_ARM = """<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="revolute">
<parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
_SUDO = "" if os.geteuid() == 0 else "sudo "


class ProbeFailed(SartError, RuntimeError):
    """Something that the doctor tested does not do what it should."""


@dataclass(frozen=True)
class Finding:
    """One answer of the doctor.

    Attributes:
        name: what was checked.
        ok: whether it works.
        detail: what was found, or what went wrong.
        remedy: what to do about it; empty where `ok`.
        required: whether the toolkit is useless without it.
        tested: whether it was tested, and not only found to be installed.
    """

    name: str
    ok: bool
    detail: str
    remedy: str = ""
    required: bool = False
    tested: bool = True


@dataclass(frozen=True)
class Probe:
    """One question to the machine, asked in a process of its own.

    Attributes:
        name: what is checked.
        target: `module:function`; the function returns what it found, or raises.
        extra: the extra of sart_toolkit that it belongs to; empty for the core.
        remedy: what to do where the function fails, other than for a missing package or library.
        required: whether the toolkit is useless without it.
        timeout_s: how long it may take [s].
        packages: for an answer without trying: the installed packages that it needs.
    """

    name: str
    target: str
    extra: str = ""
    remedy: str = ""
    required: bool = False
    timeout_s: float = 120.0
    packages: tuple[str, ...] = ()


def diagnose(full: bool = True) -> list[Finding]:
    """What works on this machine, required things first.

    Simulators and renderers are really run, each in a process of its own, so that one
    that crashes or hangs is a finding and not the end of the doctor. Unless `full`, what is
    not required is only checked to be installed.
    """
    probe = run_probe if full else _quick_finding
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        findings = [_python_finding(), _disk_finding(Path.cwd()), *pool.map(probe, PROBES)]
    return sorted(findings, key=lambda finding: not finding.required)


def _quick_finding(probe: Probe) -> Finding:
    if probe.required:
        return run_probe(probe)
    if not any(map(_is_installed, probe.packages)):
        return _broken(
            probe, f"{probe.packages[0]} is not installed", _remedy(probe, "ModuleNotFoundError")
        )
    return Finding(probe.name, True, f"{_version(*probe.packages)}, not tested", tested=False)


def _is_installed(package: str) -> bool:
    try:
        importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def run_probe(probe: Probe) -> Finding:
    """The finding of one probe, whatever its process does: return, raise, crash or hang."""
    with tempfile.TemporaryDirectory() as folder:
        answer_file = Path(folder) / "answer.json"
        # A session of its own, so that a probe that hangs is ended with all that it started.
        process = subprocess.Popen(
            [sys.executable, "-c", _CHILD, probe.target, str(answer_file)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        try:
            _, stderr = process.communicate(timeout=probe.timeout_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            detail = f"no answer within {probe.timeout_s:g} s"
            return _broken(probe, detail, probe.remedy)
        if process.returncode != 0 or not answer_file.exists():
            return _broken(probe, _crash_detail(process.returncode, stderr), probe.remedy)
        answer = json.loads(answer_file.read_text())
    if answer["error"] == "":
        return Finding(probe.name, True, answer["detail"], required=probe.required)
    return _broken(probe, answer["detail"], _remedy(probe, answer["error"]))


_CHILD = "import sys; from sart_toolkit.doctor import answer; answer(sys.argv[1], sys.argv[2])"


def answer(target: str, answer_file: str) -> None:
    """Runs in the probe's process: calls `module:function` and writes the result as JSON."""
    module, _, function = target.partition(":")
    try:
        detail = getattr(importlib.import_module(module), function)()
        error = ""
    except Exception as exception:
        detail = str(exception) or type(exception).__name__
        error = "ImportError" if isinstance(exception, ImportError) else "other"
        if isinstance(exception, ModuleNotFoundError):
            error = "ModuleNotFoundError"
    Path(answer_file).write_text(json.dumps({"detail": detail, "error": error}))


def _broken(probe: Probe, detail: str, remedy: str) -> Finding:
    return Finding(probe.name, False, detail, remedy, probe.required)


def _crash_detail(returncode: int, stderr: str) -> str:
    how = f"exit code {returncode}" if returncode >= 0 else signal.Signals(-returncode).name
    last_line = (stderr.strip().splitlines() or ["it said nothing"])[-1]
    return f"its process ended with {how}: {last_line}"


def _remedy(probe: Probe, error: str) -> str:
    if error == "ModuleNotFoundError" and probe.extra:
        return f"pip install sart_toolkit[{probe.extra}], or in a checkout: make setup-all"
    if error == "ModuleNotFoundError":
        return "pip install sart_toolkit, or in a checkout: make setup"
    if error == "ImportError" and probe.extra:
        return f"in a checkout: {_SUDO}bash tools/setup_debian.sh {probe.extra}"
    return probe.remedy


def _python_finding() -> Finding:
    version = ".".join(str(part) for part in sys.version_info[:3])
    return Finding(
        "Python",
        sys.version_info[:2] == (3, 11),
        version,
        "" if sys.version_info[:2] == (3, 11) else "use Python 3.11: PyBullet has no newer wheels",
        required=True,
    )


def _disk_finding(folder: Path) -> Finding:
    free_gb = shutil.disk_usage(folder).free / 1e9
    if not os.access(folder, os.W_OK):
        ok, detail, remedy = False, f"{folder} can't be written", "work in a folder of yours"
    elif free_gb < DISK_NEEDED_GB:
        ok, detail = False, f"{free_gb:.1f} GB free in {folder}"
        remedy = f"free {DISK_NEEDED_GB:g} GB, or work on another disk"
    else:
        ok, detail, remedy = True, f"{free_gb:.1f} GB free in {folder}", ""
    return Finding("disk", ok, detail, remedy, required=True)


def probe_kinematics() -> str:
    """Versions of Pinocchio and coal, once each has computed something."""
    import coal
    import pinocchio

    with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
        file.write(_ARM)
        file.flush()
        model = pinocchio.buildModelFromUrdf(file.name)
    data = model.createData()
    pinocchio.forwardKinematics(model, data, pinocchio.neutral(model))
    apart = coal.Transform3s()
    apart.setTranslation(data.oMi[1].translation + [2.0, 0.0, 0.0])
    distance = coal.distance(
        coal.Sphere(0.5), coal.Transform3s(), coal.Sphere(0.5), apart,
        coal.DistanceRequest(), coal.DistanceResult(),
    )  # fmt: skip
    if abs(distance - 1.0) > 1e-6:
        raise ProbeFailed(f"two spheres 1 m apart are {distance:.3f} m apart")
    return f"{_version('pin')}, {_version('coal')}, compute"


def probe_pybullet() -> str:
    """What PyBullet and embreex are, after a ball fell in the one and was drawn by the other."""
    import numpy as np
    import pybullet

    from sart_toolkit.backends.raycast import RayCaster
    from sart_toolkit.poses import pose
    from sart_toolkit.robots.spec import CameraSpec, Shape, look_at
    from sart_toolkit.robots.visuals import body_meshes
    from sart_toolkit.scenes.spec import Light

    client = pybullet.connect(pybullet.DIRECT)
    shape = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1)
    ball = pybullet.createMultiBody(1.0, shape, basePosition=[0, 0, 1])
    pybullet.setGravity(0, 0, -9.81)
    for _ in range(60):
        pybullet.stepSimulation()
    height = pybullet.getBasePositionAndOrientation(ball)[0][2]
    pybullet.disconnect(client)
    _check_fall(height)
    caster = RayCaster({"ball": body_meshes([Shape("sphere", (0.1,))])}, Light())
    at = np.array([0, 0, height])
    camera = CameraSpec("camera", "world", look_at(at + [1, 0, 0], at, np.array([0, 0, 1.0])))
    image = caster.view(camera, np.eye(4), (32, 32), {"ball": pose(at)})
    _check_image(bool((image.depth > 0).any()))
    return f"{_version('pybullet')}, {_version('embreex')}, simulates and draws"


def probe_sapien_physics() -> str:
    """What SAPIEN is, after it let a ball fall without any renderer."""
    import sapien

    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    scene.set_timestep(1 / 240)
    builder = scene.create_actor_builder()
    builder.add_sphere_collision(radius=0.1)
    ball = builder.build(name="ball")
    ball.set_pose(sapien.Pose([0, 0, 1]))
    for _ in range(60):
        scene.step()
    _check_fall(float(ball.pose.p[2]))
    return f"{_version('sapien')}, simulates"


def probe_sapien_rendering() -> str:
    """What SAPIEN draws with, after it drew a ball."""
    import sapien

    scene = sapien.Scene()
    scene.set_ambient_light([1.0, 1.0, 1.0])
    builder = scene.create_actor_builder()
    builder.add_sphere_visual(radius=0.1)
    ball = builder.build_static(name="ball")
    camera = scene.add_camera("camera", 32, 32, 1.0, 0.01, 5.0)
    camera.entity.set_pose(sapien.Pose([-1, 0, 0]))
    scene.update_render()
    camera.take_picture()
    _check_image(bool((camera.get_picture("Segmentation")[..., 1] == ball.per_scene_id).any()))
    return f"draws on {sapien.render.RenderSystem().device.name}"


def probe_open3d_offscreen() -> str:
    """What Open3D is, after it drew a ball without a window."""
    import numpy as np
    import open3d

    rendering = open3d.visualization.rendering
    renderer = rendering.OffscreenRenderer(32, 32)
    material = rendering.MaterialRecord()
    material.shader = "defaultUnlit"
    material.base_color = (0.0, 0.0, 0.0, 1.0)
    renderer.scene.set_background([1.0, 1.0, 1.0, 1.0])
    ball = open3d.geometry.TriangleMesh.create_sphere(0.2)
    renderer.scene.add_geometry("ball", ball, material)
    renderer.setup_camera(60.0, [0, 0, 0], [1, 0, 0], [0, 0, 1])
    _check_image(bool(np.ptp(np.asarray(renderer.render_to_image())) > 0))
    return f"{_version('open3d-cpu', 'open3d')}, draws"


def probe_open3d_window() -> str:
    """Which display showed a window of Open3D."""
    import open3d

    # Without a display Open3D draws nowhere and ends the process on closing; say it in words.
    if not os.environ.get("DISPLAY"):
        raise ProbeFailed("DISPLAY is not set")
    gui = open3d.visualization.gui
    gui.Application.instance.initialize()
    window = gui.Application.instance.create_window("sart doctor", 64, 64)
    widget = gui.SceneWidget()
    widget.scene = open3d.visualization.rendering.Open3DScene(window.renderer)
    window.add_child(widget)
    for _ in range(3):
        gui.Application.instance.run_one_tick()
    window.close()
    gui.Application.instance.run_one_tick()
    return f"opens on display {os.environ['DISPLAY']}"


def probe_teleop_window() -> str:
    """Which display showed a window of pygame's."""
    import pygame  # noqa: F401 - its absence has a remedy of its own

    from sart_toolkit.record.screen import Screen

    try:
        with Screen("sart doctor") as screen:
            screen.clear()
            screen.show()
    except NoDisplay as error:
        raise ProbeFailed(str(error).partition(";")[0]) from error
    return f"{_version('pygame-ce')}, opens on display {os.environ.get('DISPLAY', '')}".strip()


def probe_browser_page() -> str:
    """What viser is, after it served a page to this machine."""
    import socket
    import urllib.request

    import viser  # noqa: F401 - its absence has a remedy of its own

    from sart_toolkit.record.webpage import WebPage

    with socket.create_server(("127.0.0.1", 0)) as found:
        port = found.getsockname()[1]
    with WebPage("sart doctor", port=port) as page, urllib.request.urlopen(page.url) as answer:
        if b"<html" not in answer.read():
            raise ProbeFailed(f"{page.url} answers with something else than a page")
    return f"{_version('viser')}, serves a page"


def probe_spacemouse() -> str:
    """What hidapi is, and whether it finds a SpaceMouse; none is no fault."""
    import hid

    from sart_toolkit.record.devices.spacemouse import is_spacemouse

    found = [info["product_string"] for info in hid.enumerate() if is_spacemouse(info)]
    return f"{_version('hidapi')}, finds {', '.join(found) or 'none plugged in'}"


def probe_cuda() -> str:
    """Which CUDA device computed something with torch."""
    import torch

    if torch.version.cuda is None:
        raise ProbeFailed(f"torch {torch.__version__} is built without CUDA")
    if not torch.cuda.is_available():
        raise ProbeFailed(f"torch {torch.__version__} finds no CUDA device")
    total = torch.ones(8, device="cuda").sum().item()
    if total != 8.0:
        raise ProbeFailed(f"{torch.cuda.get_device_name()} adds eight ones to {total}")
    return f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}"


def probe_threads() -> str:
    """How many threads torch uses on how many cores."""
    import torch

    cores, threads = usable_cores(), torch.get_num_threads()
    detail = f"torch {torch.__version__} uses {threads} threads, usable cores: {cores}"
    if threads > cores:
        raise ProbeFailed(detail)
    return detail


def probe_ffmpeg() -> str:
    """Which ffmpeg encoded a small video."""
    import imageio_ffmpeg

    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "video.mp4"
        writer = imageio_ffmpeg.write_frames(str(video), (64, 64), fps=10, codec="libx264")
        writer.send(None)
        for level in range(5):
            writer.send(bytes([level * 50]) * (64 * 64 * 3))
        writer.close()
        frames, _ = imageio_ffmpeg.count_frames_and_secs(str(video))
    if frames != 5:
        raise ProbeFailed(f"a video of 5 frames came out with {frames}")
    return f"ffmpeg {imageio_ffmpeg.get_ffmpeg_version()}, encodes H.264"


def machine() -> dict[str, str | int | float]:
    """Processor, usable cores, memory, system and load of this machine, without its name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.machine(),
        "cores": usable_cores(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "load_average": round(os.getloadavg()[0], 2),
    }


def source_commit() -> str | None:
    """The commit of the Git checkout that the toolkit runs from; None where it was installed.

    "+" follows it where tracked files differ from it.
    """
    root = Path(__file__).resolve().parents[1]

    def git(*words: str) -> str:
        command = ["git", "-C", str(root), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        # It may be installed somewhere inside a checkout of something else.
        if Path(git("rev-parse", "--show-toplevel")) != root:
            return None
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return None


def usable_cores() -> int:
    """How many cores this process may keep busy: its CPU affinity, less a container's quota."""
    cores = len(os.sched_getaffinity(0))
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        return cores if quota == "max" else min(cores, math.ceil(int(quota) / int(period)))
    except OSError:
        return cores


def _check_fall(height: float) -> None:
    # Both integrators miss the exact fall of 0.307 m by less than 0.02 m at these 60 steps.
    if abs(height - 0.693) > 0.02:
        raise ProbeFailed(f"a ball dropped from 1 m is at {height:.3f} m after 0.25 s, not 0.693")


def _check_image(shows_ball: bool) -> None:
    if not shows_ball:
        raise ProbeFailed("an image of a ball does not show it")


def _version(*packages: str) -> str:
    for package in packages:
        try:
            return f"{package} {importlib.metadata.version(package)}"
        except importlib.metadata.PackageNotFoundError:
            continue
    return packages[0]


_REINSTALL = "reinstall: pip install --force-reinstall sart_toolkit, or: make clean setup"

PROBES: Sequence[Probe] = (
    Probe(
        "kinematics",
        "sart_toolkit.doctor:probe_kinematics",
        remedy=f"in a checkout: {_SUDO}bash tools/setup_debian.sh core, or reinstall both",
        required=True,
    ),
    Probe("PyBullet", "sart_toolkit.doctor:probe_pybullet", remedy=_REINSTALL, required=True),
    Probe("ffmpeg", "sart_toolkit.doctor:probe_ffmpeg", remedy=_REINSTALL, required=True),
    Probe(
        "threads",
        "sart_toolkit.doctor:probe_threads",
        packages=("torch",),
        remedy="set OMP_NUM_THREADS to the number of usable cores",
    ),
    Probe(
        "CUDA",
        "sart_toolkit.doctor:probe_cuda",
        packages=("torch",),
        remedy="none needed, everything runs on the CPU; for a GPU: NVIDIA's driver, and the "
        "CUDA build of torch 2.13.0",
    ),
    Probe(
        "SAPIEN physics",
        "sart_toolkit.doctor:probe_sapien_physics",
        extra="sapien",
        packages=("sapien",),
        remedy="reinstall: pip install --force-reinstall sapien==3.0.3",
    ),
    Probe(
        "SAPIEN rendering",
        "sart_toolkit.doctor:probe_sapien_rendering",
        extra="sapien",
        packages=("sapien",),
        remedy="it needs a GPU's Vulkan driver, or Mesa's from 24.3 on (Debian 12: from "
        f"bookworm-backports); in a checkout: {_SUDO}bash tools/setup_debian.sh sapien",
    ),
    Probe(
        "Open3D off-screen",
        "sart_toolkit.doctor:probe_open3d_offscreen",
        extra="annotate",
        packages=("open3d-cpu", "open3d"),
        remedy=f"in a checkout: {_SUDO}bash tools/setup_debian.sh annotate",
    ),
    Probe(
        "Open3D window",
        "sart_toolkit.doctor:probe_open3d_window",
        extra="annotate",
        packages=("open3d-cpu", "open3d"),
        remedy="work on a desktop, or give it a virtual display: xvfb-run -a COMMAND (in a "
        f"checkout, to install that: {_SUDO}bash tools/setup_debian.sh annotate)",
    ),
    Probe(
        "pygame window",
        "sart_toolkit.doctor:probe_teleop_window",
        extra="teleop",
        packages=("pygame-ce",),
        remedy="work on a desktop, or give it a virtual display: xvfb-run -a COMMAND (in a "
        f"checkout, to install that: {_SUDO}bash tools/setup_debian.sh teleop)",
    ),
    Probe(
        "browser page",
        "sart_toolkit.doctor:probe_browser_page",
        extra="web",
        packages=("viser",),
        remedy="reinstall: pip install --force-reinstall viser; --text and windows work as well",
    ),
    Probe(
        "SpaceMouse",
        "sart_toolkit.doctor:probe_spacemouse",
        extra="teleop",
        packages=("hidapi",),
        remedy="reinstall: pip install --force-reinstall hidapi; other devices steer as well",
    ),
)
