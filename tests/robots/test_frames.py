import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from sart_toolkit.robots import USUAL_ROBOTS, get_robot
from sart_toolkit.robots.frames import Bodies, without_frames
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.urdf import FRAME_MASS
from sart_toolkit.tasks import get_task


@pytest.fixture(params=[*USUAL_ROBOTS, "panda", "with a peg"])
def model(request: pytest.FixtureRequest) -> RobotModel:
    if request.param == "with a peg":
        task = get_task("peg_in_hole")
        return RobotModel(get_robot(task.robot), task.scene.held)
    return RobotModel(get_robot(request.param))


@pytest.fixture
def bodies(model: RobotModel) -> Bodies:
    return without_frames(model.urdf)


def masses(robot: ET.Element) -> dict[str, float]:
    found = {}
    for link in robot.findall("link"):
        mass = link.find("inertial/mass")
        assert mass is not None
        found[str(link.get("name"))] = float(str(mass.get("value")))
    return found


def test_what_is_left_out_weighs_a_gram_at_most_and_collides_with_nothing(
    model: RobotModel, bodies: Bodies
) -> None:
    whole = ET.parse(model.urdf).getroot()
    before, after = masses(whole), masses(ET.fromstring(bodies.urdf))
    assert before.keys() == after.keys() | bodies.frames.keys()
    assert after.items() <= before.items()
    assert model.spec.tool_frame in bodies.frames
    for name in bodies.frames:
        assert before[name] <= FRAME_MASS
        assert whole.find(f"link[@name='{name}']/collision") is None


def test_what_is_kept_is_where_it_was_in_every_configuration(
    model: RobotModel, bodies: Bodies, tmp_path: Path
) -> None:
    path = tmp_path / "bodies.urdf"
    path.write_text(bodies.urdf)
    whole, kept = (pin.buildModelFromUrdf(str(urdf)) for urdf in (model.urdf, path))
    assert list(whole.names) == list(kept.names)
    rng = np.random.default_rng(3)
    for _ in range(5):
        q = rng.uniform(np.maximum(whole.lowerPositionLimit, -3), 1) * np.ones(whole.nq)
        poses = []
        for of in (whole, kept):
            data = of.createData()
            pin.framesForwardKinematics(of, data, q)
            poses.append({f.name: data.oMf[i].homogeneous for i, f in enumerate(of.frames)})
        for name in masses(ET.fromstring(bodies.urdf)):
            assert_allclose(poses[1][name], poses[0][name], atol=1e-9, err_msg=name)
        for name, (link, T_link_frame) in bodies.frames.items():
            assert link not in bodies.frames
            assert_allclose(poses[1][link] @ T_link_frame, poses[0][name], atol=1e-9, err_msg=name)


def test_its_meshes_are_found_from_anywhere(bodies: Bodies) -> None:
    names = [str(mesh.get("filename")) for mesh in ET.fromstring(bodies.urdf).iter("mesh")]
    assert names
    assert all(Path(name).is_absolute() and Path(name).is_file() for name in names)
