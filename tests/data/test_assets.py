"""What comes with the toolkit is found, and the recorded demonstration is ready for use."""

from __future__ import annotations

from pathlib import Path

import pytest

import sart_toolkit as sart
from sart_toolkit.data import assets
from sart_toolkit.errors import MissingFile


def test_an_asset_is_found_beside_the_package_or_inside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "sart_toolkit"
    monkeypatch.setattr(assets, "_PACKAGE", package)
    for root in (tmp_path / "assets", package / "assets"):
        (root / "robots").mkdir(parents=True)
        (root / "robots" / "arm.urdf").write_text("")
        assert assets.asset("robots/arm.urdf") == root / "robots" / "arm.urdf"


@pytest.mark.parametrize("name", ["robots/none.urdf", "robots", "../pyproject.toml/x"])
def test_a_missing_asset_is_reported(name: str) -> None:
    with pytest.raises(MissingFile, match="no such asset of sart_toolkit"):
        sart.asset(name)


def test_the_demonstration_is_small_reached_the_goal_and_is_annotated() -> None:
    path = sart.asset("peg_in_hole/demo.h5")
    assert path.stat().st_size < 1.5e6
    demonstration = sart.load_demonstration(path)
    assert sart.get_task(demonstration.task).achieved(demonstration.success)
    annotation = sart.load_annotation(sart.asset("peg_in_hole/annotation.json"))
    annotation.check_matches(demonstration)
    assert annotation.spheres
