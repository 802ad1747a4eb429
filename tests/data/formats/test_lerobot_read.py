"""Episodes of LeRobot datasets, the toolkit's own and anyone's, become demonstrations."""

from __future__ import annotations

import dataclasses
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image as PillowImage
from scipy.spatial.transform import Rotation

from sart_toolkit import pipeline
from sart_toolkit.calibrate.board import Board
from sart_toolkit.calibrate.calibration import Calibration, save_calibration
from sart_toolkit.data.formats.format import Given
from sart_toolkit.data.formats.lerobot import (
    DATA,
    DEPTH_CODECS,
    DEPTH_MAX,
    DEPTH_MIN,
    DEPTH_SHIFT,
    EPISODES,
    INFO,
    RGB_CODECS,
    VIDEOS,
    LeRobot,
    depth_levels,
)
from sart_toolkit.data.formats.rmb import MAIN
from sart_toolkit.data.formats.video import VideoWriter, best_codec
from sart_toolkit.data.records import Demonstration
from sart_toolkit.data.storage import load_demonstration
from sart_toolkit.errors import BrokenFile, InvalidInput, UnknownName
from sart_toolkit.poses import inverse
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel

pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")

POSE_COLUMNS = {
    "tool_pose": "observation.state[0:6]",
    "gripper": "observation.state[6]",
    "commanded_gripper": "action[6]",
}


def test_an_episode_of_ours_is_read_as_it_was_written(exported, trajectories):
    format = LeRobot()
    found = format.recordings(exported("lerobot"))
    assert len(found) == len(trajectories) and format.recordings(found[2]) == [found[2]]
    for number in (0, 3):
        read, wanted = format.read(found[number], Given()), trajectories[number]
        steps, told = read.steps, wanted.steps
        for name in ("joint_positions", "joint_velocities", "commanded_joint_positions",
                     "measured_gripper", "commanded_gripper", "contact_force"):  # fmt: skip
            np.testing.assert_allclose(getattr(steps, name), getattr(told, name), atol=1e-5)
        for name in ("measured_Ts_world_tool", "commanded_Ts_world_tool"):
            np.testing.assert_allclose(getattr(steps, name), getattr(told, name), atol=1e-6)
        camera, wrist = steps.cameras["wrist"], told.cameras["wrist"]
        assert np.array_equal(camera.intrinsics, wrist.intrinsics)
        assert np.array_equal(camera.T_frame_camera, wrist.T_frame_camera)
        hit = wrist.depth > 0.02
        assert np.abs(camera.depth - wrist.depth)[hit].max() < 1e-3
        assert (camera.depth[wrist.depth == 0] == 0).all()
        # The images are compressed, but they are those of this episode's steps.
        far = np.abs(camera.rgb.astype(int) - wrist.rgb).mean(axis=(1, 2, 3))
        assert far.max() < 12
        assert (read.task, read.robot, read.judged_by) == ("peg_in_hole", "ur5e_2f85", "task")
        assert read.success[-1] == wanted.success[-1]
        assert read.rates.record_hz == 10


def test_what_an_episode_of_ours_says_itself_is_not_said_again(exported):
    path = LeRobot().recordings(exported("lerobot"))[0]
    with pytest.raises(InvalidInput, match="says itself what this would; leave --columns out"):
        LeRobot().read(path, Given(columns=POSE_COLUMNS))


# --- anyone's -----------------------------------------------------------------------------------


