"""`tools/enclosure.py` measures how far drawn links stand out of the parts of proofs."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.robots import get_robot
from sart_toolkit.robots.enclosure import HullPart, ShapePart
from sart_toolkit.robots.spec import Shape

_PATH = Path(__file__).parents[2] / "tools" / "enclosure.py"
_SPEC = importlib.util.spec_from_file_location("enclosure", _PATH)
assert _SPEC is not None and _SPEC.loader is not None
enclosure = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(enclosure)


@pytest.mark.parametrize("robot", ["ur5e_2f85", "ur5e_hande"])
def test_no_sample_of_a_drawn_link_stands_out_of_its_parts(robot):
    rows = enclosure.measure(get_robot(robot), 500, np.random.default_rng(0), (0.0, 0.6), every=31)
    assert len(rows) >= 12
    assert max(row["outside_mm"] for row in rows) <= enclosure.LIMIT_MM
    # What the sources' own parts leave out.
    assert max(row["outside_before_mm"] for row in rows) > 25
    # All but the base, which two spheres stood for, are hardly larger than before.
    others = [row for row in rows if row["link"] != "base_link_inertia"]
    assert max(row["volume_by_before"] for row in others) < 1.01


def test_the_table_ends_with_one_json_object_and_the_exit_code_says_whether_it_holds(
    capsys, monkeypatch
):
    def row(robot, *_):
        lengths = ("outside_mm", "outside_before_mm", "farthest_from_drawn_mm")
        volumes = ("volume_cm3", "volume_by_before", "volume_by_drawn_hull")
        counts = {"samples": 1, "parts": 1, "parts_before": 1}
        return [
            {"robot": robot.name, "link": "a", **counts, **dict.fromkeys(volumes, 1.0)}
            | dict.fromkeys(lengths, far)
        ]

    monkeypatch.setattr(enclosure, "measure", row)
    for far, code in ((0.009, 0), (0.011, 1)):
        assert enclosure.main(["--robots", "ur5e_2f85"]) == code
        report = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert report["largest_outside_mm"] == far
        assert report["command"] == "python tools/enclosure.py --robots ur5e_2f85"


@pytest.mark.parametrize("kind", ["box", "sphere", "cylinder"])
def test_samples_of_a_primitive_are_on_its_surface(kind):
    size = {"box": (0.1, 0.2, 0.3), "sphere": (0.1,), "cylinder": (0.1, 0.3)}[kind]
    shape = Shape(kind, size)
    points = enclosure.surface(shape, 2000, np.random.default_rng(0))
    np.testing.assert_allclose(ShapePart(shape).outside(points), 0, atol=1e-12)
    assert enclosure.own_volume(ShapePart(shape)) == pytest.approx(
        HullPart(points).volume, rel=0.05
    )
