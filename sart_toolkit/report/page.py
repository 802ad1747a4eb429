"""`report.html`: one self-contained page that shows what a run taught the robot and how well.

What is shown is gathered here; how it looks is in `templates/`.
"""

from __future__ import annotations

import base64
import collections
import functools
import hashlib
import math
import os
import shlex
import urllib.parse
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import jinja2
import markupsafe
import numpy as np
from PIL import Image as PillowImage

from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.records import Annotation, Demonstration, Image
from sart_toolkit.data.schemas import EvaluationFile, RunFile, TrainingFile
from sart_toolkit.data.storage import (
    load_annotation,
    load_demonstration,
    read_json,
    write_text,
)
from sart_toolkit.errors import BrokenFile, MissingFile, SartError
from sart_toolkit.evaluate.failures import FailureKind, group_failures
from sart_toolkit.report.figures import (
    SegmentPath,
    Theme,
    film_strip,
    montage,
    placement_image,
    scene_image,
    segment_paths,
    sphere_colour,
    training_curve,
)
from sart_toolkit.report.video import last_frame
from sart_toolkit.report.view import MAX_SEGMENTS, scene_view
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec

# A page can be sent to somebody: with what else is on it, 3 MB.
MAX_VIDEO_BYTES = 2**20
_FILM_IMAGES = 8
# Of each kind of failure so many final images are shown, and of so many kinds.
_LAST_IMAGES, _KINDS_PICTURED = 6, 4
_TRAJECTORIES_LISTED = 100
# What isn't a pair of bodies or a reason in words, as `annotate/suggest.py` has it.
_LIMITS: Mapping[str | None, str] = {"max_radius": "the largest radius that may be suggested"}

Shown = dict[str, Any]
Setting = Callable[[Demonstration], tuple[RobotSpec, SceneSpec]]


def write_report(run_dir: Path, out: Path, setting: Setting | None = None) -> None:
    """Write the page about a run to `out`: images and videos inside, no request to anywhere.

    A part that the run doesn't have yet is left out with a line that says so; a part that is
    there but damaged is an error.

    Args:
        run_dir: what `sart run` writes: `demo.h5`, `annotation.json`, `dataset/`, `skill/`,
            `evaluation.json`, `videos/`, `run.json`, any of them absent.
        out: the HTML file, written whole or not at all.
        setting: finds the robot and the scene of a demonstration for the 3D view. Where it raises
            a `SartError` the page says why neither is shown.

    Raises:
        MissingFile: `run_dir` isn't there or holds no part of a run.
        BrokenFile: a part is damaged or lacks a field.
        InvalidInput, Mismatch: a part holds a value that can't be, or belongs to another run.
        CannotWrite: the disk refuses.
    """
    try:
        page = _page(_load_run(Path(run_dir)), Path(out), setting)
        # Half a pair of UTF-16, which JSON lets pass, can't be written.
        page.encode()
    except SartError:
        raise
    # A number, list or name where a JSON file should hold something else.
    except (
        ArithmeticError, AttributeError, LookupError, OSError, RecursionError, TypeError,
        ValueError, jinja2.TemplateError,
    ) as error:  # fmt: skip
        raise BrokenFile(
            f"{run_dir}: one of its JSON files holds a value that can't be shown "
            f"({type(error).__name__}: {error}); make that part of the run again"
        ) from error
    write_text(Path(out), page)


# --- what a run holds ---------------------------------------------------------------------------


@dataclass(frozen=True)
class _Run:
    """The parts of a run; `None` for those that aren't there.

    Of several demonstrations, at `demonstrations`, the first is shown with its annotation and its
    paths; `demonstrating` and `annotating` [s] are a person's time for all of them.
    """

    directory: Path
    demonstration: Demonstration | None
    annotation: Annotation | None
    demonstrations: Sequence[Path]
    demonstrating: float
    annotating: float
    augmentation: Mapping[str, Any] | None
    paths: Sequence[SegmentPath]
    trajectories: Sequence[_Trajectory]
    training: Mapping[str, Any] | None
    evaluation: Mapping[str, Any] | None
    run: Mapping[str, Any] | None