def write_foreign(root: Path, demonstration: Demonstration) -> None:
    """Two episodes as the format's description has them, by a robot that reports its flange.

    `observation.state`: the flange in the base (xyz, rotation vector), the gripper from 0 (closed)
    to 1 (open), then six joints; `action` the same as commanded. The camera is called "hand".
    """
    steps, hz = demonstration.steps, 10
    n = len(steps)
    model = RobotModel(get_robot(demonstration.robot))
    T_tool_flange = inverse(model.fk(np.array(model.spec.home))) @ model.fk(
        np.array(model.spec.home), "tool0"
    )

    def rows(Ts: Any, gripper: Any, q: Any) -> Any:
        Ts = Ts @ T_tool_flange
        r = Rotation.from_matrix(Ts[:, :3, :3]).as_rotvec()
        return np.concatenate([Ts[:, :3, 3], r, 1 - gripper[:, None], q], axis=1, dtype=np.float32)

    one = {
        "observation.state": rows(
            steps.measured_Ts_world_tool, steps.measured_gripper, steps.joint_positions
        ),
        "action": rows(
            steps.commanded_Ts_world_tool,
            steps.commanded_gripper,
            steps.commanded_joint_positions,
        ),
    }
    names = ["x", "y", "z", "rx", "ry", "rz", "gripper", *(f"joint_{i}" for i in range(6))]
    place = {"chunk_index": 0, "file_index": 0}
    # The first episode is another, so that the second starts within the files.
    columns = {
        key: [*(values + 0.01).tolist(), *values.tolist()] for key, values in one.items()
    }  # fmt: skip
    columns |= {
        "timestamp": np.tile(np.arange(n) / hz, 2).astype(np.float32),
        "frame_index": np.tile(np.arange(n), 2),
        "episode_index": np.repeat([0, 1], n),
        "index": np.arange(2 * n),
        "task_index": np.zeros(2 * n, int),
    }
    data = root / DATA.format(**place)
    data.parent.mkdir(parents=True)
    parquet.write_table(pa.table(columns), data)
    camera = steps.cameras["wrist"]
    height, width = camera.rgb.shape[1:3]
    videos = {
        "observation.images.hand": (best_codec(RGB_CODECS), camera.rgb),
        "observation.images.hand_depth": (best_codec(DEPTH_CODECS), depth_levels(camera.depth)),
    }
    for key, (codec, frames) in videos.items():
        path = root / VIDEOS.format(video_key=key, **place)
        writer = VideoWriter(path, codec, width, height, hz)
        for frame in [*frames[::-1], *frames]:
            writer.add(frame)
        writer.close()
    episodes = root / EPISODES.format(**place)
    episodes.parent.mkdir(parents=True)
    at = {
        f"{key}/{word}": 0 for key in ("data", *(f"videos/{k}" for k in videos)) for word in place
    }
    parquet.write_table(
        pa.Table.from_pylist(
            [
                {
                    "episode_index": i,
                    "tasks": ["put it in"],
                    "length": n,
                    "dataset_from_index": i * n,
                    "dataset_to_index": (i + 1) * n,
                    **at,
                    **{f"videos/{key}/from_timestamp": i * n / hz for key in videos},
                    **{f"videos/{key}/to_timestamp": (i + 1) * n / hz for key in videos},
                }
                for i in range(2)
            ]
        ),
        episodes,
    )
    depth = {
        "is_depth_map": True,
        "depth_unit": "m",
        "video.depth_min": DEPTH_MIN,
        "video.depth_max": DEPTH_MAX,
        "video.shift": DEPTH_SHIFT,
        "video.use_log": True,
    }
    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [len(names)], "names": names} for key in one
    }
    for key in videos:
        channels = 1 if key.endswith("_depth") else 3
        features[key] = {
            "dtype": "video",
            "shape": [height, width, channels],
            "info": depth if channels == 1 else {},
        }
    info = {
        "codebase_version": "v3.0",
        "fps": hz,
        "total_episodes": 2,
        "total_frames": 2 * n,
        "data_path": DATA,
        "video_path": VIDEOS,
        "features": features,
    }
    (root / INFO).write_text(json.dumps(info))


@pytest.fixture(scope="session")
def foreign(
    peg_demonstration: Demonstration, tmp_path_factory: pytest.TempPathFactory
) -> Path:  # fmt: skip
    root: Path = tmp_path_factory.mktemp("foreign") / "cable"
    write_foreign(root, peg_demonstration)
    return root


