"""Benchmarks of the toolkit: `python tools/bench.py NAME` prints one JSON object as its last line.

Progress goes to stderr. A benchmark is a function from its own command-line arguments to figures,
and one line in `BENCHMARKS`.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import importlib
import importlib.metadata
import io
import itertools
import json
import math
import os
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import h5py
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from sart_toolkit import doctor
from sart_toolkit.annotate.session import AnnotationSession
from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.augment.preview import preview_sources
from sart_toolkit.backends import BACKENDS, get_backend, make_backend
from sart_toolkit.backends.interface import Backend, BackendFactory, Draws, Resets, require
from sart_toolkit.collision.certificate import certify
from sart_toolkit.collision.cloud import fuse_cloud
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.collision.model import CollisionModel, PlacedModel
from sart_toolkit.data import storage
from sart_toolkit.data.assets import asset
from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.formats import FORMATS, get_format
from sart_toolkit.data.formats.format import trajectories_of
from sart_toolkit.data.records import (
    Annotation,
    CameraRecord,
    Demonstration,
    Episode,
    PrecisionSphere,
    Provenance,
    Steps,
    library_versions,
)
from sart_toolkit.data.storage import load_demonstration, save_demonstration
from sart_toolkit.data.writer import write_dataset
from sart_toolkit.errors import InvalidInput, MotionRejected, SartError, Unreachable, unknown_name
from sart_toolkit.learn.frames import input_size
from sart_toolkit.learn.policies import POLICIES, get_policy
from sart_toolkit.learn.samples import FRAMES, Batch, WindowConfig, Windows, open_windows
from sart_toolkit.learn.training import (
    TrainConfig,
    build_policy,
    epoch_batches,
    make_optimizer,
    resolve_bfloat16,
    resolve_device,
    train,
)
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.motion.line import straight_line
from sart_toolkit.motion.path import SplinePath
from sart_toolkit.poses import Array, apply_motion, check_positive, inverse, pose
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import record_demonstration
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.robots.visuals import body_meshes
from sart_toolkit.scenes.spec import SceneSpec, SceneState
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.tasks.task import Placement, Task
from sart_toolkit.testing.browser import Browser
from sart_toolkit.testing.closest import ClosestPoints
from sart_toolkit.testing.clutter import CLUTTER, Segment, random_segment
from sart_toolkit.testing.desktop import Desktop

if TYPE_CHECKING:
    from sart_toolkit.annotate.open3d_window import WindowConfig

_RECORDED_SIZE = 128
_DEMONSTRATION_STEPS = 60
_SEGMENT_STEPS = 20


# --- the training loop --------------------------------------------------------------------------


def bench_train(arguments: Sequence[str]) -> dict[str, Any]:
    """Images/s of the training loop, of the same model's bare steps, and their ratio, by policy.

    Steps of both alternate in this process, so that whatever else the machine does slows both: one
    through `learn.training.train` (everything from one step's end to the next's: windows drawn,
    gathered and shifted, losses kept, epochs, checkpoints), one of forward, backward and optimizer
    on a batch that is loaded already. The ratio is the median over blocks of steps.
    """
    parser = argparse.ArgumentParser(prog="bench.py train", description=bench_train.__doc__)
    parser.add_argument("--policy", default="all", help=f"all, {', '.join(POLICIES)}")
    parser.add_argument("--blocks", type=int, default=10, help="blocks of steps, for the median")
    parser.add_argument("--seconds", type=float, default=30.0, help="about, for each policy")
    parser.add_argument("--image-size", type=int, help="[pixels]; the policy's own if left out")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda")
    parser.add_argument("--threads", type=int, help="torch's threads; its own choice if left out")
    options = parser.parse_args(arguments)
    check_positive("--blocks", options.blocks)
    check_positive("--seconds", options.seconds)
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    overrides: dict[str, Any] = {"device": options.device}
    if options.image_size is not None:
        overrides["image_size"] = options.image_size
    policies = list(POLICIES) if options.policy == "all" else [options.policy]
    return {
        policy: _train_figures(
            TrainConfig.for_policy(policy, **overrides), options.blocks, options.seconds
        )
        for policy in policies
    }


def _train_figures(config: TrainConfig, n_blocks: int, seconds: float) -> dict[str, Any]:
    device = resolve_device(config.device)
    window_config = WindowConfig(
        config.cameras, config.image_size, config.history, config.image_shift
    )
    with tempfile.TemporaryDirectory() as scratch:
        few = _synthetic_dataset(Path(scratch) / "dataset", 8)
        windows = open_windows(few, window_config, Path(scratch)).to(device)
    bare_step = _stepper(config, itertools.repeat(next(_random_batches(config, windows))))
    # The first steps choose and compile kernels.
    step_seconds = [bare_step() for _ in range(6)]
    per_block = max(2, round(seconds / (2 * statistics.median(step_seconds[2:]) * n_blocks)))
    n_steps = (n_blocks + 1) * per_block
    # At most 39 generated trajectories, and two epochs at least so that an epoch's end is counted.
    per_trajectory = _DEMONSTRATION_STEPS // 2 + _SEGMENT_STEPS
    n_episodes = min(39, max(2, n_steps * config.batch_size // (2 * per_trajectory)))
    n_windows = _DEMONSTRATION_STEPS + n_episodes * per_trajectory
    n_batches = -(-n_windows // config.batch_size)
    config = dataclasses.replace(config, epochs=-(-n_steps // n_batches))

    loop_seconds: list[float] = []
    bare_seconds: list[float] = []
    last = 0.0

    def between_steps(done: int, total: int, text: str) -> None:
        nonlocal last
        _synchronise(device)
        loop_seconds.append(time.perf_counter() - last)
        bare_seconds.append(bare_step())
        if done % per_block == 0:
            _say(f"{config.policy} step {done}/{total}")
        last = time.perf_counter()

    with tempfile.TemporaryDirectory() as scratch:
        dataset = _synthetic_dataset(Path(scratch) / "dataset", n_episodes)
        last = time.perf_counter()
        result = train(dataset, config, Path(scratch) / "skill", progress=between_steps)
    # The first block warms up.
    blocks = [slice(i * per_block, (i + 1) * per_block) for i in range(1, n_blocks + 1)]
    loop_images = n_windows / n_batches * config.history * per_block
    bare_images = config.batch_size * config.history * per_block
    loop = [loop_images / sum(loop_seconds[block]) for block in blocks]
    bare = [bare_images / sum(bare_seconds[block]) for block in blocks]
    ratios = [a / b for a, b in zip(loop, bare, strict=True)]
    return {
        "loop_images_per_second": statistics.median(loop),
        "bare_images_per_second": statistics.median(bare),
        "loop_over_bare": statistics.median(ratios),
        "loop_over_bare_range": [min(ratios), max(ratios)],
        "blocks": n_blocks,
        "steps_per_block": per_block,
        "batch_size": config.batch_size,
        "history": config.history,
        "image_size": config.image_size,
        "image_shift": config.image_shift,
        "device": result.device,
        "bfloat16": result.bfloat16,
        "threads": torch.get_num_threads(),
    }


def _stepper(config: TrainConfig, batches: Iterator[Batch]) -> Callable[[], float]:
    """A function that draws a batch, takes one step on it and returns the seconds of both."""
    device = resolve_device(config.device)
    bfloat16 = resolve_bfloat16(config.bfloat16, device)
    size = input_size((_RECORDED_SIZE, _RECORDED_SIZE), config.image_size)
    policy = build_policy(config, dict.fromkeys(config.cameras, size)).to(device).train()
    optimizer = make_optimizer(policy, config)

    def step() -> float:
        began = time.perf_counter()
        batch = next(batches)
        with torch.autocast(device.type, torch.bfloat16, enabled=bfloat16):
            loss = policy.loss(batch)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        _synchronise(device)
        return time.perf_counter() - began

    return step


def _synchronise(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _synthetic_dataset(path: Path, n_episodes: int, flat: bool = False) -> Dataset:
    """A dataset of 128x128 images, shaped as augmentation makes them.

    The images are noise, or `flat`: a plain one with a box in it, as easy to compress as any.
    """
    rng = np.random.default_rng(0)

    def images(n: int) -> NDArray[np.uint8]:
        if not flat:
            return rng.integers(0, 256, (n, 128, 128, 3), dtype=np.uint8)
        plain = np.empty((n, 128, 128, 3), np.uint8)
        plain[:] = rng.integers(0, 256, (n, 1, 1, 3), dtype=np.uint8)
        for image, (u, v) in zip(plain, rng.integers(0, 96, (n, 2)), strict=True):
            image[u : u + 32, v : v + 32] = 255 - image[0, 0]
        return plain

    def steps(n: int) -> Steps:
        commanded = np.tile(pose((0.4, 0.0, 0.3)), (n, 1, 1))
        commanded[:, :3, 3] += np.cumsum(rng.normal(0, 0.005, (n, 3)), 0)
        camera = CameraRecord(
            rgb=images(n),
            depth=np.zeros((n, 128, 128), np.float32),
            intrinsics=np.diag([128.0, 128.0, 1.0]),
            frame="tool",
            T_frame_camera=np.eye(4),
        )
        joints = np.zeros((n, 6))
        gripper = rng.uniform(0, 1, n)
        return Steps(
            joint_positions=joints,
            joint_velocities=joints,
            commanded_joint_positions=joints,
            measured_Ts_world_tool=commanded,
            commanded_Ts_world_tool=commanded,
            measured_gripper=gripper,
            commanded_gripper=gripper,
            contact_force=np.zeros(n),
            cameras={"wrist": camera},
        )

    n = _DEMONSTRATION_STEPS
    demonstration = Demonstration(
        task="synthetic",
        task_parameters={},
        robot="none",
        backend="none",
        steps=steps(n),
        timestamps=np.arange(n) / 10,
        body_Ts_world={},
        success=np.ones(n, bool),
        touching=((),) * n,
        raw_commands=np.zeros((3 * n, 7)),
        states=(),
        operator="none",
        device="none",
        seconds=0.0,
    )
    sha, key = demonstration.content_hash(), demonstration.steps.measured_Ts_world_tool[0]
    annotation = Annotation((PrecisionSphere(0, key, 0.1),), sha)
    episodes = (
        Episode(
            steps(_SEGMENT_STEPS),
            Provenance(sha, 0, 0, k, n // 2, key, 0, "sart", "paper"),
        )
        for k in range(n_episodes)
    )
    info = {"task": "synthetic", "seconds": 0.0}
    return write_dataset(path, [(demonstration, annotation)], episodes, info)


# --- training data ------------------------------------------------------------------------------


def bench_training_data(arguments: Sequence[str]) -> dict[str, Any]:
    """Training from the file of images: its memory, and images/s over a copy in memory.

    As many episodes as asked for are made up and read by `open_windows`, then steps are taken on
    random batches from its file; the peak of this process's memory so far, its
    imports included, is what is reported: all of it, and the part that no file backs. Only then the
    images are copied into memory, and steps on batches from the file and from the copy alternate,
    so that whatever else the machine does slows both; the ratios, of time that passed and of the
    processor's time, are medians over blocks of steps. `file_from_disk`: after the kernel was asked
    to drop what it keeps of the file.
    """
    parser = argparse.ArgumentParser(
        prog="bench.py training-data", description=bench_training_data.__doc__
    )
    parser.add_argument("--episodes", type=int, default=10_000, help=f"of {_SEGMENT_STEPS} steps")
    parser.add_argument("--policy", default="compact_mlp", help=", ".join(POLICIES))
    parser.add_argument("--image-size", type=int, default=64, help="[pixels]")
    parser.add_argument("--blocks", type=int, default=10, help="blocks of steps, for the median")
    parser.add_argument("--steps", type=int, default=20, help="of a block")
    parser.add_argument("--threads", type=int, help="torch's threads; its own choice if left out")
    parser.add_argument("--folder", type=Path, help="where the file goes; a temporary one")
    options = parser.parse_args(arguments)
    for name in ("episodes", "blocks", "steps"):
        check_positive(f"--{name}", getattr(options, name))
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    config = TrainConfig.for_policy(options.policy, image_size=options.image_size, device="cpu")
    window_config = WindowConfig(
        config.cameras, config.image_size, config.history, config.image_shift
    )
    peak_anonymous = 0
    with tempfile.TemporaryDirectory(dir=options.folder) as scratch:

        def reading(done: int, total: int) -> None:
            nonlocal peak_anonymous
            if done % 200 == 0 or done == total:
                peak_anonymous = max(peak_anonymous, _memory("RssAnon"))
                _say(f"read {done}/{total}")

        at_start = _memory("VmRSS")
        dataset = _synthetic_dataset(Path(scratch) / "dataset", options.episodes, flat=True)
        started = time.perf_counter()
        windows = open_windows(dataset, window_config, Path(scratch), reading)
        writing_seconds = time.perf_counter() - started
        file = Path(scratch) / FRAMES
        mapped_step = _stepper(config, _random_batches(config, windows))
        for _ in range(options.blocks * options.steps):
            mapped_step()
            peak_anonymous = max(peak_anonymous, _memory("RssAnon"))
        peak = _memory("VmHWM")

        copy = windows.to(torch.device("cpu"))
        steps = {"file": mapped_step, "copy": _stepper(config, _random_batches(config, copy))}
        steps["copy"]()
        walls: dict[str, list[float]] = {name: [] for name in ("file", "copy", "file_from_disk")}
        processors: dict[str, list[float]] = {name: [] for name in steps}
        for turn in range(options.blocks):
            for figures in (*walls.values(), *processors.values()):
                figures.append(0.0)
            for _ in range(options.steps):
                for name, step in steps.items():
                    began = time.process_time()
                    walls[name][-1] += step()
                    processors[name][-1] += time.process_time() - began
            _drop_from_cache(file, windows)
            walls["file_from_disk"][-1] = sum(mapped_step() for _ in range(options.steps))
            ratio = walls["copy"][-1] / walls["file"][-1]
            _say(f"block {turn + 1}/{options.blocks}: {ratio:.3f} of a copy")
        n_images = config.batch_size * config.history * options.steps
        ratios = [b / a for a, b in zip(walls["file"], walls["copy"], strict=True)]
        processor = [b / a for a, b in zip(processors["file"], processors["copy"], strict=True)]
        return {
            "episodes": options.episodes,
            "images": len(windows.gripper),
            "windows": int(windows.multiplicity.sum()),
            "file_gb": file.stat().st_size / 1e9,
            "writing_seconds": writing_seconds,
            "peak_memory_gb": {
                "at_start": at_start / 1e9,
                "anonymous": peak_anonymous / 1e9,
                "total": peak / 1e9,
            },
            "images_per_second": {
                name: n_images / statistics.median(seconds) for name, seconds in walls.items()
            },
            "file_over_copy": statistics.median(ratios),
            "file_over_copy_range": [min(ratios), max(ratios)],
            "file_over_copy_by_processor_time": statistics.median(processor),
            "policy": config.policy,
            "image_size": config.image_size,
            "image_shift": config.image_shift,
            "batch_size": config.batch_size,
            "blocks": options.blocks,
            "steps_per_block": options.steps,
            "threads": torch.get_num_threads(),
        }


def _random_batches(config: TrainConfig, windows: Windows) -> Iterator[Batch]:
    """Batches as the training loop draws them, epoch after epoch."""
    n_batches = math.ceil(int(windows.multiplicity.sum()) / config.batch_size)
    shared = get_policy(config.policy).shares_pictures
    for epoch in itertools.count():
        batches = epoch_batches(windows, config, epoch, n_batches)
        for i, (some, variation) in enumerate(batches):
            if i + 1 < n_batches:
                windows.will_need(batches[i + 1][0])
            yield windows.batch(some, variation, shared)


def _memory(name: str) -> int:
    """A figure of this process's memory [bytes], by its name in Linux's table."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) * 1024
    raise InvalidInput(f"{name}: not in /proc/self/status")


