"""What each JSON file of ours holds, as types that a file's values are checked against when read.

Numbers are finite and whole ones fit 64 bits; a file in which anything is missing or of another
type is a `BrokenFile`. Where a table takes fields that aren't listed, they are anyone's to add.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

Count = Annotated[int, Meta(ge=0, le=2**53)]
Seconds = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
Hash = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
Name = Annotated[str, Meta(min_length=1, max_length=1000, pattern=r"^[^\x00-\x1f]*$")]
# What stands in a file may be looked for in its directory and below, nowhere else.
PathInside = Annotated[
    str, Meta(max_length=1000, pattern=r"^(?!/)(?!.*(^|/)\.\.(/|$))[^\x00-\x1f\\]+$")
]
Matrix = list[list[float]]
References = dict[Literal["task", "robot", "backend"], Name]
Values = dict[str, Any]


class Sphere(msgspec.Struct, forbid_unknown_fields=True):
    """A sphere of `annotation.json`."""

    waypoint: int | float
    radius_m: float
    T_world_key: Matrix
    kind: Literal["ball", "free_space"] = "ball"
    source: Literal["human", "suggested"] = "human"
    clearance_m: float | None = None
    limited_by: str | None = None


class AnnotationFile(msgspec.Struct, forbid_unknown_fields=True):
    """`annotation.json`, which a person may edit."""

    demonstration_hash: str
    spheres: list[Sphere]
    about: str = ""
    seconds_spent: float = 0.0
    settings: Values = {}


class ManifestOrigin(msgspec.Struct, forbid_unknown_fields=True):
    """Which number a source had in the dataset that it was generated in, and that one's request."""

    number: Count
    request: Values


class ManifestSource(msgspec.Struct, forbid_unknown_fields=True):
    """A demonstration and its annotation in a manifest, by their hashes."""

    demonstration: str
    annotation: str | None
    # Where the dataset was made of others.
    origin: ManifestOrigin | UnsetType = UNSET


class ManifestHead(msgspec.Struct, forbid_unknown_fields=True):
    """The first line of `manifest.jsonl`."""

    schema_version: int
    sources: list[ManifestSource]
    request: Values


class ManifestRow(msgspec.Struct, forbid_unknown_fields=True):
    """Any other line of `manifest.jsonl`: how an attempt ended."""

    source: Count
    sphere: Count
    k: Count
    outcome: str
    detail: str = ""
    steps: Count | None = None
    content_hash: str | None = None
    clearance_m: float | None = None
    seconds: Seconds | None = None


class Tally(msgspec.Struct):
    """How the attempts from one sphere ended."""

    source: Count
    waypoint: Count
    kept: Count
    rejections: dict[str, Count]
    # What was allocated to it at first.
    wanted: Count | UnsetType = UNSET


class DatasetFile(msgspec.Struct):
    """`dataset.json`; besides, whatever the engine says of its settings."""

    n_trajectories: Count
    n_kept: Count
    n_attempted: Count
    rejections: dict[str, Count]
    by_sphere: list[Tally]
    least_commanded_clearance_m: float | None
    content_hash: str
    manifest_hash: str
    versions: dict[str, str]
    task: Name | UnsetType = UNSET
    robot: Name | UnsetType = UNSET
    # What it is for, if no other is asked for.
    policy: Name | UnsetType = UNSET
    seconds: Seconds | None | UnsetType = UNSET
    simulated_seconds: Seconds | None | UnsetType = UNSET
    resets: Count | None | UnsetType = UNSET
    config: Values | UnsetType = UNSET
    references: References | UnsetType = UNSET


class Epoch(msgspec.Struct):
    """An epoch of a training curve."""

    epoch: Count
    loss: float
    seconds: Seconds


class TrainingFile(msgspec.Struct):
    """A skill's `training.json`."""

    curve: list[Epoch]
    images_per_second: float
    config: Values
    final_loss: float | UnsetType = UNSET
    seconds: Seconds | UnsetType = UNSET
    windows: Count | UnsetType = UNSET
    trajectories: Count | UnsetType = UNSET
    device: str | UnsetType = UNSET
    bfloat16: bool | UnsetType = UNSET
    versions: dict[str, str] = {}


