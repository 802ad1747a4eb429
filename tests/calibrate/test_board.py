"""Boards are printed in true size and found where they are."""

from __future__ import annotations

import re

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from sart_toolkit.calibrate import board as board_module
from sart_toolkit.calibrate.board import Board, save_board
from sart_toolkit.errors import InvalidInput, MissingExtra, OutputExists, UnknownName

pytest.importorskip("cv2")


def test_its_corners_are_found_where_they_are_drawn():
    board = Board()
    # As a lens softens it.
    grey = gaussian_filter(np.pad(board.image(40), 30, constant_values=255), 0.7)
    found = board.find(np.repeat(grey[..., None], 3, axis=2))
    assert found is not None and found.numbers.tolist() == list(range(8 * 6))
    wanted = board.corners()[:, :2] / board.square * 40 + 30 - 0.5
    assert np.abs(found.pixels - wanted).max() < 0.1


def test_an_image_without_it_or_with_a_single_row_of_corners_shows_none():
    board = Board()
    assert board.find(np.full((200, 200, 3), 255, np.uint8)) is None
    strip = np.pad(board.image(40)[:85], 30, constant_values=255)
    assert board.find(np.repeat(strip[..., None], 3, axis=2)) is None


@pytest.mark.parametrize("board", [Board(), Board(6, 4, 0.04, 0.03, "DICT_5X5_100")], ids=repr)
def test_as_pdf_and_png_its_squares_have_their_true_size(board, tmp_path):
    save_board(tmp_path / "board.png", board)
    with Image.open(tmp_path / "board.png") as page:
        per_mm = page.info["dpi"][0] / 25.4
        pixels = np.array(page.convert("RGB"))
        paper = tuple(sorted(round(n / per_mm) for n in page.size))
    assert paper == (210, 297)
    shrink = 4
    small = np.array(Image.fromarray(pixels).reduce(shrink))
    found = board.find(small)
    assert found is not None and len(found.numbers) == (board.columns - 1) * (board.rows - 1)
    first, last = found.pixels[0], found.pixels[board.columns - 2]
    width_mm = np.linalg.norm(last - first) * shrink / per_mm
    assert width_mm == pytest.approx((board.columns - 2) * board.square * 1e3, rel=1e-3)
    save_board(tmp_path / "board.pdf", board)
    content = (tmp_path / "board.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[ ?([\d. ]+)\]", content)
    assert box is not None
    points = sorted(float(word) for word in box[1].split())[-2:]
    assert points == pytest.approx([210 / 25.4 * 72, 297 / 25.4 * 72], rel=1e-3)


def test_a_board_larger_than_paper_gets_a_page_of_its_own(tmp_path):
    save_board(tmp_path / "board.png", Board(3, 3, 0.5, 0.4))
    with Image.open(tmp_path / "board.png") as page:
        assert page.width / page.info["dpi"][0] * 25.4 == pytest.approx(1512, abs=1)


def test_what_is_no_board_is_refused(tmp_path):
    with pytest.raises(InvalidInput, match="columns: expected 3 to 100, got 2"):
        Board(columns=2)
    with pytest.raises(InvalidInput, match=r"marker: expected less than the square \(25 mm\)"):
        Board(marker=0.03)
    with pytest.raises(UnknownName, match="unknown dictionary 'DICT_4X4'"):
        Board(dictionary="DICT_4X4").image(10)
    with pytest.raises(InvalidInput, match="has 50 markers, a board of 20 x 20 squares needs 200"):
        Board(20, 20).image(10)
    with pytest.raises(InvalidInput, match="a board is written as .pdf or .png"):
        save_board(tmp_path / "board.svg", Board())
    (tmp_path / "board.pdf").write_text("mine")
    with pytest.raises(OutputExists, match="already exists"):
        save_board(tmp_path / "board.pdf", Board())


def test_without_opencv_it_is_said_what_to_install(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(board_module.importlib, "import_module", missing)
    with pytest.raises(MissingExtra, match=r"pip install 'sart_toolkit\[calibrate\]'"):
        Board().image(10)
