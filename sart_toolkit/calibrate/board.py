"""ChArUco boards: printed in true size, and found in images."""

from __future__ import annotations

import dataclasses
import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from sart_toolkit.data.records import Image
from sart_toolkit.data.storage import check_writable, replacing
from sart_toolkit.errors import InvalidInput, MissingExtra, unknown_name
from sart_toolkit.poses import Array, check_positive

# 254 dpi: a module of the default board is 30 pixels wide.
_PIXELS_PER_MM = 10
_MOST_PIXELS = 9000
_MM_PER_INCH = 25.4
# Paper by name, width and height [mm], upright.
_PAPER = ((210, 297), (216, 279), (297, 420), (420, 594), (594, 841), (841, 1189))
# Printers leave so much blank [mm].
_MARGIN_MM = 6
# A corner that few others confirm may be a reflection or a second board.
_LEAST_CORNERS = 6
# Least and largest distance [pixels] from a corner at which its edges are looked at.
_WINDOW = (2, 8)


def opencv() -> Any:
    """OpenCV, which the extra `calibrate` brings.

    Raises:
        MissingExtra: it isn't installed, or is older than 4.7.
    """
    try:
        cv2 = importlib.import_module("cv2")
        _ = cv2.aruco.CharucoDetector
    except (ImportError, AttributeError) as error:
        raise MissingExtra(
            "calibration needs OpenCV 4.7 or later; pip install 'sart_toolkit[calibrate]'"
        ) from error
    return cv2


class FoundCorners(NamedTuple):
    """Corners of a board in an image: `numbers (n,)`, and `pixels (n, 2)` of each.

    Pixel (0, 0) is the centre of the first one.
    """

    numbers: NDArray[np.int64]
    pixels: Array


@dataclass(frozen=True)
class Board:
    """A ChArUco board of `columns` x `rows` squares, the white ones with a marker in each.

    `square`, `marker`: edge lengths [m]. `dictionary`: OpenCV's name of the markers. Board frame:
    origin at the outer corner of the first square, x along the columns, y along the rows (down as
    it is printed), z into the paper.
    """

    columns: int = 9
    rows: int = 7
    square: float = 0.025
    marker: float = 0.018
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        for name in ("columns", "rows"):
            if not 3 <= getattr(self, name) <= 100:
                raise InvalidInput(f"{name}: expected 3 to 100, got {getattr(self, name)}")
        check_positive("square", self.square, "m")
        if not 0 < self.marker < self.square:
            raise InvalidInput(
                f"marker: expected less than the square ({self.square * 1e3:g} mm) and more than "
                f"0, got {self.marker * 1e3:g} mm"
            )

    def corners(self) -> Array:
        """The inner corners `(n, 3)` [m] in the board frame, by number: row after row."""
        y, x = np.mgrid[1 : self.rows, 1 : self.columns]
        return self.square * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)

    def to_json(self) -> dict[str, Any]:
        """The board as JSON values."""
        return dataclasses.asdict(self)

    def _opencv(self) -> Any:
        """OpenCV's board.

        Raises:
            MissingExtra: OpenCV isn't installed.
            UnknownName: it has no such dictionary.
            InvalidInput: the dictionary has fewer markers than the board needs.
        """
        aruco = opencv().aruco
        names = [name for name in dir(aruco) if name.startswith("DICT_")]
        if self.dictionary not in names:
            raise unknown_name("dictionary", self.dictionary, names)
        markers = aruco.getPredefinedDictionary(getattr(aruco, self.dictionary))
        needed, there = self.columns * self.rows // 2, len(markers.bytesList)
        if needed > there:
            raise InvalidInput(
                f"dictionary {self.dictionary}: has {there} markers, a board of {self.columns} x "
                f"{self.rows} squares needs {needed}; choose a larger one"
            )
        return aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, markers)

    def image(self, square_pixels: int) -> NDArray[np.uint8]:
        """The board as it is printed, black and white `(H, W)`, its squares so many pixels wide.

        Raises:
            MissingExtra, UnknownName, InvalidInput: as `find`.
        """
        size = self.columns * square_pixels, self.rows * square_pixels
        drawn: NDArray[np.uint8] = self._opencv().generateImage(size, marginSize=0, borderBits=1)
        return np.where(drawn < 128, 0, 255).astype(np.uint8)

    def find(self, rgb: Image) -> FoundCorners | None:
        """The board's inner corners in an image `(H, W, 3)`; None if it doesn't show six of them.

        Raises:
            MissingExtra: OpenCV isn't installed.
            UnknownName, InvalidInput: the dictionary doesn't exist, or is too small.
        """
        cv2 = opencv()
        grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
        detector, threads = cv2.aruco.CharucoDetector(self._opencv()), cv2.getNumThreads()
        # Threads of its own spend more time waiting for each other than they save.
        cv2.setNumThreads(1)
        try:
            pixels, numbers, _, _ = detector.detectBoard(grey)
        finally:
            cv2.setNumThreads(threads)
        if numbers is None or len(numbers) < _LEAST_CORNERS:
            return None
        numbers, pixels = numbers.ravel().astype(np.int64), pixels.reshape(-1, 2)
        places = np.stack(np.divmod(numbers, self.columns - 1), axis=1)
        # A single row says nothing of how the board is tilted.
        if (np.ptp(places, axis=0) == 0).any():
            return None
        apart = np.abs(places[:, None] - places).sum(axis=2) == 1
        if not apart.any():
            return None
        spacing = float(np.linalg.norm(pixels[:, None] - pixels, axis=2)[apart].min())
        # OpenCV's own window reaches the markers' edges, which draw corners aside by 0.2 pixels.
        blank = spacing * (self.square - self.marker) / (2 * self.square)
        half = int(np.clip(blank - 2, *_WINDOW))
        steps = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
        refined = cv2.cornerSubPix(grey, pixels.copy(), (half, half), (-1, -1), steps)
        return FoundCorners(numbers, refined.reshape(-1, 2).astype(np.float64))