@pytest.fixture(scope="session")
def calibration(peg_demonstration: Demonstration, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a calibration of the camera that recorded `foreign`."""
    camera = peg_demonstration.steps.cameras["wrist"]
    height, width = camera.rgb.shape[1:3]
    path: Path = tmp_path_factory.mktemp("calibration") / "wrist.json"
    found = Calibration(
        "wrist", "tool", camera.T_frame_camera, camera.intrinsics, (width, height),
        hand_eye=0.0006, hand_eye_deg=0.1, axis_errors=(0.0003, 0.0003, 0.0005),
        axis_errors_deg=(0.05, 0.05, 0.05), square_scale=1.0, rms_pixels=0.2, views=12,
        board=Board(), depth_scale=1.0, depth_scale_error=0.002,
    )  # fmt: skip
    save_calibration(path, found)
    return path


@pytest.fixture
def command(foreign: Path, calibration: Path, tmp_path: Path) -> list[object]:
    """All that has to be said of an episode with poses."""
    return [
        "import", foreign, "--out", tmp_path / "demo.h5", "--episode", 1, "--task", "peg_in_hole",
        "--robot", "ur5e_2f85", "--gripper-range", "1,0", "--cameras", "wrist=hand",
        "--calibration", calibration, "--rotation", "rotvec", "--pose-frame", "tool0",
        "--columns", *(f"{name}={column}" for name, column in POSE_COLUMNS.items()),
        "commanded_tool_pose=action[0:6]",
    ]  # fmt: skip


def without(command: list[object], flag: str, n: int = 1) -> list[object]:
    at = command.index(flag)
    return [*command[:at], *command[at + 1 + n :]]


def test_an_episode_of_poses_is_a_demonstration_of_the_tool_with_joints(
    command, said, tmp_path, peg_demonstration
):
    (made,) = said(*command)["demonstrations"]
    read, wanted = load_demonstration(Path(made)), peg_demonstration.steps
    steps = read.steps
    np.testing.assert_allclose(
        steps.measured_Ts_world_tool, wanted.measured_Ts_world_tool, atol=1e-5
    )
    np.testing.assert_allclose(
        steps.commanded_Ts_world_tool, wanted.commanded_Ts_world_tool, atol=1e-5
    )
    # Found by inverse kinematics from the robot's home, near which it was recorded.
    np.testing.assert_allclose(steps.joint_positions, wanted.joint_positions, atol=1e-3)
    np.testing.assert_allclose(steps.measured_gripper, wanted.measured_gripper, atol=1e-5)
    camera, wrist = steps.cameras["wrist"], wanted.cameras["wrist"]
    assert np.array_equal(camera.T_frame_camera, wrist.T_frame_camera)
    assert np.array_equal(camera.intrinsics, wrist.intrinsics)
    hit = wrist.depth > 0.02
    assert np.abs(camera.depth - wrist.depth)[hit].max() < 1e-3
    assert (read.backend, read.judged_by, read.rates.record_hz) == ("imported", "nobody", 10)


def test_an_episode_of_joints_needs_no_inverse_kinematics(foreign, calibration, peg_demonstration):
    given = pipeline._given("peg_in_hole", "ur5e_2f85", None, [], {})
    given = dataclasses.replace(
        given,
        gripper_range=(1.0, 0.0),
        camera_names={"wrist": "hand"},
        intrinsics={"wrist": lambda width, height: np.eye(3)},
        columns={"joints": "observation.state[7:13]", "gripper": "observation.state[6]"},
    )
    steps = LeRobot().read(foreign / "episode_000001", given).steps
    wanted = peg_demonstration.steps
    np.testing.assert_allclose(steps.joint_positions, wanted.joint_positions, atol=1e-6)
    np.testing.assert_allclose(
        steps.measured_Ts_world_tool, wanted.measured_Ts_world_tool, atol=1e-5
    )
    # Nobody says what was commanded.
    assert np.array_equal(steps.commanded_joint_positions, steps.joint_positions)
    assert np.array_equal(steps.commanded_gripper, steps.measured_gripper)


@pytest.mark.parametrize(
    ("flag", "n", "complaint"),
    [
        ("--task", 1, "doesn't say which task it is of; add --task REF"),
        ("--gripper-range", 1, "add --gripper-range OPEN,CLOSED"),
        ("--calibration", 1, "camera 'wrist': its intrinsics aren't said; add --calibration FILE, "
         "or --camera-intrinsics wrist=FX,FY,CX,CY"),
        ("--cameras", 1, "has a calibration or intrinsics but isn't in the recording, which has "
         "hand; add --cameras wrist="),
        ("--rotation", 1, "how its rotations are written isn't said; add --rotation rotvec or rpy"),
        ("--pose-frame", 1, "of which frame of the robot it is isn't said; add --pose-frame FRAME"),
        ("--columns", 4, "which columns are the joints or the tool's pose isn't said; add "
         "--columns joints=COLUMN[A:B] or tool_pose=COLUMN[A:B]; there are observation.state (x, "),
    ],
)  # fmt: skip
def test_what_is_missing_is_asked_for_by_name(flag, n, complaint, command, refused):
    assert complaint in refused(*without(command, flag, n))


def test_without_a_robot_it_is_asked_for(command, refused):
    words = without(without(command, "--robot"), "--pose-frame")
    assert "known from the robot alone; add --robot REF" in refused(*words)
    assert "--pose-frame: is a frame of the robot" in refused(*without(command, "--robot"))


@pytest.mark.parametrize(
    ("columns", "complaint"),
    [
        ({"tool_pose": "state"}, "unknown column 'state'"),
        ({"pose": "action"}, "unknown column 'pose': did you mean 'tool_pose'?"),
        ({"joints": "action[10:20]"}, "action has 13 numbers a row; the first is 0"),
        ({"joints": "action[0:5]"}, "joints: 5 numbers a row, the robot has 6 arm joints"),
        ({"joints": "action[0:6]", "tool_pose": "action[0:6]"}, "joints and tool_pose; give one"),
        ({"joints": "action[7:13]", "gripper": "action[6:8]"}, "gripper: 2 numbers a row"),
        ({"joints": "action[7:13]"}, "which column is the gripper's isn't said; add --columns"),
        ({"tool_pose": "action[0:5]"}, "tool_pose: rows of 5 numbers, expected 3 and 3 for rotvec"),
    ],
    ids=str,
)
def test_columns_that_are_none_are_refused(columns, complaint, foreign):
    posed = "tool_pose" in columns
    given = dataclasses.replace(
        pipeline._given("peg_in_hole", "ur5e_2f85", "tool" if posed else None, [], {}),
        columns=columns, rotation="rotvec" if posed else None, gripper_range=(1.0, 0.0),
    )  # fmt: skip
    with pytest.raises((InvalidInput, UnknownName)) as caught:
        LeRobot().read(foreign / "episode_000001", given)
    assert complaint in str(caught.value)


def test_poses_out_of_reach_say_what_to_check(command, refused):
    words = [word if word != "tool0" else "tool" for word in command]
    words = ["wxyz" if word == "rotvec" else word for word in words]
    assert "tool_pose: rows of 6 numbers, expected 3 and 4 for wxyz" in refused(*words)
    shifted = [str(w).replace("state[0:6]", "state[4:10]") for w in command]
    assert "check --rotation, --pose-frame, that positions are in metres" in refused(*shifted)


def test_options_that_can_not_be_honoured_are_refused(command, refused, calibration, tmp_path):
    assert "episode: expected 0 to 1, got 7" in refused(
        *without(command, "--episode"), "--episode", 7
    )
    again = [*command, "--camera-intrinsics", "wrist=1,1,1,1"]
    assert "--camera-intrinsics wrist: --calibration says them; leave it out" in refused(*again)
    assert "--columns: expected NAME=VALUE, got 'gripper'" in refused(
        *without(command, "--columns", 4), "--columns", "gripper"
    )
    assert "doesn't move with the tool" in refused(
        *without(command, "--pose-frame"), "--pose-frame", "base_link"
    )
    assert "unknown camera 'head'" in refused(
        *without(command, "--cameras"), "--cameras", "wrist=head"
    )


def test_what_is_about_poses_is_refused_with_joints(command, refused):
    words = [str(w).replace("tool_pose=observation.state[0:6]", "joints=observation.state[7:13]")
             for w in command]  # fmt: skip
    assert "joints: have no rotation and no frame; leave --rotation" in refused(*words)


def test_a_calibration_of_a_camera_that_is_not_read_is_refused(command, refused):
    assert "camera 'wrist': has a calibration or intrinsics but isn't in the recording, which " in (
        refused(*without(command, "--cameras"), "--cameras", "overview=hand")
    )


def test_images_in_the_table_are_read_as_well(command, foreign, said, tmp_path, peg_demonstration):
    copy, place = tmp_path / "copy", {"chunk_index": 0, "file_index": 0}
    shutil.copytree(foreign, copy)
    rgb = peg_demonstration.steps.cameras["wrist"].rgb
    cells = []
    for image in [*rgb[::-1], *rgb]:
        PillowImage.fromarray(image).save(content := io.BytesIO(), "PNG")
        cells.append({"bytes": content.getvalue(), "path": None})
    table = parquet.read_table(copy / DATA.format(**place))
    key = "observation.images.hand"
    parquet.write_table(table.append_column(key, pa.array(cells)), copy / DATA.format(**place))
    info = json.loads((copy / INFO).read_text())
    info["features"][key]["dtype"] = "image"
    (copy / INFO).write_text(json.dumps(info))
    said(*[copy if word == foreign else word for word in command])
    read = load_demonstration(tmp_path / "demo.h5")
    assert np.array_equal(read.steps.cameras["wrist"].rgb, rgb)


def test_a_dataset_of_an_older_version_is_refused(foreign, tmp_path):
    info = json.loads((foreign / INFO).read_text()) | {"codebase_version": "v2.1"}
    (tmp_path / "meta").mkdir()
    (tmp_path / INFO).write_text(json.dumps(info))
    with pytest.raises(BrokenFile, match=r"is of LeRobot v2.1, v3.0 is read"):
        LeRobot().read(tmp_path / "episode_000000", Given())


def test_a_file_that_is_missing_or_short_is_told(foreign, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(foreign, copy)
    place = {"chunk_index": 0, "file_index": 0}
    table = parquet.read_table(copy / DATA.format(**place))
    parquet.write_table(table.slice(0, len(table) - 3), copy / DATA.format(**place))
    with pytest.raises(BrokenFile, match=r"episode 1 has \d+ rows, expected \d+"):
        LeRobot().read(copy / "episode_000001", Given())
    (copy / DATA.format(**place)).unlink()
    with pytest.raises(BrokenFile, match="can't be read as parquet"):
        LeRobot().read(copy / "episode_000001", Given())


# A robot that nobody can reset and that knows no bodies, at the demonstration's start.
CELL = """
import dataclasses

import sart_toolkit as sart
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks.task import Placement


class Cell(sart.Backend):
    name = "cell"

    def __init__(self, robot, scene, *options):
        super().__init__(robot, scene, *options)
        self._whole = sart.get_backend("pybullet")(robot, scene, *options)
        model = RobotModel(robot, scene.held)
        self._whole.reset(sart.get_task("peg_in_hole").initial_state(model, Placement()))

    def observe(self, *args):
        return dataclasses.replace(self._whole.observe(*args), Ts_world_body={})

    def command(self, q, gripper):
        return self._whole.command(q, gripper)

    def step(self):
        self._whole.step()

    def close(self):
        self._whole.close()
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lerobot", "rmb"])
def test_a_recording_from_elsewhere_is_annotated_and_augmented_from_its_images(
    name, command, said, calibration, tmp_path: Path, exported: Callable[[str], Path]
):
    demo, spheres = tmp_path / "demo.h5", tmp_path / "spheres.json"
    if name == "lerobot":
        said(*command)
    else:
        recording = tmp_path / "peg.rmb"
        shutil.copytree(sorted(exported("rmb").glob("*.rmb"))[0], recording)
        with h5py.File(recording / MAIN, "r+") as file:
            del file.attrs["sart"], file["sart_contact_force"]
        said(
            "import", recording, "--out", demo, "--task", "peg_in_hole", "--robot", "ur5e_2f85",
            "--gripper-range", "0,1", "--calibration", calibration,
        )  # fmt: skip
    cloud = ["--source", "cloud", "--sensor", "d405", "--calibration", calibration]
    suggested = said("suggest", demo, "--out", spheres, *cloud)
    assert len(suggested["spheres"]) >= 2
    settings = json.loads(spheres.read_text())["settings"]
    sensor = settings["cloud"]["sensor"]
    assert sensor["hand_eye"] == pytest.approx(0.0006, abs=1e-5)
    assert sensor["depth_scale"] == pytest.approx(0.002)
    (tmp_path / "cell.py").write_text(CELL)
    asked: list[str] = []
    dataset = pipeline.augment(
        demo, spheres, tmp_path / "dataset", backend=f"{tmp_path / 'cell.py'}:Cell", n=4,
        obstacles="cloud", cameras=("wrist",), ask=asked.append,
    )  # fmt: skip
    assert len(dataset) == 3 and asked
    checked = said("validate", tmp_path / "dataset")
    assert checked["episodes"] == 3 and checked["least_measured_clearance_mm"] > 0