@dataclass(frozen=True)
class _Trajectory:
    """A generated trajectory's file, sphere, attempt, number of steps, and what is proved of it."""

    path: Path
    source: int
    sphere: int
    k: int
    steps: int
    proof: Mapping[str, Any] | None


_Part = TypeVar("_Part")


def _load_run(directory: Path) -> _Run:
    def optional(name: str, load: Callable[[Path], _Part]) -> _Part | None:
        path = directory / name
        return load(path) if path.exists() else None

    if not directory.is_dir():
        raise MissingFile(f"{directory}: no such directory; pass one that `sart run` wrote")
    made = (directory / "dataset" / "dataset.json").exists()
    dataset = load_dataset(directory / "dataset") if made else None
    # Of each episode only its path and what is proved of it are kept.
    paths: list[SegmentPath] = []
    trajectories: list[_Trajectory] = []
    for i in range(len(dataset) if dataset is not None else 0):
        assert dataset is not None
        episode = dataset.episode(i)
        provenance = episode.provenance
        if provenance.source == 0:
            paths += segment_paths([episode])
        at = dataset.path / dataset.index[i].name
        of = (provenance.source, provenance.sphere, provenance.k)
        trajectories.append(_Trajectory(at, *of, len(episode), provenance.certificate))
    demonstration = optional("demo.h5", load_demonstration)
    annotation = optional("annotation.json", load_annotation)
    several = sorted((directory / "demos").glob("demo*.h5"))
    demonstrating = annotating = 0.0
    for shown, spheres in (
        *([] if demonstration is None else [(demonstration, annotation)]),
        *(
            (load_demonstration(p), optional(f"demos/{p.stem}.json", load_annotation))
            for p in several
        ),
    ):
        demonstration, annotation = demonstration or shown, annotation or spheres
        demonstrating += shown.seconds if shown.steered_by_person else 0.0
        if spheres is not None and any(sphere.source == "human" for sphere in spheres.spheres):
            annotating += spheres.seconds
    run = _Run(
        directory=directory,
        demonstration=demonstration,
        annotation=annotation,
        demonstrations=several or [directory / "demo.h5"],
        demonstrating=demonstrating,
        annotating=annotating,
        augmentation=dataset.info if dataset is not None else None,
        paths=paths,
        trajectories=trajectories,
        training=optional("skill/training.json", lambda path: read_json(path, TrainingFile)),
        evaluation=optional("evaluation.json", lambda path: read_json(path, EvaluationFile)),
        run=optional("run.json", lambda path: read_json(path, RunFile)),
    )
    parts = (run.demonstration, run.annotation, dataset, run.training, run.evaluation, run.run)
    if all(part is None for part in parts):
        raise MissingFile(f"{directory}: holds no part of a run; pass one that `sart run` wrote")
    return run


def _field(value: Any, file: str, *keys: str) -> Any:
    """What lies under the keys of a file's JSON.

    Raises:
        BrokenFile: it isn't there.
    """
    for depth, key in enumerate(keys):
        if not isinstance(value, Mapping) or key not in value:
            raise BrokenFile(f"{file}: has no {'.'.join(keys[: depth + 1])}; make it again")
        value = value[key]
    return value


# --- images and numbers -----------------------------------------------------------------------


def data_uri(kind: str, content: bytes) -> str:
    """Content as an address that a page carries inside."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def image(png: bytes, alt: str, dark: bytes | None = None) -> Shown:
    """A PNG as the templates' macros show it, with another one for dark screens."""
    # A PNG's width and height are the first two numbers of its first chunk.
    width, height = (int.from_bytes(png[at : at + 4], "big") for at in (16, 20))
    return {
        "src": data_uri("image/png", png),
        "dark": None if dark is None else data_uri("image/png", dark),
        "alt": alt,
        "width": width,
        "height": height,
    }


