"""Generates trajectories: executes each segment, checks it, records it reversed, and resumes."""

from __future__ import annotations

import collections
import dataclasses
import functools
import json
import logging
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit.augment.strategies import SamplingConfig, get_strategy
from sart_toolkit.backends.interface import Backend, BackendFactory, Observation
from sart_toolkit.errors import (
    BrokenFile,
    InvalidInput,
    Mismatch,
    MissingCapability,
    MotionRejected,
    OutputExists,
    Unreachable,
    unknown_name,
)
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.motion.line import straight_line
from sart_toolkit.poses import check_positive, distance, inverse
from sart_toolkit.records import (
    CONTROL_PER_RECORD,
    RECORD_HZ,
    Annotation,
    Dataset,
    Demonstration,
    Episode,
    Provenance,
    library_versions,
)
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.storage import (
    annotation_to_json,
    append_json_line,
    clear_directory,
    episode_name,
    load_annotation,
    load_dataset,
    load_demonstration,
    load_episode,
    read_json,
    read_json_lines,
    save_annotation,
    save_demonstration,
    save_episode,
    write_json,
    write_text,
)
from sart_toolkit.teach.recorder import StepRecorder
from sart_toolkit.workers import worker_map

_log = logging.getLogger(__name__)
KEPT = "kept"
_LOG = "attempts.jsonl"
_LEAST_ATTEMPTS = 20
_ATTEMPTS_PER_EPISODE = 10
_SLIP, _SLIP_DEG = 0.005, 3.0


@dataclass(frozen=True)
class AugmentConfig:
    """What to generate.

    `n`: trajectories in all, the demonstration among them; the others go round-robin over the
    spheres. `duration` [s] is the paper's delta. `camera`: whose pictures are recorded.
    """

    n: int = 40
    strategy: str = "sart"
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    duration: float = 2.0
    seed: int = 0
    camera: str = "wrist"

    def __post_init__(self) -> None:
        if self.n < 2:
            raise InvalidInput(f"n: expected at least 2 (the demonstration counts), got {self.n}")
        if self.seed < 0:
            raise InvalidInput(f"seed: expected a whole number >= 0, got {self.seed}")
        check_positive("duration", self.duration, "s")
        get_strategy(self.strategy)


@dataclass(frozen=True)
class Attempt:
    """The outcome of one try: the episode, or the reason why it was rejected."""

    outcome: str
    episode: Episode | None


def try_segment(
    backend: Backend,
    model: RobotModel,
    demonstration: Demonstration,
    annotation: Annotation,
    config: AugmentConfig,
    sphere_index: int,
    k: int,
) -> Attempt:
    """The k-th try from a sphere: sample, move there, check, and reverse what was recorded.

    The robot starts from the restored state of waypoint t*, at the pose commanded there. Any
    contact of the robot, or of what it holds or has grasped there, with anything else at any
    physics step rejects the segment; so does an object that slips in the grasp.

    Args:
        backend: the robot in the demonstration's scene.
        model: its kinematics.
        demonstration: what was shown.
        annotation: its spheres.
        config: what to generate.
        sphere_index: which sphere.
        k: which try; it alone decides the random numbers, with the seed and the sphere.

    Raises:
        MissingCapability: the backend can't restore states or report contacts.
    """
    rng = np.random.default_rng([config.seed, sphere_index, k])
    sphere = annotation.spheres[sphere_index]
    proposal = get_strategy(config.strategy)(demonstration, sphere, rng, config.sampling)
    t_star = proposal.t_star
    steps = demonstration.steps
    q_start = steps.commanded_joint_positions[t_star]
    T_start = steps.commanded_Ts_world_tool[t_star]
    gripper = float(steps.commanded_gripper[t_star])
    scene = backend.scene
    carried = scene.grasped(demonstration.touching[t_star], backend.robot.gripper.finger_links)
    controller = ToolController(model)
    try:
        line = straight_line(model, q_start, T_start, proposal.T_world_sampled, config.duration)
        backend.restore(demonstration.states[t_star])
        controller.reset(q_start, T_start)
        recorder = StepRecorder(backend, (config.camera,))
        start = backend.observe()
        measured = start.T_world_tool
        for desired in line.sample(RECORD_HZ):
            for q in controller.move(desired, measured, CONTROL_PER_RECORD):
                backend.command(q, gripper)
                backend.step()
                hits = _hits(backend, carried)
                if hits:
                    return Attempt(f"contact {hits[0][0]} / {hits[0][1]}", None)
            if not np.allclose(controller.commanded_T_world_tool, desired, rtol=0, atol=1e-9):
                return Attempt("tool lags behind the line", None)
            measured = recorder.add(controller, gripper, 0.0).T_world_tool
        for name in sorted(carried):
            if _slipped(name, start, recorder.observations[-1]):
                return Attempt(f"{name} slipped in the grasp", None)
    except Unreachable:
        return Attempt("out of reach", None)
    except MotionRejected as error:
        # "joint jump: ..." or "joint limits: ...": the figures behind the colon differ each time.
        return Attempt(str(error).partition(":")[0], None)
    provenance = Provenance(
        demonstration_hash=annotation.demonstration_hash,
        sphere=sphere_index,
        k=k,
        t_star=t_star,
        T_world_sampled=proposal.T_world_sampled,
        seed=config.seed,
        strategy=config.strategy,
        law=config.sampling.law,
    )
    return Attempt(KEPT, Episode(recorder.steps(slice(None, None, -1)), provenance))


