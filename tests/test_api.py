"""What `import sart_toolkit as sart` offers."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import sart_toolkit as sart
from sart_toolkit.collision.cloud import SceneCloud


@pytest.mark.parametrize("name", dir(sart))
def test_every_export_resolves(name):
    assert getattr(sart, name) is not None


def test_what_is_not_exported_is_an_attribute_error():
    with pytest.raises(AttributeError, match="attribute nonsense"):
        _ = sart.nonsense


def test_importing_the_package_imports_nothing_else():
    code = "import sys; import sart_toolkit; print('numpy' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "False"


def test_records_with_arrays_have_a_short_repr(peg_demonstration, peg_annotation, peg_dataset):
    cloud = SceneCloud(np.zeros((4, 3)), np.zeros((4, 3), np.uint8), np.array([1, 0, 0, 1], bool))
    assert repr(cloud) == "SceneCloud(points=4, behind=2)"
    steps = peg_demonstration.steps
    for record in (peg_demonstration, steps, steps.cameras["wrist"], peg_annotation, peg_dataset):
        assert len(repr(record)) < 300 and "\n" not in repr(record)
    assert repr(peg_demonstration).startswith("Demonstration(task=peg_in_hole, robot=ur5e_2f85")
    assert f"waypoints={len(peg_demonstration)}" in repr(peg_demonstration)
    assert repr(peg_dataset.episode(0)).startswith("Episode(steps=")