def drawn(draw: Callable[[Theme], bytes], alt: str) -> Shown:
    """What is drawn in either theme, as the templates' macros show it."""
    return image(draw("light"), alt, draw("dark"))


# No line may end between a number and its unit.
_SPACE = "\N{NO-BREAK SPACE}"


def duration(seconds: float) -> str:
    """A time span as a person would write it: `9.6 s`, `3 min 32 s`, `2 h 05 min`."""
    if seconds < 59.95:
        return f"{seconds:.1f}{_SPACE}s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes}{_SPACE}min {rest:02d}{_SPACE}s"
    return f"{minutes // 60}{_SPACE}h {minutes % 60:02d}{_SPACE}min"


def percent(share: float) -> str:
    """A share of 1 in per cent, to a tenth where it has one."""
    return f"{100 * share:.1f}".removesuffix(".0") + f"{_SPACE}%"


def at_least_mm(metres: float) -> str:
    """A lower bound in mm, rounded down to hundredths so that it stays one."""
    # Parts per million of a micrometre are what the conversion to mm may add or take away.
    return f"{math.floor(1e5 * metres + 1e-6) / 100:.2f}{_SPACE}mm"


def at_most_mm(metres: float) -> str:
    """An upper bound in mm, rounded up to hundredths so that it stays one."""
    return f"{math.ceil(1e5 * metres - 1e-6) / 100:.2f}{_SPACE}mm"


def _millimetres(metres: float) -> str:
    return f"{1e3 * metres:.1f}{_SPACE}mm"


def _plural(n: int, one: str) -> str:
    return f"{n} {one if n == 1 else one + 's'}"


