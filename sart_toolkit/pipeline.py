"""The stages from a demonstration to a report, and all of them in sequence: what `sart` calls.

Robots, tasks, backends, strategies and policies are given as names, references (see `registry`) or
objects. Later stages find those of a recording by the references that it holds, unless others are
given. What can be refused is refused before torch or a simulator is imported, which is why these
imports stand in the functions.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import logging
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, Protocol, TypeVar

import numpy as np

from sart_toolkit.augment import STRATEGIES
from sart_toolkit.backends import BACKENDS, DEFAULT_BACKEND, get_backend, is_cell, make_backend
from sart_toolkit.data.dataset import Dataset, load_dataset
from sart_toolkit.data.formats import FORMATS, get_format
from sart_toolkit.data.records import (
    DEFAULT_RATES,
    Annotation,
    Demonstration,
    Rates,
    Recording,
    Referring,
    library_versions,
)
from sart_toolkit.data.schemas import DatasetFile, EvaluationFile, RunFile, TrainingFile
from sart_toolkit.data.storage import (
    OutputLock,
    check_writable,
    clear_directory,
    load_annotation,
    load_demonstration,
    read_json,
    save_annotation,
    save_demonstration,
    write_json,
)
from sart_toolkit.doctor import machine, source_commit
from sart_toolkit.errors import (
    InvalidInput,
    Mismatch,
    MissingFile,
    OutputExists,
    UnknownName,
    unknown_name,
)
from sart_toolkit.learn.policies import POLICIES
from sart_toolkit.record.devices import DEVICES, make_device
from sart_toolkit.registry import check_known, reference_to
from sart_toolkit.robots import ROBOTS, get_robot
from sart_toolkit.robots.spec import check_image_size
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.workers import Workers

if TYPE_CHECKING:
    from sart_toolkit.annotate.suggest import SuggestConfig
    from sart_toolkit.augment.config import AugmentConfig
    from sart_toolkit.augment.engine import Watch
    from sart_toolkit.augment.preview import Preview
    from sart_toolkit.augment.strategies import Strategy
    from sart_toolkit.augment.validate import Validation
    from sart_toolkit.backends.hardware import HardwareBackend
    from sart_toolkit.backends.interface import Backend, BackendFactory
    from sart_toolkit.benchmark.plans import Plan
    from sart_toolkit.calibrate.calibration import Calibration
    from sart_toolkit.collision.sensor import CloudConfig, SensorErrors
    from sart_toolkit.collision.world import CollisionWorld
    from sart_toolkit.data.formats.format import Arm, Format, Given
    from sart_toolkit.data.writer import Sources
    from sart_toolkit.evaluate.deploy import Deployment, Judge
    from sart_toolkit.evaluate.rollout import Film, Rollout
    from sart_toolkit.learn.policy import Policy
    from sart_toolkit.learn.skill import Skill, SkillConfig
    from sart_toolkit.learn.training import TrainConfig
    from sart_toolkit.poses import Array
    from sart_toolkit.record.session import Device, DeviceSetup, SessionConfig
    from sart_toolkit.robots.model import RobotModel
    from sart_toolkit.robots.spec import ImageSize, RobotSpec
    from sart_toolkit.scenes.spec import SceneSpec
    from sart_toolkit.tasks.task import Placement, Task

    RobotLike = str | RobotSpec
    TaskLike = str | Task | type[Task]
    BackendLike = str | type[Backend]
    FormatLike = str | Format | type[Format]
    Steer = Callable[[Path, DeviceSetup, Device, Placement, SessionConfig], Demonstration]

_log = logging.getLogger(__name__)
_TABLES: Mapping[str, Mapping[str, str]] = {
    "backend": BACKENDS,
    "device": DEVICES,
    "format": FORMATS,
    "policy": POLICIES,
    "robot": ROBOTS,
    "strategy": STRATEGIES,
    "task": TASKS,
}
Kind = Literal["robot", "task", "backend"]
# How often an operator may fail to reach the goal.
_ATTEMPTS = 3


class Progress(Protocol):
    """Called with a stage's name, what is done of the total (if known), and a few words."""

    def __call__(
        self, stage: str, done: float, total: float | None = None, text: str = "", /
    ) -> None: ...


def _silent(stage: str, done: float, total: float | None = None, text: str = "", /) -> None:
    pass


def check_names(**references: Any) -> None:
    """Return if what is named exists: `check_names(task="peg_in_hole", robot=None)`.

    Raises:
        UnknownName: there is no such name, module or file.
        MissingFile: there is no such file of a cell.
    """
    for kind, reference in references.items():
        if kind == "backend" and is_cell(reference):
            if not Path(reference).is_file():
                raise MissingFile(f"backend {reference}: no such file; check the path")
            continue
        check_known(kind, reference, _TABLES[kind])


# --- what a recording notes ---------------------------------------------------------------------


def noted(
    demonstration: Demonstration,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    backend: BackendLike | None = None,
) -> Demonstration:
    """The demonstration with the references of what is given in place of those that it holds."""
    given = {"task": task, "robot": robot, "backend": backend}
    found = {
        kind: reference_to(kind, value, _TABLES[kind])
        for kind, value in given.items()
        if value is not None
    }
    references = {kind: reference for kind, reference in found.items() if reference is not None}
    return dataclasses.replace(demonstration, references={**demonstration.references, **references})


Found = TypeVar("Found")


def _find(source: Referring, kind: Kind, given: Any, get: Callable[[Any], Found]) -> Found:
    """What is given, or else what a recording notes."""
    if given is not None:
        return get(given)
    try:
        return get(source.reference(kind))
    except UnknownName as error:
        raise UnknownName(
            f"{error}; it is what the recording notes: name another with --{kind} REF"
        ) from error


def task_of(source: Referring, task: TaskLike | None = None) -> Task:
    """The task of a recording or skill, or the one given.

    Raises:
        UnknownName: it can't be found.
        Mismatch: a mesh of its scene is another than when the demonstration was recorded.
    """
    found = _find(source, "task", task, get_task)
    if isinstance(source, Demonstration):
        known, now = source.task_parameters.get("meshes", {}), found.scene.mesh_digests
        for name in sorted({*known, *now}):
            if known.get(name) != now.get(name):
                raise Mismatch(
                    f"body {name!r} of {found.name}: its mesh is another than when the "
                    "demonstration was recorded; restore the file, or record again"
                )
    return found


def robot_of(source: Referring, robot: RobotLike | None = None) -> RobotSpec:
    """The robot of a recording or skill, or the one given.

    Raises:
        UnknownName: it can't be found.
    """
    return _find(source, "robot", robot, get_robot)


def backend_maker(
    source: Referring,
    image_size: ImageSize,
    rates: Rates = DEFAULT_RATES,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    backend: BackendLike | None = None,
) -> BackendFactory:
    """Makes the backend of a recording or skill with its robot in its scene; picklable.

    Both look as they did when the recording was made.

    Raises:
        UnknownName: the robot, the task or the backend can't be found.
        InvalidInput: the appearance that the recording notes is none.
    """
    spec, scene = setting_of(source, task, robot)
    made = _find(source, "backend", backend, get_backend)
    return functools.partial(make_backend, made, spec, scene, image_size, rates)


def setting_of(
    source: Referring, task: TaskLike | None = None, robot: RobotLike | None = None
) -> tuple[RobotSpec, SceneSpec]:
    """The robot and the scene of a recording or skill, as they looked when it was made."""
    spec, scene = robot_of(source, robot), task_of(source, task).scene
    if isinstance(source, Demonstration) and "appearance" in source.task_parameters:
        from sart_toolkit.scenes.appearance import Appearance

        appearance = Appearance.from_json(source.task_parameters["appearance"])
        spec, scene = appearance.applied(spec, scene)
    return spec, scene


def image_size_of(demonstration: Demonstration) -> tuple[int, int]:
    """Width and height of its images [pixels].

    Raises:
        InvalidInput: it holds none.
    """
    for camera in demonstration.steps.cameras.values():
        height, width = camera.rgb.shape[1:3]
        return width, height
    raise InvalidInput("the demonstration holds no images; record it with a camera")


def _image_size_of_skill(skill: SkillConfig) -> tuple[int, int]:
    """Width and height [pixels] of the images that a skill was shown."""
    height, width = skill.cameras[skill.training.cameras[0]].size
    return width, height


def _checked_size(image_size: ImageSize) -> tuple[int, int]:
    size = check_image_size(image_size)
    if min(size) < 16:
        raise InvalidInput(f"image_size: expected at least 16 pixels, got {image_size}")
    return size