class SkillFile(msgspec.Struct):
    """A skill's `config.json`; `SkillConfig` checks what is inside its parts."""

    # The hashes of the skill's other files, by their names.
    files: dict[str, Hash]
    demonstration_hash: Hash
    task: Name | UnsetType = UNSET
    robot: Name | UnsetType = UNSET
    backend: Name | UnsetType = UNSET
    references: References | UnsetType = UNSET
    task_parameters: Values | UnsetType = UNSET
    training: Values | UnsetType = UNSET
    cameras: Values | UnsetType = UNSET


class Reached(msgspec.Struct, forbid_unknown_fields=True):
    """The furthest waypoint that a rollout reached, of how many, and when."""

    waypoint: Count
    of: Count
    seconds: Seconds


class EvaluatedEpisode(msgspec.Struct):
    """A rollout of `evaluation.json`."""

    episode: Count
    outcome: Literal["success", "failure"]
    seed: list[Count] | str | Count = ""
    placement: dict[str, dict[str, float]] = {}
    success_any: bool = False
    steps: Count | str = ""
    reason: str | None = None
    progress: Reached | None = None
    final_image: PathInside | None = None


class Video(msgspec.Struct):
    """A video that an evaluation made."""

    path: PathInside
    episode: Count
    outcome: str
    evaluated_outcome: str | None = None


class EvaluationFile(msgspec.Struct):
    """`evaluation.json`."""

    task: str
    backend: str
    robot: str
    policy: str
    n_episodes: Annotated[int, Meta(ge=1, le=2**53)]
    n_success: Count
    success_rate: Share
    ci95: tuple[float, float]
    episodes: list[EvaluatedEpisode]
    n_success_any: Count | UnsetType = UNSET
    success_rate_any: Share | UnsetType = UNSET
    ci95_any: tuple[float, float] | UnsetType = UNSET
    seeds: Values | UnsetType = UNSET
    seconds: Seconds | UnsetType = UNSET
    config: Values | UnsetType = UNSET
    videos: list[Video] = []
    versions: dict[str, str] = {}


class CalibrationFile(msgspec.Struct, forbid_unknown_fields=True):
    """A camera's calibration."""

    kind: Literal["calibration"]
    camera: Name
    frame: Literal["tool", "world"]
    T_frame_camera: Matrix
    intrinsics: Matrix
    image_size: tuple[int, int]
    hand_eye: float
    hand_eye_deg: float
    axis_errors: tuple[float, float, float]
    axis_errors_deg: tuple[float, float, float]
    square_scale: float
    rms_pixels: float
    views: Count
    board: Values
    left_out: list[str]
    depth_scale: float | None
    depth_scale_error: float | None
    versions: dict[str, str]


class RunFile(msgspec.Struct):
    """`run.json`."""

    config: Values
    stages: dict[str, Seconds]
    command: str = ""
    versions: dict[str, str] = {}
    # Of the toolkit's own Git checkout, where it ran from one.
    commit: str | None = None
    machine: Values = {}


class JobFile(msgspec.Struct, forbid_unknown_fields=True):
    """`job.json` of a benchmark's stage that is done."""

    stage: Literal["record", "suggest", "augment", "train", "evaluate"]
    options: Values
    size: Annotated[int, Meta(ge=1, le=2**53)]
    seconds: Seconds
    bytes: Count
    figures: Values


class CellFile(msgspec.Struct):
    """A cell of a benchmark; besides, whatever was kept with it."""

    name: Name
    cell: Values
    keys: dict[str, str]
    seconds: dict[str, Seconds]
    figures: dict[str, Values]
    # None where only effort was asked for.
    evaluation: EvaluationFile | None
    command: str = ""


class StateHead(msgspec.Struct):
    """What a saved state says of itself; besides, the backend's own values."""

    robot: str
    scene: str
    bodies: list[str]