def _drop_from_cache(file: Path, windows: Windows) -> None:
    """Have the kernel forget what it keeps of a file in memory."""
    windows.frames.let_go()
    with open(file, "rb") as opened:
        os.posix_fadvise(opened.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


# --- datasets -----------------------------------------------------------------------------------

_OPEN = """
from sart_toolkit.data.dataset import load_dataset
from pathlib import Path
begin()
result = {"episodes": len(load_dataset(Path(sys.argv[1])))}
"""
_INFO = """
from sart_toolkit.cli import main
main(["info", sys.argv[1], "--json"])
result = {}
"""
_AUGMENT = """
from pathlib import Path
from bench import augmentation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
demonstration, annotation, make = augmentation(sys.argv[2], int(sys.argv[3]))
begin()
dataset = augment_demonstration(
    demonstration, annotation, make, Path(sys.argv[1]), AugmentConfig(int(sys.argv[4]))
)
result = {"kept": len(dataset)}
"""
_MEASURED = """
import json, sys, time
def begin():
    global started
    started = time.perf_counter(), time.process_time()
begin()
{}
result["seconds"] = time.perf_counter() - started[0]
result["processor_seconds"] = time.process_time() - started[1]
status = open("/proc/self/status").read()
# Of this program alone: what `getrusage` says counts the memory of the one that started it.
result["peak_mb"] = int(status.split("VmHWM:")[1].split()[0]) / 1024
print(json.dumps(result))
"""


def bench_dataset(arguments: Sequence[str]) -> dict[str, Any]:
    """Seconds and peak memory of opening a large dataset and of generating a small and a large one.

    The large dataset is synthetic: 20 steps an episode, 128x128 RGB-D, images that are easy to
    compress. Each figure is of a program of its own. Opening is `load_dataset` after its imports;
    `info` is the whole command, from its imports on.
    """
    parser = argparse.ArgumentParser(prog="bench.py dataset", description=bench_dataset.__doc__)
    parser.add_argument("--episodes", type=int, default=10_000, help="of the synthetic dataset")
    parser.add_argument("--n", type=int, nargs="+", default=[40, 400], help="trajectories")
    parser.add_argument("--task", default="peg_in_hole", help=", ".join(TASKS))
    parser.add_argument("--image-size", type=int, default=128, help="of augmentation [pixels]")
    options = parser.parse_args(arguments)
    check_positive("--episodes", options.episodes)
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "synthetic"
        started = time.perf_counter()
        _synthetic_dataset(path, options.episodes, flat=True)
        making = time.perf_counter() - started
        _say(f"{options.episodes} episodes made in {making:.0f} s")
        size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        figures: dict[str, Any] = {
            "episodes": options.episodes,
            "size_mb": size / 2**20,
            "making_seconds": making,
            "open": _measured(_OPEN, path),
            "info": _measured(_INFO, path),
            "augment": {},
        }
        for n in options.n:
            out = Path(scratch) / str(n)
            found = _measured(_AUGMENT, out, options.task, options.image_size, n)
            figures["augment"][str(n)] = found
            _say(f"augment --n {n}: {found['peak_mb']:.0f} MB, {found['seconds']:.0f} s")
    return figures


def _measured(work: str, *arguments: Any) -> dict[str, Any]:
    """What a program of its own says of its work, with its seconds and peak memory."""
    run = subprocess.run(
        [sys.executable, "-c", _MEASURED.format(work), *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])},
        capture_output=True,
        text=True,
    )
    if run.returncode:
        raise SartError(f"a measured program failed: {run.stderr.strip().splitlines()[-1]}")
    found: dict[str, Any] = json.loads(run.stdout.splitlines()[-1])
    return found