def _check(demonstration: Demonstration, robot: RobotSpec, name: str = "demonstration") -> None:
    """Return if a demonstration can be learned from: `check_recording`."""
    from sart_toolkit.record.checks import check_recording

    check_recording(demonstration, robot, name=name)


# --- the stages ---------------------------------------------------------------------------------

_P = ParamSpec("_P")
_R = TypeVar("_R")


def _alone(stage: Callable[_P, _R]) -> Callable[_P, _R]:
    """The stage, holding the lock of its output `out` from its first check to its last write."""
    signature = inspect.signature(stage)

    @functools.wraps(stage)
    def alone(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with OutputLock(signature.bind(*args, **kwargs).arguments["out"]):
            return stage(*args, **kwargs)

    return alone


@_alone
def record(
    task: TaskLike,
    out: Path,
    *,
    robot: RobotLike | None = None,
    backend: BackendLike = DEFAULT_BACKEND,
    device: str | Callable[[DeviceSetup], Device] = "scripted",
    steer: Steer | None = None,
    by_hand: Collection[str] = (),
    frame: Literal["world", "tool"] = "world",
    operator: str = "person",
    max_seconds: float = 120.0,
    placement: Literal["middle", "random"] = "middle",
    yaw_deg: float = 0.0,
    vary_appearance: bool = False,
    cameras: Sequence[str] = ("wrist",),
    image_size: ImageSize = 128,
    seed: int = 0,
    overwrite: bool = False,
    progress: Progress = _silent,
) -> Demonstration:
    """One demonstration, recorded and saved in the file `out`.

    Args:
        task: what is shown.
        out: HDF5 file to write.
        robot: the task's own if left out.
        backend: where it is shown.
        device: what steers.
        steer: follows a device that a person holds, and saves the recording in the path given.
        by_hand: flags that mean nothing to any other device, which are refused with one.
        frame: what a person's directions are fixed to at first.
        operator: who steers, where it is a person.
        max_seconds: the longest it may take [s].
        placement: where the object stands in its range.
        yaw_deg: a random placement is also turned within ± this [deg].
        vary_appearance: whether colours, light and the wrist camera's mounting vary.
        cameras: whose images are recorded.
        image_size: width and height of images [pixels]; one number for a square.
        seed: of all that is random.
        overwrite: whether `out` may be replaced.
        progress: called with the seconds recorded.

    Raises:
        UnknownName: a name or reference leads to nothing.
        InvalidInput: options don't fit each other, a value is not acceptable, or what was recorded
            can't be learned from (`check_recording`).
        Mismatch: the goal was not reached.
        RobotStopped: a real robot stopped; what was recorded until then is beside `out`.
        OutputExists, CannotWrite: `out` can't be written.
    """
    check_names(task=task, robot=robot, backend=backend, device=device)
    size = _checked_size(image_size)
    if yaw_deg and placement == "middle":
        raise InvalidInput("--yaw-deg: turns random placements only; add --placement random")
    check_writable(out, overwrite)
    from sart_toolkit.record.session import DeviceSetup, SessionConfig, record_demonstration
    from sart_toolkit.robots.model import RobotModel
    from sart_toolkit.scenes.appearance import Appearance
    from sart_toolkit.tasks.task import Placement

    found = get_task(task)
    spec, scene = get_robot(robot or found.robot), found.scene
    found.check_operable(yaw_deg)
    rng = np.random.default_rng(seed)
    at = found.sample_placement(rng, yaw_deg) if placement == "random" else Placement()
    references = {
        "task": reference_to("task", task if isinstance(task, str) else found, TASKS),
        "robot": reference_to("robot", robot or found.robot, ROBOTS),
        "backend": reference_to("backend", backend, BACKENDS),
    }
    config = SessionConfig(
        tuple(cameras),
        max_seconds,
        references={k: v for k, v in references.items() if v is not None},
        appearance=Appearance((seed, 1)) if vary_appearance else None,
    )
    if config.appearance is not None:
        spec, scene = config.appearance.applied(spec, scene)
    with closing(make_backend(backend, spec, scene, size)) as made:
        model = RobotModel(made.robot, made.scene.held)
        setup = DeviceSetup(
            made, found, model, found.initial_state(model, at), rng, frame, operator
        )
        steered = make_device(device, setup)
        config = dataclasses.replace(config, guided=steered.guides)
        if steered.guides and "frame" in by_hand:
            raise InvalidInput("--frame: a hand moves the arm itself; leave it out")
        if steered.interactive:
            if steer is None:
                raise InvalidInput(
                    f"device {steered.name!r}: is for a person's hands; record with `sart record`"
                )
            return steer(out, setup, steered, at, config)
        for flag in by_hand:
            raise InvalidInput(
                f"--{flag}: is for a device that a person holds; add --device keyboard, say"
            )
        demonstration = record_demonstration(
            made, found, model, steered, at, seed, config, lambda t: progress("record", t),
            functools.partial(_keep_stopped, out),
        )  # fmt: skip
    achieved = found.achieved(demonstration.success, demonstration.rates.record_hz)
    if demonstration.judged_by == "task" and not achieved:
        raise Mismatch("the demonstration did not reach the goal; record again with another --seed")
    _check(demonstration, made.robot)
    save_demonstration(out, demonstration)
    return demonstration


def _keep_stopped(out: Path, demonstration: Demonstration) -> None:
    """Save what was recorded until a robot stopped, as `demo.stopped.h5` beside `demo.h5`."""
    path = out.with_suffix(f".stopped{out.suffix}")
    save_demonstration(path, demonstration)
    _log.warning("%d waypoints were recorded until then: %s", len(demonstration), path)


def record_several(
    task: TaskLike,
    out: Path,
    count: int,
    *,
    seed: int = 0,
    overwrite: bool = False,
    progress: Progress = _silent,
    **options: Any,
) -> list[Demonstration]:
    """Demonstrations of one task, recorded one after the other and saved in directory `out`.

    Those that are there are kept: called again after an interruption it resumes.

    Args:
        task: what is shown.
        out: directory; `demo00.h5` and so on are written.
        count: how many; each has a seed of its own, drawn from `seed`.
        seed: of all that is random.
        overwrite: whether those that are there may be replaced.
        progress: called with the seconds recorded of each.
        options: of `record`.

    Raises:
        InvalidInput: `count` is not positive, or as `record`.
        UnknownName, Mismatch, CannotWrite: as `record`; an operator that doesn't reach the goal has
            three attempts.
        OutputExists: a file there holds a demonstration of another task or seed.
    """
    if count < 1:
        raise InvalidInput(f"count: expected at least 1, got {count}")
    name = get_task(task).name
    found = []
    for i in range(count):
        path = demonstration_path(out, i)
        sequences = (np.random.SeedSequence([seed, i, k]) for k in range(_ATTEMPTS))
        seeds = [int(sequence.generate_state(1)[0]) for sequence in sequences]
        if path.exists() and not overwrite:
            demonstration = load_demonstration(path)
            # What a person steered has no seed.
            if demonstration.task != name or demonstration.seed not in (None, *seeds):
                raise OutputExists(
                    f"{path}: holds another demonstration; add --overwrite or choose another --out"
                )
            found.append(demonstration)
            continue
        for own in seeds:
            try:
                found.append(
                    record(task, path, seed=own, overwrite=overwrite, progress=progress, **options)
                )
                break
            except Mismatch as error:
                if own == seeds[-1]:
                    raise
                _log.warning("demonstration %d: %s; trying another seed", i, error)
    return found


def demonstration_path(directory: Path, i: int) -> Path:
    """Where the i-th of several demonstrations is."""
    return directory / f"demo{i:02d}.h5"


def mounting_error(demonstration: Demonstration) -> tuple[float, float]:
    """How far [m] and [deg] recorded cameras may be from where they are said to be.

    As the file of the cell that the demonstration notes has it, the largest of its cameras; 0 where
    it notes no cell.

    Raises:
        MissingFile, BrokenFile, InvalidInput: the cell's file can't be read.
    """
    try:
        cell = getattr(get_backend(demonstration.reference("backend")), "cell", None)
    except UnknownName:
        return 0.0, 0.0
    recorded = demonstration.steps.cameras
    parts = [part for name, part in cell.cameras.items() if name in recorded] if cell else []
    return (
        max((part.hand_eye_mm / 1e3 for part in parts), default=0.0),
        max((part.hand_eye_deg for part in parts), default=0.0),
    )


def world_of(
    demonstration: Demonstration,
    source: Literal["scene", "cloud"] = "scene",
    unknown: Literal["behind", "free"] = "behind",
    slip_tolerance: float = 0.005,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    sensor: SensorErrors | None = None,
) -> CollisionWorld:
    """Where the obstacles of a demonstration are, from its scene or from its images alone.

    `sensor`: with "cloud", what its images may be off by; if left out, by what the demonstration's
    cell has of where its cameras are (`mounting_error`).
    """
    from sart_toolkit.collision import make_world
    from sart_toolkit.collision.sensor import CloudConfig, SensorErrors

    _check_sensor(source, sensor)
    spec, scene = robot_of(demonstration, robot), task_of(demonstration, task).scene
    if sensor is None and source == "cloud":
        sensor = SensorErrors(*mounting_error(demonstration))
    cloud = CloudConfig(unknown=unknown, sensor=sensor or SensorErrors())
    return make_world(source, demonstration, spec, scene, slip_tolerance, cloud)


def suggest_config(
    demonstration: Demonstration,
    backend: BackendLike | None = None,
    margin: float | None = None,
    **options: Any,
) -> SuggestConfig:
    """How radii are suggested for a demonstration, its `margin` [m] by the backend if left out.

    The backend is the one that the demonstration notes, if no other is asked for. What was imported
    may note one that isn't ours; then the margin is `SuggestConfig`'s own.

    Raises:
        UnknownName: the backend asked for can't be found.
        InvalidInput: a value is not acceptable.
    """
    from sart_toolkit.annotate.suggest import SuggestConfig

    if margin is not None:
        return SuggestConfig(margin=margin, **options)
    try:
        found = _find(demonstration, "backend", backend, get_backend)
    except UnknownName:
        if backend is not None:
            raise
        return SuggestConfig(**options)
    return SuggestConfig.for_tracking_error(found.tracking_error, **options)


@_alone
def suggest(
    demo: Path,
    out: Path,
    *,
    waypoints: tuple[int, ...] = (),
    source: Literal["scene", "cloud"] = "scene",
    unknown: Literal["behind", "free"] = "behind",
    sensor: SensorErrors | None = None,
    slip_tolerance: float = 0.005,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    backend: BackendLike | None = None,
    overwrite: bool = False,
    progress: Progress = _silent,
    **options: Any,
) -> Annotation:
    """Precision spheres suggested for a demonstration's file, saved in the file `out`.

    Args:
        demo: the demonstration.
        out: JSON file to write.
        waypoints: key waypoints; chosen to tile the free part if left out.
        source: what is known of obstacles.
        unknown: with "cloud": what space behind what was seen counts as.
        sensor: with "cloud": what the images may be off by, see `world_of`.
        slip_tolerance: how far what is grasped may move in the grasp [m].
        task, robot, backend: in place of those that the demonstration notes.
        overwrite: whether `out` may be replaced.
        progress: called with the waypoints done.
        options: of `SuggestConfig`; without a `margin`, what `backend`'s tracking error needs.

    Raises:
        MissingFile, BrokenFile: the demonstration can't be read.
        UnknownName: task or robot can't be found.
        InvalidInput: it can't be learned from (`check_recording`).
        OutputExists, CannotWrite: `out` can't be written.
    """
    check_names(task=task, robot=robot, backend=backend)
    demonstration = load_demonstration(demo)
    check_writable(out, overwrite)
    _check(demonstration, robot_of(demonstration, robot), str(demo))
    from sart_toolkit.annotate.suggest import suggest_annotation

    config = suggest_config(demonstration, backend, **options)
    world = world_of(demonstration, source, unknown, slip_tolerance, task, robot, sensor)
    n = len(demonstration)
    annotation = suggest_annotation(
        demonstration, world, waypoints or None, config,
        lambda t: progress("suggest", t + 1, n),
    )  # fmt: skip
    progress("suggest", n, n)
    save_annotation(out, annotation)
    return annotation


def augment(
    demo: Path | Sequence[Path],
    annotation: Path | Sequence[Path],
    out: Path,
    *,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    backend: BackendLike | None = None,
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Progress = _silent,
    sensor: SensorErrors | None = None,
    ask: Callable[[str], None] | None = None,
    watch: Callable[[Sources, AugmentConfig], Watch] | None = None,
    **options: Any,
) -> Dataset:
    """Trajectories generated from demonstrations' and annotations' files, in directory `out`.

    Args:
        demo: the demonstration, or several of one task.
        annotation: its precision spheres, or those of several in any order; none where the strategy
            needs none.
        out: directory to write; an interrupted generation resumes.
        task, robot, backend: in place of those that the demonstrations note.
        workers: how many processes, or `Workers` elsewhere.
        overwrite: whether `out` may be replaced.
        progress: called with the trajectories kept.
        sensor: with `obstacles` "cloud", what the images may be off by; if left out, what the
            annotation says, where its spheres were suggested from the images.
        ask: where the robot can't be reset: shows a person what to do, returns when it is done.
        watch: called with what is generated from, and how; what it returns is called with each
            attempt's key and outcome, see `augment_sources`.
        options: of `AugmentConfig`. Without `n`, a strategy that draws nothing takes the
            demonstrations that there are.

    Raises:
        MissingFile, BrokenFile: a file can't be read.
        UnknownName: task, robot or backend can't be found.
        Mismatch: an annotation belongs to none of the demonstrations, or these look different.
        InvalidInput, MissingCapability, OutputExists, CannotWrite: as `augment_sources`.
    """
    sources, config = _asked_for(demo, annotation, task, robot, backend, sensor, options)
    from sart_toolkit.augment.engine import augment_sources

    first = sources[0][0]
    size, rates = image_size_of(first), first.rates
    make = backend_maker(first, size, rates, task, robot, backend)
    return augment_sources(
        sources, make, out, config, workers, overwrite,
        lambda kept, wanted, rejected: progress("augment", kept, wanted, f"{rejected} rejected"),
        ask, task_of(first, task), None if watch is None else watch(sources, config),
    )  # fmt: skip


@_alone
def preview(
    demo: Path | Sequence[Path],
    annotation: Path | Sequence[Path],
    out: Path,
    *,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    backend: BackendLike | None = None,
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Progress = _silent,
    sensor: SensorErrors | None = None,
    **options: Any,
) -> Preview:
    """What `augment` with the same arguments would attempt, planned and proved, in a file `out`.

    Nothing is executed and no backend is made, so that it may be looked at before a robot moves.

    Args:
        demo, annotation: as for `augment`.
        out: JSON lines: the settings, then each attempt with its pose and certificate.
        task, robot, backend: in place of those that the demonstrations note.
        workers: how many processes, or `Workers` elsewhere.
        overwrite: whether `out` may be replaced.
        progress: called with the segments proved.
        sensor: as for `augment`.
        options: of `AugmentConfig`.

    Raises:
        MissingFile, BrokenFile: a file can't be read.
        UnknownName: task, robot or backend can't be found.
        Mismatch: an annotation belongs to none of the demonstrations, or these look different.
        InvalidInput, OutputExists, CannotWrite: as `preview_sources`.
    """
    check_writable(out, overwrite)
    sources, config = _asked_for(demo, annotation, task, robot, backend, sensor, options)
    from sart_toolkit.augment.executors import executor_name
    from sart_toolkit.augment.preview import preview_sources

    first = sources[0][0]
    made = _find(first, "backend", backend, get_backend)
    # What is proved depends on how it is to be executed.
    execution = executor_name(
        config.execution, made, [demonstration for demonstration, _ in sources]
    )
    return preview_sources(
        sources, *setting_of(first, task, robot), made.tracking_error, out,
        dataclasses.replace(config, execution=execution), workers, overwrite,
        lambda proved, wanted, rejected: progress("plan", proved, wanted, f"{rejected} rejected"),
    )  # fmt: skip


def _asked_for(
    demo: Path | Sequence[Path],
    annotation: Path | Sequence[Path],
    task: TaskLike | None,
    robot: RobotLike | None,
    backend: BackendLike | None,
    sensor: SensorErrors | None,
    options: dict[str, Any],
) -> tuple[list[tuple[Demonstration, Annotation | None]], AugmentConfig]:
    """What `augment` generates from, and how.

    Raises:
        MissingFile, BrokenFile: a file can't be read.
        UnknownName: task, robot or backend can't be found.
        Mismatch: an annotation belongs to none of the demonstrations, or these look different.
        InvalidInput: an option is not acceptable.
    """
    strategy = options.get("strategy", "sart")
    check_names(task=task, robot=robot, backend=backend, strategy=strategy)
    demos = [demo] if isinstance(demo, Path) else list(demo)
    read = [load_demonstration(path) for path in demos]
    for path, demonstration in zip(demos, read, strict=True):
        _check(demonstration, robot_of(demonstration, robot), str(path))
    sources = _matched(read, [annotation] if isinstance(annotation, Path) else annotation)
    sources = [(noted(d, task, robot, backend), spheres) for d, spheres in sources]
    annotated = [a for _, a in sources if a is not None]
    from sart_toolkit.augment import get_strategy
    from sart_toolkit.augment.config import AugmentConfig

    draws = get_strategy(strategy).draws
    if not draws:
        options.setdefault("n", len(sources))
    elif len({str(d.task_parameters.get("appearance")) for d, _ in sources}) > 1:
        raise Mismatch(
            "the demonstrations' scenes look different (--vary-appearance), and segments are seen "
            "in one; record them with the same --seed, or make a dataset of each"
        )
    _check_sensor(options.get("obstacles"), sensor)
    if options.get("obstacles") == "cloud" and "cloud" not in options and annotated:
        options["cloud"] = _cloud_of(annotated[0], sensor)
    config = AugmentConfig(**options)
    for demonstration, spheres in sources:
        if spheres is not None:
            _warn_of_unproved(demonstration, spheres, config, task, robot)
    return sources, config


def _matched(
    demonstrations: Sequence[Demonstration], annotations: Sequence[Path]
) -> list[tuple[Demonstration, Annotation | None]]:
    """Demonstrations, each with the annotation that names it.

    Raises:
        MissingFile, BrokenFile: an annotation can't be read.
        Mismatch: an annotation names none of them, or two name one, or a demonstration is there
            twice.
    """
    hashes = [demonstration.content_hash() for demonstration in demonstrations]
    if len(set(hashes)) < len(hashes):
        raise Mismatch("the same demonstration is given twice; leave one out")
    found: dict[str, Annotation] = {}
    for path in annotations:
        spheres = load_annotation(path)
        if spheres.demonstration_hash in found:
            raise Mismatch(f"{path}: a second annotation of one demonstration; leave one out")
        if spheres.demonstration_hash not in hashes:
            # Says which, and what to do about it.
            spheres.check_matches(demonstrations[0])
        found[spheres.demonstration_hash] = spheres
    return [(d, found.get(own)) for d, own in zip(demonstrations, hashes, strict=True)]


def _check_sensor(source: str | None, sensor: SensorErrors | None) -> None:
    """Return if no sensor is given but for obstacles from images."""
    if sensor is not None and source != "cloud":
        raise InvalidInput("sensor: is about the recorded RGB-D, not the scene; leave it out")


def _cloud_of(annotation: Annotation, sensor: SensorErrors | None) -> CloudConfig:
    """How images become a cloud, as an annotation says, with another sensor if one is given."""
    from sart_toolkit.collision.sensor import CloudConfig

    settings = annotation.settings.get("cloud")
    cloud = CloudConfig() if settings is None else CloudConfig.from_json(settings)
    return cloud if sensor is None else dataclasses.replace(cloud, sensor=sensor)


def _warn_of_unproved(
    demonstration: Demonstration,
    annotation: Annotation,
    config: AugmentConfig,
    task: TaskLike | None,
    robot: RobotLike | None,
) -> None:
    """Name the spheres whose radius no certificate backs; segments from them may be rejected."""
    from sart_toolkit.annotate.verdict import needs_verdict, unproved_spheres

    annotation.check_matches(demonstration)
    if not any(map(needs_verdict, annotation.spheres)):
        return
    world = world_of(
        demonstration, config.obstacles, slip_tolerance=config.slip_tolerance, task=task,
        robot=robot, unknown=config.cloud.unknown,
        sensor=config.cloud.sensor if config.obstacles == "cloud" else None,
    )  # fmt: skip
    for sphere in unproved_spheres(annotation, world, config.margin):
        _log.warning("sphere not proved clear: %s; segments from it may be rejected", sphere)


def validate(
    dataset: Path,
    *,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    progress: Progress = _silent,
) -> Validation:
    """What came of proving a dataset's segments again.

    Args:
        dataset: directory from `augment`.
        task, robot: in place of those that its demonstration notes.
        progress: called with the episodes done.

    Raises:
        MissingFile, BrokenFile, Mismatch: as `validate_dataset`.
        UnknownName: task or robot can't be found.
    """
    check_names(task=task, robot=robot)
    demonstration = load_dataset(dataset).sources[0].demonstration
    from sart_toolkit.augment.validate import validate_dataset

    return validate_dataset(
        dataset, robot_of(demonstration, robot), task_of(demonstration, task).scene,
        lambda done, wanted: progress("validate", done, wanted),
    )  # fmt: skip


def replay(
    dataset: Path,
    *,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    backend: BackendLike | None = None,
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Progress = _silent,
) -> dict[str, Any]:
    """Whether a dataset's trajectories lead to the goal, also in `replay.json` in its directory.

    Args:
        dataset: directory from `augment`.
        task, robot, backend: in place of those that its demonstrations note.
        workers: how many processes, or `Workers` elsewhere.
        overwrite: whether an earlier result may be replaced.
        progress: called with the trajectories done.

    Raises:
        MissingFile, BrokenFile, MissingCapability, InvalidInput, OutputExists, Mismatch,
        CannotWrite: as `replay_dataset`.
        UnknownName: task, robot or backend can't be found.
    """
    check_names(task=task, robot=robot, backend=backend)
    demonstration = load_dataset(dataset).sources[0].demonstration
    from sart_toolkit.augment.trajectories import replay_dataset

    make = backend_maker(demonstration, 16, demonstration.rates, task, robot, backend)
    return replay_dataset(
        dataset, task_of(demonstration, task), make, workers, overwrite,
        lambda done, wanted, failed: progress("replay", done, wanted, f"{failed} failed"),
    )  # fmt: skip


def merge(
    datasets: Sequence[Path], out: Path, *, overwrite: bool = False, progress: Progress = _silent
) -> Dataset:
    """One dataset, in directory `out`, of several of one task and robot.

    Args:
        datasets: directories from `augment`, `merge` or `split`.
        out: directory to write; an interrupted merge resumes.
        overwrite: whether a dataset in `out` may be replaced.
        progress: called with the episodes done.

    Raises:
        MissingFile, BrokenFile: a dataset can't be read.
        InvalidInput, Mismatch, OutputExists, CannotWrite: as `merge_datasets`.
    """
    from sart_toolkit.data.combine import merge_datasets

    found = [load_dataset(path) for path in datasets]
    return merge_datasets(found, out, overwrite, lambda *counts: progress("merge", *counts))


def split(
    dataset: Path,
    out: Path,
    *,
    parts: Mapping[str, float] | None = None,
    n: int | None = None,
    by_source: bool = False,
    seed: int = 0,
    overwrite: bool = False,
    progress: Progress = _silent,
) -> dict[str, Dataset]:
    """Parts of a dataset as datasets of their own, by their names.

    Args:
        dataset: directory from `augment`, `merge` or `split`.
        out: directory to write; an interrupted split resumes.
        parts: the fraction of the episodes that each part gets, by its name; written to `out/NAME`.
        n: one part of so many trajectories, written to `out` itself.
        by_source: a part for each demonstration, written to `out/demoNN`.
        seed: of which episodes `parts` get.
        overwrite: whether datasets that are there may be replaced.
        progress: called with the episodes done.

    Raises:
        MissingFile, BrokenFile: the dataset can't be read.
        InvalidInput: not exactly one of `parts`, `n` and `by_source` is given; or as
            `split_dataset` and `shorten_dataset`.
        OutputExists, CannotWrite: as these.
    """
    from sart_toolkit.data.combine import shorten_dataset, split_dataset, split_sources

    if (parts is not None) + (n is not None) + by_source != 1:
        raise InvalidInput("split: expected one of parts, n and by_source; give just one")
    found = load_dataset(dataset)

    def shown(done: int, total: int) -> None:
        progress("split", done, total)

    if parts is not None:
        return split_dataset(found, out, parts, seed, overwrite, shown)
    if n is not None:
        return {"": shorten_dataset(found, out, n, overwrite, shown)}
    return split_sources(found, out, overwrite, shown)


def export(
    dataset: Path,
    out: Path,
    format: FormatLike,
    *,
    instruction: str | None = None,
    depth: bool = True,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    overwrite: bool = False,
    progress: Progress = _silent,
) -> dict[str, Any]:
    """What was written when a dataset, or a demonstration, is exported to a format of the field.

    Args:
        dataset: directory from `augment`, `merge` or `split`, or a demonstration's file.
        out: the file or directory to write.
        format: how; see `data.formats`.
        instruction: the task in a sentence; the first of the task's docstring if left out, or its
            name in words where the task can't be found.
        depth: whether depth images are written.
        task: in place of the one that the recording notes.
        robot: likewise.
        overwrite: whether an earlier export may be replaced.
        progress: called with the trajectories done.

    Raises:
        UnknownName: no such format, or the task or robot that is given can't be found.
        MissingExtra: the format needs a library that isn't installed.
        MissingFile, BrokenFile, Mismatch, InvalidInput, OutputExists, CannotWrite: as
            `export_dataset`.
    """
    check_names(format=format, task=task, robot=robot)
    found = load_dataset(dataset) if Path(dataset).is_dir() else load_demonstration(dataset)
    from sart_toolkit.data.formats.format import about_dataset
    from sart_toolkit.data.formats.transfer import export_dataset

    made = get_format(format)
    first = found if isinstance(found, Demonstration) else found.sources[0].demonstration
    try:
        words = (task_of(first, task).__doc__ or "").partition("\n")[0].rstrip(".")
    except UnknownName:
        if task is not None:
            raise
        words = ""
    try:
        joints = robot_of(first, robot).arm_joints
    except UnknownName:
        if robot is not None:
            raise
        joints = ()
    about = about_dataset(found, instruction or words, joints, depth)
    export_dataset(found, made, out, about, overwrite, lambda *counts: progress("export", *counts))
    return {
        "format": made.name,
        "instruction": about.instruction,
        "trajectories": about.n_trajectories,
        "bytes": _size(Path(out)),
    }


def _size(path: Path) -> int:
    """Bytes of a file, or of all files in a directory."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def import_recordings(
    path: Path,
    out: Path,
    format: FormatLike | None = None,
    *,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    gripper_range: tuple[float, float] | None = None,
    calibrations: Sequence[Calibration] = (),
    intrinsics: Mapping[str, Array] | None = None,
    cameras: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
    rotation: str | None = None,
    pose_frame: str | None = None,
    episode: int | None = None,
    overwrite: bool = False,
    progress: Progress = _silent,
) -> list[Path]:
    """The demonstrations' files that are made of recordings in a format of the field.

    Args:
        path: a recording, or a directory of several.
        out: the HDF5 file to write; for a directory, the directory of as many.
        format: what it is; found out if left out.
        task: what it is of, where the file doesn't say so.
        robot: likewise.
        gripper_range: what the file has for an open and for a closed gripper, where it doesn't say.
        calibrations: of cameras, where the file says neither mounting nor intrinsics.
        intrinsics: `(3, 3)` [pixels] by camera, where it doesn't say them.
        cameras: which to take, our name of each with the file's; all by their own if left out.
        columns: where a LeRobot dataset has `joints` or `tool_pose`, `gripper`, and these after
            `commanded_`, each as `COLUMN[A:B]`.
        rotation: how it has the rotations of `tool_pose`: rotvec, rpy, wxyz, xyzw or 6d.
        pose_frame: whose pose `tool_pose` is in the robot's base, a link of its URDF, or "tool".
        episode: the one to take of several, in the file `out`.
        overwrite: whether earlier files may be replaced.
        progress: called with the recordings done.

    Raises:
        UnknownName: the format, the task, the robot, a camera, a column or the frame can't be
            found.
        MissingFile, BrokenFile: it can't be read, or is of no format that is read.
        InvalidInput: the format isn't read, or something is said neither by the file nor here.
        OutputExists, CannotWrite: as `check_writable` and `save_demonstration`.
    """
    check_names(format=format, task=task, robot=robot)
    path, out = Path(path), Path(out)
    if not path.exists():
        raise MissingFile(f"{path}: no such file or directory; check the path")
    check_writable(out, overwrite)
    from sart_toolkit.data.formats.format import reader_of

    reader, found = reader_of(path, None if format is None else get_format(format))
    if episode is not None:
        if not 0 <= episode < len(found):
            raise InvalidInput(f"episode: expected 0 to {len(found) - 1}, got {episode}")
        found = [found[episode]]
    given = dataclasses.replace(
        _given(task, robot, pose_frame, calibrations, intrinsics or {}),
        gripper_range=gripper_range,
        camera_names=cameras or {},
        columns=columns or {},
        rotation=rotation,
    )
    single = episode is not None or found == [path]
    paths = [out] if single else [demonstration_path(out, i) for i in range(len(found))]
    for i, (recording, target) in enumerate(zip(found, paths, strict=True)):
        with OutputLock(target):
            save_demonstration(target, reader.read(recording, given))
        progress("import", i + 1, len(found))
    return paths


def _given(
    task: TaskLike | None,
    robot: RobotLike | None,
    pose_frame: str | None,
    calibrations: Sequence[Calibration],
    intrinsics: Mapping[str, Array],
) -> Given:
    """What a person says of a recording, with the kinematics of the robot."""
    from sart_toolkit.data.formats.format import Given

    given = {"task": task, "robot": robot}
    found = {k: reference_to(k, v, _TABLES[k]) for k, v in given.items() if v is not None}
    said: dict[str, Any] = {
        "references": {kind: ref for kind, ref in found.items() if ref is not None},
        "cameras": {},
        "intrinsics": {},
    }
    if task is not None:
        said["task"] = get_task(task).name
    if robot is not None:
        from sart_toolkit.robots.model import RobotModel

        model = RobotModel(get_robot(robot))
        said |= {"robot": model.spec.name, "arm": _arm(model, pose_frame)}
        said["cameras"] |= model.mounted_cameras()
    elif pose_frame is not None:
        raise InvalidInput("--pose-frame: is a frame of the robot; add --robot REF")
    # What was measured comes before what the robot's specification says.
    for calibration in calibrations:
        said["cameras"][calibration.camera] = calibration.frame, calibration.T_frame_camera
        said["intrinsics"][calibration.camera] = calibration.intrinsics_of
    for name, K in intrinsics.items():
        if name in said["intrinsics"]:
            raise InvalidInput(f"--camera-intrinsics {name}: --calibration says them; leave it out")
        said["intrinsics"][name] = functools.partial(_constant, K)
    return Given(**said)


def _constant(K: Array, width: int, height: int) -> Array:
    return K


def _arm(model: RobotModel, pose_frame: str | None) -> Arm:
    """A robot's kinematics, and where the tool is in a frame of its URDF."""
    from sart_toolkit.data.formats.format import Arm
    from sart_toolkit.poses import inverse

    home = np.array(model.spec.home)
    T_frame_tool = None
    if pose_frame is not None:
        frame = model.spec.tool_frame if pose_frame == "tool" else pose_frame
        if model.mount_of(frame) != "tool":
            raise InvalidInput(
                f"--pose-frame {pose_frame}: doesn't move with the tool; name the flange or a link "
                "beyond it"
            )
        T_frame_tool = inverse(model.fk(home, frame)) @ model.fk(home)
    return Arm(model.fk, model.ik, home, model.spec.T_world_base, T_frame_tool)


def check_export(path: Path, format: FormatLike) -> Sequence[str]:
    """What a reader of a format would fail on in what is said to be of it; empty if all is well.

    Raises:
        UnknownName: no such format.
        MissingFile: there is nothing.
        MissingExtra: the format needs a library that isn't installed.
    """
    check_names(format=format)
    if not Path(path).exists():
        raise MissingFile(f"{path}: no such file or directory; check the path")
    return get_format(format).problems(path)


@_alone
def train_policy(
    dataset: Path,
    out: Path,
    policy: str | type[Policy] | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = _silent,
    **options: Any,
) -> TrainConfig:
    """A skill trained on a dataset's directory, in directory `out`; how it was trained.

    Args:
        dataset: directory from `augment`.
        out: directory to write; an interrupted training resumes.
        policy: what is trained; what the dataset's strategy is for if left out.
        overwrite: whether a skill in `out` may be replaced, or an interrupted training forgotten.
        progress: called with the steps done.
        options: of `TrainConfig`; the policy's own where left out or None.

    Raises:
        MissingFile, BrokenFile: the dataset can't be read.
        UnknownName, InvalidInput: an option is not acceptable, or a demonstration can't be learned
            from (`check_recording`).
        OutputExists, CannotWrite: `out` can't be written.
    """
    check_writable(out / "config.json", overwrite)
    generated, config = _training(dataset, policy, options)
    from sart_toolkit.learn.skill import save_skill
    from sart_toolkit.learn.training import train

    if overwrite and (out / "config.json").exists():
        clear_directory(out, "config.json", overwrite=True)
    result = train(
        generated, config, out, lambda done, total, text: progress("train", done, total, text),
        resume=not overwrite, reading=lambda done, total: progress("read", done, total),
    )  # fmt: skip
    save_skill(out, result, generated)
    return config


@_alone
def train_seeds(
    dataset: Path,
    out: Path,
    seeds: Sequence[int],
    policy: str | type[Policy] | None = None,
    *,
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Progress = _silent,
    **options: Any,
) -> dict[str, Any]:
    """A table of the skills trained on a dataset's directory with each seed, in directory `out`.

    Args:
        dataset: directory from `augment`.
        out: directory to write: `seed0` and so on, and `sweep.json`; interrupted, it resumes.
        seeds: what differs.
        policy: what is trained; what the dataset's strategy is for if left out.
        workers: how many processes, or `Workers` elsewhere.
        overwrite: whether a sweep in `out` may be replaced.
        progress: called with the trainings done.
        options: of `TrainConfig`, but `seed`; the policy's own where left out or None.

    Raises:
        MissingFile, BrokenFile, UnknownName, InvalidInput: as `train_policy`.
        OutputExists, Mismatch, CannotWrite: as `learn.sweep.train_seeds`.
    """
    check_writable(out / "sweep.json", overwrite)
    generated, config = _training(dataset, policy, options)
    from sart_toolkit.learn import sweep

    return sweep.train_seeds(
        generated, config, seeds, out, workers, overwrite,
        lambda done, total: progress("sweep", done, total),
        lambda done, total, text: progress("train", done, total, text),
    )  # fmt: skip


def _training(
    dataset: Path, policy: str | type[Policy] | None, options: Mapping[str, Any]
) -> tuple[Dataset, TrainConfig]:
    """A dataset that can be learned from, and how."""
    generated = load_dataset(dataset)
    if policy is None:
        from sart_toolkit.augment.strategies import Strategy

        # One that was made elsewhere notes none.
        policy = generated.info.get("policy", Strategy.policy)
    check_names(policy=policy)
    from sart_toolkit.record.checks import check_recording

    for source in generated.sources:
        # Its robot's limits were compared when the dataset was made; here it need not be found.
        check_recording(source.demonstration, name=str(source.path))
    return generated, _train_config(policy, options)


def _train_config(policy: str | type[Policy], options: Mapping[str, Any]) -> TrainConfig:
    from sart_toolkit.learn.training import TrainConfig

    given = {name: value for name, value in options.items() if value is not None}
    return TrainConfig.for_policy(policy, **given)


def evaluate(
    skill: Path,
    out: Path,
    *,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    backend: BackendLike | None = None,
    workers: int | Workers = 1,
    device: str = "cpu",
    overwrite: bool = False,
    progress: Progress = _silent,
    **options: Any,
) -> dict[str, Any]:
    """How well a skill's directory performs on random placements, saved in the file `out`.

    Args:
        skill: the skill.
        out: JSON file to write; videos go beside it. An interrupted evaluation resumes.
        task: in place of the one that the skill notes.
        robot: likewise.
        backend: likewise.
        workers: how many processes, or `Workers` elsewhere.
        device: where the policy runs.
        overwrite: whether `out` may be replaced.
        progress: called with the rollouts done.
        options: of `EvaluateConfig`.

    Raises:
        MissingFile, BrokenFile: the skill can't be read.
        UnknownName: task, robot or backend can't be found.
        InvalidInput: `workers` is not positive.
        Mismatch: another evaluation into `out` was interrupted.
        OutputExists, CannotWrite: `out` can't be written.
    """
    check_names(task=task, robot=robot, backend=backend)
    check_writable(out, overwrite)
    if not (skill / "config.json").exists():
        raise MissingFile(f"{skill}: no such skill directory; make it with `sart train`")
    from sart_toolkit.evaluate.rollout import EvaluateConfig, evaluate_skill
    from sart_toolkit.learn.skill import load_skill

    config = EvaluateConfig(**options)
    loaded = load_skill(skill)
    about, rates = loaded.config, loaded.demonstration.rates
    make = backend_maker(about, _image_size_of_skill(about), rates, task, robot, backend)
    film: Film | None = None
    if config.videos:
        from sart_toolkit.report.video import film_rollout

        film = film_rollout

    def report_progress(done: int, wanted: int, successes: int) -> None:
        progress("evaluate", done, wanted, f"{successes}/{done} succeeded")

    return evaluate_skill(
        skill, task_of(about, task), make, config, out, workers, device, report_progress, film,
        overwrite,
    )  # fmt: skip


def deploy(
    skill: Path,
    *,
    backend: BackendLike | None = None,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    max_seconds: float | None = None,
    dry_run: bool = False,
    device: str = "cpu",
    ready: Callable[[str], None] | None = None,
    progress: Progress = _silent,
) -> Deployment:
    """What a skill's directory did on a real robot, from where it stands.

    Args:
        skill: the skill.
        backend: the cell; the one that the skill notes if left out.
        task, robot: in place of those that the skill notes.
        max_seconds: for how long it acts [s]; the task's horizon if left out.
        dry_run: whether nothing moves: it sees and decides alone.
        device: where the policy runs.
        ready: called once all is connected, with what will happen; returns when it may.
        progress: called with the seconds done.

    Raises:
        MissingFile, BrokenFile, Mismatch: skill or cell can't be read, or don't fit each other.
        UnknownName: task, robot or backend can't be found.
        InvalidInput: the backend is no real robot, or a value is not acceptable.
        RobotStopped: the robot stopped.
    """
    from sart_toolkit.evaluate.deploy import deploy_skill

    with _on_robot(skill, backend, task, robot, max_seconds, dry_run, device) as use:
        if ready is not None:
            speed = use.backend.cell.limits.speed_scale
            what = "nothing moves" if dry_run else f"the robot moves at {speed:.0%} of its speed"
            ready(f"The skill acts for up to {use.seconds:g} s of its own time: {what}")
        return deploy_skill(
            use.skill, use.backend, use.seconds, dry_run,
            lambda done: progress("deploy", done, use.seconds),
        )  # fmt: skip


def judge(
    skill: Path,
    out: Path,
    judge: Judge,
    *,
    trials: int = 20,
    backend: BackendLike | None = None,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    max_seconds: float | None = None,
    device: str = "cpu",
    overwrite: bool = False,
    progress: Progress = _silent,
) -> dict[str, Any]:
    """How well a skill's directory performs on a real robot, a person judging; saved in `out`.

    Args:
        skill: the skill.
        out: JSON file to write, as `evaluate` does. An interrupted evaluation resumes.
        judge: the person.
        trials: how many count.
        backend: the cell; the one that the skill notes if left out.
        task, robot: in place of those that the skill notes.
        max_seconds: how long a trial lasts at most [s]; the task's horizon if left out.
        device: where the policy runs.
        overwrite: whether `out` may be replaced.
        progress: called with the trials judged.

    Raises:
        MissingFile, BrokenFile, Mismatch: skill or cell can't be read, or don't fit each other;
            another evaluation into `out` was interrupted.
        UnknownName: task, robot or backend can't be found.
        InvalidInput: the backend is no real robot, or a value is not acceptable.
        RobotStopped: the robot stopped.
        OutputExists, CannotWrite: `out` can't be written.
    """
    check_writable(out, overwrite)
    from sart_toolkit.evaluate.deploy import judge_skill
    from sart_toolkit.learn.skill import skill_hash

    with _on_robot(skill, backend, task, robot, max_seconds, False, device) as use:
        request = {
            "verb": "deploy", "skill": skill_hash(skill), "task": use.task.name,
            "robot": use.backend.robot.name, "backend": use.backend.name, "seconds": use.seconds,
        }  # fmt: skip
        return judge_skill(
            use.skill, use.backend, trials, use.seconds, judge, out, request, overwrite,
            lambda done, wanted, k: progress("judge", done, wanted, f"{k}/{done} succeeded"),
        )  # fmt: skip


@dataclass(frozen=True)
class _OnRobot:
    """A skill and the robot that it is to act on, for so long [s] at most."""

    skill: Skill
    backend: HardwareBackend
    task: Task
    seconds: float


@contextmanager
def _on_robot(
    skill: Path,
    backend: BackendLike | None,
    task: TaskLike | None,
    robot: RobotLike | None,
    max_seconds: float | None,
    dry_run: bool,
    device: str,
) -> Iterator[_OnRobot]:
    """A skill and the real robot that it acts on, connected."""
    check_names(task=task, robot=robot, backend=backend)
    if not (skill / "config.json").exists():
        raise MissingFile(f"{skill}: no such skill directory; make it with `sart train`")
    from sart_toolkit.backends.hardware import HardwareBackend, without_motion
    from sart_toolkit.learn.skill import load_skill

    loaded = load_skill(skill, device)
    about, rates = loaded.config, loaded.demonstration.rates
    found = _find(about, "backend", backend, get_backend)
    if not issubclass(found, HardwareBackend):
        raise InvalidInput(
            f"backend {found.name!r}: is no real robot; pass a cell's file, or use `sart evaluate`"
        )
    goal = task_of(about, task)
    seconds = goal.horizon if max_seconds is None else max_seconds
    made_of = without_motion(found) if dry_run else found
    make = backend_maker(about, _image_size_of_skill(about), rates, goal, robot, made_of)
    with closing(make()) as made:
        assert isinstance(made, HardwareBackend)
        yield _OnRobot(loaded, made, goal, seconds)


def report(run_dir: Path, out: Path | None = None, *, overwrite: bool = False) -> Path:
    """Where the page about a run's directory was written: in `out`, or its own `report.html`.

    The run's own page is made again as often as this is called.

    Raises:
        MissingFile, BrokenFile, InvalidInput, Mismatch: as `write_report`.
        OutputExists, CannotWrite: `out` can't be written.
    """
    if not run_dir.is_dir():
        raise MissingFile(f"{run_dir}: no such directory; pass one that `sart run` wrote")
    page = out or run_dir / "report.html"
    with OutputLock(page):
        if out is not None:
            check_writable(out, overwrite)
        from sart_toolkit.report.page import write_report

        write_report(run_dir, page, setting_of)
    return page


# --- all of them --------------------------------------------------------------------------------


@_alone
def run(
    task: TaskLike,
    out: Path | str,
    *,
    robot: RobotLike | None = None,
    backend: BackendLike = DEFAULT_BACKEND,
    strategy: str | Strategy = "sart",
    policy: str | type[Policy] | None = None,
    n: int | None = None,
    demonstrations: int | None = None,
    episodes: int = 50,
    epochs: int | None = None,
    distribution: Literal["paper", "area"] = "area",
    recording: Recording = "reversed",
    cameras: Sequence[str] = ("wrist",),
    image_size: ImageSize = 128,
    seed: int = 0,
    eval_seed: int = 1000,
    workers: int | Workers = 1,
    device: str = "auto",
    overwrite: bool = False,
    command: str = "sart_toolkit.run",
    progress: Progress = _silent,
) -> dict[str, Any]:
    """Record, suggest, augment, train, evaluate and report, in directory `out`; its figures.

    A stage whose result is there is not done again; called again after an interruption, the run
    resumes.

    Args:
        task: what is to be learned.
        out: directory to write.
        robot: the task's own if left out.
        backend: where all of it happens.
        strategy: how segments are drawn.
        policy: what is trained; what the strategy is for if left out.
        n: trajectories in all, the demonstrations among them; the strategy's own number if left
            out.
        demonstrations: how many are recorded, at random placements if more than one; 1 if left out,
            or `n` where the strategy draws nothing.
        episodes: rollouts with random placements.
        epochs: of training, the policy's own if None.
        distribution: how positions are drawn on a sphere.
        recording: whether segments are recorded on the way out and reversed, or on the return.
        cameras: whose images are recorded and trained on.
        image_size: width and height of recorded images [pixels]; one number for a square.
        seed: of all that is random, except evaluation.
        eval_seed: of the placements that are evaluated.
        workers: how many processes, or `Workers` elsewhere.
        device: where training and the policy run: "auto", "cpu" or "cuda".
        overwrite: whether a run in `out` may be replaced.
        command: how it was asked for, kept with the run.
        progress: called with the progress of each stage.

    Raises:
        UnknownName: a name or reference leads to nothing.
        InvalidInput: a value is not acceptable.
        Mismatch: `out` holds a run with another configuration, or the goal was not reached.
        OutputExists, CannotWrite: `out` can't be written.
    """
    out = Path(out)
    check_names(task=task, robot=robot, backend=backend, strategy=strategy, policy=policy)
    size = _checked_size(image_size)
    from sart_toolkit.augment import get_strategy
    from sart_toolkit.augment.config import AugmentConfig
    from sart_toolkit.data.sampling import SamplingConfig
    from sart_toolkit.evaluate.rollout import EvaluateConfig

    # What can't work should be said before anything is written.
    drawing = get_strategy(strategy)
    policy = policy or drawing.policy
    n = drawing.n if n is None else n
    count = (1 if drawing.draws else n) if demonstrations is None else demonstrations
    if count < 1 or (n != count and not drawing.draws) or (n <= count and drawing.draws):
        fewer = f"fewer than the {n} trajectories" if drawing.draws else f"{n}, as trajectories"
        raise InvalidInput(f"demonstrations: expected at least 1, and {fewer}, got {count}")
    found = get_task(task)
    get_robot(robot or found.robot)
    get_backend(backend)
    generation: dict[str, Any] = {
        "n": n, "strategy": strategy, "sampling": SamplingConfig(distribution), "seed": seed,
        "recording": recording,
    }  # fmt: skip
    drawn = AugmentConfig(**generation)
    training: dict[str, Any] = {
        "epochs": epochs, "cameras": tuple(cameras), "seed": seed, "device": device,
    }  # fmt: skip
    trained = _train_config(policy, training)
    EvaluateConfig(episodes, eval_seed)

    wanted = {
        "task": _named("task", task, found),
        "backend": _named("backend", backend, get_backend(backend)),
        "robot": None if robot is None else _named("robot", robot, get_robot(robot)),
        "strategy": drawn.strategy,
        "policy": trained.policy,
        "n": n,
        "demonstrations": count,
        "episodes": episodes,
        "seed": seed,
        "eval_seed": eval_seed,
        "cameras": list(cameras),
        "image_size": list(size),
        "distribution": distribution,
        "recording": recording,
        "epochs": epochs,
        "device": device,
    }
    state = _resumed(out, wanted, overwrite)
    state |= {
        "command": command, "versions": library_versions(), "commit": source_commit(),
        "machine": machine(),
    }  # fmt: skip
    write_json(out / "run.json", state)
    skill, evaluation, dataset = out / "skill", out / "evaluation.json", out / "dataset"
    demos, spheres = [out / "demo.h5"], [out / "annotation.json"]
    if count > 1:
        demos = [demonstration_path(out / "demos", i) for i in range(count)]
        spheres = [path.with_suffix(".json") for path in demos]
    if not drawing.annotated:
        spheres = []

    def show() -> None:
        shown: dict[str, Any] = {
            "robot": robot, "backend": backend, "seed": seed, "cameras": cameras,
            "image_size": size, "progress": progress,
        }  # fmt: skip
        if count == 1:
            record(task, demos[0], **shown)
        else:
            record_several(task, demos[0].parent, count, placement="random", **shown)

    def annotate() -> None:
        for demo, path in zip(demos, spheres, strict=True):
            if not path.exists():
                suggest(demo, path, task=task, robot=robot, progress=progress)

    steps: list[tuple[str, Path, Callable[[], object]]] = [
        ("record", demos[-1], show),
        *([("suggest", spheres[-1], annotate)] if spheres else []),
        ("augment", dataset / "dataset.json", lambda: augment(
            demos, spheres, dataset, task=task, robot=robot, backend=backend, workers=workers,
            progress=progress, **generation,
        )),
        ("train", skill / "config.json", lambda: train_policy(
            dataset, skill, policy, progress=progress, **training,
        )),
        ("evaluate", evaluation, lambda: evaluate(
            skill, evaluation, task=task, robot=robot, backend=backend, workers=workers,
            device=device, progress=progress, episodes=episodes, eval_seed=eval_seed, videos=2,
            final_images=True,
        )),
    ]  # fmt: skip
    for name, result, carry_out in steps:
        if result.exists():
            _log.info("%-9s done before: %s", name, result)
            continue
        started = time.perf_counter()
        try:
            carry_out()
        finally:
            # Also what an interrupted stage took, which will resume.
            seconds = state["stages"].get(name, 0.0) + time.perf_counter() - started
            state["stages"][name] = seconds
            write_json(out / "run.json", state)
        _log.info("%-9s %6.1f s  %s", name, seconds, result)
    page = report(out)
    figures = read_json(evaluation, EvaluationFile)
    generated = read_json(dataset / "dataset.json", DatasetFile)
    return {
        "task": found.name,
        "success": f"{figures['n_success']}/{figures['n_episodes']}",
        "success_rate": figures["success_rate"],
        "ci95": figures["ci95"],
        "kept": generated["n_kept"],
        "attempted": generated["n_attempted"],
        "stages_seconds": {k: round(v, 1) for k, v in state["stages"].items()},
        "seconds": round(sum(state["stages"].values()), 1),
        "skill": str(skill),
        "report": str(page),
    }


def _named(kind: str, given: Any, found: Any) -> str:
    """What a person gave as text, or else what names the object; at least its own name."""
    name: str = found.name
    return reference_to(kind, given, _TABLES[kind]) or name


def _resumed(out: Path, wanted: Mapping[str, Any], overwrite: bool) -> dict[str, Any]:
    """The state of the run in `out`, or of a new one where there is none or it is replaced."""
    if overwrite:
        clear_directory(out, "run.json", overwrite=True)
    elif (out / "run.json").exists():
        state = read_json(out / "run.json", RunFile)
        if state["config"] != wanted:
            changed = [k for k, v in wanted.items() if state["config"].get(k) != v]
            raise Mismatch(
                f"{out}: holds a run with another {', '.join(changed)}; add --overwrite or choose "
                "another --out"
            )
        return {"config": state["config"], "stages": state["stages"]}
    else:
        check_writable(out)
    return {"config": wanted, "stages": {}}


def run_benchmark(
    plan: str | Path | Plan,
    out: Path | str,
    *,
    changes: Mapping[str, Any] | None = None,
    only: str | None = None,
    store: Path | None = None,
    workers: int | Workers = 1,
    command: str = "sart_toolkit.run_benchmark",
    dry_run: bool = False,
    progress: Progress = _silent,
) -> dict[str, Any]:
    """The result of a benchmark's plan in directory `out`: see `benchmark.runner.run_plan`.

    Args:
        plan: a name in `benchmark.plans.PLANS`, a TOML file, or the plan itself.
        out: directory to write; an interrupted benchmark resumes.
        changes: of a name or file, values of cells' fields in place of those in it.
        only: a pattern of the names of cells; all if left out.
        store: directory of the stages' results, which plans may share; `out`/stages if left out.
        workers: how many processes, or `Workers` elsewhere.
        command: how it was asked for, kept with the result.
        dry_run: only say what is missing and what it would take: see `preview_plan`.
        progress: called with the jobs done of each stage.

    Raises:
        UnknownName: no such plan, cell or field, or a reference of a cell leads to nothing.
        MissingFile, BrokenFile: the plan's file can't be read.
        InvalidInput: a value in it is not acceptable.
        CannotWrite, SartError: as `run_plan`.
    """
    from sart_toolkit.benchmark.plans import Plan, read_plan

    found = plan if isinstance(plan, Plan) else read_plan(plan, changes)
    if changes and found is plan:
        raise InvalidInput("changes: are for a plan's name or file; change the plan itself")
    found = found if only is None else found.only(only)
    for cell in found.cells:
        check_names(
            task=cell.task, backend=cell.backend, strategy=cell.strategy, policy=cell.policy
        )
        check_names(backend=cell.evaluate_on)
    from sart_toolkit.benchmark.jobs import jobs_of
    from sart_toolkit.benchmark.runner import preview_plan, run_plan

    # What can't work should be said before hours are spent.
    for cell in found.cells:
        for stage, job in jobs_of(cell).items():
            _stage_options(stage, job.options)
    if dry_run:
        return preview_plan(found, Path(out), workers, store)
    return run_plan(
        found, Path(out), _carry_out, workers, store,
        {"command": command, "machine": machine()}, progress,
    )  # fmt: skip


def _stage_options(stage: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """JSON values of a benchmark's stage as the options of the function that carries it out.

    Raises:
        UnknownName, InvalidInput: one is not acceptable.
    """
    from sart_toolkit.annotate.suggest import SuggestConfig
    from sart_toolkit.augment.config import AugmentConfig
    from sart_toolkit.data.sampling import SamplingConfig
    from sart_toolkit.evaluate.rollout import EvaluateConfig
    from sart_toolkit.learn.training import TrainConfig
    from sart_toolkit.scenes.appearance import AppearanceConfig

    stages: dict[str, tuple[Callable[..., Any], type[Any] | None]] = {
        "record": (record, None),
        "suggest": (suggest, SuggestConfig),
        "augment": (augment, AugmentConfig),
        "train": (train_policy, TrainConfig),
        "evaluate": (evaluate, EvaluateConfig),
    }
    function, config = stages[stage]
    found = dict(options)
    if "appearance" in found:
        found["appearance"] = AppearanceConfig.only(**found["appearance"])
    if "sampling" in found:
        found["sampling"] = SamplingConfig(**_known("sampling", found["sampling"], SamplingConfig))
    own = {*inspect.signature(function).parameters, "count"}
    rest = {name: value for name, value in found.items() if name not in own}
    if config is None:
        _known(stage, rest)
    elif config is TrainConfig:
        _train_config(found["policy"], rest)
    else:
        config(**_known(stage, rest, config))
    return found


def _known(what: str, values: Mapping[str, Any], config: type[Any] | None = None) -> Any:
    """The values, all of them fields of a config."""
    names = [] if config is None else [field.name for field in dataclasses.fields(config)]
    for name in values:
        if name not in names:
            raise unknown_name(f"option of {what}", name, names)
    return values


def _carry_out(
    stage: str, out: Path, inputs: Mapping[str, Path], options: Mapping[str, Any]
) -> dict[str, Any]:
    """Carry out a stage of a benchmark's cell in a directory; figures of it.

    A stage that was finished but not noted is not done again.
    """
    given = _stage_options(stage, options)
    demos = sorted(inputs.get("demo", out).glob("demo*.h5"))
    if stage == "record":
        count = given.pop("count")
        if count > 1:
            record_several(out=out, count=count, **{"placement": "random", **given})
        elif not (out / "demo.h5").exists():
            record(out=out / "demo.h5", **given)
        shown = [load_demonstration(path) for path in sorted(out.glob("demo*.h5"))]
        spent = [float(d.timestamps[-1] - d.timestamps[0]) for d in shown]
        return {"demonstrations": len(shown), "demonstrating_seconds": sum(spent)}
    if stage == "suggest":
        for demo in demos:
            path = out / demo.with_suffix(".json").name
            if not path.exists():
                suggest(demo, path, **given)
        spheres = [load_annotation(path) for path in sorted(out.glob("demo*.json"))]
        return {
            "spheres": sum(len(annotation.spheres) for annotation in spheres),
            "annotating_seconds": sum(annotation.seconds for annotation in spheres),
        }
    if stage == "augment":
        annotations = sorted(inputs.get("annotation", out).glob("demo*.json"))
        path = out / "dataset"
        if not (path / "dataset.json").exists():
            augment(demos, annotations, path, **given)
        info = read_json(path / "dataset.json", DatasetFile)
        return {
            "kept": info["n_kept"],
            "attempted": info["n_attempted"],
            "rejections": info["rejections"],
            "simulated_seconds": info.get("simulated_seconds"),
            "resets": info.get("resets"),
        }
    if stage == "train":
        path = out / "skill"
        if not (path / "config.json").exists():
            train_policy(inputs["dataset"] / "dataset", path, **given)
        training = read_json(path / "training.json", TrainingFile)
        return {name: training.get(name) for name in ("final_loss", "windows", "trajectories")}
    path = out / "evaluation.json"
    if not path.exists():
        evaluate(inputs["skill"] / "skill", path, final_images=True, **given)
    figures = read_json(path, EvaluationFile)
    return {name: figures[name] for name in ("n_success", "n_episodes")}


def run_skill(
    skill: Path | str,
    *,
    placement: Placement | None = None,
    seed: int = 0,
    task: TaskLike | None = None,
    robot: RobotLike | None = None,
    backend: BackendLike | None = None,
    device: str = "cpu",
    watch: Callable[[Any, int, bool], None] | None = None,
) -> Rollout:
    """One rollout of a skill's directory, on the robot, task and backend that it notes.

    Args:
        skill: the directory.
        placement: where the object stands; drawn at random with `seed` if left out.
        seed: of the placement.
        task: in place of the one that the skill notes.
        robot: likewise.
        backend: likewise.
        device: where the policy runs.
        watch: called at the start and after each step with what is observed, the number of steps
            done and whether the goal is reached.

    Raises:
        MissingFile, BrokenFile, Mismatch: the skill can't be read.
        UnknownName: task, robot or backend can't be found.
    """
    check_names(task=task, robot=robot, backend=backend)
    from sart_toolkit.evaluate.rollout import run_rollout
    from sart_toolkit.learn.skill import load_skill
    from sart_toolkit.robots.model import RobotModel

    loaded = load_skill(Path(skill), device)
    about = loaded.config
    goal = task_of(about, task)
    placement = placement or goal.sample_placement(np.random.default_rng(seed))
    rates = loaded.demonstration.rates
    make = backend_maker(about, _image_size_of_skill(about), rates, goal, robot, backend)
    with closing(make()) as made:
        model = RobotModel(made.robot, made.scene.held)
        return run_rollout(loaded, goal, made, model, placement, (seed, 0), watch)
