"""`sart calibrate`: folders of images, demonstrations, and the board."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from sart_toolkit.calibrate.calibration import load_calibration
from sart_toolkit.calibrate.pictures import views_in_folder, views_of_demonstration
from sart_toolkit.data.records import CameraRecord, Demonstration
from sart_toolkit.data.storage import save_demonstration
from sart_toolkit.errors import BrokenFile, InvalidInput, MissingFile, UnknownName
from sart_toolkit.poses import distance, pose
from sart_toolkit.robots.model import RobotModel

pytest.importorskip("cv2")


def write(folder: Path, views, rotation: str = "rotvec") -> Path:
    """A folder as a person makes it."""
    folder.mkdir()
    with open(folder / "poses.csv", "w", newline="") as file:
        names = ["rx", "ry", "rz"] if rotation == "rotvec" else ["qx", "qy", "qz", "qw"]
        table = csv.writer(file)
        table.writerow(["image", "depth", "x", "y", "z", *names])
        for view in views:
            Image.fromarray(view.rgb).save(folder / view.name)
            depth = ""
            if view.depth is not None:
                depth = view.name.replace(".png", "_depth.png")
                Image.fromarray(np.rint(view.depth * 1e3).astype(np.uint16)).save(folder / depth)
            R = Rotation.from_matrix(view.T_world_tool[:3, :3])
            r = R.as_rotvec() if rotation == "rotvec" else R.as_quat()
            table.writerow([view.name, depth, *view.T_world_tool[:3, 3], *r])
    return folder


def test_a_folder_of_images_becomes_a_calibration(board_views, tmp_path, said):
    folder = write(tmp_path / "pictures", board_views.views)
    told = said("calibrate", folder, "--out", tmp_path / "wrist.json")
    found = load_calibration(tmp_path / "wrist.json")
    metres, angle = distance(found.T_frame_camera, board_views.T_frame_camera)
    assert metres <= found.hand_eye and np.rad2deg(angle) <= found.hand_eye_deg
    assert found.depth_scale == pytest.approx(1.01, abs=0.004)
    assert told["views"] == 12 and told["error_mm"] == pytest.approx(found.hand_eye * 1e3, abs=1e-3)
    assert told["intrinsics"] == found.intrinsics.round(3).tolist()


@pytest.mark.parametrize("rotation", ["rotvec", "xyzw"])
def test_poses_are_read_as_they_are_written(rotation, board_views, tmp_path):
    folder = write(tmp_path / "pictures", board_views.views[:2], rotation)
    for read, wanted in zip(views_in_folder(folder / "poses.csv"), board_views.views, strict=False):
        np.testing.assert_allclose(read.T_world_tool, wanted.T_world_tool, atol=1e-9)
        assert np.array_equal(read.rgb, wanted.rgb)
        assert np.abs(read.depth - wanted.depth).max() <= 5.1e-4


def test_joints_are_poses_of_the_robot_s_tool(board_views, tmp_path, peg_model: RobotModel):
    folder = write(tmp_path / "pictures", board_views.views[:1])
    q = np.array(peg_model.spec.home)
    (folder / "poses.csv").write_text(
        ", ".join(["image", *peg_model.spec.arm_joints])
        + "\n"
        + ", ".join(["00.png", *map(str, q)])
        + "\n"
    )
    (view,) = views_in_folder(folder, peg_model)
    np.testing.assert_allclose(view.T_world_tool, peg_model.fk(q), atol=1e-9)
    with pytest.raises(InvalidInput, match="for joints, say whose they are: --robot REF"):
        views_in_folder(folder)


def test_what_a_folder_lacks_is_said(board_views, tmp_path):
    with pytest.raises(MissingFile, match=r"poses.csv: no such file; it lists images with poses"):
        views_in_folder(tmp_path)
    folder = write(tmp_path / "pictures", board_views.views[:1])
    table = folder / "poses.csv"
    text = table.read_text()

    def refused(new: str, error: type[Exception], complaint: str) -> None:
        table.write_text(new)
        with pytest.raises(error, match=complaint):
            views_in_folder(folder)

    refused(text.replace("image", "file"), InvalidInput, "column image is missing")
    refused(text.replace("00.png", "01.png"), MissingFile, "01.png: no such file")
    refused("image,x,y,z,rx,ry,rz\n00.png,1,2,a,0,0,0\n", InvalidInput, "line 2: could not conv")
    refused("image,x,y,z,rx,ry,rz\n00.png,1,2\n", InvalidInput, "line 2: ")
    refused(
        "image,x,y,z,qx,qy,qz,qw\n00.png,1,2,3,1,1,1,1\n", InvalidInput, "expected length 1, got"
    )
    refused("image,x,y,z,rx,ry,rz\nposes.csv,1,2,3,0,0,0\n", BrokenFile, "read as an image")
    refused(
        "image,depth,x,y,z,rx,ry,rz\n00.png,00.png,1,2,3,0,0,0\n",
        InvalidInput,
        "expected a PNG of 16 bits in millimetres, got 'RGB'",
    )


def of_board(demonstration: Demonstration, drawn, K) -> Demonstration:
    """The demonstration as if its first steps had been spent before a board."""
    steps, n = demonstration.steps, len(drawn.views)
    Ts = np.array(steps.measured_Ts_world_tool)
    Ts[:n] = [view.T_world_tool for view in drawn.views]
    height, width = drawn.views[0].rgb.shape[:2]
    rgb = np.full((len(steps), height, width, 3), 128, np.uint8)
    depth = np.zeros((len(steps), height, width), np.float32)
    rgb[:n] = [view.rgb for view in drawn.views]
    depth[:n] = [view.depth for view in drawn.views]
    record = CameraRecord(rgb, depth, K, "tool", pose())
    return dataclasses.replace(
        demonstration,
        steps=dataclasses.replace(steps, measured_Ts_world_tool=Ts, cameras={"wrist": record}),
    )


def test_a_demonstration_that_shows_the_board_becomes_a_calibration(
    board_views, peg_demonstration, tmp_path, said
):
    shown = of_board(peg_demonstration, board_views, board_views.K)
    views = views_of_demonstration(shown, "wrist")
    # Steps that hardly differ from each other tell nothing more.
    assert [view.name for view in views[:2]] == ["step 0", "step 1"]
    assert 12 <= len(views) < len(shown)
    with pytest.raises(UnknownName, match="unknown camera 'head'"):
        views_of_demonstration(shown, "head")
    save_demonstration(tmp_path / "board.h5", shown)
    said("calibrate", tmp_path / "board.h5", "--out", tmp_path / "wrist.json")
    found = load_calibration(tmp_path / "wrist.json")
    metres, _ = distance(found.T_frame_camera, board_views.T_frame_camera)
    assert metres <= found.hand_eye and found.views == 12
    # What was recorded of them is taken.
    assert np.array_equal(found.intrinsics, board_views.K)


def test_the_board_is_written_and_other_options_then_refused(tmp_path, said, refused):
    told = said("calibrate", "--board", tmp_path / "board.pdf", "--squares", "7x5")
    assert told["squares"] == "7x5" and (tmp_path / "board.pdf").stat().st_size > 1000
    again = "calibrate", "--board", tmp_path / "b.pdf"
    assert "--board: only writes the board; leave out out" in refused(*again, "--out", "a.json")
    assert "--squares: expected 9x7 for instance, got '9'" in refused(*again, "--squares", "9")
    assert "SOURCE, --out: both are needed" in refused("calibrate")
    assert "--intrinsics: expected FX,FY,CX,CY in pixels" in refused(
        "calibrate", write(tmp_path / "p", []), "--out", "a.json", "--intrinsics", "600"
    )