def _flat(value: Any, prefix: str = "") -> Iterable[tuple[str, str]]:
    """Nested JSON as rows of dotted name and text."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _flat(inner, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix, "none" if value is None else str(value)


# --- the top ------------------------------------------------------------------------------------


def _names(run: _Run) -> dict[str, str]:
    """Task, robot, backend and policy, from whichever part knows them."""
    names: dict[str, str] = {}
    demonstration = run.demonstration
    if demonstration is not None:
        names = {
            "task": demonstration.task,
            "robot": demonstration.robot,
            "backend": demonstration.backend,
        }
    if run.evaluation is not None:
        for key in ("task", "robot", "backend", "policy"):
            names[key] = str(_field(run.evaluation, "evaluation.json", key))
    return names


def _lead(run: _Run) -> str:
    """The run in a sentence."""
    said = []
    if run.demonstration is not None:
        n = len(run.demonstrations)
        said.append("shown once" if n == 1 else f"shown {n} times")
    if run.augmentation is not None:
        kept, _ = _counts(run.augmentation)
        said.append(f"varied by the robot itself {_plural(kept, 'time')}")
    if run.evaluation is not None:
        rate = _success_rate(run.evaluation)
        said.append(f"successful in {rate['successes']} of {rate['n']} rollouts")
    words = ", ".join(said)
    return f"{words[:1].upper()}{words[1:]}." if words else ""


def _tiles(run: _Run) -> list[Shown]:
    tiles: list[Shown] = []

    def tile(label: str, value: str, *notes: str) -> None:
        tiles.append({"label": label, "value": value, "notes": notes})

    if run.evaluation is not None:
        rate = _success_rate(run.evaluation)
        share, low, high = (percent(rate[key]) for key in ("share", "low", "high"))
        tile(
            "Success",
            f"{rate['successes']} / {rate['n']}",
            f"{share}, Wilson 95 % interval {low} to {high}",
        )
    if run.demonstration is not None:
        d = run.demonstration
        steps = f"{len(d)} steps over {duration(float(d.timestamps[-1] - d.timestamps[0]))}"
        if len(run.demonstrations) > 1:
            steps = f"the first with {steps}"
        tile("Demonstrations", str(len(run.demonstrations)), steps, f"steered by {d.operator}")
        by_hand = run.annotation is not None and any(
            sphere.source == "human" for sphere in run.annotation.spheres
        )
        notes = [
            f"{duration(run.demonstrating)} demonstrating"
            if d.steered_by_person
            else "no demonstrating: a script steered"
        ]
        if by_hand:
            notes.append(f"{duration(run.annotating)} annotating")
        elif run.annotation is not None:
            notes.append("no annotating: radii suggested by the toolkit")
        human = run.demonstrating + run.annotating
        tile("Human time", duration(human) if human else "none", *notes)
    if run.augmentation is not None:
        kept, attempted = _counts(run.augmentation)
        tile("Generated by the robot", str(kept), f"trajectories, of {attempted} attempted")
    if run.run is not None:
        stages = _field(run.run, "run.json", "stages")
        tile(
            "Wall clock",
            duration(sum(stages.values())),
            f"{_plural(len(stages), 'stage')}: {', '.join(stages)}",
        )
    return tiles


def _success_rate(evaluation: Mapping[str, Any], suffix: str = "") -> Shown:
    """Rollouts, successes, their share and its interval: at the end, or `_any` time."""
    file = "evaluation.json"
    n, successes = (
        int(_field(evaluation, file, key)) for key in ("n_episodes", f"n_success{suffix}")
    )
    low, high = _field(evaluation, file, f"ci95{suffix}")
    if n < 1:
        raise BrokenFile(f"{file}: counts {n} episodes; evaluate at least one")
    return {
        "n": n,
        "successes": successes,
        "share": successes / n,
        "low": float(low),
        "high": float(high),
    }


def _counts(augmentation: Mapping[str, Any]) -> tuple[int, int]:
    """Kept and attempted trajectories."""
    kept, attempted = (
        int(_field(augmentation, "dataset.json", key)) for key in ("n_kept", "n_attempted")
    )
    return kept, attempted


# --- the sections: what each template is given, or in words why there is nothing to show ---------


def _demonstration(run: _Run) -> Shown | str:
    if run.demonstration is None:
        return "No demo.h5 in this run: nothing was recorded yet."
    d = run.demonstration
    if not d.steps.cameras:
        return "The demonstration holds no camera images."
    camera = "wrist" if "wrist" in d.steps.cameras else sorted(d.steps.cameras)[0]
    n = min(_FILM_IMAGES, len(d))
    end = duration(float(d.timestamps[-1] - d.timestamps[0]))
    alt = f"{n} images of the {camera} camera, evenly from the start to the end after {end}"
    return {"camera": camera, "film": image(film_strip(d, camera, n), alt)}


def _spheres(run: _Run, setting: Setting | None) -> Shown | str:
    if run.demonstration is None or run.annotation is None:
        name = "demo.h5" if run.demonstration is None else "annotation.json"
        return f"No {name} in this run: there are no precision spheres to draw."
    demonstration, annotation, paths = run.demonstration, run.annotation, run.paths
    annotation.check_matches(demonstration)
    rejections: Sequence[Mapping[str, int]] = ()
    if run.augmentation is not None:
        rows = _field(run.augmentation, "dataset.json", "by_sphere")
        waypoints = [row["waypoint"] for row in rows if row["source"] == 0]
        rejections = [row["rejections"] for row in rows if row["source"] == 0]
        if waypoints != [sphere.waypoint for sphere in annotation.spheres]:
            # By a strategy that has spheres of its own.
            paths = ()

    counts = collections.Counter(path.sphere for path in paths)
    times = demonstration.timestamps - demonstration.timestamps[0]
    shown = [
        {
            "colour": sphere_colour(i),
            "waypoint": sphere.waypoint,
            "seconds": times[sphere.waypoint],
            "radius": sphere.radius,
            "clearance": sphere.clearance,
            "limited_by": _LIMITS.get(sphere.limited_by, sphere.limited_by),
            "source": sphere.source,
            "paths": counts[i] if paths else None,
            "rejections": rejections[i] if paths else None,
        }
        for i, sphere in enumerate(annotation.spheres)
    ]
    alt = (
        f"Two 3D views of the demonstrated tool path with {_plural(len(shown), 'precision sphere')}"
        + (f" and {_plural(len(paths), 'augmented path')} leading back to it" if paths else "")
    )
    robot, scene, unseen = None, None, "no robot or scene was given for it"
    if setting is not None:
        try:
            robot, scene = setting(demonstration)
            view = scene_view(demonstration, annotation, paths, robot, scene)
        # Such as a task's file that is no longer there: no reason to have no page.
        except SartError as error:
            robot, scene, unseen = None, None, str(error)
    if robot is None:
        view = scene_view(demonstration, annotation, paths)
    return {
        "drawing": image(scene_image(demonstration, annotation, paths), alt),
        "view": view,
        "unseen": unseen if robot is None else None,
        "drawn_paths": min(len(paths), MAX_SEGMENTS),
        "paths": len(paths),
        "spheres": shown,
    }


def _augmentation(run: _Run) -> Shown | str:
    if run.augmentation is None:
        return "No finished dataset in this run: nothing was generated yet."
    kept, attempted = _counts(run.augmentation)
    rejections: Mapping[str, int] = _field(run.augmentation, "dataset.json", "rejections")
    # None where generation was interrupted.
    seconds = _field(run.augmentation, "dataset.json", "seconds")
    counted = [("kept", kept, "var(--good)")]
    counted += [(reason, count, "var(--bad)") for reason, count in rejections.items()]
    return {
        "kept": kept,
        "attempted": attempted,
        "seconds": None if seconds is None else float(seconds),
        "outcomes": [
            {"name": name, "count": count, "share": count / max(attempted, 1), "colour": colour}
            for name, count, colour in counted
            if rejections
        ],
    }


def _proofs(run: _Run) -> Shown | str:
    if run.augmentation is None:
        return "No finished dataset in this run: nothing was executed that could be proved clear."
    proofs = [t.proof for t in run.trajectories if t.proof is not None]
    if not proofs:
        return "Nothing was proved: no generated trajectory has a certificate."

    def bound(which: str) -> Shown:
        """The least clearance that is proved, and between what."""
        least = min(proofs, key=lambda proof: _field(proof, "dataset", which, "clearance"))
        return {
            "clearance": float(_field(least, "dataset", which, "clearance")),
            "pair": " / ".join(filter(None, least[which].get("pair", ()))),
        }

    declared = [proof["tracking_error"] for proof in proofs if "tracking_error" in proof]
    return {
        "of": len(proofs),
        "kept": len(run.trajectories),
        "commanded": bound("commanded"),
        "measured": bound("measured"),
        "deviation": max(float(_field(proof, "dataset", "deviation")) for proof in proofs),
        "declared": max(declared, default=None),
    }


def _trajectories(run: _Run) -> Shown | str:
    if not run.trajectories:
        return "No generated trajectory in this run."
    return {
        "of": len(run.trajectories),
        "trajectories": [
            {
                "demonstration": t.source,
                "sphere": t.sphere,
                "k": t.k,
                "steps": t.steps,
                "proved": {
                    which: _field(t.proof, "dataset", which, "clearance")
                    for which in ("commanded", "measured")
                }
                if t.proof is not None
                else None,
                "command": _typed("play", t.path),
            }
            for t in run.trajectories[:_TRAJECTORIES_LISTED]
        ],
    }


def _typed(verb: str, path: Path, *more: str) -> str:
    """A command about a file, as it can be typed."""
    return shlex.join(["sart", verb, str(path), *more])


def _training(run: _Run) -> Shown | str:
    if run.training is None:
        return "No skill/training.json in this run: no policy was trained yet."
    file = "training.json"
    curve = _field(run.training, file, "curve")
    if not curve:
        raise BrokenFile(f"{file}: its curve has no epoch; train the skill again")
    epochs = [float(_field(row, file, "epoch")) for row in curve]
    losses = [float(_field(row, file, "loss")) for row in curve]

    if not any(losses):
        return "Nothing was learned: the policy has no loss to lower."

    def draw(theme: Theme) -> bytes:
        return training_curve(epochs, losses, theme)

    alt = (
        f"Training loss over {_plural(len(curve), 'epoch')}, on a logarithmic scale, ending at "
        f"{losses[-1]:.2g}"
    )
    return {
        "policy": (run.training.get("config") or {}).get("policy", "the policy"),
        "epochs": len(curve),
        "seconds": sum(float(_field(row, file, "seconds")) for row in curve),
        "images_per_second": run.training.get("images_per_second"),
        "curve": drawn(draw, alt),
    }


def _success(run: _Run) -> Shown | str:
    if run.evaluation is None:
        return "No evaluation.json in this run: the skill was not evaluated yet."
    episodes = _field(run.evaluation, "evaluation.json", "episodes")
    kinds = [
        {
            "reason": kind.reason,
            "count": len(kind.episodes),
            "reached": reached_words(kind),
            "drawing": last_images(
                [(run.directory, e) for e in episodes if e["episode"] in kind.episodes]
            )
            if rank < _KINDS_PICTURED
            else None,
        }
        for rank, kind in enumerate(group_failures(episodes))
    ]
    at_any_time = None
    if "n_success_any" in run.evaluation:
        at_any_time = _success_rate(run.evaluation, "_any")
    return {
        "at_end": _success_rate(run.evaluation),
        "at_any_time": at_any_time,
        "kinds": kinds,
        "placements": _placements(run, episodes),
    }


def reached_words(kind: FailureKind) -> str:
    """How far along the demonstration failures of a kind came, and when."""
    if kind.waypoint is None:
        return "none came within 2 cm of the demonstrated path"
    return f"furthest waypoint {kind.waypoint:.0f}, after {kind.seconds:.1f}{_SPACE}s"


def last_images(rollouts: Iterable[tuple[Path, Mapping[str, Any]]]) -> Shown | None:
    """What cameras saw at the end of some rollouts, with how each ended; None where none is kept.

    Args:
        rollouts: directory and row of `evaluation.json`.
    """
    images: list[Image] = []
    captions: list[str] = []
    for directory, row in rollouts:
        path = directory / str(row.get("final_image"))
        if not path.is_file() or len(images) == _LAST_IMAGES:
            continue
        with PillowImage.open(path) as opened:
            images.append(np.asarray(opened.convert("RGB")))
        reached = row.get("progress")
        moment = f"waypoint {reached['waypoint']} at {reached['seconds']:g} s; " if reached else ""
        captions.append(f"{row['episode']}: {moment}{row.get('reason')}")
    if not images:
        return None
    alt = (
        f"What overview and wrist camera saw at the end of {_plural(len(images), 'failed rollout')}"
    )
    # Four in rows of three would leave a gap.
    return image(montage(images, captions, 2 if len(images) == 4 else 3), alt)


def _placements(run: _Run, episodes: Sequence[Mapping[str, Any]]) -> Shown | None:
    placed = [e for e in episodes if e.get("placement")]
    if not placed:
        return None
    places = [e["placement"] for e in placed]
    outcomes = [_field(e, "evaluation.json", "outcome") for e in placed]
    names = {name for place in places for name in place}
    # The demonstration's own placement has no name; it is clear only where there is one object.
    shown = run.demonstration.task_parameters.get("placement") if run.demonstration else None
    demonstrated = {names.pop(): shown} if shown and len(names) == 1 else None

    def draw(theme: Theme) -> bytes:
        return placement_image(places, outcomes, demonstrated, theme)

    good = outcomes.count("success")
    bad = len(places) - good
    alt = f"Top view of {len(places)} object placements: {good} successes, {bad} failures"
    return drawn(draw, alt)


def _videos(run: _Run, out: Path) -> Shown | str:
    if run.evaluation is None:
        return "No evaluation.json in this run: there are no rollouts to show."
    rows = run.evaluation.get("videos") or []
    if not rows:
        return "The evaluation made no videos."
    episodes = {e["episode"]: e for e in _field(run.evaluation, "evaluation.json", "episodes")}
    videos: list[Shown] = []
    absent: list[str] = []
    beside: list[Shown] = []
    room = MAX_VIDEO_BYTES
    for row in _alternating(rows):
        name = str(_field(row, "evaluation.json", "path"))
        path = (run.directory / name).resolve()
        if not path.is_relative_to(run.directory.resolve()):
            raise BrokenFile(
                f"evaluation.json: video {name!r} lies outside the run; evaluate again"
            )
        if not path.is_file():
            absent.append(name)
            continue
        if path.stat().st_size > room:
            link = os.path.relpath(path, out.resolve().parent)
            beside.append({"name": name, "href": urllib.parse.quote(link)})
            continue
        content = path.read_bytes()
        room -= len(content)
        videos.append(
            {
                "src": data_uri("video/mp4", content),
                "poster": data_uri("image/jpeg", last_frame(path)),
                "episode": row.get("episode", "?"),
                "outcome": str(row.get("outcome", "")),
                "evaluated_outcome": row.get("evaluated_outcome"),
                "reason": episodes.get(row.get("episode"), {}).get("reason"),
            }
        )
    rate = _success_rate(run.evaluation)
    return {
        "videos": videos,
        "absent": absent,
        "beside": beside,
        "all_succeeded": rate["successes"] == rate["n"],
    }


def _alternating(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The first of each outcome, then the second of each, and so on."""
    seen: collections.Counter[Any] = collections.Counter()
    ranked = []
    for row in rows:
        seen[row.get("outcome")] += 1
        ranked.append((seen[row.get("outcome")], row))
    return [row for _, row in sorted(ranked, key=lambda pair: pair[0])]


