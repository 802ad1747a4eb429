"""`sart suggest` leaves the room that augmentation proves on the backend asked for."""

import dataclasses

import pytest

from sart_toolkit import pipeline
from sart_toolkit.data.storage import save_demonstration
from sart_toolkit.errors import UnknownName
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
