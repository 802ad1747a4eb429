"""RMB, both variants, both ways."""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from sart_toolkit.data.formats import get_format
from sart_toolkit.data.formats.format import Arm, Format, Given, about_dataset
from sart_toolkit.data.formats.rmb import MAIN, Rmb, _depth_planes, _of_planes
from sart_toolkit.data.formats.transfer import export_dataset
from sart_toolkit.data.formats.video import read_video
from sart_toolkit.data.records import Demonstration, Steps
from sart_toolkit.errors import BrokenFile, InvalidInput
from sart_toolkit.poses import pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel

VARIANTS = ("rmb", "rmb_hdf5")


@pytest.fixture
def copy_of(exported: Callable[[str], Path], tmp_path: Path) -> Callable[[str], Path]:
    """A recording that may be damaged."""

    def copy_of(name: str) -> Path:
        shutil.copytree(exported(name), tmp_path / "copy")
        return sorted((tmp_path / "copy").glob("peg_in_hole_*"))[0]

    return copy_of


def main_of(recording: Path) -> Path:
    return recording / MAIN if recording.is_dir() else recording


@pytest.mark.parametrize("name", VARIANTS)
def test_what_is_read_is_what_was_written(name, exported, trajectories):
    """Depth in videos to a millimetre, as RMB has it; all else is equal, poses up to rounding."""
    format = get_format(name)
    found = format.recordings(exported(name))
    for path, trajectory in zip(found, trajectories, strict=True):
        read = format.read(path, Given())
        for field in dataclasses.fields(Steps):
            wanted, got = getattr(trajectory.steps, field.name), getattr(read.steps, field.name)
            if field.name.endswith("Ts_world_tool"):
                np.testing.assert_allclose(got, wanted, atol=1e-12)
            elif field.name != "cameras":
                assert np.array_equal(got, wanted), field.name
        camera, wrist = read.steps.cameras["wrist"], trajectory.steps.cameras["wrist"]
        assert np.array_equal(camera.rgb, wrist.rgb)
        assert np.array_equal(camera.intrinsics, wrist.intrinsics)
        assert np.array_equal(camera.T_frame_camera, wrist.T_frame_camera)
        assert np.abs(camera.depth - wrist.depth).max() <= (5.1e-4 if name == "rmb" else 0)
        assert read.success.tolist() == trajectory.success.tolist()
        np.testing.assert_allclose(read.actions, trajectory.actions, atol=1e-9)


@pytest.mark.parametrize("name", VARIANTS)
def test_written_again_it_is_equal(name, exported, tmp_path):
    format = get_format(name)
    first = format.recordings(exported(name))[0]
    demonstration = format.read(first, Given())
    export_dataset(demonstration, format, tmp_path / "again", about_dataset(demonstration))
    (second,) = format.recordings(tmp_path / "again")
    with h5py.File(main_of(first)) as a, h5py.File(main_of(second)) as b:
        assert sorted(a) == sorted(b)
        for key in a:
            np.testing.assert_allclose(b[key][()], a[key][()], atol=1e-12, err_msg=key)
    for video in first.glob("*.mp4") if first.is_dir() else ():
        pix_fmt = "rgb24" if "rgb" in video.name else "yuv444p"
        frames = zip(
            read_video(video, pix_fmt), read_video(second / video.name, pix_fmt), strict=True
        )
        assert all(np.array_equal(*pair) for pair in frames)


def test_the_keys_are_those_of_rmb(exported, trajectories):
    recording = Rmb().recordings(exported("rmb"))[1]
    n = len(trajectories[1])
    with h5py.File(recording / MAIN) as file:
        widths = {key: file[key].shape[1:] for key in file}
        for which in ("measured", "command"):
            for suffix in ("", "_rel"):
                assert widths[f"{which}_joint_pos{suffix}"] == (7,)
                assert widths[f"{which}_gripper_joint_pos{suffix}"] == (1,)
            assert widths[f"{which}_eef_pose"] == (7,)
            assert widths[f"{which}_eef_pose_rel"] == (6,)
            assert not file[f"{which}_eef_pose_rel"][0].any()
        assert len(file["time"]) == len(file["reward"]) == n
        # Real part first, and the same motion as the poses say.
        assert np.abs(file["measured_eef_pose"][:, 3:]).max(0)[0] < 0.1
        assert file.attrs["format"] == "RmbData-Compact" and file.attrs["world_idx"] == 0
        assert list(file.attrs["camera_names"]) == ["wrist"]
        assert file.attrs["wrist_depth_image_fovy"] == pytest.approx(
            get_robot("ur5e_2f85").cameras[0].fov_y_deg
        )
        assert "action" in json.loads(file.attrs["sart"])["conventions"]


def test_depth_in_videos_changes_steadily_with_distance():
    millimetres = np.arange(2048, dtype=np.uint16).reshape(1, 32, 64)
    planes = _depth_planes(millimetres)
    assert np.array_equal(_of_planes(planes[0]), millimetres[0])
    low = planes[0, 0].ravel().astype(int)
    assert np.abs(np.diff(low)).max() == 1 and not planes[0, 1].any()