def _rollouts(run: _Run) -> Shown | str:
    if run.evaluation is None:
        return "No evaluation.json in this run: there are no rollouts to list."
    file = "evaluation.json"
    rows = []
    for e in _field(run.evaluation, file, "episodes"):
        seed = e.get("seed", "")
        rows.append(
            {
                "episode": _field(e, file, "episode"),
                "seed": f",{_SPACE}".join(map(str, seed)) if isinstance(seed, list) else seed,
                "placement": _placement_words(e.get("placement") or {}),
                "outcome": str(_field(e, file, "outcome")),
                "success_any": bool(e.get("success_any")),
                "steps": e.get("steps", ""),
                "reason": e.get("reason") or "",
            }
        )
    return {"rollouts": rows}


def _placement_words(placement: Mapping[str, Mapping[str, float]]) -> str:
    words = []
    for name, at in placement.items():
        x, y, yaw = (float(at.get(key, 0.0)) for key in ("x", "y", "yaw_deg"))
        turned = f", {yaw:+.0f}°" if yaw else ""
        words.append(f"{name} {1e3 * x:+.1f}, {1e3 * y:+.1f} mm{turned}")
    return "; ".join(words)


def _time(run: _Run) -> Shown | str:
    if run.run is None:
        return "No run.json in this run: the stages were run one by one."
    stages: Mapping[str, float] = _field(run.run, "run.json", "stages")
    total = sum(stages.values())
    return {
        "seconds": total,
        "machine": [
            f"memory {value} GiB" if key == "memory_gib" else f"{key.replace('_', ' ')} {value}"
            for key, value in (run.run.get("machine") or {}).items()
        ],
        "stages": [
            {"name": name, "seconds": seconds, "share": seconds / (total or 1.0)}
            for name, seconds in stages.items()
        ],
    }


