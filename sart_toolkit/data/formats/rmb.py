"""RoboManipBaselines' RMB format, both variants: one recording each, written and read.

Compact: a directory `X.rmb` of `main.rmb.hdf5` and a video for each camera's images and depth.
Single: one `X.hdf5` with everything. The toolkit's own files say besides, in an attribute and a
dataset that others leave aside, what RMB has no place for; of those of others, a person does.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sart_toolkit.data.formats.format import (
    SAID_BY_OURS,
    About,
    Given,
    Reads,
    Trajectory,
    all_problems,
    imported_demonstration,
    poses_of,
    quaternions,
)
from sart_toolkit.data.formats.hdf5 import reading_hdf5, rows
from sart_toolkit.data.formats.video import (
    Codec,
    VideoWriter,
    best_codec,
    inspect_video,
    read_video,
)
from sart_toolkit.data.records import (
    CameraRecord,
    Demonstration,
    Image,
    Steps,
    library_versions,
)
from sart_toolkit.data.storage import put_frames
from sart_toolkit.errors import BrokenFile, InvalidInput, SartError
from sart_toolkit.poses import Array, inverse

MAIN = "main.rmb.hdf5"
_COMPACT, _SINGLE = "RmbData-Compact", "RmbData-SingleHDF5"
_MARK = "sart.json"
_NOT_UNIT = 1e-3
_log = logging.getLogger(__name__)

# Lossless, both: what is read is what was written.
_RGB = Codec("libx264rgb", "h264", "rgb24", "rgb24", {"crf": "0", "preset": "veryfast"})
_DEPTH = Codec("libx264", "h264", "yuv444p", "yuv444p", {"crf": "0", "preset": "veryfast"})


class Rmb(Reads):
    """RMB, a directory of recordings, each an `X.rmb`."""

    name = "rmb"
    mark = _MARK
    ending = ".rmb"

    def write(self, path: Path, trajectories: Iterable[Trajectory], about: About) -> None:
        told = []
        for i, trajectory in enumerate(trajectories):
            name = f"{about.task}_{i:04d}{self.ending}"
            self.write_one(path / name, trajectory, about)
            told.append({"file": name, "name": trajectory.name})
        text = json.dumps({**about.sart, "recordings": told}, indent=2, allow_nan=False)
        (path / _MARK).write_text(text + "\n")

    def write_one(self, path: Path, trajectory: Trajectory, about: About) -> None:
        """Write a recording.

        Raises:
            OSError: the disk refuses.
        """
        path.mkdir()
        with _hdf5(path / MAIN) as file:
            _put(file, trajectory, about, _COMPACT)
        for name, camera in trajectory.steps.cameras.items():
            _write_video(_video(path, name, "rgb"), _RGB, camera.rgb, about.hz)
            if about.depth:
                levels = _depth_planes(_millimetres(trajectory.name, camera.depth))
                _write_video(_video(path, name, "depth"), _DEPTH, levels, about.hz)

    def problems(self, path: Path) -> Sequence[str]:
        found = self.recordings(path)
        if not found:
            return [f"{path}: no recording of RMB"]
        return all_problems(line for each in found for line in _recording_problems(each))

    def recordings(self, path: Path) -> Sequence[Path]:
        path = Path(path)
        if _is_recording(path):
            return [path]
        if not path.is_dir():
            return []
        return sorted(inside for inside in path.iterdir() if _is_recording(inside))

    def read(self, path: Path, given: Given) -> Demonstration:
        path = Path(path)
        try:
            with reading_hdf5(path / MAIN if path.is_dir() else path) as file:
                return _Recording(path, file, given).demonstration()
        except InvalidInput as error:
            raise InvalidInput(f"{path}: {error}") from error


class RmbHdf5(Rmb):
    """RMB, a directory of recordings, each one file `X.hdf5`."""

    name = "rmb_hdf5"
    ending = ".hdf5"

    def write_one(self, path: Path, trajectory: Trajectory, about: About) -> None:
        with _hdf5(path) as file:
            _put(file, trajectory, about, _SINGLE)
            for name, camera in trajectory.steps.cameras.items():
                put_frames(file, f"{name}_rgb_image", camera.rgb)
                if about.depth:
                    put_frames(file, f"{name}_depth_image", camera.depth)


@contextlib.contextmanager
def _hdf5(path: Path) -> Iterator[h5py.File]:
    """A small HDF5 file, made in memory: HDF5 crashes the process where a disk fills up."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        yield file
    with content.getbuffer() as all_:
        path.write_bytes(all_)


