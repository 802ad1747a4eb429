"""A mesh is found however a URDF names it, and where it isn't the message says what to give."""

from __future__ import annotations

from pathlib import Path

import pytest

from sart_toolkit.errors import BrokenFile, InvalidInput, MissingExtra
from sart_toolkit.robots.references import mesh_path, resource_path
from sart_toolkit.robots.urdf import source_elements


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A ROS package `arm_description` with a mesh and a URDF, in a workspace."""
    folder = tmp_path / "ws" / "src" / "arm_description"
    (folder / "meshes").mkdir(parents=True)
    (folder / "urdf").mkdir()
    (folder / "meshes" / "a b.stl").write_text("solid")
    (folder / "urdf" / "arm.urdf").write_text("<robot/>")
    return folder


@pytest.mark.parametrize(
    "reference",
    [
        "../meshes/a b.stl",
        "..\\meshes\\a b.stl",
        "package://arm_description/meshes/a b.stl",
        "package://arm_description/meshes/a%20b.stl",
        "model://arm_description/meshes/a b.stl",
        "package://meshes/a b.stl",
        "{folder}/meshes/a b.stl",
        "file://{folder}/meshes/a%20b.stl",
        "file://localhost{folder}/meshes/a b.stl",
        "file:{folder}/meshes/a b.stl",
    ],
)
def test_a_mesh_is_found_from_the_urdf_alone(package: Path, reference: str) -> None:
    found = mesh_path(reference.format(folder=package), package / "urdf" / "arm.urdf")
    assert found == package / "meshes" / "a b.stl"


@pytest.mark.parametrize("given", ["ws", "ws/src", "ws/src/arm_description"])
def test_a_package_is_found_in_folders_given_and_in_those_of_ros(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str
) -> None:
    elsewhere = tmp_path / "elsewhere" / "arm.urdf"
    reference = "package://arm_description/meshes/a b.stl"
    assert not mesh_path(reference, elsewhere).exists()
    folder = str(tmp_path / given)
    assert mesh_path(reference, elsewhere, (folder,)) == package / "meshes" / "a b.stl"
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere:{folder}")
    assert mesh_path(reference, elsewhere) == package / "meshes" / "a b.stl"


def test_a_package_is_called_what_its_package_xml_says(package: Path) -> None:
    renamed = package.rename(package.parent / "arm-main")
    (renamed / "package.xml").write_text("<package><name>my_arm</name></package>")
    found = mesh_path("package://my_arm/meshes/a b.stl", renamed / "urdf" / "arm.urdf")
    assert found == renamed / "meshes" / "a b.stl"


def test_a_package_is_found_among_installed_ones(tmp_path: Path) -> None:
    reference = "package://airo_models/arms/ur5e/ur5e.urdf"
    assert mesh_path(reference, tmp_path / "x.urdf") == resource_path(
        "airo_models:arms/ur5e/ur5e.urdf"
    )


def test_a_urdf_may_be_in_what_pip_installed_under_a_name_that_is_no_module() -> None:
    found = resource_path("airo-models:airo_models/arms/ur5e/ur5e.urdf")
    assert found == resource_path("airo_models:arms/ur5e/ur5e.urdf")
    with pytest.raises(MissingExtra, match="package 'no-such-thing' missing; pip install"):
        resource_path("no-such-thing:a.urdf")


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("https://x.org/a.stl", "expected a path, file:// or package://; download the mesh"),
        ("C:\\cad\\a.stl", "is a path of another machine; copy the mesh beside the URDF"),
    ],
)
def test_a_mesh_that_can_not_be_here_is_refused(
    tmp_path: Path, reference: str, message: str
) -> None:
    with pytest.raises(InvalidInput, match=message):
        mesh_path(reference, tmp_path / "x.urdf")


def test_a_package_that_is_nowhere_is_named_with_what_to_give(tmp_path: Path) -> None:
    urdf = tmp_path / "x.urdf"
    urdf.write_text(
        '<robot name="x"><link name="a"><visual><geometry>'
        '<mesh filename="package://my_arm/a.stl"/></geometry></visual></link></robot>'
    )
    with pytest.raises(BrokenFile, match="link 'a': mesh package://my_arm/a.stl is missing; give"):
        source_elements(urdf)
    with pytest.raises(BrokenFile, match=r"package_dirs of the RobotSpec \(now: /opt\) or in ROS"):
        source_elements(urdf, package_dirs=("/opt",))