def _hits(backend: Backend, carried: frozenset[str]) -> list[tuple[str, str]]:
    """Contacts of the last step that should not be: of the robot with itself, and outer ones."""
    touching = [(contact.a, contact.b) for contact in backend.contacts()]
    bodies = {body.name for body in backend.scene.bodies}
    itself = [pair for pair in touching if bodies.isdisjoint(pair)]
    return sorted([*itself, *backend.scene.outer_contacts(touching, carried)])


def _slipped(name: str, start: Observation, end: Observation) -> bool:
    Ts = [inverse(seen.T_world_tool) @ seen.Ts_world_body[name] for seen in (start, end)]
    far, turn = distance(*Ts)
    return far > _SLIP or turn > np.deg2rad(_SLIP_DEG)


class _Worker:
    """Makes tries (sphere, k) and writes the kept episodes of one dataset directory."""

    def __init__(
        self, make_backend: BackendFactory, directory: Path, config: AugmentConfig
    ) -> None:
        self._directory = directory
        self._config = config
        self._demonstration = load_demonstration(directory / "demo.h5")
        self._annotation = load_annotation(directory / "annotation.json")
        self._backend = make_backend()
        self._model = RobotModel(self._backend.robot, self._backend.scene.held)

    def __call__(self, at: tuple[int, int]) -> tuple[int, int, str]:
        sphere, k = at
        attempt = try_segment(
            self._backend,
            self._model,
            self._demonstration,
            self._annotation,
            self._config,
            sphere,
            k,
        )
        if attempt.episode is not None:
            save_episode(self._directory / "episodes" / episode_name(sphere, k), attempt.episode)
        return sphere, k, attempt.outcome

    def close(self) -> None:
        self._backend.close()


def augment_demonstration(
    demonstration: Demonstration,
    annotation: Annotation,
    make_backend: BackendFactory,
    out: Path,
    config: AugmentConfig | None = None,
    workers: int = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
) -> Dataset:
    """Generate a dataset directory from a demonstration and its annotation.

    Neither the number of workers nor an interruption changes what is generated: called again with
    the same arguments it goes on where it was.

    Args:
        demonstration: what was shown.
        annotation: its precision spheres.
        make_backend: makes the robot in the demonstration's scene; picklable if `workers` > 1.
        out: directory to write.
        config: what to generate.
        workers: processes.
        overwrite: replace what is in `out`.
        progress: called with (kept, wanted, rejected) after each try.

    Raises:
        Mismatch: the annotation belongs to another demonstration.
        MissingCapability: the backend can't restore states or report contacts.
        OutputExists: `out` holds something else and `overwrite` is false.
        CannotWrite: the disk refuses.
        InvalidInput: no try from any sphere was kept, or `workers` is not positive.
    """
    config = config or AugmentConfig()
    out = Path(out)
    annotation.check_matches(demonstration)
    if not demonstration.states:
        raise Mismatch(
            "the demonstration holds no saved states; record it on a backend that can restore"
        )
    started = time.perf_counter()
    request = {
        "config": dataclasses.asdict(config),
        "demonstration": demonstration.content_hash(),
        "annotation": annotation_to_json(annotation),
    }
    # All that can be refused is refused before anything is replaced.
    if workers < 1:
        raise InvalidInput(f"workers: expected at least 1, got {workers}")
    _check_capable(make_backend, config.camera)
    finished = _prepare(out, request, demonstration, annotation, overwrite)
    if finished is not None:
        return finished
    outcomes = _read_attempts(out)
    quotas = [
        len(range(i, config.n - 1, len(annotation.spheres))) for i in range(len(annotation.spheres))
    ]
    with worker_map(functools.partial(_Worker, make_backend, out, config), workers) as run:
        while batch := _next_batch(outcomes, quotas):
            for sphere, k, outcome in run(batch):
                outcomes[sphere, k] = outcome
                row = {"sphere": sphere, "k": k, "outcome": outcome}
                append_json_line(out / _LOG, row)
                if progress is not None:
                    kept = sum(o == KEPT for o in outcomes.values())
                    progress(kept, config.n - 1, len(outcomes) - kept)
    return _finish(out, outcomes, request, time.perf_counter() - started)


