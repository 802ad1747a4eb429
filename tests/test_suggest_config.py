"""`sart suggest` leaves the room that augmentation proves on the backend asked for."""

import dataclasses

import pytest

from sart_toolkit import pipeline
from sart_toolkit.cli.arguments import Suggest
from sart_toolkit.cli.sensor import declared_sensor
from sart_toolkit.cli.verbs import Verb
from sart_toolkit.collision.sensor import SensorErrors
from sart_toolkit.data.storage import save_demonstration
from sart_toolkit.errors import MissingFile, UnknownName
from sart_toolkit.testing.emulated import EmulatedBackend

EMULATED = "sart_toolkit.testing.emulated:EmulatedBackend"


def test_the_margin_is_by_the_tracking_error_of_the_backend_asked_for_or_noted(peg_demonstration):
    noted = pipeline.suggest_config(peg_demonstration).margin
    asked = pipeline.suggest_config(peg_demonstration, EMULATED).margin
    from_cell = dataclasses.replace(
        peg_demonstration, backend="emulated", references={"backend": EMULATED}
    )
    assert noted == pytest.approx(0.0008)
    assert asked == pytest.approx(0.0004 + EmulatedBackend.tracking_error) and asked > 2 * noted
    assert pipeline.suggest_config(from_cell).margin == asked
    assert pipeline.suggest_config(from_cell, margin=0.002).margin == 0.002


def test_a_noted_backend_that_is_nobody_s_leaves_the_default(peg_demonstration):
    imported = dataclasses.replace(peg_demonstration, backend="imported", references={})
    assert pipeline.suggest_config(imported).margin == pytest.approx(0.0008)
    with pytest.raises(UnknownName, match="unknown backend 'mujoco'"):
        pipeline.suggest_config(imported, "mujoco")


def test_spheres_for_a_robot_that_follows_less_closely_are_smaller(peg_demonstration, tmp_path):
    demo = tmp_path / "demo.h5"
    save_demonstration(demo, peg_demonstration)
    close = pipeline.suggest(demo, tmp_path / "close.json", waypoints=(20,))
    loose = pipeline.suggest(demo, tmp_path / "loose.json", waypoints=(20,), backend=EMULATED)
    lost = EmulatedBackend.tracking_error - 4e-4
    assert close.spheres[0].radius - loose.spheres[0].radius >= 0.9 * lost


# --- how cameras of a cell are mounted ----------------------------------------------------------

CELL = """
robot = "ur5e_hande"

[arm]
driver = "ur_rtde"
host = "192.0.2.1"

[camera.wrist]
driver = "realsense"
hand_eye_mm = 2.0
hand_eye_deg = 0.3

[camera.side]
driver = "realsense"
hand_eye_mm = 9.0

[limits]
workspace = { low = [0.2, -0.4, 0.0], high = [0.8, 0.4, 0.6] }
"""


@pytest.fixture
def in_a_cell(peg_demonstration, tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(CELL)
    return dataclasses.replace(peg_demonstration, backend="cell", references={"backend": str(path)})


def test_recorded_cameras_are_off_by_what_the_cell_s_file_says(in_a_cell, peg_demonstration):
    assert pipeline.mounting_error(in_a_cell) == pytest.approx((0.002, 0.3))
    assert pipeline.mounting_error(peg_demonstration) == (0.0, 0.0)


def test_a_cloud_counts_with_how_the_cell_s_cameras_are_mounted(in_a_cell, peg_demonstration):
    seen = pipeline.world_of(in_a_cell, "cloud")
    ideal = pipeline.world_of(peg_demonstration, "cloud")
    given = pipeline.world_of(in_a_cell, "cloud", sensor=SensorErrors(hand_eye=0.001))
    assert seen.config.sensor == SensorErrors(hand_eye=0.002, hand_eye_deg=0.3)
    assert ideal.config.sensor == SensorErrors()
    assert given.config.sensor == SensorErrors(hand_eye=0.001)


@pytest.mark.parametrize(
    ("flags", "hand_eye"), [("", 0.002), ("--hand-eye-error 1,0.1", 0.001)], ids=["cell", "flag"]
)
def test_a_named_sensor_keeps_what_the_cell_says_unless_a_flag_does(
    in_a_cell, tmp_path, flags, hand_eye
):
    save_demonstration(tmp_path / "demo.h5", in_a_cell)
    words = f"demo.h5 --out a.json --source cloud --sensor d405 {flags}".split()
    found = declared_sensor(Verb(Suggest, "").parse("suggest", words), [tmp_path / "demo.h5"])
    assert found is not None
    assert found.hand_eye == pytest.approx(hand_eye) and found.noise > 0


def test_a_cell_s_file_that_is_gone_is_named(in_a_cell, tmp_path):
    (tmp_path / "cell.toml").unlink()
    with pytest.raises(MissingFile, match=r"cell\.toml"):
        pipeline.world_of(in_a_cell, "cloud")