def _details(run: _Run) -> Shown | str:
    def config(part: Mapping[str, Any] | None) -> Any:
        return (part or {}).get("config")

    versions: Shown = {}
    for part in (run.evaluation, run.run):
        versions |= (part or {}).get("versions") or {}
    hashes: Shown = {}
    if run.demonstration is not None:
        hashes["demonstration"] = run.demonstration.content_hash()
    if run.augmentation is not None:
        hashes["dataset"] = run.augmentation.get("content_hash")
    groups = {
        "Run configuration": config(run.run),
        "Augmentation configuration": config(run.augmentation),
        "Training configuration": config(run.training),
        "Evaluation configuration": config(run.evaluation),
        "Versions": versions,
        "Content hashes (SHA-256)": hashes,
    }
    return {
        "commands": _commands(run),
        "version": versions.get("sart_toolkit"),
        "commit": (run.run or {}).get("commit"),
        "groups": {name: list(_flat(value)) for name, value in groups.items() if value},
    }


def _commands(run: _Run) -> dict[str, str]:
    """What each command does, and the command."""
    commands: dict[str, str] = {}
    if run.run is not None and run.run.get("command"):
        commands["all of it"] = str(run.run["command"])
    if run.demonstration is not None:
        commands["see the demonstration"] = _typed("play", run.demonstrations[0])
    if run.trajectories:
        commands["see a generated trajectory"] = _typed("play", run.trajectories[0].path)
    if (run.directory / "skill" / "config.json").exists():
        again = str(run.directory / "again.json")
        commands["evaluate the skill again"] = _typed(
            "evaluate", run.directory / "skill", "--out", again
        )
    commands["make this page"] = _typed("report", run.directory)
    return commands