def _prepare(
    out: Path,
    request: dict[str, Any],
    demonstration: Demonstration,
    annotation: Annotation,
    overwrite: bool,
) -> Dataset | None:
    """Set the directory up; the dataset itself if it is already whole."""
    if (out / "request.json").exists() and not overwrite:
        if read_json(out / "request.json") != json.loads(json.dumps(request)):
            raise OutputExists(
                f"{out}: holds a dataset made with other settings; add --overwrite or choose "
                "another --out"
            )
        if (out / "dataset.json").exists():
            return load_dataset(out)
    else:
        clear_directory(out, "request.json", overwrite)
        # First of all, so that an interruption from here on leaves a directory to go on in.
        write_json(out / "request.json", request)
    save_demonstration(out / "demo.h5", demonstration)
    save_annotation(out / "annotation.json", annotation)
    (out / "episodes").mkdir(exist_ok=True)
    return None


def _read_attempts(out: Path) -> dict[tuple[int, int], str]:
    """Outcomes noted before an interruption; a try whose line or file was cut is made again."""
    outcomes: dict[tuple[int, int], str] = {}
    for row in read_json_lines(out / _LOG):
        at = row["sphere"], row["k"]
        if row["outcome"] == KEPT:
            try:
                load_episode(out / "episodes" / episode_name(*at))
            except (BrokenFile, FileNotFoundError):
                continue
        outcomes[at] = row["outcome"]
    # Written anew: a further line must not join one that was cut.
    rows = [{"sphere": s, "k": k, "outcome": o} for (s, k), o in outcomes.items()]
    write_text(out / _LOG, "".join(json.dumps(row) + "\n" for row in rows))
    return outcomes


def _next_batch(outcomes: dict[tuple[int, int], str], quotas: list[int]) -> list[tuple[int, int]]:
    """The tries still needed, no more than can all be kept; spheres that give up are left out."""
    batch = []
    for sphere, quota in enumerate(quotas):
        tried = {k: o for (s, k), o in outcomes.items() if s == sphere}
        kept = sum(o == KEPT for o in tried.values())
        limit = max(_LEAST_ATTEMPTS, _ATTEMPTS_PER_EPISODE * quota)
        missing = [k for k in range(limit) if k not in tried]
        batch += [(sphere, k) for k in missing[: quota - kept]]
    return sorted(batch, key=lambda at: (at[1], at[0]))


def _check_capable(make_backend: BackendFactory, camera: str) -> None:
    with closing(make_backend()) as backend:
        can = backend.capabilities
        if camera not in backend.cameras:
            raise unknown_name("camera", camera, backend.cameras)
        if not (can.can_restore and can.has_contacts and can.renders):
            raise MissingCapability(
                f"backend {backend.name!r} can't restore states, report contacts and render, which "
                "augmentation needs; use another backend"
            )


def _finish(
    out: Path, outcomes: dict[tuple[int, int], str], request: dict[str, Any], seconds: float
) -> Dataset:
    kept = sorted((k, s) for (s, k), outcome in outcomes.items() if outcome == KEPT)
    reasons = collections.Counter(o for o in outcomes.values() if o != KEPT)
    if not kept:
        raise InvalidInput(
            f"none of {len(outcomes)} tries was kept ({_counted(reasons)}); use smaller radii or "
            "other waypoints"
        )
    wanted = request["config"]["n"] - 1
    if len(kept) < wanted:
        _log.warning(
            "only %d of %d trajectories were kept (%s)", len(kept), wanted, _counted(reasons)
        )
    names = [episode_name(s, k) for k, s in kept]
    demonstration = load_demonstration(out / "demo.h5")
    annotation = load_annotation(out / "annotation.json")
    episodes = tuple(load_episode(out / "episodes" / name) for name in names)
    dataset = Dataset(demonstration, annotation, episodes)
    info = {
        "n_trajectories": len(kept) + 1,
        "n_kept": len(kept),
        "n_attempted": len(outcomes),
        "rejections": dict(sorted(reasons.items())),
        "seconds": seconds,
        "simulated_seconds": len(outcomes) * request["config"]["duration"],
        "config": request["config"],
        "content_hash": dataset.content_hash(),
        "versions": library_versions(),
        "episodes": names,
    }
    write_json(out / "dataset.json", info)
    return dataclasses.replace(dataset, info=info)


def _counted(reasons: collections.Counter[str]) -> str:
    return ", ".join(f"{reason}: {count}" for reason, count in reasons.items())
