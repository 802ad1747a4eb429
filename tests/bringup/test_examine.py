"""What is wrong with a robot is said in a line with its remedy, in seconds, before it is used."""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.bringup.examine import examine
from sart_toolkit.doctor import Finding
from sart_toolkit.poses import pose
from sart_toolkit.robots.spec import CameraSpec, RobotSpec

Make = Callable[..., RobotSpec]
BOX = '<geometry><box size="0.06 0.06 0.25"/></geometry>'


def faults(robot: RobotSpec) -> list[Finding]:
    """What was found that must be put right; it took seconds."""
    started = time.perf_counter()
    found = [finding for finding in examine(robot) if finding.required and not finding.ok]
    assert time.perf_counter() - started < 30
    return found


def test_a_sound_robot_has_no_fault_and_its_cameras_image_is_written(
    toy: Make, tmp_path: Path
) -> None:
    findings = examine(toy(), tmp_path / "toy.png")
    assert [f for f in findings if not f.ok] == []
    assert {"files", "joints", "reach", "gripper", "cameras", "home", "pybullet"} <= {
        finding.name for finding in findings
    }
    (gripper,) = (f for f in findings if f.name == "gripper")
    assert gripper.detail == "gap from open to closed: 90.0, 70.0, 50.0, 30.0, 10.0 mm"
    assert (tmp_path / "toy.png").stat().st_size > 1000


def _edited(old: str, new: str, count: int = 1) -> Callable[[Make, Path], RobotSpec]:
    def make(toy: Make, folder: Path) -> RobotSpec:
        urdf = folder / "toy.urdf"
        assert old in urdf.read_text()
        urdf.write_text(urdf.read_text().replace(old, new, count))
        return toy()

    return make


def _changed(**changes: object) -> Callable[[Make, Path], RobotSpec]:
    return lambda toy, folder: toy(**changes)