def save_board(path: Path, board: Board, overwrite: bool = False) -> None:
    """Write a board to a PDF or PNG that prints in true size, with a line of 100 mm to check.

    On the smallest paper that it fits on; on a page of its own size where none is large enough.

    Raises:
        InvalidInput: the path ends in neither .pdf nor .png, or the dictionary is too small.
        UnknownName: there is no such dictionary.
        MissingExtra: OpenCV isn't installed.
        OutputExists, CannotWrite: it can't be written.
    """
    if path.suffix not in (".pdf", ".png"):
        raise InvalidInput(f"{path}: a board is written as .pdf or .png; change its name")
    check_writable(path, overwrite)
    square_pixels = min(
        board.square * 1e3 * _PIXELS_PER_MM, _MOST_PIXELS / max(board.columns, board.rows)
    )
    drawn = PillowImage.fromarray(board.image(round(square_pixels)))
    # A square needs a whole number of pixels; the resolution makes it its size.
    per_mm = drawn.width / (board.columns * board.square * 1e3)
    words, line = 12, 100
    width, height = board.columns * board.square * 1e3, board.rows * board.square * 1e3
    needed = max(width, line) + 2 * _MARGIN_MM, height + words + 2 * _MARGIN_MM
    sheets = [sheet for w, h in _PAPER for sheet in ((h, w), (w, h))]
    fitting = [s for s in sheets if s[0] >= needed[0] and s[1] >= needed[1]]
    sheet = fitting[0] if fitting else needed
    page = PillowImage.new("L", (round(sheet[0] * per_mm), round(sheet[1] * per_mm)), 255)
    left = round((sheet[0] - width) / 2 * per_mm)
    top = round((sheet[1] - height - words) / 2 * per_mm)
    page.paste(drawn, (left, top))
    pen = ImageDraw.Draw(page)
    y = top + drawn.height + round(4 * per_mm)
    start = round((sheet[0] - line) / 2 * per_mm)
    pen.rectangle((start, y, start + round(line * per_mm) - 1, y + round(0.5 * per_mm)), fill=0)
    text = (
        f"this line: 100 mm; print at 100 %, without fitting to the page. "
        f"{board.columns} x {board.rows} squares of {board.square * 1e3:g} mm, markers of "
        f"{board.marker * 1e3:g} mm, {board.dictionary}"
    )
    font = ImageFont.load_default(size=2.5 * per_mm)
    pen.text((sheet[0] / 2 * per_mm, y + 2 * per_mm), text, fill=0, font=font, anchor="ma")
    dpi = per_mm * _MM_PER_INCH
    with replacing(path) as temporary:
        if path.suffix == ".pdf":
            page.convert("1").save(temporary, "PDF", resolution=dpi)
        else:
            page.save(temporary, "PNG", dpi=(dpi, dpi))