def foreign(recording: Path) -> None:
    """As if it were of somebody else: nothing of ours in it, and a gripper from 0 to 255."""
    with h5py.File(main_of(recording), "r+") as file:
        del file.attrs["sart"], file["sart_contact_force"]
        for which in ("measured", "command"):
            file[f"{which}_gripper_joint_pos"][...] *= 255
            # Another end-effector frame than the tool.
            file[f"{which}_eef_pose"][:, :3] += 0.1


@pytest.mark.parametrize("name", VARIANTS)
def test_of_others_what_the_file_lacks_is_given(name, copy_of, trajectories):
    recording, format = copy_of(name), get_format(name)
    foreign(recording)
    model = RobotModel(get_robot("ur5e_2f85"))
    given = {
        "task": "peg_in_hole",
        "robot": "ur5e_2f85",
        "gripper_range": (0.0, 255.0),
        "arm": Arm(model.fk, model.ik, np.array(model.spec.home), np.eye(4)),
        "cameras": model.mounted_cameras(),
    }
    read = format.read(recording, Given(**given))
    steps, wanted = read.steps, trajectories[0].steps
    assert (read.task, read.robot, read.backend) == ("peg_in_hole", "ur5e_2f85", "imported")
    assert read.rates.record_hz == 10 and read.judged_by == "nobody"
    np.testing.assert_allclose(steps.measured_gripper, wanted.measured_gripper, atol=1e-12)
    np.testing.assert_allclose(steps.measured_Ts_world_tool, wanted.measured_Ts_world_tool,
                               atol=1e-6)  # fmt: skip
    camera, wrist = steps.cameras["wrist"], wanted.cameras["wrist"]
    np.testing.assert_allclose(camera.T_frame_camera, wrist.T_frame_camera, atol=1e-6)
    np.testing.assert_allclose(camera.intrinsics, wrist.intrinsics, atol=1e-9)
    assert np.isnan(steps.contact_force).all()
    for missing, complaint in {
        "task": "doesn't say which task it is of; add --task REF",
        "robot": "doesn't say which robot it is of; add --robot REF",
        "gripper_range": "which are open and closed isn't said; add --gripper-range OPEN,CLOSED",
        "arm": "tool frame is known from the robot alone; add --robot REF",
        "cameras": "camera 'wrist': where it is mounted isn't said; add --calibration FILE, or "
        "--robot REF of a robot",
    }.items():
        rest = {key: value for key, value in given.items() if key != missing}
        with pytest.raises(InvalidInput, match=complaint):
            format.read(recording, Given(**rest))
    with pytest.raises(InvalidInput, match="gripper_range: expected two numbers, got 3 twice"):
        format.read(recording, Given(**{**given, "gripper_range": (3.0, 3.0)}))


@pytest.mark.parametrize(
    "said", [{"task": "a"}, {"robot": "b"}, {"gripper_range": (0.0, 255.0)}], ids=str
)
def test_what_the_file_says_itself_is_not_said_again(said, exported):
    recording = Rmb().recordings(exported("rmb"))[0]
    flag = next(iter(said)).replace("_", "-")
    with pytest.raises(InvalidInput, match=f"says itself what this would; leave --{flag} out"):
        Rmb().read(recording, Given(**said))


def test_without_depth_it_is_read_as_if_nothing_was_hit(copy_of, caplog):
    recording = copy_of("rmb")
    (recording / "wrist_depth_image.rmb.mp4").unlink()
    assert Rmb().problems(recording) == []
    with caplog.at_level(logging.WARNING):
        read = Rmb().read(recording, Given())
    assert not read.steps.cameras["wrist"].depth.any() and "has no depth" in caplog.text


def test_two_arms_are_refused(copy_of):
    recording = copy_of("rmb_hdf5")
    with h5py.File(recording, "r+") as file:
        gripper = file["measured_gripper_joint_pos"][()]
        del file["measured_gripper_joint_pos"]
        file["measured_gripper_joint_pos"] = np.repeat(gripper, 2, axis=1)
    with pytest.raises(InvalidInput, match="2 gripper joints; one arm and one is read"):
        Rmb().read(recording, Given())


def test_uneven_times_of_others_are_refused(copy_of):
    recording = copy_of("rmb_hdf5")
    foreign(recording)
    with h5py.File(recording, "r+") as file:
        file["time"][5:] += 0.3
    arm = Arm(lambda q: pose(), lambda T, q: q, np.zeros(6), pose())
    given = Given("t", "r", gripper_range=(0, 255), arm=arm,
                  cameras={"wrist": ("tool", np.eye(4))})  # fmt: skip
    with pytest.raises(InvalidInput, match="steps are missing or uneven"):
        Rmb().read(recording, given)


def test_depth_beyond_what_videos_hold_is_refused(peg_demonstration, tmp_path):
    steps = peg_demonstration.steps
    far = dataclasses.replace(steps.cameras["wrist"], depth=steps.cameras["wrist"].depth + 70)
    demonstration: Demonstration = dataclasses.replace(
        peg_demonstration, steps=dataclasses.replace(steps, cameras={"wrist": far})
    )
    with pytest.raises(InvalidInput, match=r"depth beyond 65.5 m"):
        export_dataset(demonstration, Rmb(), tmp_path / "a", about_dataset(demonstration))