# --- the page -----------------------------------------------------------------------------------


@functools.cache
def templates() -> jinja2.Environment:
    """The pages' templates, with their filters."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sart_toolkit.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "duration": duration,
        "percent": percent,
        "millimetres": _millimetres,
        "at_least_mm": at_least_mm,
        "at_most_mm": at_most_mm,
        "plural": _plural,
        "sha256": _script_hash,
        "breakable": _breakable,
    }
    return environment


def _breakable(name: str) -> markupsafe.Markup:
    """Names whose lines may end after an underscore."""
    return markupsafe.Markup("_<wbr>").join(name.split("_"))


def _script_hash(script: str) -> str:
    """What a page's policy calls a script that may run, so that no other does."""
    digest = hashlib.sha256(script.encode()).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"


def _script(name: str) -> str:
    loader = templates().loader
    assert loader is not None
    return loader.get_source(templates(), name)[0]


def _sections(
    run: _Run, out: Path, setting: Setting | None
) -> Iterable[tuple[str, str, Shown | str]]:
    """Title, template and what it is given of each section, or why there is nothing to show."""
    return (
        ("The skill at work", "videos.html", _videos(run, out)),
        ("The demonstration", "demonstration.html", _demonstration(run)),
        ("Where precision matters", "spheres.html", _spheres(run, setting)),
        ("What the robot generated by itself", "augmentation.html", _augmentation(run)),
        ("What is proved, what was measured", "proofs.html", _proofs(run)),
        ("Learning", "training.html", _training(run)),
        ("How well it works", "success.html", _success(run)),
        ("Every rollout", "rollouts.html", _rollouts(run)),
        ("Every generated trajectory", "trajectories.html", _trajectories(run)),
        ("Where the time went", "time.html", _time(run)),
        ("To make it again", "details.html", _details(run)),
    )


def _page(run: _Run, out: Path, setting: Setting | None) -> str:
    names = _names(run)
    task = names.get("task", run.directory.resolve().name)
    try:
        sections, scripts = [], ["page.js"]
        for title, template, found in _sections(run, out, setting):
            absent, shown = (found, None) if isinstance(found, str) else (None, found)
            if shown is not None and "view" in shown:
                scripts.append("view.js")
            sections.append(
                {
                    "title": title,
                    "anchor": template.partition(".")[0],
                    "template": template,
                    "shown": shown,
                    "absent": absent,
                }
            )
        return (
            templates()
            .get_template("page.html")
            .render(
                task=task[:1].upper() + task[1:].replace("_", " "),
                lead=_lead(run),
                facts={key: value for key, value in names.items() if value},
                tiles=_tiles(run),
                sections=sections,
                scripts=[_script(name) for name in scripts],
            )
        )
    except SartError:
        raise
    except (TypeError, ValueError, AttributeError) as error:
        raise BrokenFile(
            f"{run.directory}: a JSON file of the run holds a value of the wrong type ({error}); "
            "make that part again"
        ) from error
