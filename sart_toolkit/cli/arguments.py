"""What each verb of `sart` takes, as frozen dataclasses that become its flags."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from sart_toolkit.augment import STRATEGIES
from sart_toolkit.backends import DEFAULT_BACKEND
from sart_toolkit.data.formats import FORMATS
from sart_toolkit.errors import InvalidInput


def _optional(metavar: str, help: str) -> Any:
    """A flag that may be left out, what happens then being in its help."""
    return arg(metavar=metavar, help=help, help_behavior_hint="")


def _several(metavar: str, help: str) -> Any:
    """A flag that takes several values, or may be left out."""
    return arg(metavar=f"{metavar} [{metavar} ...]", help=help, help_behavior_hint="")


def whole_numbers(flag: str, text: str) -> tuple[int, ...]:
    """The numbers in a flag's comma-separated list.

    Raises:
        InvalidInput: something else is in it.
    """
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError as error:
        raise InvalidInput(
            f"--{flag}: expected whole numbers separated by commas, got {text!r}"
        ) from error


_JSON = Annotated[bool, arg(name="json", help="Print the result as one JSON object on stdout.")]
_OVERWRITE = Annotated[bool, arg(help="Replace what is at the output path.")]
_TASK = Annotated[
    Positional[str],
    arg(metavar="TASK", help="Task, such as peg_in_hole, or your own: drawer.py:Drawer."),
]
_BACKEND = Annotated[
    str,
    arg(
        metavar="REF",
        help="Simulator or robot to run on: pybullet (Python 3.11 only), sapien, a cell's TOML "
        "file, or your own.",
    ),
]
_REF = "a name, module:NAME or file.py:NAME"
_ROBOT = Annotated[str | None, _optional("REF", f"Robot, as {_REF}; the task's own if left out.")]
_NOTED_TASK = Annotated[
    str | None, _optional("REF", f"Task, as {_REF}; what the recording notes if left out.")
]
_NOTED_ROBOT = Annotated[
    str | None, _optional("REF", f"Robot, as {_REF}; what the recording notes if left out.")
]
_NOTED_BACKEND = Annotated[
    str | None, _optional("REF", f"Backend, as {_REF}; what the recording notes if left out.")
]
_EPOCHS = Annotated[int | None, _optional("INT", "Training epochs; the policy's own if left out.")]
_WORKERS = Annotated[int, arg(help="Processes to use, or workers on the cluster.")]
_EXECUTOR = Annotated[
    Literal["processes", "ray"],
    arg(help="What runs the workers: processes of this machine, or the nodes of a Ray cluster."),
]
_RAY_ADDRESS = Annotated[
    str | None,
    _optional(
        "ADDRESS",
        "With --executor ray: HOST:PORT of the cluster, auto for the one that this machine belongs "
        "to, or local for one of this command's own; if left out RAY_ADDRESS, else auto, else "
        "local.",
    ),
]
_SEED = Annotated[int, arg(help="Seed of everything random in this step.")]
_IMAGE = Annotated[
    str, arg(help="Size of recorded images [pixels]: 128, or width and height as in 160x120.")
]
_CAMERAS = Annotated[
    str, arg(help="Cameras to record and learn from, comma-separated, such as wrist,overview.")
]
_DEVICE = Annotated[Literal["auto", "cpu", "cuda"], arg(help="Where the policy runs.")]
_STRATEGY = Annotated[
    str,
    arg(
        metavar="REF",
        help=f"How segments are drawn, as in docs/strategies.md: {', '.join(STRATEGIES)}; or your "
        "own.",
    ),
]
_POLICY = Annotated[
    str | None,
    _optional(
        "REF",
        "Policy: compact_mlp, resnet18_mlp as in the paper, replay, or your own; what the strategy "
        "is for if left out (compact_mlp, or replay).",
    ),
]
_RECORDING = Annotated[
    Literal["reversed", "return"],
    arg(
        help="Which way is recorded: out, reversed as in the paper, or the return, on which "
        "the robot lags behind its commands as it does when a policy acts."
    ),
]
_N = Annotated[
    int | None,
    _optional(
        "INT",
        "Trajectories in all, the demonstrations among them; 40 if left out, or what the strategy "
        "needs.",
    ),
]
_EPISODES = Annotated[int, arg(help="Rollouts with random placements.")]
_EVAL_SEED = Annotated[int, arg(help="Seed of the placements, separate from training's.")]
_YAW = Annotated[
    float, arg(help="Also turn the object, uniformly within ± this [deg]; the paper does not.")
]
_APPEARANCE = Annotated[
    bool, arg(help="Vary colours, light and the wrist camera's mounting at random.")
]
_TASKS = Annotated[str, arg(help="Comma-separated names of tasks, or all.")]
_BACKENDS = Annotated[str, arg(help="Comma-separated names of backends, or all.")]
_SLIP_TOLERANCE = Annotated[
    float, arg(help="In-grasp slip tolerance [m]: so much more is kept clear of a grasped object.")
]
_SOURCE = Annotated[
    Literal["scene", "cloud"],
    arg(help="What is known of obstacles: the simulated scene, or the recorded RGB-D alone."),
]
_UNKNOWN = Annotated[
    Literal["behind", "free"],
    arg(help="With --source cloud: space behind what was seen counts as solid, or as free."),
]
_SENSOR = Annotated[
    Literal["exact", "d405", "d435"] | None,
    _optional(
        "{exact,d405,d435}",
        "With --source cloud: noise and flying pixels of the depth camera; exact if left out.",
    ),
]
_HAND_EYE = Annotated[
    str | None,
    _optional(
        "MM,DEG",
        "With --source cloud: how far the camera may be from where it is recorded to be, as in "
        "2,0.3; what the cell's file says if left out, nothing where there is none.",
    ),
]
_DEPTH_SCALE = Annotated[
    float | None,
    _optional(
        "PERCENT", "With --source cloud: largest error of the depth's scale; none if left out."
    ),
]
_CALIBRATION = Annotated[
    tuple[Path, ...],
    _several(
        "JSON",
        "With --source cloud: files from `sart calibrate`, one for each camera with depth, whose "
        "errors are declared in place of --hand-eye-error; none if left out.",
    ),
]
_TOOL_MARGIN = Annotated[
    float | None,
    _optional(
        "METRES",
        "Distance kept free around the tool [m]; what augmentation proves on the backend, by its "
        "tracking error, if left out (0.8 mm on the simulators).",
    ),
]
_MIN_RADIUS = Annotated[float, arg(help="Smallest radius of a sphere [m].")]
_MAX_RADIUS = Annotated[float, arg(help="Largest radius of a sphere [m].")]
_DISTRIBUTION = Annotated[
    Literal["paper", "area"],
    arg(help="How positions are drawn on a sphere: as the paper says, or uniform over its area."),
]


@dataclass(frozen=True)
class Run:
    """Everything: record, suggest, augment, train, evaluate, report.

    Example: sart run peg_in_hole --out runs/peg

    Example: sart run peg_in_hole --out runs/peg --n 40 --episodes 100 --workers 2

    Example: sart run drawer.py:Drawer --robot my_panda:PANDA --out runs/drawer

    Example: sart run peg_in_hole --out runs/bc --strategy bc

    Example: sart run peg_in_hole --out runs/three --demonstrations 3

    An interrupted run resumes when the same command is typed again.
    """

    task: _TASK
    out: Annotated[Path, arg(help="Directory to write.")]
    backend: _BACKEND = DEFAULT_BACKEND
    robot: _ROBOT = None
    strategy: _STRATEGY = "sart"
    policy: _POLICY = None
    n: _N = None
    demonstrations: Annotated[
        int | None,
        _optional(
            "INT",
            "Demonstrations to record, at random placements if more than one; 1 if left out, or "
            "all N with bc.",
        ),
    ] = None
    episodes: _EPISODES = 50
    seed: _SEED = 0
    eval_seed: _EVAL_SEED = 1000
    cameras: _CAMERAS = "wrist"
    image_size: _IMAGE = "128"
    distribution: _DISTRIBUTION = "area"
    recording: _RECORDING = "reversed"
    epochs: _EPOCHS = None
    workers: _WORKERS = 2
    executor: _EXECUTOR = "processes"
    ray_address: _RAY_ADDRESS = None
    device: _DEVICE = "auto"
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Record:
    """Record one demonstration: steered by you, in a window, or by the scripted operator.

    Example: sart record peg_in_hole --out demo.h5

    Example: sart record peg_in_hole --out demo.h5 --device keyboard

    Example: sart record toolbox_picking --out demo.h5 --backend sapien

    Example: sart record peg_in_hole --out demo.h5 --seed 3 --placement random --yaw-deg 10

    Example: sart record peg_in_hole --out demos --count 40 --placement random
    """

    task: _TASK
    out: Annotated[Path, arg(help="HDF5 file to write; with --count, the directory of as many.")]
    count: Annotated[
        int | None,
        _optional(
            "INT",
            "Record several, in directory OUT, each with a seed of its own; those that are there "
            "are kept.",
        ),
    ] = None
    device: Annotated[
        str,
        arg(
            metavar="REF",
            help="What steers: keyboard, spacemouse, gamepad, hand_guiding (a real arm, moved by "
            "hand), scripted, or your own.",
        ),
    ] = "scripted"
    backend: _BACKEND = DEFAULT_BACKEND
    robot: _ROBOT = None
    frame: Annotated[
        Literal["world", "tool"] | None,
        _optional(
            "{world,tool}",
            "What your directions are fixed to at first; world if left out. F changes it.",
        ),
    ] = None
    operator: Annotated[
        str | None,
        _optional("TEXT", "Who steers, kept with the demonstration; 'person' if left out."),
    ] = None
    max_seconds: Annotated[float, arg(help="Longest demonstration [s].")] = 120.0
    status: Annotated[
        Path | None,
        _optional(
            "PATH",
            "File for others to watch: a JSON line for each recorded step; none if left out.",
        ),
    ] = None
    seed: _SEED = 0
    placement: Annotated[
        Literal["middle", "random"], arg(help="Where the object stands in its range.")
    ] = "middle"
    yaw_deg: _YAW = 0.0
    vary_appearance: _APPEARANCE = False
    image_size: _IMAGE = "128"
    cameras: _CAMERAS = "wrist"
    overwrite: _OVERWRITE = False
    json: _JSON = False


_WEB = Annotated[bool, arg(help="In a browser, also another computer's over ssh.")]
_HOST = Annotated[
    str | None, _optional("ADDRESS", "Where --web is reached; 127.0.0.1, this computer only.")
]
_PORT = Annotated[int | None, _optional("PORT", "Port of --web; 8080.")]


@dataclass(frozen=True)
class Play:
    """Look at a demonstration or an episode again, in a window, a browser or as an MP4 video.

    Example: sart play demo.h5

    Example: sart play dataset/episodes/demo00/sphere00_k00000.h5 --web

    Example: sart play dataset/episodes/demo00/sphere00_k00000.h5 --out episode.mp4

    Example: sart play demo.h5 --camera wrist --out wrist.mp4 --speed 0.5
    """

    file: Annotated[
        Positional[Path], arg(metavar="FILE", help="Demonstration, or an episode in its dataset.")
    ]
    out: Annotated[
        Path | None, _optional("PATH", "MP4 file to write; shown in a window if left out.")
    ] = None
    web: _WEB = False
    host: _HOST = None
    port: _PORT = None
    camera: Annotated[
        str | None,
        _optional(
            "CAMERA",
            "A camera of the scene, drawn again, or a recorded one, such as wrist; overview if "
            "left out. With --web: the recorded one that is shown beside the view.",
        ),
    ] = None
    speed: Annotated[float, arg(help="Playback speed; 1 is real time.")] = 1.0
    task: _NOTED_TASK = None
    robot: _NOTED_ROBOT = None
    backend: _NOTED_BACKEND = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Calibrate:
    """Find where a camera is mounted, and how far it may be off, from images of a printed board.

    Example: sart calibrate --board board.pdf

    Example: sart calibrate pictures --out wrist.json

    Example: sart calibrate pictures --out wrist.json --intrinsics 606,606,319.5,239.5

    Example: sart calibrate board.h5 --out wrist.json --square-mm 30 --marker-mm 22

    Example: sart calibrate pictures --out overview.json --camera overview --mount world

    Print the board in true size, lay it flat, and take 15 to 25 images of it from all sides, tilted
    by 15 to 30 degrees. A folder holds poses.csv beside the images, as docs/calibration.md has it;
    a demonstration (.h5) has both. A camera that stands in the world looks at a board in the
    gripper.
    """

    source: Annotated[
        Positional[Path | None],
        arg(
            metavar="SOURCE",
            help="Folder with images and poses.csv, or a demonstration that shows the board.",
            help_behavior_hint="",
        ),
    ] = None
    out: Annotated[Path | None, _optional("PATH", "JSON file to write.")] = None
    board: Annotated[
        Path | None,
        _optional("PATH", "Write the board instead, as .pdf or .png to print in true size."),
    ] = None
    camera: Annotated[str, arg(help="The camera's name.")] = "wrist"
    mount: Annotated[
        Literal["tool", "world"] | None,
        _optional(
            "{tool,world}",
            "What the camera is mounted on; what a demonstration notes, or tool, if left out.",
        ),
    ] = None
    intrinsics: Annotated[
        str | None,
        _optional(
            "FX,FY,CX,CY",
            "Pinhole intrinsics of the images [pixels], or estimate; what a demonstration "
            "recorded, or estimated, if left out.",
        ),
    ] = None
    robot: Annotated[
        str | None,
        _optional("REF", f"Robot, as {_REF}, whose joints poses.csv has; none if it has poses."),
    ] = None
    squares: Annotated[str, arg(help="Squares of the board, columns and rows.")] = "9x7"
    square_mm: Annotated[float, arg(help="Edge of a square, as measured [mm].")] = 25.0
    marker_mm: Annotated[float, arg(help="Edge of a marker [mm].")] = 18.0
    dictionary: Annotated[str, arg(help="OpenCV's name of the markers.")] = "DICT_4X4_50"
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Suggest:
    """Suggest precision spheres for a demonstration, as a file that you can edit.

    Example: sart suggest demo.h5 --out annotation.json

    Example: sart suggest demo.h5 --out annotation.json --waypoints 0 18 --margin 0.005

    Example: sart suggest demo.h5 --out annotation.json --source cloud

    Example: sart suggest demo.h5 --out annotation.json --source cloud --sensor d405
        --hand-eye-error 2,0.3

    Example: sart suggest demo.h5 --out annotation.json --source cloud --sensor d405
        --calibration wrist.json
    """

    demo: Annotated[Positional[Path], arg(metavar="DEMO", help="Demonstration from `sart record`.")]
    out: Annotated[Path, arg(help="JSON file to write.")]
    waypoints: Annotated[
        tuple[int, ...],
        arg(
            metavar="INT [INT ...]",
            help="Key waypoints; chosen to tile the free part if left out.",
            help_behavior_hint="",
        ),
    ] = ()
    task: _NOTED_TASK = None
    robot: _NOTED_ROBOT = None
    backend: _NOTED_BACKEND = None
    source: _SOURCE = "scene"
    unknown: _UNKNOWN = "behind"
    sensor: _SENSOR = None
    hand_eye_error: _HAND_EYE = None
    depth_scale_error: _DEPTH_SCALE = None
    calibration: _CALIBRATION = ()
    margin: _TOOL_MARGIN = None
    slip_tolerance: _SLIP_TOLERANCE = 0.005
    min_radius: _MIN_RADIUS = 0.004
    max_radius: _MAX_RADIUS = 0.15
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Annotate:
    """Annotate a demonstration with precision spheres: in a window, a browser, words, or headless.

    Example: sart annotate demo.h5

    Example: sart annotate demo.h5 --web

    Example: sart annotate demo.h5 --text

    Example: sart annotate demo.h5 --suggest-all --no-window --out annotation.json

    An existing annotation is continued, also after an interruption.
    """

    demo: Annotated[Positional[Path], arg(metavar="DEMO", help="Demonstration from `sart record`.")]
    out: Annotated[
        Path | None,
        _optional(
            "PATH", "JSON file to edit or make; DEMO's name with .annotation.json if left out."
        ),
    ] = None
    text: Annotated[bool, arg(help="Without a window: type words, or pipe them in.")] = False
    suggest_all: Annotated[bool, arg(help="Begin with all spheres suggested.")] = False
    no_window: Annotated[bool, arg(help="Save what is suggested at once, without a window.")] = (
        False
    )
    web: _WEB = False
    host: _HOST = None
    port: _PORT = None
    show: Annotated[
        Literal["cloud", "scene"], arg(help="What is drawn first: recorded points, or meshes.")
    ] = "cloud"
    task: _NOTED_TASK = None
    robot: _NOTED_ROBOT = None
    backend: _NOTED_BACKEND = None
    source: _SOURCE = "scene"
    unknown: _UNKNOWN = "behind"
    sensor: _SENSOR = None
    hand_eye_error: _HAND_EYE = None
    depth_scale_error: _DEPTH_SCALE = None
    calibration: _CALIBRATION = ()
    margin: _TOOL_MARGIN = None
    slip_tolerance: _SLIP_TOLERANCE = 0.005
    min_radius: _MIN_RADIUS = 0.004
    max_radius: _MAX_RADIUS = 0.15
    overwrite: Annotated[bool, arg(help="Begin again instead of continuing.")] = False
    json: _JSON = False


@dataclass(frozen=True)
class Augment:
    """Generate collision-free trajectories from a demonstration and its spheres.

    Example: sart augment demo.h5 annotation.json --out dataset

    Example: sart augment demo.h5 annotation.json --out dataset --n 100 --workers 2

    Example: sart augment demo.h5 annotation.json --out dataset --strategy sart_planned

    Example: sart augment demo.h5 annotation.json --out dataset --source cloud

    Example: sart augment demos/*.h5 annotations/*.json --out dataset --n 100

    Example: sart augment demos/*.h5 --out dataset --strategy bc

    Example: sart augment demo.h5 annotation.json --out dataset --web

    Example: sart augment demo.h5 annotation.json --out plan.jsonl --dry-run

    Each annotation finds its demonstration; trajectories are allocated to the spheres of all. With
    --source cloud, images are read as the annotation says, where its spheres were suggested from
    them; flags about the sensor replace that. An interrupted generation resumes when the same
    command is typed again.
    """

    files: Annotated[
        Positional[tuple[Path, ...]],
        arg(
            metavar="FILE [FILE ...]",
            help="Demonstrations of one task (.h5), and the spheres of each (.json), in any order.",
            help_behavior_hint="",
        ),
    ]
    out: Annotated[Path, arg(help="Directory to write; with --dry-run a file of JSON lines.")]
    n: _N = None
    task: _NOTED_TASK = None
    robot: _NOTED_ROBOT = None
    backend: _NOTED_BACKEND = None
    strategy: _STRATEGY = "sart"
    allocation: Annotated[
        Literal["root", "radius", "equal"],
        arg(
            help="Allocation of trajectories to spheres: by the root of the radius, by the radius, "
            "or equally as in the paper."
        ),
    ] = "root"
    distribution: _DISTRIBUTION = "area"
    rotation_per_metre: Annotated[
        float, arg(help="Largest rotation per metre of radius, nu_r [rad/m].")
    ] = 2.0
    duration: Annotated[
        float | None,
        _optional(
            "SECONDS",
            "Seconds each segment takes, delta (in the paper 2), rounded up to whole recorded "
            "steps; more where the joints need it. If left out, as long as the demonstration takes "
            "for as much motion near its waypoint, from 0.4 to 2 s.",
        ),
    ] = None
    execution: Annotated[
        str,
        arg(
            metavar="auto|restore|replay|REF",
            help="How segments are executed: from the demonstration's saved states (restore), or "
            "on a robot that follows the demonstration to each waypoint (replay); auto: whichever "
            "backend and demonstration allow.",
        ),
    ] = "auto"
    recording: _RECORDING = "reversed"
    source: _SOURCE = "scene"
    sensor: _SENSOR = None
    hand_eye_error: _HAND_EYE = None
    depth_scale_error: _DEPTH_SCALE = None
    calibration: _CALIBRATION = ()
    margin: Annotated[
        float,
        arg(
            help="Distance that every segment is proved to keep free [m], the backend's tracking "
            "error and what bodies may move not counted."
        ),
    ] = 0.0002
    slip_tolerance: _SLIP_TOLERANCE = 0.005
    seed: _SEED = 0
    dry_run: Annotated[
        bool,
        arg(
            help="Execute nothing: write the segments that would be attempted, each with its pose "
            "and proof, or why it would be rejected."
        ),
    ] = False
    web: Annotated[
        bool, arg(help="Show in a browser what is generated, as it comes; also over ssh.")
    ] = False
    host: _HOST = None
    port: _PORT = None
    workers: _WORKERS = 1
    executor: _EXECUTOR = "processes"
    ray_address: _RAY_ADDRESS = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Validate:
    """Prove commanded and measured paths of a dataset clear again; check hashes and courses.

    Example: sart validate dataset

    Example: sart validate dataset --replay

    Example: sart validate peg_lerobot --format lerobot

    With --replay every trajectory is executed to the end of the task besides, commanded at the rate
    of a policy, and DATASET/replay.json says which reach the goal. That resumes when interrupted.

    With --format, what is checked is a dataset in a format of the field, anyone's: that it holds
    what readers of the format rely on, which often fail on it only when they come to the place.
    """

    dataset: Annotated[
        Positional[Path],
        arg(
            metavar="DATASET",
            help="Directory from `sart augment`; with --format, a path of that format.",
        ),
    ]
    format: Annotated[
        str | None,
        _optional(
            "REF", f"Format of DATASET: {', '.join(FORMATS)}, or your own; ours if left out."
        ),
    ] = None
    task: _NOTED_TASK = None
    robot: _NOTED_ROBOT = None
    backend: _NOTED_BACKEND = None
    replay: Annotated[bool, arg(help="Also execute every trajectory to the end.")] = False
    workers: _WORKERS = 1
    executor: _EXECUTOR = "processes"
    ray_address: _RAY_ADDRESS = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Merge:
    """Make one dataset of several of the same task, robot and cameras.

    Example: sart merge dataset1 dataset2 --out both

    Each part keeps its settings, so that the whole can be validated. Files are linked where the
    disk can do that. Interrupted, it resumes when the same command is typed again.
    """

    datasets: Annotated[
        Positional[tuple[Path, ...]],
        arg(
            metavar="DATASET [DATASET ...]",
            help="Directories from `sart augment`, `merge` or `split`.",
            help_behavior_hint="",
        ),
    ]
    out: Annotated[Path, arg(help="Directory to write.")]
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Split:
    """Make datasets of parts of one: for training and validation, smaller, or by demonstration.

    Example: sart split dataset --out parts --parts train=0.8,validation=0.2

    Example: sart split dataset --out small --n 20

    Example: sart split dataset --out each --by-source

    Of each sphere every part gets its share. Interrupted, it resumes when the same command is typed
    again.
    """

    dataset: Annotated[
        Positional[Path], arg(metavar="DATASET", help="Directory from `sart augment` or `merge`.")
    ]
    out: Annotated[
        Path, arg(help="Directory to write; with --n it is the dataset, otherwise OUT/NAME are.")
    ]
    parts: Annotated[
        str | None,
        _optional(
            "NAME=FRACTION,...", "Parts by name, with the fraction of the episodes that each gets."
        ),
    ] = None
    n: Annotated[
        int | None,
        _optional("INT", "One part of so many trajectories, the demonstrations among them."),
    ] = None
    by_source: Annotated[bool, arg(help="A part for each demonstration.")] = False
    seed: Annotated[int, arg(help="Seed of which episodes the --parts get.")] = 0
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Export:
    """Write a dataset in a format of the field, for others' policies and tools.

    Example: sart export dataset --format lerobot --out peg_lerobot

    Example: sart export dataset --format robomimic --out peg.hdf5

    Example: sart export dataset --format zarr --out peg.zarr --no-depth

    Example: sart export demo.h5 --format rmb --out recordings

    Every trajectory is written whole: a generated segment, then its demonstration from where it
    rejoins. lerobot, rmb, rmb_hdf5 and zarr are
    directories, robomimic is a file.
    """

    dataset: Annotated[
        Positional[Path],
        arg(
            metavar="DATASET",
            help="Directory from `sart augment`, `merge` or `split`, or a demonstration.",
        ),
    ]
    out: Annotated[Path, arg(help="File or directory to write.")]
    format: Annotated[str, arg(metavar="REF", help=f"Format: {', '.join(FORMATS)}, or your own.")]
    instruction: Annotated[
        str | None,
        _optional(
            "TEXT", "The task in a sentence, as policies are told it; the task's own if left out."
        ),
    ] = None
    depth: Annotated[bool, arg(help="Leave depth images out.")] = True
    task: _NOTED_TASK = None
    robot: _NOTED_ROBOT = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Import:
    """Make demonstrations of recordings in a format of the field: RMB, both variants, or LeRobot.

    Example: sart import peg_in_hole_0000.rmb --out demo.h5

    Example: sart import recordings --out demos

    Example: sart import cable.rmb --out demo.h5 --task cable.py:Cable --robot my_ur5e.py:UR5E
        --gripper-range 0,255 --calibration wrist.json

    Example: sart import lerobot_cable --episode 3 --out demo.h5 --task cable.py:Cable
        --robot my_ur5e.py:UR5E --columns tool_pose=observation.state[0:6]
        gripper=observation.state[6] commanded_gripper=action[6] --rotation rotvec
        --pose-frame tool0 --gripper-range 0,1 --cameras wrist=hand --calibration wrist.json

    What a file doesn't say has to be said: of a recording from elsewhere the task, the robot (its
    tool frame), where cameras are mounted and their intrinsics, the range of its gripper, and of
    LeRobot which columns hold what.
    """

    file: Annotated[
        Positional[Path],
        arg(
            metavar="FILE",
            help="A recording, .rmb or .hdf5, a directory of several, or a LeRobot dataset.",
        ),
    ]
    out: Annotated[Path, arg(help="HDF5 file to write; of several, the directory of as many.")]
    format: Annotated[
        str | None, _optional("REF", "Format, as for export; found out if left out.")
    ] = None
    episode: Annotated[
        int | None,
        _optional("INT", "Which one to take of several, from 0; all if left out."),
    ] = None
    task: Annotated[
        str | None, _optional("REF", f"Task, as {_REF}, where the file doesn't say it.")
    ] = None
    robot: Annotated[
        str | None, _optional("REF", f"Robot, as {_REF}, where the file doesn't say it.")
    ] = None
    gripper_range: Annotated[
        str | None,
        _optional(
            "OPEN,CLOSED",
            "What the file has for an open and for a closed gripper, such as 0,255, where it "
            "doesn't say it.",
        ),
    ] = None
    cameras: Annotated[
        tuple[str, ...],
        _several(
            "NAME=THEIRS",
            "Cameras to take, our name of each with the file's; all by their own if left out.",
        ),
    ] = ()
    calibration: Annotated[
        tuple[Path, ...],
        _several("JSON", "Files from `sart calibrate`: cameras' mounting and intrinsics."),
    ] = ()
    camera_intrinsics: Annotated[
        tuple[str, ...],
        _several(
            "NAME=FX,FY,CX,CY", "Cameras' intrinsics [pixels], where no calibration has them."
        ),
    ] = ()
    columns: Annotated[
        tuple[str, ...],
        _several(
            "NAME=COLUMN",
            "Of LeRobot: the columns of joints [rad] or tool_pose (position [m], rotation), and "
            "gripper; also of joint_velocities, commanded_joints or commanded_tool_pose, and "
            "commanded_gripper, as measured if left out. Parts as COLUMN[A:B] or COLUMN[I].",
        ),
    ] = ()
    rotation: Annotated[
        Literal["rotvec", "rpy", "wxyz", "xyzw", "6d"] | None,
        _optional("{rotvec,rpy,wxyz,xyzw,6d}", "Of LeRobot: how tool_pose has its rotation."),
    ] = None
    pose_frame: Annotated[
        str | None,
        _optional(
            "FRAME",
            "Of LeRobot: what tool_pose is the pose of, in the robot's base: a link of its URDF, "
            "or tool.",
        ),
    ] = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Train:
    """Train a policy on a dataset; interrupted training resumes when typed again.

    Example: sart train dataset --out skill

    Example: sart train dataset --out skill --policy resnet18_mlp --epochs 20 --lr 3e-4
        --schedule cosine --image-size 64

    Example: sart train dataset --out skill --cameras wrist,overview

    Example: sart train dataset --out skills --seeds 0,1,2 --workers 3

    With --seeds there is a skill for each, OUT/seed0 and so on, and a table in OUT/sweep.json.
    """

    dataset: Annotated[
        Positional[Path], arg(metavar="DATASET", help="Directory from `sart augment`.")
    ]
    out: Annotated[Path, arg(help="Directory to write: the skill, or with --seeds one for each.")]
    policy: _POLICY = None
    epochs: _EPOCHS = None
    lr: Annotated[
        float | None, _optional("FLOAT", "Learning rate; the policy's own if left out.")
    ] = None
    batch_size: Annotated[int | None, _optional("INT", "The policy's own if left out.")] = None
    image_size: Annotated[
        int | None,
        _optional("INT", "Images are scaled to this [pixels]; the policy's own if left out."),
    ] = None
    image_shift: Annotated[
        int | None,
        _optional(
            "INT",
            "Random shift of the images, up to this [pixels]; the policy's own if left out.",
        ),
    ] = None
    cameras: _CAMERAS = "wrist"
    schedule: Annotated[
        Literal["cosine", "constant"] | None,
        _optional(
            "{cosine,constant}", "Course of the learning rate; the policy's own if left out."
        ),
    ] = None
    norm: Annotated[
        Literal["batch", "group"] | None,
        _optional("{batch,group}", "Normalisation layers, of resnet18_mlp; its own if left out."),
    ] = None
    weighting: Annotated[
        Literal["balanced", "trajectories"],
        arg(
            help="How often steps are learned from: balanced, so that what all trajectories share "
            "and where the tool stands still count less and gripper events more; or as often as "
            "trajectories pass them, as in the paper."
        ),
    ] = "balanced"
    backbone_weights: Annotated[
        Path | None,
        _optional(
            "PATH",
            "File with ResNet18 weights (torchvision's names) to start from; none if left out.",
        ),
    ] = None
    seed: Annotated[
        int | None, _optional("INT", "Seed of everything random in this step; 0 if left out.")
    ] = None
    seeds: Annotated[
        str | None,
        _optional(
            "INT,INT...",
            "Comma-separated seeds, to train a skill with each; one skill if left out.",
        ),
    ] = None
    device: _DEVICE = "auto"
    workers: Annotated[
        int, arg(help="Processes to use, or workers on the cluster, with --seeds.")
    ] = 1
    executor: _EXECUTOR = "processes"
    ray_address: _RAY_ADDRESS = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Evaluate:
    """Evaluate a skill on random placements.

    Example: sart evaluate skill --out evaluation.json --episodes 100 --workers 2

    Example: sart evaluate skill --out varied.json --vary-appearance --yaw-deg 15

    Example: sart evaluate skill --out camera.json --appearance camera=0.005,camera_deg=2

    Interrupted, it resumes when the same command is typed again.
    """

    skill: Annotated[Positional[Path], arg(metavar="SKILL", help="Directory from `sart train`.")]
    out: Annotated[Path, arg(help="JSON file to write; videos go beside it.")]
    task: _NOTED_TASK = None
    robot: _NOTED_ROBOT = None
    backend: _NOTED_BACKEND = None
    episodes: _EPISODES = 50
    eval_seed: _EVAL_SEED = 1000
    yaw_deg: _YAW = 0.0
    placement_range: Annotated[
        float | None,
        _optional(
            "METRES", "Half width of the square of placements [m]; the task's own if left out."
        ),
    ] = None
    vary_appearance: _APPEARANCE = False
    appearance: Annotated[
        str | None,
        _optional(
            "NAME=NUMBER,...",
            "Vary only these: colour, light, ambient (shares), light_deg, camera [m], camera_deg, "
            "camera_offset [m] (moved just so far), distractors (how many); nothing if left out.",
        ),
    ] = None
    latency: Annotated[float, arg(help="So late the policy sees what it acts on [s].")] = 0.0
    final_images: Annotated[
        bool, arg(help="Keep what the cameras saw at the end of each failure, beside OUT.")
    ] = False
    videos: Annotated[int, arg(help="Videos of the first successes, and as many of failures.")] = 2
    workers: _WORKERS = 2
    executor: _EXECUTOR = "processes"
    ray_address: _RAY_ADDRESS = None
    device: _DEVICE = "cpu"
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Deploy:
    """Let a skill act on a real robot, from where it stands; several times, judged by you.

    Example: sart deploy skill --backend cell.toml --dry-run

    Example: sart deploy skill --backend cell.toml

    Example: sart deploy skill --backend cell.toml --episodes 20 --out trials.json

    The first shows what it sees and decides without moving. The robot moves at the speed scale of
    its cell's file, once you have pressed Enter; Ctrl-C stops it. With --out you say of each trial
    what it was: space for success, backspace for failure, x if it is not to count; then the robot
    goes back the way it came. Interrupted, it goes on when the same command is typed again; `sart
    compare` reads the file.
    """

    skill: Annotated[Positional[Path], arg(metavar="SKILL", help="Directory from `sart train`.")]
    backend: Annotated[
        str | None,
        _optional("CELL", "The cell's TOML file, or your own; what the skill notes if left out."),
    ] = None
    task: _NOTED_TASK = None
    robot: _NOTED_ROBOT = None
    max_seconds: Annotated[
        float | None, _optional("SECONDS", "How long it acts [s]; the task's horizon if left out.")
    ] = None
    out: Annotated[
        Path | None,
        _optional("PATH", "JSON file of verdicts to write; none is asked for if left out."),
    ] = None
    episodes: Annotated[
        int | None, _optional("INT", "With --out: how many trials count; 20 if left out.")
    ] = None
    overwrite: _OVERWRITE = False
    dry_run: Annotated[bool, arg(help="See and decide, and move nothing.")] = False
    unattended: Annotated[
        bool, arg(help="Begin without a person's key, where this isn't typed at a terminal.")
    ] = False
    device: _DEVICE = "cpu"
    json: _JSON = False


@dataclass(frozen=True)
class Emulate:
    """Write the file of an emulated cell, to be used as that of a real one.

    Example: sart emulate peg_in_hole --out cell.toml

    Nothing runs by itself: whatever is given the file has a world of its own for as long as it
    lasts, with a simulated arm that lags, a camera that is late and not quite where it should be,
    and a gripper, at the task's start. So each of these begins there:

    Example: sart doctor --cell cell.toml

    Example: sart record peg_in_hole --backend cell.toml --out demo.h5

    Example: sart suggest demo.h5 --source cloud --sensor d405 --out annotation.json

    Example: sart augment demo.h5 annotation.json --source cloud --sensor d405 --out dataset --n 10

    Example: sart train dataset --out skill

    Example: sart deploy skill --backend cell.toml --unattended

    With --hand a hand holds the arm, for `--device hand_guiding`:

    Example: sart emulate peg_in_hole --hand demo.h5 --out guided.toml

    Example: sart record peg_in_hole --backend guided.toml --device hand_guiding --out by_hand.h5

    It tests the way that a real arm is used, and says nothing of how a real one moves.
    """

    task: _TASK
    out: Annotated[Path, arg(help="TOML file to write.")]
    robot: Annotated[
        str | None, _optional("NAME", "Robot, by its name; the task's own if left out.")
    ] = None
    simulator: Annotated[Literal["pybullet", "sapien"], arg(help="What simulates it.")] = (
        DEFAULT_BACKEND  # type: ignore[assignment]
    )
    placement: Annotated[
        str, arg(metavar="X,Y,DEG", help="Where the object stands, from its middle [m], [deg].")
    ] = "0,0,0"
    hand: Annotated[
        Path | None,
        _optional(
            "DEMO", "Demonstration whose joints a hand leads the arm along; none if left out."
        ),
    ] = None
    image_height: Annotated[int, arg(help="Of the cameras' images, which are 4:3 [pixels].")] = 240
    sensor: Annotated[Literal["d405", "d435", "exact"], arg(help="Whose errors the depth has.")] = (
        "d405"
    )
    hand_eye_error: Annotated[
        str,
        arg(
            metavar="MM,DEG",
            help="How far cameras are from where they should be; declared in the file, too.",
        ),
    ] = "2,0.3"
    latency: Annotated[float, arg(help="How old an image is when it arrives [s].")] = 0.03
    lag: Annotated[float, arg(help="Time constant with which the arm follows [s].")] = 0.03
    joint_noise: Annotated[float, arg(help="Of measured joints [rad].")] = 1e-5
    speed_scale: Annotated[float, arg(help="How fast it goes of what is commanded.")] = 1.0
    seed: _SEED = 0
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class BenchmarkOperator:
    """How often the scripted operator reaches the goal, on each task and backend.

    Example: sart benchmark operator --tasks all --backends pybullet,sapien --episodes 100
        --out operator.json

    Interrupted, it resumes when the same command is typed again.
    """

    tasks: _TASKS = "all"
    backends: _BACKENDS = "all"
    episodes: Annotated[
        int, arg(help="Episodes with random placements, for each task and backend.")
    ] = 100
    seed: _SEED = 0
    yaw_deg: _YAW = 0.0
    out: Annotated[Path, arg(help="JSON file to write.")] = Path("runs/benchmark_operator.json")
    workers: _WORKERS = 2
    executor: _EXECUTOR = "processes"
    ray_address: _RAY_ADDRESS = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class BenchmarkReplay:
    """How well a demonstration recorded on one backend replays on another.

    Example: sart benchmark replay --tasks all --backends pybullet,sapien --out replay.json

    Interrupted, it resumes when the same command is typed again.
    """

    tasks: _TASKS = "all"
    backends: _BACKENDS = "all"
    seed: _SEED = 0
    out: Annotated[Path, arg(help="JSON file to write.")] = Path("runs/benchmark_replay.json")
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class BenchmarkSegments:
    """How augmentation's segments perform: kept, touched, off their path, beyond joint limits.

    On each task and backend a demonstration is recorded for each seed, spheres are suggested, and
    segments are attempted from them in turn, without images. With --source cloud spheres and
    segments are proved against what the demonstration's camera saw, and executed in the true scene.

    Example: sart benchmark segments --tasks all --backends all --seed 101,102,103,104,105
        --count 12000 --out segments.json

    Example: sart benchmark segments --tasks peg_in_hole --backends pybullet --source cloud
        --count 200

    Interrupted, it resumes when the same command is typed again.
    """

    tasks: _TASKS = "all"
    backends: _BACKENDS = "all"
    count: Annotated[int, arg(help="Segments to attempt, divided among tasks and backends.")] = (
        10_000
    )
    source: _SOURCE = "scene"
    seed: Annotated[
        str, arg(help="Comma-separated seeds of demonstrations and draws, each a cell of its own.")
    ] = "0"
    out: Annotated[Path, arg(help="JSON file to write.")] = Path("runs/benchmark_segments.json")
    workers: _WORKERS = 2
    executor: _EXECUTOR = "processes"
    ray_address: _RAY_ADDRESS = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class BenchmarkRadii:
    """Whether suggested radii are safe and tight, and how long suggesting them takes.

    Safe: random poses in each sphere are free of collisions of the whole robot. Tight: with 15 %
    more, draws that aim at the pair of bodies which limits a sphere find one.

    Example: sart benchmark radii --tasks all --draws 2000 --directed 20000 --out radii.json

    Interrupted, it resumes when the same command is typed again.
    """

    tasks: _TASKS = "all"
    backends: _BACKENDS = DEFAULT_BACKEND
    draws: Annotated[int, arg(help="Random poses in each sphere.")] = 2000
    directed: Annotated[int, arg(help="Directed draws in each enlarged sphere.")] = 20_000
    seed: _SEED = 0
    out: Annotated[Path, arg(help="JSON file to write.")] = Path("runs/benchmark_radii.json")
    workers: _WORKERS = 2
    executor: _EXECUTOR = "processes"
    ray_address: _RAY_ADDRESS = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class BenchmarkCloud:
    """How radii from the recorded images compare with those from the true scene.

    With --noise the images are replaced by what real depth cameras would have recorded, their
    errors being declared: that of the hand-eye calibration in each, 2 mm and 0.3 deg.

    Example: sart benchmark cloud --tasks all --out cloud.json

    Example: sart benchmark cloud --tasks toolbox_picking,door_opening --noise 3
        --out cloud_noise.json

    Interrupted, it resumes when the same command is typed again.
    """

    tasks: _TASKS = "all"
    backends: _BACKENDS = DEFAULT_BACKEND
    seed: _SEED = 0
    noise: Annotated[int, arg(help="Noise draws for each task and sensor; 0: images as drawn.")] = 0
    workers: Annotated[
        int, arg(help="Processes to use, or workers on the cluster, with --noise.")
    ] = 1
    executor: _EXECUTOR = "processes"
    ray_address: _RAY_ADDRESS = None
    out: Annotated[Path, arg(help="JSON file to write.")] = Path("runs/benchmark_cloud.json")
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class BenchmarkSkill:
    """How well a skill learned from one demonstration does, on each task and backend.

    Each is a `sart run` of its own, in OUT/TASK-BACKEND; the figures are collected in
    OUT/benchmark.json.

    Example: sart benchmark skill --tasks peg_in_hole,toolbox_picking --backends all
        --out runs/skills --episodes 20

    Interrupted, it resumes when the same command is typed again.
    """

    out: Annotated[Path, arg(help="Directory to write.")]
    tasks: _TASKS = "all"
    backends: _BACKENDS = "all"
    policy: _POLICY = None
    n: _N = None
    epochs: _EPOCHS = None
    episodes: _EPISODES = 20
    seed: _SEED = 0
    eval_seed: _EVAL_SEED = 1000
    workers: _WORKERS = 2
    executor: _EXECUTOR = "processes"
    ray_address: _RAY_ADDRESS = None
    device: _DEVICE = "auto"
    json: _JSON = False


@dataclass(frozen=True)
class Benchmark:
    """Learn and evaluate every cell of a plan, a grid of skills, and show tables with intervals.

    Plans: success, table1, scaling, ablation, miles_radii, effort, transfer, recordings,
    placement, robustness, precision; or a TOML file of your own, as docs/benchmarks.md has it.
    Measurements of the toolkit itself, operator, replay, segments, radii, cloud and skill, have
    flags of their own.

    Example: sart benchmark table1 --out runs/table1 --dry-run

    Example: sart benchmark table1 --out runs/table1 --workers 2

    Example: sart benchmark scaling --out runs/scaling --store runs/stages
        --set task=peg_in_hole n=20,40 demonstration_seed=101,102

    Example: sart benchmark my_plan.toml --out runs/mine --only "peg_in_hole-*-d101-*"

    Example: sart benchmark radii --help

    OUT gets benchmark.html, benchmark.json and a file of each cell in cells/. Interrupted, it
    resumes when the same command is typed again.
    """

    plan: Annotated[
        Positional[str], arg(metavar="PLAN", help="Name of a plan, or a TOML file with one.")
    ]
    out: Annotated[Path, arg(help="Directory to write.")]
    set: Annotated[
        tuple[str, ...],
        arg(
            metavar="FIELD=VALUE[,VALUE...] [...]",
            help="Other values of cells' fields than the plan has: task, backend, strategy, n, "
            "policy, demonstration_seed, training_seed, episodes, eval_seed and so on; the plan's "
            "if left out.",
            help_behavior_hint="",
        ),
    ] = ()
    only: Annotated[
        str | None,
        _optional(
            "PATTERN", "Only cells whose name matches, such as 'peg*-d101-*'; all if left out."
        ),
    ] = None
    store: Annotated[
        Path | None,
        _optional(
            "PATH",
            "Directory of the stages' results, which plans may share; OUT/stages if left out.",
        ),
    ] = None
    dry_run: Annotated[
        bool, arg(help="Only say which cells there are, what is done, and time and disk needed.")
    ] = False
    workers: _WORKERS = 2
    executor: _EXECUTOR = "processes"
    ray_address: _RAY_ADDRESS = None
    json: _JSON = False


@dataclass(frozen=True)
class Compare:
    """Whether two evaluations differ: by pairs of rollouts where placements are the same.

    Example: sart compare runs/peg runs/peg_bc

    Example: sart compare first.json second.json

    Example: sart compare runs/table1/cells/peg_in_hole-pybullet-sart-n40-d101-t0.json
        runs/table1/cells/peg_in_hole-pybullet-bc-n40-d101-t0.json
    """

    a: Annotated[
        Positional[Path],
        arg(
            metavar="A",
            help="evaluation.json, a cell of a benchmark, or the directory of a run or its skill.",
        ),
    ]
    b: Annotated[Positional[Path], arg(metavar="B", help="What it is compared with.")]
    json: _JSON = False


@dataclass(frozen=True)
class Report:
    """Write the page about a run: images, videos and figures in one HTML file.

    Example: sart report runs/peg

    Example: sart report runs/peg --out peg.html
    """

    run: Annotated[Positional[Path], arg(metavar="RUN", help="Directory from `sart run`.")]
    out: Annotated[
        Path | None, _optional("PATH", "HTML file to write; report.html in RUN if left out.")
    ] = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class Info:
    """Say what a file or directory of the toolkit holds.

    Example: sart info runs/peg/demo.h5
    """

    file: Annotated[
        Positional[Path],
        arg(metavar="FILE", help="Demonstration, annotation, dataset, skill or run."),
    ]
    json: _JSON = False


@dataclass(frozen=True)
class Doctor:
    """Say what works on this machine and how to fix what doesn't.

    Example: sart doctor

    Example: sart doctor --full

    With --robot, say instead whether a robot will work, before anything is recorded: its files,
    joints, gripper, cameras and home, and how it moves in both simulators.

    Example: sart doctor --robot my_arm.py:MY_ARM --image my_arm.png

    With --cell, say instead what a real cell's parts answer: all is read, and nothing moves.

    Example: sart doctor --cell cell.toml
    """

    full: Annotated[
        bool, arg(help="Also test torch, SAPIEN, windows and devices, which takes longer.")
    ] = False
    robot: Annotated[str | None, _optional("REF", f"Robot to examine instead, as {_REF}.")] = None
    image: Annotated[
        Path | None, _optional("PNG", "Where to write what the robot's cameras see at home.")
    ] = None
    cell: Annotated[
        Path | None, _optional("TOML", "File of a real cell whose parts are asked instead.")
    ] = None
    json: _JSON = False


@dataclass(frozen=True)
class NewRobot:
    """Write a commented RobotSpec file from a URDF, to be completed.

    Example: sart new robot my_arm.urdf --out my_arm.py

    `sart doctor --robot my_arm.py:MY_ARM` then says what is still to be done.
    """

    urdf: Annotated[
        Positional[str], arg(metavar="URDF", help="A path, or package:path/inside/it.urdf.")
    ]
    out: Annotated[Path, arg(help="Python file to write.")]
    name: Annotated[
        str | None, _optional("NAME", "What to call the robot; the file's name if left out.")
    ] = None
    package_dirs: Annotated[
        str | None,
        _optional("DIRS", "Folders, separated by commas, to look in for package:// meshes."),
    ] = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


_NEW_NAME = Annotated[
    Positional[str],
    arg(metavar="NAME", help="What to call it, such as push_block; a class is called PushBlock."),
]
_NEW_OUT = Annotated[Path | None, _optional("FILE", "Python file to write; NAME.py if left out.")]


@dataclass(frozen=True)
class NewTask:
    """Write a commented Task file that works as it stands, to be changed.

    Example: sart new task push_block

    It is a block to be picked up. `sart run push_block.py:PushBlock --out runs/push_block` learns
    it, `pytest --pyargs sart_toolkit.testing --sart-task push_block.py:PushBlock` tests it.
    """

    name: _NEW_NAME
    out: _NEW_OUT = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class NewStrategy:
    """Write a commented Strategy file that works as it stands, to be changed.

    Example: sart new strategy upright

    It varies positions and keeps the tool's orientation. Use it with
    `sart augment demo.h5 annotation.json --out dataset --strategy upright.py:UPRIGHT`.
    """

    name: _NEW_NAME
    out: _NEW_OUT = None
    overwrite: _OVERWRITE = False
    json: _JSON = False


@dataclass(frozen=True)
class NewBackend:
    """Write a commented Backend file that works as it stands, to be changed.

    Example: sart new backend my_arm

    It is an arm without physics. `sart run peg_in_hole --backend my_arm.py:MyArm --out runs/my_arm`
    runs on it, `pytest --pyargs sart_toolkit.testing --sart-backend my_arm.py:MyArm` tests it.
    """

    name: _NEW_NAME
    out: _NEW_OUT = None
    overwrite: _OVERWRITE = False
    json: _JSON = False