def test_what_is_no_recording_is_none(tmp_path):
    (tmp_path / "a.hdf5").write_bytes(b"nothing")
    (tmp_path / "b.rmb").mkdir()
    assert Rmb().recordings(tmp_path) == [tmp_path / "b.rmb"]
    with pytest.raises(BrokenFile, match=r"main.rmb.hdf5: can't be read as such a file"):
        Rmb().read(tmp_path / "b.rmb", Given())
    assert Rmb().problems(tmp_path / "a.hdf5") == [f"{tmp_path / 'a.hdf5'}: no recording of RMB"]


def _drop(key: str) -> Callable[[h5py.File], None]:
    return lambda file: file.__delitem__(key)


def _cut(file: h5py.File) -> None:
    values = file["command_joint_pos"][()]
    del file["command_joint_pos"]
    file["command_joint_pos"] = values[:-1]


def _put(key: str, step: int, value: float) -> Callable[[h5py.File], None]:
    def put(file: h5py.File) -> None:
        file[key][step] = value

    return put


MUTATIONS: dict[str, tuple[Callable[[h5py.File], object], str]] = {
    "a key that is missing": (_drop("command_eef_pose"), "command_eef_pose is missing"),
    "steps that are missing": (_cut, "command_joint_pos has "),
    "no times": (_drop("time"), "time is missing"),
    "times that go back": (_put("time", 4, 0.0), "time doesn't increase"),
    "a quaternion that is none": (
        _put("measured_eef_pose", 3, 0.0),
        "measured_eef_pose: quaternions of length 0 to 1",
    ),
    "a number that is none": (
        _put("measured_joint_pos", 3, np.nan),
        "measured_joint_pos has NaN or infinite values",
    ),
    "a motion before the first step": (
        _put("command_eef_pose_rel", 0, 0.1),
        "command_eef_pose_rel: the first step isn't zero",
    ),
    "another variant": (
        lambda file: file.attrs.create("format", "RmbData-Other"),
        "attribute format is 'RmbData-Other', expected ",
    ),
    "a camera without its field of view": (
        lambda file: file.attrs.__delitem__("wrist_depth_image_fovy"),
        "attribute wrist_depth_image_fovy is missing",
    ),
}


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", MUTATIONS)
def test_what_a_reader_fails_on_is_found(name, variant, copy_of):
    recording = copy_of(variant)
    mutate, complaint = MUTATIONS[name]
    with h5py.File(main_of(recording), "r+") as file:
        mutate(file)
    format: Format = get_format(variant)
    found = format.problems(recording.parent)
    assert found and found[0].startswith(f"{recording.name}: {complaint}"), found


def test_images_that_are_missing_are_found(copy_of):
    recording = copy_of("rmb")
    (recording / "wrist_rgb_image.rmb.mp4").unlink()
    (line,) = Rmb().problems(recording)
    assert line.endswith("wrist_rgb_image.rmb.mp4: no such file, camera_names has 'wrist'")
    other = Rmb().recordings(recording.parent)[2]
    shutil.copy(other / "wrist_rgb_image.rmb.mp4", recording)
    with h5py.File(recording / MAIN) as file, h5py.File(other / MAIN) as others:
        assert len(file["time"]) != len(others["time"])
    (line,) = Rmb().problems(recording)
    assert "wrist_rgb_image.rmb.mp4 has " in line and ", time has " in line


def test_cameras_are_taken_by_our_names_with_measured_intrinsics(copy_of):
    recording = copy_of("rmb_hdf5")
    foreign(recording)
    K = np.array([[50.0, 0, 20], [0, 51, 21], [0, 0, 1]])
    model = RobotModel(get_robot("ur5e_2f85"))
    given = Given(
        "peg_in_hole", "ur5e_2f85", gripper_range=(0, 255),
        arm=Arm(model.fk, model.ik, np.array(model.spec.home), np.eye(4)),
        cameras={"hand": ("tool", pose([0, 0, 0.1]))},
        intrinsics={"hand": lambda width, height: K}, camera_names={"hand": "wrist"},
    )  # fmt: skip
    format = get_format("rmb_hdf5")
    camera = format.read(recording, given).steps.cameras["hand"]
    assert np.array_equal(camera.intrinsics, K) and camera.T_frame_camera[2, 3] == 0.1
    with h5py.File(main_of(recording), "r+") as file:
        del file.attrs["wrist_depth_image_fovy"]
    format.read(recording, given)
    with pytest.raises(InvalidInput, match="add --calibration FILE, or --camera-intrinsics hand="):
        format.read(recording, dataclasses.replace(given, intrinsics={}))
    posed = dataclasses.replace(given.arm, T_frame_tool=pose())
    with pytest.raises(InvalidInput, match="poses come from its joints; leave --pose-frame out"):
        format.read(recording, dataclasses.replace(given, arm=posed))
    with pytest.raises(InvalidInput, match="has columns of fixed names; leave --columns out"):
        format.read(recording, dataclasses.replace(given, columns={"joints": "a"}))