# --- formats ------------------------------------------------------------------------------------

_EXPORT = """
from pathlib import Path
from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.formats import get_format
from sart_toolkit.data.formats.format import about_dataset, trajectories_of
from sart_toolkit.data.formats.transfer import export_dataset
dataset = load_dataset(Path(sys.argv[1]))
about = about_dataset(dataset)
begin()
if sys.argv[2] == "raw":
    with open(sys.argv[3], "wb") as file:
        for trajectory in trajectories_of(dataset):
            for camera in trajectory.steps.cameras.values():
                file.write(camera.rgb.data)
                file.write(camera.depth.data)
else:
    export_dataset(dataset, get_format(sys.argv[2]), Path(sys.argv[3]), about)
result = {}
"""


def bench_formats(arguments: Sequence[str]) -> dict[str, Any]:
    """Bytes and time a frame of each export format, against raw images, and peak memory by size.

    Every export is a program of its own: it reads the dataset, joins trajectories and writes them
    whole. `raw`: the same with images and depth written to a file as they are. Memory is measured
    with the first of `--n` and with the last, which should make no difference.
    """
    parser = argparse.ArgumentParser(prog="bench.py formats", description=bench_formats.__doc__)
    parser.add_argument("--task", default="peg_in_hole", help=", ".join(TASKS))
    parser.add_argument("--image-size", type=int, default=128, help="[pixels]")
    parser.add_argument("--n", type=int, nargs="+", default=[10, 100], help="trajectories")
    options = parser.parse_args(arguments)
    figures: dict[str, Any] = {}
    demonstration, annotation, make = augmentation(options.task, options.image_size)
    with tempfile.TemporaryDirectory() as scratch:
        for n in options.n:
            path = Path(scratch) / str(n)
            config = AugmentConfig(n)
            dataset = augment_demonstration(demonstration, annotation, make, path, config)
            frames = sum(map(len, trajectories_of(dataset)))
            rows: dict[str, Any] = {"ours": {"bytes_per_frame": _bytes_in(path) / frames}}
            for name in ("raw", *FORMATS):
                suffix = "" if name == "raw" else get_format(name).suffix
                out = Path(scratch) / f"{n}_{name}{suffix}"
                found = _measured(_EXPORT, path, name, out)
                rows[name] = {
                    "bytes_per_frame": _bytes_in(out) / frames,
                    "frames_per_second": frames / found["seconds"],
                    "frames_per_processor_second": frames / found["processor_seconds"],
                    "peak_mb": found["peak_mb"],
                }
                _say(f"{name}, {n} trajectories: {rows[name]['bytes_per_frame']:.0f} bytes a frame")
            figures[str(n)] = {"frames": frames, **rows}
    return {"task": options.task, "image_size": options.image_size, "trajectories": figures}