def _video(path: Path, camera: str, kind: str) -> Path:
    return path / f"{camera}_{kind}_image.rmb.mp4"


# --- writing ------------------------------------------------------------------------------------


def _put(file: h5py.File, trajectory: Trajectory, about: About, variant: str) -> None:
    """Everything but images."""
    steps, n = trajectory.steps, len(trajectory)
    file["time"] = np.arange(n) / about.hz
    file["reward"] = trajectory.success.astype(np.float64)
    grippers = {"measured": steps.measured_gripper, "command": steps.commanded_gripper}
    joints = {"measured": steps.joint_positions, "command": steps.commanded_joint_positions}
    poses = {"measured": steps.measured_Ts_world_tool, "command": steps.commanded_Ts_world_tool}
    for which in ("measured", "command"):
        gripper = grippers[which][:, None]
        # The gripper is the last joint there.
        for name, values in (
            ("joint_pos", np.concatenate([joints[which], gripper], axis=1)),
            ("gripper_joint_pos", gripper),
        ):
            file[f"{which}_{name}"] = values
            file[f"{which}_{name}_rel"] = np.diff(values, axis=0, prepend=values[:1])
        Ts = poses[which]
        file[f"{which}_eef_pose"] = np.concatenate(
            [Ts[:, :3, 3], quaternions(Ts, real="first")], axis=1
        )
        file[f"{which}_eef_pose_rel"] = _relative(Ts)
    rate = np.diff(steps.measured_gripper, prepend=steps.measured_gripper[:1]) * about.hz
    file["measured_joint_vel"] = np.concatenate([steps.joint_velocities, rate[:, None]], axis=1)
    file["sart_contact_force"] = steps.contact_force
    attributes = {
        "format": variant,
        "demo_name": trajectory.name,
        "task_desc": about.instruction,
        "version": f"sart_toolkit {library_versions().get('sart_toolkit', '')}",
        "env": f"{about.task} on {about.sart['backend']}",
        "world_idx": 0,
        "camera_names": np.array(list(steps.cameras), dtype=h5py.string_dtype()),
        "sart": json.dumps(
            {**about.sart, "sources": [], "provenance": dict(trajectory.provenance)}
        ),
    }
    for name, camera in steps.cameras.items():
        height = camera.rgb.shape[1]
        fov_y = 2 * np.arctan(0.5 * height / camera.intrinsics[1, 1])
        attributes[f"{name}_depth_image_fovy"] = np.rad2deg(fov_y)
    for name, value in attributes.items():
        file.attrs[name] = value


def _relative(Ts: Array) -> Array:
    """Each pose in the frame of the one before: xyz [m], roll, pitch, yaw [rad]; zeros first."""
    found = np.zeros((len(Ts), 6))
    steps = inverse(Ts[:-1]) @ Ts[1:]
    found[1:, :3] = steps[:, :3, 3]
    found[1:, 3:] = Rotation.from_matrix(steps[:, :3, :3]).as_euler("xyz")
    return found


def _millimetres(name: str, depth: NDArray[Any]) -> NDArray[np.uint16]:
    millimetres = np.rint(1e3 * depth)
    if not (millimetres <= np.iinfo(np.uint16).max).all():
        raise InvalidInput(f"{name}: depth beyond 65.5 m, which RMB's videos can't hold")
    return millimetres.astype(np.uint16)


