"""`sart info`, and what the verbs say of what they made."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sart_toolkit.cli.arguments import Info
from sart_toolkit.data.dataset import MANIFEST, Dataset, load_dataset
from sart_toolkit.data.records import Demonstration
from sart_toolkit.data.schemas import EvaluationFile, RunFile
from sart_toolkit.data.storage import annotation_from_json, load_recording, read_json
from sart_toolkit.errors import BrokenFile, MissingFile
from sart_toolkit.learn.skillfiles import load_files
from sart_toolkit.robots import ROBOTS, get_robot
from sart_toolkit.tasks import TASKS, get_task

if TYPE_CHECKING:
    from sart_toolkit.tasks.task import Task


def info_verb(args: Info) -> dict[str, Any]:
    """`sart info`: by what the file or directory holds."""
    path = args.file
    if not path.exists():
        raise MissingFile(f"{path}: no such file or directory; check the path")
    if path.is_dir():
        if (path / "run.json").exists():
            state = read_json(path / "run.json", RunFile)
            return {"kind": "run", **state["config"], "stages": state["stages"]}
        if (path / "model.safetensors").exists():
            return {"kind": "skill", **describe_skill(path), "hash_checked": "yes, of every file"}
        if (path / MANIFEST).exists():
            described = describe_dataset(load_dataset(path))
            checked = "of dataset.json and manifest.jsonl; of each other file when it is read"
            return {"kind": "dataset", **described, "hash_checked": checked}
        raise BrokenFile(f"{path}: holds no run, skill or dataset; pass another directory")
    if path.suffix == ".json":
        value = read_json(path, dict, sealed=False)
        if "spheres" in value:
            spheres = annotation_from_json(value, path).spheres
            return {
                "kind": "annotation",
                "demonstration": value["demonstration_hash"],
                "spheres": [
                    f"waypoint {s.waypoint}: {s.radius * 1e3:.1f} mm ({s.source})" for s in spheres
                ],
                "hash_checked": "no, a person may edit it; where it is used, that it names its "
                "demonstration",
            }
        if "success_rate" in value:
            value = read_json(path, EvaluationFile)
            return {"kind": "evaluation", **without_rows(value), "hash_checked": "yes"}
        raise BrokenFile(f"{path}: neither an annotation nor an evaluation; pass another file")
    recording = load_recording(path)
    if isinstance(recording, Demonstration):
        described = {**describe_demonstration(recording), **_checked(recording)}
        return {"kind": "demonstration", **described, "hash_checked": "yes"}
    return {
        "kind": "episode",
        "steps": len(recording),
        **plain(recording.provenance),
        "hash_checked": "yes",
    }


def describe_demonstration(
    demonstration: Demonstration, task: Task | None = None
) -> dict[str, Any]:
    """A demonstration in a few words; whether it succeeded, where its task is one of ours or given.

    A file may name any code as its task, which is not to run only to look at the file.
    """
    d = demonstration
    if task is None and d.task in TASKS and d.reference("task") == d.task:
        task = get_task(d.task)
    held = next((n for n, now in enumerate(d.success[::-1]) if not now), len(d))
    return {
        "task": d.task,
        "robot": d.robot,
        "backend": d.backend,
        "waypoints": len(d),
        "seconds": float(d.timestamps[-1] - d.timestamps[0]),
        **({} if task is None else {"success": task.achieved(d.success, d.rates.record_hz)}),
        "goal_held_seconds": held / d.rates.record_hz,
        "judged_by": d.judged_by,
        "placement": dict(d.task_parameters.get("placement", {})),
        "varied_appearance": "appearance" in d.task_parameters,
        "cameras": {k: "x".join(map(str, c.rgb.shape[2:0:-1])) for k, c in d.steps.cameras.items()},
        "operator": d.operator,
        "device": d.device,
        # Nobody's time was spent where a script steered.
        **({"seconds_spent": round(d.seconds, 1)} if d.steered_by_person else {}),
        "content_hash": d.content_hash(),
    }


def _checked(demonstration: Demonstration) -> dict[str, Any]:
    """What is wrong with a demonstration, compared with its robot where that is one of ours."""
    from sart_toolkit.record.checks import inspect_recording

    ours = demonstration.robot in ROBOTS and demonstration.reference("robot") == demonstration.robot
    found = inspect_recording(demonstration, get_robot(demonstration.robot) if ours else None)
    return {"problems": list(found.problems), "warnings": list(found.warnings)}


def describe_dataset(dataset: Dataset) -> dict[str, Any]:
    """A dataset in a few words."""
    keys = (
        "task",
        "n_trajectories",
        "n_kept",
        "n_attempted",
        "rejections",
        "seconds",
        "content_hash",
    )
    clearance = dataset.info.get("least_commanded_clearance_m")
    resets = dataset.info.get("resets")
    return (
        {k: dataset.info.get(k) for k in keys}
        | ({"resets": resets} if resets else {})
        | {"least_commanded_clearance_mm": None if clearance is None else 1e3 * clearance}
    )


def describe_skill(path: Path) -> dict[str, Any]:
    """A skill's directory in a few words, its files compared with their hashes."""
    files = load_files(path)
    config, training = files.config, files.training
    try:
        return {
            "task": config["task"],
            "robot": config["robot"],
            "policy": config["training"]["policy"],
            "epochs": config["training"]["epochs"],
            "image_size": config["training"]["image_size"],
            "trajectories": training["trajectories"],
            "final_loss": training["final_loss"],
            "seconds": training["seconds"],
            "images_per_second": training["images_per_second"],
        }
    except (KeyError, TypeError) as error:
        raise BrokenFile(f"{path}: {error} is missing or wrong; train it again") from error


def without_rows(evaluation: dict[str, Any]) -> dict[str, Any]:
    """The figures of an evaluation, without what it lists for each episode."""
    rows = ("episodes", "versions", "config", "seeds", "videos")
    return {k: v for k, v in evaluation.items() if k not in rows}


def plain(record: Any) -> dict[str, Any]:
    """A dataclass as JSON values."""

    def simple(value: Any) -> Any:
        return value.tolist() if isinstance(value, np.ndarray) else str(value)

    plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(record), default=simple))
    return plain