def _bytes_in(path: Path) -> int:
    """Bytes of a file, or of all files in a directory."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


# --- augmentation -------------------------------------------------------------------------------


def bench_augment(arguments: Sequence[str]) -> dict[str, Any]:
    """Kept trajectories per second and simulated over wall time, RGB and depth kept, by processes.

    A whole call of the engine each time: the simulator, every attempt, writing the episodes; the
    numbers of processes take turns. `once_started` leaves the first tenth out, in which processes
    start and compute what each needs once.
    """
    parser = argparse.ArgumentParser(prog="bench.py augment", description=bench_augment.__doc__)
    parser.add_argument("--tasks", default="peg_in_hole", help=f"all, {', '.join(TASKS)}")
    parser.add_argument("--n", type=int, default=40, help="trajectories, the demonstration counts")
    parser.add_argument("--workers", type=int, nargs="+", default=[1], help="processes, e.g. 1 2")
    parser.add_argument("--image-size", type=int, default=128, help="[pixels]")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args(arguments)
    check_positive("--repeats", options.repeats)
    tasks = list(TASKS) if options.tasks == "all" else options.tasks.split(",")
    return {
        "by_task": {task: _augment_figures(task, options) for task in tasks},
        "n": options.n,
        "image_size": options.image_size,
        "repeats": options.repeats,
    }


def _augment_figures(task_name: str, options: argparse.Namespace) -> dict[str, Any]:
    task = get_task(task_name)
    demonstration, annotation, make = augmentation(task_name, options.image_size)
    whole: dict[int, list[float]] = {count: [] for count in options.workers}
    started: dict[int, list[float]] = {count: [] for count in options.workers}
    over_wall: list[float] = []
    times: list[tuple[int, float]] = []

    def progress(done: int, wanted: int, rejected: int) -> None:
        times.append((done, time.perf_counter()))

    for turn, count in itertools.product(range(options.repeats), options.workers):
        times.clear()
        with tempfile.TemporaryDirectory() as scratch:
            began = time.perf_counter()
            info = augment_demonstration(
                demonstration, annotation, make, Path(scratch) / "dataset",
                AugmentConfig(options.n), count, progress=progress, task=task,
            ).info  # fmt: skip
            seconds = time.perf_counter() - began
        (first, begin), (last, end) = times[len(times) // 10], times[-1]
        whole[count].append(info["n_kept"] / seconds)
        started[count].append((last - first) / (end - begin))
        over_wall.append(info["simulated_seconds"] / seconds / count)
        _say(
            f"{task_name}, turn {turn + 1}/{options.repeats}, processes {count}: "
            f"{whole[count][-1]:.2f} kept trajectories/s, {started[count][-1]:.2f} once started"
        )
    return {
        "kept_trajectories_per_second": _median_and_range(whole),
        "once_started": _median_and_range(started),
        "simulated_over_wall_a_process": statistics.median(over_wall),
        "kept": info["n_kept"],
        "attempted": info["n_attempted"],
        "rejections": info["rejections"],
    }


def _median_and_range(rates: dict[int, list[float]]) -> dict[str, dict[str, float]]:
    """The median and the range of the rates of each number of processes."""
    return {
        str(count): {"median": statistics.median(row), "min": min(row), "max": max(row)}
        for count, row in rates.items()
    }


def augmentation(
    task_name: str, image_size: int, backend: str = "pybullet"
) -> tuple[Demonstration, Annotation, BackendFactory]:
    """A demonstration of a task, its suggested spheres, and what makes its robot and scene."""
    task = get_task(task_name)
    robot = get_robot(task.robot)
    make = functools.partial(make_backend, backend, robot, task.scene, image_size)
    model = RobotModel(robot, task.scene.held)
    plan = task.plan(task.initial_state(model, Placement()))
    operator = ScriptedOperator(plan, np.random.default_rng(0))
    with closing(make()) as robot_in_scene:
        demonstration = record_demonstration(robot_in_scene, task, model, operator)
    world = ExactWorld(demonstration, robot, task.scene)
    return demonstration, suggest_annotation(demonstration, world), make


# --- planning -----------------------------------------------------------------------------------


def bench_plan(arguments: Sequence[str]) -> dict[str, Any]:
    """Segments drawn, planned and proved a second, nothing executed, as `sart augment --dry-run`.

    By task, the first tenth left out: what each process computes once, the robot's model and that
    of each waypoint, mostly comes there. `whole_call` counts all, with the start of the processes.
    Of one process also by its own time on the processor, which what else runs there hardly changes.
    """
    parser = argparse.ArgumentParser(prog="bench.py plan", description=bench_plan.__doc__)
    parser.add_argument("--tasks", default="all", help=f"all, {', '.join(TASKS)}")
    parser.add_argument("--n", type=int, default=1000, help="trajectories, of each task")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args(arguments)
    check_positive("--repeats", options.repeats)
    tasks = list(TASKS) if options.tasks == "all" else options.tasks.split(",")
    rates = {task: [_plan_rates(task, options) for _ in range(options.repeats)] for task in tasks}
    return {
        "proved_per_second": {
            task: statistics.median(row["proved_per_second"] for row in rows)
            for task, rows in rates.items()
        },
        "proved_per_second_range": {
            task: [pick(row["proved_per_second"] for row in rows) for pick in (min, max)]
            for task, rows in rates.items()
        },
        "whole_call": {
            task: statistics.median(row["whole_call"] for row in rows)
            for task, rows in rates.items()
        },
        "proved_per_processor_second": {
            task: statistics.median(row["proved_per_processor_second"] for row in rows)
            for task, rows in rates.items()
        }
        if options.workers == 1
        else None,
        "rejections": {task: rows[0]["rejections"] for task, rows in rates.items()},
        "n": options.n,
        "processes": options.workers,
        "repeats": options.repeats,
    }


def _plan_rates(task_name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Segments a second of one preview."""
    demonstration, annotation, _ = augmentation(task_name, 64)
    task = get_task(task_name)
    proved: list[tuple[int, float, float]] = []

    def progress(done: int, wanted: int, rejected: int) -> None:
        proved.append((done, time.perf_counter(), time.process_time()))

    with tempfile.TemporaryDirectory() as scratch:
        started = time.perf_counter()
        found = preview_sources(
            [(demonstration, annotation)], get_robot(task.robot), task.scene,
            get_backend("pybullet").tracking_error, Path(scratch) / "plan.jsonl",
            AugmentConfig(options.n), options.workers, progress=progress,
        )  # fmt: skip
        seconds = time.perf_counter() - started
    begin, end = proved[len(proved) // 10], proved[-1]
    done, wall, processor = (b - a for a, b in zip(begin, end, strict=True))
    _say(f"{task_name}: {done / wall:.0f} proved/s")
    return {
        "proved_per_second": done / wall,
        "proved_per_processor_second": done / processor,
        "whole_call": found.proved / seconds,
        "rejections": dict(found.rejections),
    }


# --- storage ------------------------------------------------------------------------------------


def bench_storage(arguments: Sequence[str]) -> dict[str, Any]:
    """How small images get and how long they take to write and read, by how they are stored.

    Images of generated episodes, by task and backend, in HDF5 files in memory, an image a chunk, by
    HDF5's own filters; `ours` is what the toolkit does. With the package `hdf5plugin` its filters
    too, which whoever opens such a file needs as well. PNG files stand beside; a depth image is
    float32 of metres, in `png_16_bit` tenths of a millimetre. `episode`: a whole one written, its
    hashes and flush to the disk counted, and read.
    """
    parser = argparse.ArgumentParser(prog="bench.py storage", description=bench_storage.__doc__)
    parser.add_argument("--tasks", default="peg_in_hole,toolbox_picking", help=", ".join(TASKS))
    parser.add_argument("--backends", default="pybullet,sapien", help=", ".join(BACKENDS))
    parser.add_argument("--image-size", type=int, default=128, help="[pixels]")
    parser.add_argument("--episodes", type=int, default=4, help="of each task and backend")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(arguments)
    for name in ("episodes", "repeats"):
        check_positive(f"--{name}", getattr(options, name))
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for task, backend in itertools.product(
            options.tasks.split(","), options.backends.split(",")
        ):
            name = f"{task} on {backend}"
            demonstration, annotation, make = augmentation(task, options.image_size, backend)
            config = AugmentConfig(options.episodes + 1)
            dataset = augment_demonstration(
                demonstration, annotation, make, Path(scratch) / name, config
            )
            episodes = list(dataset)
            figures[name] = {
                part: _codec_figures(
                    np.concatenate([getattr(e.steps.cameras["wrist"], part) for e in episodes]),
                    options.repeats,
                )
                for part in ("rgb", "depth")
            } | {"episode": _episode_figures(episodes, Path(scratch), options.repeats)}
            _say(f"{name}: {figures[name]['episode']['write_ms']:.1f} ms to write an episode")
    return {"image_size": options.image_size, "repeats": options.repeats, **figures}


def _codecs() -> dict[str, dict[str, Any]]:
    """What HDF5 is asked for, by a name."""
    found: dict[str, dict[str, Any]] = {
        "raw": {},
        "lzf": {"compression": "lzf"},
        "shuffle_lzf": {"compression": "lzf", "shuffle": True},
    }
    for level in (1, 4):
        found[f"gzip_{level}"] = {"compression": "gzip", "compression_opts": level}
        found[f"shuffle_gzip_{level}"] = found[f"gzip_{level}"] | {"shuffle": True}
    try:
        plugin = importlib.import_module("hdf5plugin")
    except ImportError:
        _say("hdf5plugin isn't installed: without its filters")
        return found
    return found | {
        "plugin_lz4": dict(plugin.LZ4()),
        "plugin_zstd_1": dict(plugin.Zstd(1)),
        "plugin_bitshuffle_lz4": dict(plugin.Bitshuffle(cname="lz4")),
        "plugin_bitshuffle_zstd": dict(plugin.Bitshuffle(cname="zstd", clevel=1)),
        "plugin_blosc_lz4": dict(plugin.Blosc(cname="lz4", clevel=5, shuffle=1)),
        "plugin_blosc_zstd": dict(plugin.Blosc(cname="zstd", clevel=1, shuffle=1)),
    }


def _codec_figures(frames: NDArray[Any], repeats: int) -> dict[str, Any]:
    """Of each way to store images: how much smaller they get, and microseconds an image."""
    codecs: dict[str, Callable[[], tuple[int, float, float]]] = {
        name: functools.partial(_through_hdf5, frames, functools.partial(_put_plain, filters))
        for name, filters in _codecs().items()
    }
    codecs["ours"] = functools.partial(
        _through_hdf5, frames, storage.put_frames, storage.get_frames
    )
    codecs["png"] = functools.partial(_through_png, frames, False)
    if frames.dtype == np.float32:
        codecs["png_16_bit"] = functools.partial(_through_png, frames, True)
    # In turn, so that whatever else the machine does slows all alike.
    turns = [{name: codec() for name, codec in codecs.items()} for _ in range(repeats)]
    return {
        name: {
            "ratio": frames.nbytes / turns[0][name][0],
            "write_us": 1e6 * statistics.median(turn[name][1] for turn in turns) / len(frames),
            "read_us": 1e6 * statistics.median(turn[name][2] for turn in turns) / len(frames),
        }
        for name in codecs
    }


def _put_plain(filters: dict[str, Any], file: h5py.File, name: str, frames: NDArray[Any]) -> None:
    file.create_dataset(name, data=frames, chunks=(1, *frames.shape[1:]), **filters)


def _through_hdf5(
    frames: NDArray[Any],
    put: Callable[[h5py.File, str, NDArray[Any]], None],
    get: Callable[[h5py.Dataset], NDArray[Any]] = lambda stored: stored[()],
) -> tuple[int, float, float]:
    """Bytes stored, and seconds to write and to read images."""
    content = io.BytesIO()
    started = time.perf_counter()
    with h5py.File(content, "w") as file:
        put(file, "images", frames)
    written = time.perf_counter()
    with h5py.File(content, "r") as file:
        n_bytes = file["images"].id.get_storage_size()
        opened = time.perf_counter()
        found = get(file["images"])
        read = time.perf_counter()
    if not np.array_equal(found, frames):
        raise SartError("storage: images aren't read back as they were written")
    return n_bytes, written - started, read - opened


def _through_png(frames: NDArray[Any], sixteen_bit: bool) -> tuple[int, float, float]:
    """Bytes of PNG files, and seconds to write and to read them; float32 as four channels."""
    if sixteen_bit:
        frames = np.round(1e4 * frames).astype(np.uint16)
    elif frames.dtype == np.float32:
        frames = frames.view(np.uint8).reshape(*frames.shape, 4)
    files = [io.BytesIO() for _ in frames]
    started = time.perf_counter()
    for file, frame in zip(files, frames, strict=True):
        Image.fromarray(frame).save(file, "png", compress_level=1)
    written = time.perf_counter()
    for file in files:
        np.asarray(Image.open(file))
    read = time.perf_counter()
    return sum(file.tell() for file in files), written - started, read - written


def _episode_figures(episodes: Sequence[Episode], folder: Path, repeats: int) -> dict[str, float]:
    """Milliseconds to write an episode's file and to read it, and its size."""
    writing, reading, sizes = [], [], []
    for turn, (i, episode) in itertools.product(range(repeats), enumerate(episodes)):
        path = folder / f"{turn}_{i}.h5"
        _, seconds = _timed(storage.save_episode, path, episode)
        writing.append(1e3 * seconds)
        reading.append(1e3 * _timed(storage.load_episode, path)[1])
        sizes.append(path.stat().st_size)
        path.unlink()
    return {
        "write_ms": statistics.median(writing),
        "read_ms": statistics.median(reading),
        "kilobytes": statistics.median(sizes) / 1000,
    }


# --- certificates -------------------------------------------------------------------------------

_NAIVE_POINTS = 11


class _Setting(NamedTuple):
    """Robot and scene with all in its place, for the certificate and for the independent check."""

    name: str
    placed: PlacedModel
    closest: ClosestPoints
    model: RobotModel
    scene: SceneSpec
    home: Array


def bench_certificate(arguments: Sequence[str]) -> dict[str, Any]:
    """Time and soundness of certificates on random straight segments, by scene.

    Every registered task's scene, its object placed again for every 50 segments, and five kinds of
    generated ones, another every 50 segments; half of the segments pass near something. Each
    verdict is held against PyBullet's closest points at many configurations of the same path, of
    standing meshes those of all triangles: a certified segment that collides there is unsound; one
    that isn't certified although it clears the margin by more than a millimetre everywhere is
    falsely rejected (into the hull of a mesh, for instance). Only the certificate is
    timed. For comparison coal's distances at 11 configurations of the path, and what they miss.
    """
    parser = argparse.ArgumentParser(
        prog="bench.py certificate", description=bench_certificate.__doc__
    )
    every = [*TASKS, *CLUTTER]
    parser.add_argument("--segments", type=int, default=3300, help="over all scenes")
    parser.add_argument("--scenes", default="all", help=f"all, or {','.join(every)}")
    parser.add_argument("--samples", type=int, default=500, help="of the independent check")
    parser.add_argument("--margin", type=float, default=AugmentConfig().margin, help="[m]")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    check_positive("--segments", options.segments)
    check_positive("--samples", options.samples)
    kinds = every if options.scenes == "all" else options.scenes.split(",")
    for kind in kinds:
        if kind not in every:
            raise unknown_name("scene", kind, every)
    rows: list[dict[str, Any]] = []
    for i, kind in enumerate(kinds):
        wanted = len(range(i, options.segments, len(kinds)))
        batches = -(-wanted // 50)
        for batch in range(batches):
            rng = np.random.default_rng([options.seed, every.index(kind), batch])
            setting = _setting(kind, rng)
            rows += _certified_rows(setting, min(50, wanted - 50 * batch), options, rng)
            setting.closest.close()
            _say(f"{kind}: {min(50 * (batch + 1), wanted)}/{wanted}")
    return {
        "segments": len(rows),
        "samples": options.samples,
        "margin_m": options.margin,
        **_certificate_figures(rows, options.margin),
        "scenes": {
            kind: _certificate_figures(
                [row for row in rows if row["scene"] == kind], options.margin
            )
            for kind in kinds
            if any(row["scene"] == kind for row in rows)
        },
        "surprises": [row for row in rows if row["unsound"]],
    }


def _setting(kind: str, rng: np.random.Generator) -> _Setting:
    """A task's scene at a random placement, or a generated one."""
    grasped: dict[str, Array] = {}
    if kind in TASKS:
        task = get_task(kind)
        robot = get_robot(task.robot)
        model = RobotModel(robot, task.scene.held)
        state = task.initial_state(model, task.sample_placement(rng))
        scene, Ts, gripper, home = task.scene, state.Ts_world_body, state.gripper, state.q
        # What stands between the fingers at the start is in the grasp.
        probe = CollisionModel(robot, scene).placed(Ts, gripper)
        fingers = robot.gripper.finger_links
        touching = [probe.names(k) for k, d in enumerate(probe.distances(home)) if d < 1e-3]
        T_tool_world = inverse(model.fk(home))
        grasped = {name: T_tool_world @ Ts[name] for name in scene.grasped(touching, fingers)}
    else:
        robot = get_robot("ur5e_2f85")
        scene = CLUTTER[kind](rng)
        model = RobotModel(robot)
        Ts = {body.name: body.T_world_body for body in scene.bodies}
        gripper, home = float(rng.uniform()), np.array(robot.home)
    standing = tuple(
        dataclasses.replace(body, T_world_body=Ts[body.name])
        for body in scene.bodies
        if body.name not in grasped
    )
    closest = ClosestPoints(robot, scene, joints_apart=2)
    closest.place(Ts, gripper, grasped)
    placed = CollisionModel(robot, scene).placed(Ts, gripper, grasped)
    return _Setting(kind, placed, closest, model, SceneSpec(standing), home)


def _certified_rows(
    setting: _Setting, count: int, options: argparse.Namespace, rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Random segments' certificates, their times, and what the independent check says.

    All are drawn first, then all certified: nothing else runs between two certificates.
    """
    margin = options.margin
    drawn = [_segment_path(setting, rng) for _ in range(count)]
    many, few = (np.linspace(0, 1, n) for n in (options.samples, _NAIVE_POINTS))
    # What is computed once for a scene in its place belongs to none of its segments.
    certify(setting.placed, drawn[0][1], margin)
    certified = [_timed(certify, setting.placed, path, margin) for _, path in drawn]
    naive = [
        _timed(_naively_clear, setting.placed, path.positions(few), margin) for _, path in drawn
    ]
    rows = []
    for (segment, path), (certificate, seconds), (naive_clear, naive_seconds) in zip(
        drawn, certified, naive, strict=True
    ):
        _, nearest = setting.closest.nearest_along(path.positions(many), within=0.05)
        rows.append(
            {
                "scene": setting.name,
                "beside": bool(segment.beside),
                "verdict": certificate.verdict,
                "seconds": seconds,
                "checks": certificate.checks,
                "clearance": certificate.clearance,
                "true_clearance": nearest.distance,
                "true_pair": [nearest.a, nearest.b],
                "unsound": certificate.verdict == "free" and nearest.distance < 0,
                "naive_clear": naive_clear,
                "naive_seconds": naive_seconds,
                "q_start": segment.q_start.tolist(),
                "T_world_end": segment.T_world_end.tolist(),
            }
        )
    return rows


def _segment_path(setting: _Setting, rng: np.random.Generator) -> tuple[Segment, SplinePath]:
    """A random segment that starts clear, and its joint path."""
    while True:
        segment = random_segment(
            setting.model,
            setting.home,
            rng,
            setting.scene,
            accept_start=lambda q: not setting.closest.collides(q),
        )
        ends = segment.T_world_start, segment.T_world_end
        try:
            return segment, straight_line(setting.model, segment.q_start, *ends, 2.0).path
        except (Unreachable, MotionRejected):
            continue


def _naively_clear(placed: PlacedModel, configurations: Array, margin: float) -> bool:
    return all(placed.distances(q).min() >= margin for q in configurations)


def _timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """What a function returns, and its seconds."""
    started = time.perf_counter()
    result = function(*arguments)
    return result, time.perf_counter() - started


def _certificate_figures(rows: Sequence[dict[str, Any]], margin: float) -> dict[str, Any]:
    milliseconds = [1e3 * row["seconds"] for row in rows]
    clear = [row for row in rows if row["true_clearance"] > margin + 1e-3]
    colliding = [row for row in rows if row["true_clearance"] < 0]
    return {
        "near_something": sum(row["beside"] for row in rows) / len(rows),
        "free": sum(row["verdict"] == "free" for row in rows),
        "collision": sum(row["verdict"] == "collision" for row in rows),
        "undecided": sum(row["verdict"] == "undecided" for row in rows),
        "truly_colliding": len(colliding),
        "unsound": sum(row["unsound"] for row in rows),
        "clear_by_1_mm_more": len(clear),
        "falsely_rejected": sum(row["verdict"] != "free" for row in clear),
        "milliseconds": {
            "median": statistics.median(milliseconds),
            "p90": float(np.percentile(milliseconds, 90)),
            "p99": float(np.percentile(milliseconds, 99)),
        },
        "distances_median": statistics.median(row["checks"] for row in rows),
        "at_11_points": {
            "milliseconds_median": statistics.median(1e3 * row["naive_seconds"] for row in rows),
            "collisions_missed": sum(row["naive_clear"] for row in colliding),
        },
    }


# --- control steps ------------------------------------------------------------------------------


def bench_step(arguments: Sequence[str]) -> dict[str, Any]:
    """Control steps/s with an RGB-D image at each, by task and backend, and the parts' costs.

    The scripted operator carries out its demonstration; only what the backend does is counted:
    measuring, drawing the wrist camera's image, and 1/30 s of physics. One thread.
    """
    parser = argparse.ArgumentParser(prog="bench.py step", description=bench_step.__doc__)
    parser.add_argument("--tasks", default="all", help=f"all, or {','.join(TASKS)}")
    parser.add_argument("--backends", default="all", help=f"all, or {','.join(BACKENDS)}")
    parser.add_argument("--image-size", type=int, default=128, help="[pixels]")
    parser.add_argument("--repeats", type=int, default=3, help="demonstrations, for the median")
    options = parser.parse_args(arguments)
    check_positive("--repeats", options.repeats)
    tasks = list(TASKS) if options.tasks == "all" else options.tasks.split(",")
    backends = list(BACKENDS) if options.backends == "all" else options.backends.split(",")
    figures: dict[str, Any] = {}
    for name in tasks:
        task = get_task(name)
        robot = get_robot(task.robot)
        for kind in backends:
            backend = make_backend(kind, robot, task.scene, options.image_size)
            turns = [_drive(backend, task, turn) for turn in range(options.repeats)]
            backend.close()
            medians = np.median(turns, axis=0)
            figures[f"{name}/{kind}"] = {
                "control_steps_per_second": 1 / medians.sum(),
                "image_ms": medians[0] * 1e3,
                "physics_ms": medians[1] * 1e3,
            }
            _say(f"{name}/{kind}: {1 / medians.sum():.0f} control steps/s")
    return {
        "image_size": options.image_size,
        "repeats": options.repeats,
        "cells": figures,
        "slowest": {
            kind: min(figures[f"{name}/{kind}"]["control_steps_per_second"] for name in tasks)
            for kind in backends
        },
    }


def _drive(backend: Backend, task: Task, seed: int) -> tuple[float, float]:
    """Mean seconds of an image and of a control period's physics in one demonstration."""
    model = RobotModel(backend.robot, task.scene.held)
    state = task.initial_state(model, Placement())
    operator = ScriptedOperator(task.plan(state), np.random.default_rng(seed))
    controller = ToolController(model)
    require(backend, Resets, "each demonstration begins at the task's start").reset(state)
    controller.reset(state.q)
    image, physics = [], []
    while True:
        started = time.perf_counter()
        seen = backend.observe(("wrist",))
        image.append(time.perf_counter() - started)
        command = operator.read(seen)
        if command.stop:
            return statistics.mean(image), statistics.mean(physics)
        desired = apply_motion(
            controller.commanded_T_world_tool, command.velocity / backend.rates.control_hz
        )
        (q,) = controller.move(desired, seen.T_world_tool, 1)
        started = time.perf_counter()
        backend.command(q, command.gripper)
        backend.step()
        physics.append(time.perf_counter() - started)


# --- images -------------------------------------------------------------------------------------


def bench_draw(arguments: Sequence[str]) -> dict[str, Any]:
    """Milliseconds of an RGB-D image by the wrist camera at the task's start, by task and renderer.

    Rays, as the PyBullet backend draws; PyBullet's own TinyRenderer, called directly on the same
    meshes; SAPIEN, where it can draw. Images of all alternate, one thread.
    """
    parser = argparse.ArgumentParser(prog="bench.py draw", description=bench_draw.__doc__)
    parser.add_argument("--tasks", default="all", help=f"all, or {','.join(TASKS)}")
    parser.add_argument("--image-size", type=int, default=128, help="[pixels]")
    parser.add_argument("--repeats", type=int, default=40, help="images of each, for the median")
    options = parser.parse_args(arguments)
    check_positive("--repeats", options.repeats)
    size = options.image_size
    figures: dict[str, Any] = {}
    for name in list(TASKS) if options.tasks == "all" else options.tasks.split(","):
        task = get_task(name)
        robot = get_robot(task.robot)
        state = task.initial_state(RobotModel(robot, task.scene.held), Placement())
        opened = {kind: make_backend(kind, robot, task.scene, size) for kind in BACKENDS}
        drawing = {kind: b for kind, b in opened.items() if not b.no_images}
        renderers: dict[str, Callable[[], Any]] = {
            {"pybullet": "rays"}.get(kind, kind): functools.partial(
                require(backend, Draws, "it is measured").draw,
                *(state, backend.cameras["wrist"], size, size),
            )
            for kind, backend in drawing.items()
        }
        renderers["tiny_renderer"] = _tiny_renderer(robot, task.scene, state, size)
        seconds: dict[str, list[float]] = {kind: [] for kind in renderers}
        for turn in range(options.repeats + 1):
            for kind, draw in renderers.items():
                taken = _timed(draw)[1]
                # The first reads meshes.
                if turn:
                    seconds[kind].append(taken)
        for backend in opened.values():
            backend.close()
        figures[name] = {kind: 1e3 * statistics.median(each) for kind, each in seconds.items()}
        _say(f"{name}: " + ", ".join(f"{k} {v:.1f} ms" for k, v in figures[name].items()))
    return {"image_size": size, "repeats": options.repeats, "image_ms": figures}


def _tiny_renderer(
    robot: RobotSpec, scene: SceneSpec, state: SceneState, size: int
) -> Callable[[], Any]:
    """What has PyBullet's TinyRenderer draw a state by the wrist camera."""
    import pybullet as p
    from pybullet_utils.bullet_client import BulletClient

    model = RobotModel(robot, scene.held)
    client: Any = BulletClient(p.DIRECT)
    arm = client.loadURDF(str(model.urdf), useFixedBase=True)
    positions = dict(zip(robot.arm_joints, state.q, strict=True))
    positions |= robot.gripper.joint_positions(state.gripper)
    for joint in range(client.getNumJoints(arm)):
        name = client.getJointInfo(arm, joint)[1].decode()
        client.resetJointState(arm, joint, positions.get(name, 0.0))
    for body in scene.bodies:
        for shape in body.shapes:
            mesh = body_meshes([shape])[0]
            T = state.Ts_world_body[body.name]
            drawn = client.createVisualShape(
                p.GEOM_MESH,
                vertices=mesh.vertices.tolist(),
                indices=mesh.triangles.ravel().tolist(),
                rgbaColor=shape.rgba,
            )
            at, turned = T[:3, 3].tolist(), Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
            client.createMultiBody(0, -1, drawn, at, turned)
    camera = next(camera for camera in robot.cameras if camera.name == "wrist")
    T_world_camera = model.fk(state.q, camera.frame) @ camera.T_frame_camera
    # OpenGL's camera looks along -z with y up.
    view = inverse(T_world_camera @ np.diag([1.0, -1.0, -1.0, 1.0]))
    projection = p.computeProjectionMatrixFOV(camera.fov_y_deg, 1.0, camera.near, camera.far)

    def draw() -> Any:
        return client.getCameraImage(
            size,
            size,
            view.T.ravel().tolist(),
            projection,
            shadow=0,
            flags=p.ER_NO_SEGMENTATION_MASK,
            renderer=p.ER_TINY_RENDERER,
        )

    return draw


# --- the annotator ------------------------------------------------------------------------------

# As a person would go: step, add, try radii, jump on, suggest, remove, undo.
_KEYS = (
    "Right", "Enter", "Up", "+", "-", "Down", "M", "C", "Enter", "+", "F", "N", "P", "Left", "S",
    "Right", "Right", "Page Down", "Enter", "Backspace", "Z", "Y", "Page Up", "Right", "Home",
)  # fmt: skip
# "+" by the key beside it, which means the same there: xdotool takes half a second for a shift.
_X_NAMES = {"Enter": "Return", "Backspace": "BackSpace", "+": "equal", "-": "minus",
            "Page Down": "Page_Down", "Page Up": "Page_Up"}  # fmt: skip


def bench_annotate(arguments: Sequence[str]) -> dict[str, Any]:
    """Milliseconds from a key to what it changes, in the annotator's window and session.

    `image`: from xdotool's start to the first image of the screen that differs, at 1280 x 800
    on a screen of its own; each key once all has come to rest. `session`: what a key does, with
    all that the window asks the session afterwards; `cold` with nothing computed ahead.
    """
    parser = argparse.ArgumentParser(prog="bench.py annotate", description=bench_annotate.__doc__)
    parser.add_argument("--points", type=int, default=200_000, help="of the cloud")
    parser.add_argument("--repeats", type=int, default=2, help=f"of the {len(_KEYS)} keys")
    parser.add_argument("--window", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    check_positive("--points", options.points)
    check_positive("--repeats", options.repeats)
    if options.window is not None:
        _show_window(options.window, options.points)
        return {}
    # Open3D is an extra, which the other benchmarks do without.
    from sart_toolkit.annotate.open3d_window import WindowConfig

    task = get_task("peg_in_hole")
    robot = get_robot(task.robot)
    model = RobotModel(robot, task.scene.held)
    plan = task.plan(task.initial_state(model, Placement()))
    operator = ScriptedOperator(plan, np.random.default_rng(0))
    backend = make_backend("pybullet", robot, task.scene, 128)
    demonstration = record_demonstration(backend, task, model, operator)
    backend.close()
    scene = ExactWorld(demonstration, robot, task.scene)
    keys = _KEYS * options.repeats
    cold = _session_ms(_session(demonstration, scene), keys)
    session = _session(demonstration, scene)
    while session.prepare():
        pass
    with tempfile.TemporaryDirectory() as scratch:
        save_demonstration(Path(scratch) / "demo.h5", demonstration)
        images = _image_ms(Path(scratch), options.points, keys, WindowConfig())
    return {
        "image_ms": _spread(images),
        "session_ms": _spread(_session_ms(session, keys)),
        "session_cold_ms": _spread(cold),
        "points": options.points,
        "points_while_moving": WindowConfig().moving_points,
        "keys": len(keys),
        "open3d": importlib.metadata.version("open3d-cpu"),
    }


def bench_page(arguments: Sequence[str]) -> dict[str, Any]:
    """Milliseconds from a key to what it changes, on the annotator's page in a browser.

    `words`: until the panel says something else; `image`: until the browser has drawn two more
    frames, the second of which shows what the first was told. Chromium without a window, 1400 x
    900, on this machine; each key once what is computed ahead is computed.
    """
    parser = argparse.ArgumentParser(prog="bench.py page", description=bench_page.__doc__)
    parser.add_argument("--repeats", type=int, default=2, help=f"of the {len(_KEYS)} keys")
    options = parser.parse_args(arguments)
    check_positive("--repeats", options.repeats)
    with socket.create_server(("127.0.0.1", 0)) as found:
        port = found.getsockname()[1]
    figures = []
    with tempfile.TemporaryDirectory() as scratch, Browser(1400, 900) as browser:
        demo = shutil.copy(asset("peg_in_hole/demo.h5"), scratch)
        command = [sys.executable, "-m", "sart_toolkit", "annotate", demo, "--web"]
        program = subprocess.Popen(
            [*command, "--port", str(port)], stderr=subprocess.PIPE, text=True
        )
        assert program.stderr is not None
        try:
            next(line for line in program.stderr if "ssh" in line)
            browser.open_page(f"http://127.0.0.1:{port}")
            browser.centre("button", "quit")
            time.sleep(5.0)
            for key in _KEYS * options.repeats:
                name = {"Page Down": "PageDown", "Page Up": "PageUp"}.get(key, key)
                if key in ("Left", "Right", "Up", "Down"):
                    name = f"Arrow{key}"
                words, image = browser.run(_TO_CHANGE % json.dumps(name))
                _say(f"{key}: {words:.0f} ms, {image:.0f} ms")
                figures.append((words, image))
                time.sleep(1.0)
        finally:
            program.kill()
            program.communicate()
    return {
        "words_ms": _spread([words for words, _ in figures]),
        "image_ms": _spread([image for _, image in figures]),
        "keys": len(figures),
        "viser": importlib.metadata.version("viser"),
    }


_TO_CHANGE = """new Promise((resolve, reject) => {
  const said = () => Array.from(document.querySelectorAll('.sart')).map(e => e.innerHTML).join();
  const before = said(), start = performance.now();
  setTimeout(() => reject('nothing changed within 20 s'), 20000);
  const observer = new MutationObserver(() => {
    if (said() === before) return;
    observer.disconnect();
    const words = performance.now() - start;
    requestAnimationFrame(() => requestAnimationFrame(
      () => resolve([words, performance.now() - start])));
  });
  observer.observe(document.body, {subtree: true, childList: true, characterData: true});
  document.documentElement.dispatchEvent(new KeyboardEvent('keydown', {key: %s, bubbles: true}));
})"""


def _session(demonstration: Demonstration, scene: ExactWorld) -> AnnotationSession:
    session = AnnotationSession(demonstration, scene)
    _ = session.clearances
    return session


def _session_ms(session: AnnotationSession, keys: Sequence[str]) -> list[float]:
    """For each key the time of what it does and of all that is shown afterwards."""
    figures = []
    for key in keys:
        started = time.perf_counter()
        session.press(key)
        session.state()
        for sphere in session.spheres:
            session.verdict(sphere)
        if session.sphere is not None:
            session.ghosts(session.sphere)
        figures.append(1e3 * (time.perf_counter() - started))
    return figures


def _image_ms(folder: Path, points: int, keys: Sequence[str], config: WindowConfig) -> list[float]:
    """For each key the time until the screen shows another image."""
    figures = []
    with Desktop(config.width, config.height) as screen:
        program = [sys.executable, __file__, "annotate", "--window", str(folder)]
        screen.start([*program, "--points", str(points)])
        screen.window("sart annotate")
        for n, key in enumerate(keys, 1):
            before = _at_rest(screen, 3 * config.idle_s)
            started = time.perf_counter()
            screen.key(_X_NAMES.get(key, key if len(key) > 1 else key.lower()))
            while screen.screenshot().tobytes() == before:
                if time.perf_counter() - started > 10.0:
                    raise InvalidInput(f"{key}: changed nothing on the screen within 10 s")
                # Looking all the time would take the renderer's time.
                time.sleep(0.01)
            figures.append(1e3 * (time.perf_counter() - started))
            _say(f"key {n}/{len(keys)}: {key} {figures[-1]:.0f} ms")
    return figures


def _at_rest(screen: Desktop, seconds: float) -> bytes:
    """The screen once nothing has changed on it for so long."""
    image, since = screen.screenshot().tobytes(), time.perf_counter()
    while time.perf_counter() - since < seconds:
        time.sleep(0.1)
        now = screen.screenshot().tobytes()
        if now != image:
            image, since = now, time.perf_counter()
    return image


def _show_window(folder: Path, points: int) -> None:
    """The annotator with so many points: those of the images, several times with some noise."""
    from sart_toolkit.annotate.open3d_window import annotate_in_window

    demonstration = load_demonstration(folder / "demo.h5")
    task, robot = get_task(demonstration.task), get_robot(demonstration.robot)
    session = _session(demonstration, ExactWorld(demonstration, robot, task.scene))
    cloud = fuse_cloud(demonstration, robot, task.scene.held)
    rng = np.random.default_rng(0)
    rows = rng.integers(len(cloud), size=points)
    noisy = cloud.points[rows] + rng.normal(0, cloud.config.voxel / 2, (points, 3))
    many = dataclasses.replace(
        cloud, points=noisy, colours=cloud.colours[rows], behind=cloud.behind[rows]
    )
    annotate_in_window(session, robot, task.scene, many)


def _spread(milliseconds: Sequence[float]) -> dict[str, float]:
    return {
        "median": statistics.median(milliseconds),
        "p95": float(np.percentile(milliseconds, 95)),
        "max": max(milliseconds),
    }


# --- the table, the machine ---------------------------------------------------------------------

BENCHMARKS: dict[str, Callable[[Sequence[str]], dict[str, Any]]] = {
    "annotate": bench_annotate,
    "augment": bench_augment,
    "certificate": bench_certificate,
    "dataset": bench_dataset,
    "draw": bench_draw,
    "formats": bench_formats,
    "page": bench_page,
    "plan": bench_plan,
    "step": bench_step,
    "storage": bench_storage,
    "train": bench_train,
    "training-data": bench_training_data,
}


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of running one benchmark, whose JSON object is printed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", help=", ".join(BENCHMARKS))
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="see NAME --help")
    parsed = parser.parse_args(arguments)
    try:
        if parsed.name not in BENCHMARKS:
            raise unknown_name("benchmark", parsed.name, BENCHMARKS)
        machine = doctor.machine()
        figures = BENCHMARKS[parsed.name](parsed.arguments)
    except SartError as error:
        _say(f"error: {error}")
        return 2
    report = {
        "benchmark": parsed.name,
        "figures": figures,
        "machine": machine,
        "versions": library_versions(),
    }
    print(json.dumps(report))
    return 0


if __name__ == "__main__":
    sys.exit(main())
