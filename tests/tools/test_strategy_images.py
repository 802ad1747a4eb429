from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np
from PIL import Image

from sart_toolkit.augment import STRATEGIES

ROOT = Path(__file__).parents[2]
TOOL = ROOT / "tools" / "strategy_images.py"


def test_every_strategy_has_an_image_and_its_equation_in_the_page():
    page = (ROOT / "docs" / "strategies.md").read_text()
    shown = re.findall(r"!\[(\w+)\]\(images/strategies/(\w+)\.png\)", page)
    assert sorted(shown) == sorted((name, name) for name in STRATEGIES)
    for name in STRATEGIES:
        assert f"`{name}`" in page
        assert (ROOT / "docs" / "images" / "strategies" / f"{name}.png").exists()


def test_an_image_shows_what_its_strategy_draws(tmp_path):
    spec = importlib.util.spec_from_file_location("strategy_images", TOOL)
    assert spec is not None and spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    assert tool.main(["sart", "no_merge", "--out", str(tmp_path)]) == 0
    images = {
        path.stem: np.asarray(Image.open(path).convert("RGB")).astype(int)
        for path in tmp_path.glob("*.png")
    }
    assert set(images) == {"sart", "no_merge"}
    # Yellow is what follows: nothing where nothing is merged.
    yellow = {
        name: ((i[..., 0] > 200) & (i[..., 1] > 160) & (i[..., 2] < 70)).sum()
        for name, i in images.items()
    }
    assert yellow["sart"] > 500 and yellow["no_merge"] == 0
