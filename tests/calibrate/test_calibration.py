"""What a calibration says reaches the cloud, or it is refused as another camera's."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from sart_toolkit.calibrate.board import Board
from sart_toolkit.calibrate.calibration import (
    Calibration,
    declared_errors,
    load_calibration,
    save_calibration,
)
from sart_toolkit.cli.arguments import Augment, Suggest
from sart_toolkit.cli.sensor import declared_sensor
from sart_toolkit.cli.verbs import Verb
from sart_toolkit.collision.sensor import sensor_errors
from sart_toolkit.data.storage import save_demonstration
from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch
from sart_toolkit.poses import pose


@pytest.fixture
def calibration(peg_demonstration) -> Calibration:
    """One of the camera that recorded the demonstration, 0.3 mm and 0.1 deg off that."""
    camera = peg_demonstration.steps.cameras["wrist"]
    height, width = camera.rgb.shape[1:3]
    return Calibration(
        "wrist", "tool",
        camera.T_frame_camera @ pose([0, 0.0003, 0], [np.deg2rad(0.1), 0, 0]),
        camera.intrinsics, (width, height),
        hand_eye=0.0012, hand_eye_deg=0.3, axis_errors=(0.001, 0.001, 0.001),
        axis_errors_deg=(0.2, 0.2, 0.2), square_scale=1.001, rms_pixels=0.25, views=14,
        left_out=("07.png",), board=Board(), depth_scale=1.004, depth_scale_error=0.007,
    )  # fmt: skip


@pytest.fixture
def file(calibration, tmp_path):
    save_calibration(tmp_path / "wrist.json", calibration)
    return tmp_path / "wrist.json"


def test_a_calibration_is_read_as_it_was_written(calibration, file):
    read = load_calibration(file)
    for field in dataclasses.fields(Calibration):
        assert np.all(getattr(read, field.name) == getattr(calibration, field.name)), field.name


def test_a_file_that_was_changed_or_is_another_is_refused(file, tmp_path):
    text = file.read_text()
    file.write_text(text.replace("0.0012", "0.0002"))
    with pytest.raises(BrokenFile, match="content differs from its hash"):
        load_calibration(file)
    from sart_toolkit.data.storage import write_json

    values = {k: v for k, v in json.loads(text).items() if k not in ("sha256", "schema_version")}
    for change, complaint in (
        ({"kind": "evaluation"}, "a field is missing or wrong"),
        ({"T_frame_camera": np.zeros((4, 4)).tolist()}, "is no calibration .* not a rigid"),
        ({"board": {"columns": 1}}, "is no calibration .*columns: expected 3 to 100"),
    ):
        write_json(tmp_path / "other.json", {**values, **change})
        with pytest.raises(BrokenFile, match=complaint):
            load_calibration(tmp_path / "other.json")


def test_the_recorded_pose_s_distance_from_the_calibrated_one_counts(
    peg_demonstration, calibration
):
    errors = declared_errors(peg_demonstration, [calibration])
    assert errors.hand_eye == pytest.approx(0.0012 + 0.0003, abs=1e-8)
    assert errors.hand_eye_deg == pytest.approx(0.3 + 0.1, abs=1e-6)
    assert errors.depth_scale == 0.007
    without = dataclasses.replace(calibration, depth_scale=None, depth_scale_error=None)
    assert declared_errors(peg_demonstration, [without]).depth_scale is None


@pytest.mark.parametrize("change", ["camera", "frame", "pose", "intrinsics", "shape", "twice"])
def test_another_camera_s_calibration_is_refused(change, peg_demonstration, calibration):
    other, complaint = {
        "camera": ({"camera": "overview"}, "camera 'wrist': 0 calibrations of it"),
        "frame": ({"frame": "world"}, "mounted on the tool, calibrated on the world"),
        "pose": (
            {"T_frame_camera": calibration.T_frame_camera @ pose([0.002, 0, 0])},
            "is recorded 2.0 mm and 0.10 deg from where it is calibrated to be, which is off by "
            "1.2 mm",
        ),
        "intrinsics": (
            {"intrinsics": calibration.intrinsics * [[1.1], [1.1], [1]]},
            "its recorded intrinsics are .* pixels from the calibrated ones",
        ),
        "shape": ({"image_size": (640, 480)}, "calibrated with images of 640x480"),
        "twice": ({}, "camera 'wrist': 2 calibrations of it"),
    }[change]
    found = [dataclasses.replace(calibration, **other)]
    with pytest.raises(Mismatch, match=complaint):
        declared_errors(peg_demonstration, found * (2 if change == "twice" else 1))


def test_a_demonstration_without_depth_needs_none(peg_demonstration, calibration):
    steps = peg_demonstration.steps
    flat = dataclasses.replace(
        steps.cameras["wrist"], depth=np.zeros_like(steps.cameras["wrist"].depth)
    )
    bare = dataclasses.replace(
        peg_demonstration, steps=dataclasses.replace(steps, cameras={"wrist": flat})
    )
    with pytest.raises(Mismatch, match="holds no depth that a calibration could be about"):
        declared_errors(bare, [calibration])


def test_intrinsics_scale_with_the_image(calibration):
    K = calibration.intrinsics
    width, height = calibration.image_size
    double = calibration.intrinsics_of(2 * width, 2 * height)
    ray = np.linalg.inv(K) @ [10.0, 20.0, 1.0]
    # The middle of a pixel is that of four.
    assert double @ ray == pytest.approx([20.5, 40.5, 1.0])


@pytest.mark.parametrize("of", [Suggest, Augment])
def test_flags_declare_what_the_calibration_says(of, file, peg_demonstration, tmp_path):
    save_demonstration(tmp_path / "demo.h5", peg_demonstration)
    start = "demo.h5 --out a.json" if of is Suggest else "demo.h5 a.json --out data"

    def declared(words):
        words = f"{start} --source cloud --calibration {file} {words}"
        return declared_sensor(Verb(of, "").parse("verb", words.split()), [tmp_path / "demo.h5"])

    found = declared("--sensor d405")
    assert found is not None
    wanted = sensor_errors("d405", (0.0015, 0.4), 0.007)
    for name, value in wanted.to_json().items():
        assert getattr(found, name) == pytest.approx(value, abs=1e-6), name
    with pytest.raises(InvalidInput, match="--hand-eye-error: --calibration declares it"):
        declared("--hand-eye-error 2,0.3")
    with pytest.raises(InvalidInput, match="--depth-scale-error: --calibration declares it"):
        declared("--depth-scale-error 1")


def test_where_depth_was_not_calibrated_its_scale_is_declared_by_hand(
    calibration, peg_demonstration, tmp_path
):
    save_demonstration(tmp_path / "demo.h5", peg_demonstration)
    without = dataclasses.replace(calibration, depth_scale=None, depth_scale_error=None)
    save_calibration(tmp_path / "a.json", without)
    words = f"demo.h5 --out a.json --source cloud --calibration {tmp_path / 'a.json'}"
    flags = Verb(Suggest, "").parse("verb", [*words.split(), "--depth-scale-error", "1"])
    found = declared_sensor(flags, [tmp_path / "demo.h5"])
    assert found is not None and found.depth_scale == 0.01


def test_a_calibration_for_obstacles_of_the_scene_is_refused():
    words = ["demo.h5", "--out", "a.json", "--calibration", "wrist.json"]
    flags = Verb(Suggest, "").parse("verb", words)
    with pytest.raises(InvalidInput, match="--calibration: is about the recorded RGB-D; add --s"):
        declared_sensor(flags, [])


def test_numbers_that_are_none_are_refused(calibration):
    with pytest.raises(InvalidInput, match="hand_eye: expected a number >= 0, got -1"):
        dataclasses.replace(calibration, hand_eye=-1.0)
    with pytest.raises(InvalidInput, match="frame: expected 'tool' or 'world', got 'base'"):
        dataclasses.replace(calibration, frame="base")