def _depth_planes(millimetres: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Depth `(n, H, W)` as the planes Y, U and V `(n, 3, H, W)` of a video.

    V is the high byte, Y the low one, which runs backwards where the high one is odd, so that depth
    that grows steadily changes it steadily.
    """
    high, low = millimetres >> 8, millimetres & 255
    low = np.where(high % 2, 255 - low, low)
    return np.stack([low, np.zeros_like(low), high], axis=1).astype(np.uint8)


def _of_planes(planes: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """The depth [mm] that planes `(3, H, W)` stand for."""
    low, high = planes[0].astype(np.uint16), planes[2].astype(np.uint16)
    return (high << 8) + np.where(high % 2, 255 - low, low)


def _write_video(path: Path, codec: Codec, frames: NDArray[Any], hz: int) -> None:
    height, width = frames.shape[2:] if codec.given == "yuv444p" else frames.shape[1:3]
    writer = VideoWriter(path, best_codec([codec]), width, height, hz)
    try:
        for frame in frames:
            writer.add(frame)
        writer.close()
    except BaseException:
        writer.abandon()
        raise


# --- reading ------------------------------------------------------------------------------------


def _is_recording(path: Path) -> bool:
    if path.is_dir():
        return path.suffix == ".rmb" or (path / MAIN).exists()
    if path.suffix != ".hdf5" or not path.is_file():
        return False
    try:
        with h5py.File(path, "r") as file:
            return str(file.attrs.get("format", "")).startswith("RmbData")
    except (OSError, RuntimeError):
        return False


class _Recording:
    """A recording that is being read."""

    def __init__(self, path: Path, file: h5py.File, given: Given) -> None:
        self._path, self._file, self._given = path, file, given
        text = file.attrs.get("sart")
        # What only the toolkit's own files say.
        self._ours: dict[str, Any] = {} if text is None else json.loads(text)
        given.check_unsaid(("columns", "rotation"), "has columns of fixed names")
        if given.arm is not None and given.arm.T_frame_tool is not None:
            raise InvalidInput("poses come from its joints; leave --pose-frame out")
        if self._ours:
            given.check_unsaid(SAID_BY_OURS, "says itself what this would")
        self._cameras = [str(name) for name in np.ravel(file.attrs.get("camera_names", []))]

    def demonstration(self) -> Demonstration:
        """All of it."""
        steps, ours = self._steps(), self._ours
        time = rows(self._file, "time")[:, 0]
        reward = rows(self._file, "reward")[:, 0] if ours else np.zeros(len(steps))
        provenance = ours.get("provenance", {})
        return imported_demonstration(self._given, ours, provenance, steps, time, reward > 0)

    def _steps(self) -> Steps:
        file = self._file
        measured, commanded = rows(file, "measured_joint_pos"), rows(file, "command_joint_pos")
        grippers = [rows(file, f"{which}_gripper_joint_pos") for which in ("measured", "command")]
        if any(gripper.shape[1] != 1 for gripper in grippers):
            raise InvalidInput(f"{grippers[0].shape[1]} gripper joints; one arm and one is read")
        n_joints = measured.shape[1] - 1
        q, q_commanded = measured[:, :n_joints], commanded[:, :n_joints]
        force = (
            rows(file, "sart_contact_force")[:, 0]
            if "sart_contact_force" in file
            else np.full(len(q), np.nan)
        )
        return Steps(
            joint_positions=q,
            joint_velocities=rows(file, "measured_joint_vel")[:, :n_joints],
            commanded_joint_positions=q_commanded,
            measured_Ts_world_tool=self._poses("measured", q),
            commanded_Ts_world_tool=self._poses("command", q_commanded),
            measured_gripper=self._gripper(grippers[0][:, 0]),
            commanded_gripper=self._gripper(grippers[1][:, 0]),
            contact_force=force,
            cameras={
                name: self._camera(name, theirs)
                for name, theirs in self._given.chosen_cameras(self._cameras).items()
            },
        )

    def _poses(self, which: str, q: Array) -> Array:
        """The tool's poses `(n, 4, 4)`.

        Others' end-effector is another frame than the tool, so that theirs come from the joints.
        """
        if not self._ours:
            if self._given.arm is None:
                raise InvalidInput("its tool frame is known from the robot alone; add --robot REF")
            return np.array([self._given.arm.fk(row) for row in q])
        return poses_of(rows(self._file, f"{which}_eef_pose"), "wxyz")

    def _gripper(self, values: Array) -> Array:
        return values if self._ours else self._given.gripper(values)

    def _camera(self, name: str, theirs: str) -> CameraRecord:
        rgb = self._images(theirs, "rgb")
        if rgb is None:
            raise BrokenFile(f"{self._path}: camera {theirs!r}: no images")
        depth = self._images(theirs, "depth")
        if depth is None:
            _log.warning("%s: camera %r has no depth: as if nothing was hit", self._path, theirs)
            depth = np.zeros(rgb.shape[:3], np.float32)
        ours = self._ours.get("provenance", {}).get("cameras", {}).get(theirs)
        if ours is not None:
            frame, T, K = ours["frame"], ours["T_frame_camera"], np.asarray(ours["intrinsics"])
        else:
            frame, T = self._given.mounting(name)
            K = self._intrinsics(name, theirs, *rgb.shape[1:3])
        return CameraRecord(rgb, depth, K, frame, np.asarray(T))

    def _intrinsics(self, name: str, theirs: str, height: int, width: int) -> Array:
        """Those given, which may be measured ones, or those of the file's field of view."""
        key = f"{theirs}_depth_image_fovy"
        if name in self._given.intrinsics or key not in self._file.attrs:
            return self._given.intrinsics_of(name, width, height)
        f = 0.5 * height / np.tan(0.5 * np.deg2rad(float(self._file.attrs[key])))
        return np.array([[f, 0, 0.5 * (width - 1)], [0, f, 0.5 * (height - 1)], [0, 0, 1.0]])

    def _images(self, name: str, kind: str) -> NDArray[Any] | None:
        """A camera's images, or its depth [m]; None where there are none."""
        if self._path.is_dir():
            path = _video(self._path, name, kind)
            if not path.exists():
                return None
            if kind == "rgb":
                return np.stack(list(read_video(path, "rgb24")))
            frames = [_of_planes(planes) for planes in read_video(path, "yuv444p")]
            return (np.stack(frames) / 1e3).astype(np.float32)
        key = f"{name}_{kind}_image"
        if key not in self._file:
            return None
        images: Image = self._file[key][()]
        return images if kind == "rgb" else np.asarray(images, np.float32)


# --- checking -----------------------------------------------------------------------------------

_WIDTHS: Mapping[str, int] = {"eef_pose": 7, "eef_pose_rel": 6}


def _recording_problems(path: Path) -> Iterator[str]:
    try:
        with reading_hdf5(path / MAIN if path.is_dir() else path) as file:
            yield from (f"{path.name}: {line}" for line in _file_problems(path, file))
    except BrokenFile as error:
        yield str(error)


def _file_problems(path: Path, file: h5py.File) -> Iterator[str]:
    variant = _COMPACT if path.is_dir() else _SINGLE
    if (found := str(file.attrs.get("format"))) != variant:
        yield f"attribute format is {found!r}, expected {variant!r}"
    if "time" not in file:
        yield "time is missing"
        return
    n = len(file["time"])
    for which in ("measured", "command"):
        for name in ("joint_pos", "gripper_joint_pos", "eef_pose"):
            for key in (f"{which}_{name}", f"{which}_{name}_rel"):
                if key not in file and not key.endswith("_rel"):
                    yield f"{key} is missing"
    for key in sorted(file):
        if not isinstance(file[key], h5py.Dataset):
            yield f"{key}: expected an array"
            continue
        values = file[key]
        if len(values) != n:
            yield f"{key} has {len(values)} steps, time has {n}"
            continue
        if key.endswith("_image"):
            continue
        numbers = values[()]
        if key != "sart_contact_force" and not np.isfinite(numbers).all():
            yield f"{key} has NaN or infinite values"
            continue
        kind = key.partition("_")[2]
        if kind in _WIDTHS and (numbers.ndim != 2 or numbers.shape[1] % _WIDTHS[kind]):
            yield f"{key} has rows of {numbers.shape[1:]}, expected {_WIDTHS[kind]} for each arm"
        elif kind == "eef_pose":
            lengths = np.linalg.norm(numbers.reshape(n, -1, 7)[..., 3:], axis=-1)
            if (np.abs(lengths - 1) > _NOT_UNIT).any():
                yield f"{key}: quaternions of length {lengths.min():.4g} to {lengths.max():.4g}"
        elif key.endswith("_rel") and np.any(numbers[0]):
            yield f"{key}: the first step isn't zero, before which there is none"
    if (np.diff(file["time"][()]) <= 0).any():
        yield "time doesn't increase"
    for name in map(str, np.ravel(file.attrs.get("camera_names", []))):
        yield from _image_problems(path, file, name, n)


def _image_problems(path: Path, file: h5py.File, camera: str, n: int) -> Iterator[str]:
    for kind in ("rgb", "depth"):
        if path.is_dir():
            video = _video(path, camera, kind)
            if not video.exists():
                if kind == "rgb":
                    yield f"{video.name}: no such file, camera_names has {camera!r}"
                continue
            try:
                frames = len(inspect_video(video).times)
            except SartError as error:
                yield f"{video.name}: {error}"
                continue
            if frames != n:
                yield f"{video.name} has {frames} frames, time has {n}"
        elif kind == "rgb" and f"{camera}_rgb_image" not in file:
            yield f"{camera}_rgb_image is missing, camera_names has {camera!r}"
    if f"{camera}_depth_image_fovy" not in file.attrs:
        yield f"attribute {camera}_depth_image_fovy is missing"