INSIDE = CameraSpec("wrist", "hand", pose([0, 0, 0.0]))
ROBOTS: dict[str, tuple[Callable[[Make, Path], RobotSpec], str, str]] = {
    "xacro": (
        _edited("</robot>", '<xacro:include filename="x"/></robot>'),
        "is xacro (it has <xacro:include>)", "xacro toy.urdf > toy.urdf",
    ),
    "another package": (
        _edited(BOX, '<geometry><mesh filename="package://my_arm/l2.stl"/></geometry>'),
        "link 'l2': mesh package://my_arm/l2.stl is missing", "package_dirs of the RobotSpec",
    ),
    "a joint misspelt": (
        _changed(arm_joints=("j1", "j2", "j3", "j4", "j5", "j66")),
        "unknown joint 'j66'", "did you mean 'j6'",
    ),
    "joints out of order": (
        _changed(arm_joints=("j2", "j1", "j3", "j4", "j5", "j6")),
        "arm_joints must be in the URDF's order", "got ['j2', 'j1'",
    ),
    "degrees": (
        _edited('lower="-2.9" upper="2.9"', 'lower="-170" upper="170"'),
        "joint 'j1': <limit>: from -170 to 170 rad", "give it in rad, not degrees",
    ),
    "home beyond a limit": (
        _changed(home=np.array([0, 3.0, 1.6, 1.44, 0, 0])),
        "j2 at 3.000 is outside its limits [-2.900, 2.900]", "choose a home within",
    ),
    "open and closed swapped": (
        _changed(gripper={"open_position": 0.04, "closed_position": 0.0}),
        "its gap grows as it closes: 10.0, 30.0", "swap open_position and closed_position",
    ),
    "a follower turned round": (
        _edited('axis xyz="1 0 0"/><limit lower="0"', 'axis xyz="-1 0 0"/><limit lower="0"'),
        "its gap grows|its gap doesn't shrink", "swap|check the ratios",
    ),
    "closed beyond the limits": (
        _changed(gripper={"closed_position": 0.4}),
        "closed_position 0.4 of the gripper's driver 'grip' is outside its limits [0, 0.04]",
        "give a position within",
    ),
    "a finger misspelt": (
        _changed(gripper={"finger_links": ("lefd", "right")}),
        "finger_links: no frame 'lefd'", "did you mean 'left'",
    ),
    "a camera's frame misspelt": (
        _changed(cameras=(CameraSpec("wrist", "hamd", np.eye(4)),)),
        "camera 'wrist': no frame 'hamd'", "did you mean 'hand'",
    ),
    "an impossible inertia": (
        _edited('ixy="0"', 'ixy="0.5"'),
        "link 'base': <inertia>: no body has it", "correct it, or remove <inertia>",
    ),
    "a home in the base": (
        _changed(home=np.array([0, 0.0, 2.9, 0.9, 0, 0])),
        "doesn't hold its home|doesn't follow", "choose a home where nothing touches|touches",
    ),
    "no effort to speak of": (
        _edited('effort="80"', 'effort="0.001"', 6),
        "doesn't hold its home|doesn't follow", "raise <limit effort>",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", ROBOTS)
def test_a_broken_robot_is_a_line_with_its_remedy(toy: Make, tmp_path: Path, case: str) -> None:
    make, detail, remedy = ROBOTS[case]
    fault = faults(make(toy, tmp_path))[0]
    said = f"{fault.detail}; {fault.remedy}"
    assert "\n" not in said
    for expected in (detail, remedy):
        assert any(part in said for part in expected.split("|")), said


def _stl(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    rows = [struct.pack("<12fH", 0, 0, 0, *vertices[face].ravel(), 0) for face in faces]
    return b"\0" * 80 + struct.pack("<I", len(rows)) + b"".join(rows)


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
MESHES: dict[str, tuple[str, bytes | None, str, str]] = {
    "in millimetres": ("a.stl", _stl(340 * CORNERS, FACES), "a.stl is 340 m long", '"0.001 0.001'),
    "a finger in millimetres": ("a.stl", _stl(22 * CORNERS, FACES), "is 22 m long", '"0.001 0.001'),
    "in kilometres": ("a.stl", _stl(1e-4 * CORNERS, FACES), "is 0.1 mm long", "scale is too small"),
    "missing": ("a.stl", None, "mesh a.stl is missing", "put it there, or correct its filename"),
    "empty": ("a.stl", b"", "it is empty", "export it again"),
    "cut off": ("a.stl", _stl(CORNERS, FACES)[:150], "breaks off before its 4", "export it"),
    "a web page": ("a.obj", b"<!DOCTYPE html><html></html>", "a.obj", "export it again"),
    "of no triangles": ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "a.obj", "export it again"),
    "with NaN": ("a.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "NaN", "export it again"),
    "with infinity": ("a.obj", b"v 1e999 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "a.obj", "export it"),
    "of another type": ("a.step", b"ISO-10303-21;", "mesh a.step: expected a file ending", "conv"),
    "garbage": ("a.glb", b"\x00\xff no mesh" * 30, "mesh a.glb: can't be read", "export it again"),
}


@pytest.mark.parametrize("case", MESHES)
def test_a_broken_mesh_is_a_line_with_its_remedy(toy: Make, tmp_path: Path, case: str) -> None:
    name, content, detail, remedy = MESHES[case]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    robot = _edited(BOX, f'<geometry><mesh filename="{name}"/></geometry>', 2)(toy, tmp_path)
    fault = faults(robot)[0]
    said = f"{fault.detail}; {fault.remedy}"
    assert "\n" not in said
    assert detail in said
    assert remedy in said


def test_a_mesh_that_leaks_or_has_flat_triangles_is_no_fault(toy: Make, tmp_path: Path) -> None:
    corners = np.concatenate([0.2 * CORNERS + [-0.03, -0.03, 0.05], [[0.0, 0, 0.1]] * 3])
    (tmp_path / "a.stl").write_bytes(_stl(corners, np.array([*FACES[:3], [4, 5, 6], [0, 0, 1]])))
    robot = _edited(BOX, '<geometry><mesh filename="a.stl"/></geometry>', 2)(toy, tmp_path)
    assert faults(robot) == []


@pytest.mark.parametrize(
    ("changes", "name", "detail"),
    [
        ({"cameras": ()}, "cameras", "none"),
        ({"cameras": (INSIDE,)}, "cameras", "'wrist' is behind or inside the robot"),
        ({"cameras": (CameraSpec("wrist", "hand", pose([0, 0.2, 0]) @ pose((0, 0, 0), (-2, 0, 0))),
                      )}, "cameras", "'wrist' doesn't see the tool's centre"),
        ({"T_gripper_tool": pose([0, 0, 0.13], [0, 0, np.pi / 2])}, "tool frame",
         r"its fingers close along \(0.00, 1.00, 0.00\) of it, expected x"),
        ({"T_gripper_tool": pose([0, 0, 0.33])}, "tool frame", "the fingertips are 1.. mm from it"),
        ({"velocity_limits": np.full(6, 3.0)}, "velocity", "j1, j2, j3, j4, j5, j6: faster than"),
        ({"home": np.zeros(6)}, "home", "is nearly singular"),
    ],
)  # fmt: skip
def test_what_works_but_is_hardly_meant_is_pointed_out(
    toy: Make, changes: dict[str, object], name: str, detail: str
) -> None:
    found = [f for f in examine(toy(**changes)) if not f.ok and f.name == name]
    assert any(re.search(detail, finding.detail) for finding in found), found
    assert not any(finding.required for finding in found)
