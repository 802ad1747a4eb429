"""Videos of rollouts: H.264 files that browsers play, the wrist inset and the caption strip."""

from __future__ import annotations

import contextlib
import functools
import itertools
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import imageio_ffmpeg
import matplotlib
import numpy as np
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from sart_toolkit.data.records import Image
from sart_toolkit.data.storage import replacing
from sart_toolkit.errors import BrokenFile, CannotWrite, InvalidInput, MissingExtra
from sart_toolkit.poses import check_positive

if TYPE_CHECKING:
    # At run time it would bring torch, which no video needs.
    from sart_toolkit.evaluate.rollout import Moment

Outcome = Literal["success", "failure"]
Corner = Literal["top left", "top right", "bottom left", "bottom right"]
# Bluish green and vermilion (Okabe and Ito), told apart by colour-blind viewers as well.
OUTCOME_COLOURS: dict[Outcome, str] = {"success": "#009e73", "failure": "#d55e00"}
_STRIP, _STRIP_TEXT = "#15181d", "#f2f4f7"


# --- writing ------------------------------------------------------------------------------------


def write_video(path: Path, frames: Iterable[Image], fps: float, crf: int = 23) -> int:
    """The number of frames written to an mp4 file, whole or not at all.

    H.264, yuv420p, BT.709, index at the front: what browsers play from a data URI. A frame with an
    odd width or height is padded by repeating its last column or row, as yuv420p wants even ones.

    Args:
        path: the file; a suffix other than `.mp4` is refused.
        frames: uint8 `(H, W, 3)` images of one size, at least one; an iterator is consumed as
            it encodes, so frames need not fit in memory.
        fps: frames per second.
        crf: x264's constant rate factor, 0 (lossless) to 51.

    Raises:
        InvalidInput: no frames, wrong shape or dtype, sizes differ, or fps, crf or suffix is bad.
        MissingExtra: there is no ffmpeg.
        CannotWrite: the disk or ffmpeg refuses; `path` is as it was.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise InvalidInput(f"{path}: expected a file name that ends in .mp4")
    check_positive("fps", fps, "1/s")
    if not 0 <= crf <= 51:
        raise InvalidInput(f"crf: expected 0 (lossless) to 51, got {crf}")
    remaining = iter(frames)
    first = next(remaining, None)
    if first is None:
        raise InvalidInput(f"{path}: no frames to write; pass at least one image")
    check_frame("frame 0", first)
    with replacing(path) as temporary:
        images = itertools.chain([first], remaining)
        return _encode(temporary, images, np.shape(first), fps, crf, path)


def check_frame(name: str, frame: Image) -> Image:
    """`frame` as an array if it is uint8 of shape `(H, W, 3)`, not empty.

    Raises:
        InvalidInput: another shape or dtype.
    """
    array = np.asarray(frame)
    if array.ndim != 3 or array.shape[2] != 3 or array.dtype != np.uint8 or array.size == 0:
        raise InvalidInput(f"{name}: expected uint8 of shape (H, W, 3), got {_describe(array)}")
    return array


def _describe(array: Image) -> str:
    return f"{array.dtype} {array.shape}"


def _even(frame: Image) -> Image:
    height, width = frame.shape[:2]
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _encode(
    temporary: Path,
    frames: Iterator[Image],
    shape: tuple[int, ...],
    fps: float,
    crf: int,
    path: Path,
) -> int:
    # ffmpeg is started here rather than by `imageio_ffmpeg.write_frames`, which ignores its exit
    # status: a full disk would leave a broken file without an error.
    height, width = shape[0] + shape[0] % 2, shape[1] + shape[1] % 2
    command = [
        _ffmpeg(), "-y", "-v", "error", "-nostdin",
        "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:.6f}",
        "-i", "-", "-an",
        "-vf", "scale=out_color_matrix=bt709:out_range=tv",
        "-c:v", "libx264", "-preset", "fast", "-crf", str(crf), "-pix_fmt", "yuv420p",
        "-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709",
        # Two threads: rollouts run beside it. Bitexact: the same frames give the same bytes.
        "-threads", "2", "-fflags", "+bitexact", "-flags:v", "+bitexact",
        "-movflags", "+faststart", str(temporary),
    ]  # fmt: skip
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log
        )
        try:
            n = _feed(process, frames, shape)
            status = process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
        log.seek(0)
        lines = log.read().decode(errors="replace").strip().splitlines()
    if status != 0:
        why = lines[-1].replace(str(temporary), path.name) if lines else f"exit status {status}"
        raise CannotWrite(f"{path}: ffmpeg could not write the video ({why}); nothing was replaced")
    return n


def _feed(process: subprocess.Popen[bytes], frames: Iterator[Image], shape: tuple[int, ...]) -> int:
    pipe = process.stdin
    assert pipe is not None
    n = 0
    # A broken pipe means that ffmpeg has given up: its exit status and log say why.
    with contextlib.suppress(BrokenPipeError), pipe:
        for frame in frames:
            image = check_frame(f"frame {n}", frame)
            if image.shape != shape:
                raise InvalidInput(
                    f"frame {n}: expected the first frame's shape {shape}, got {image.shape}"
                )
            pipe.write(np.ascontiguousarray(_even(image)).data)
            n += 1
    return n


def _ffmpeg() -> str:
    try:
        return imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise MissingExtra(
            "no ffmpeg for writing videos; run `pip install --force-reinstall imageio-ffmpeg`, or"
            " set IMAGEIO_FFMPEG_EXE to an ffmpeg that has libx264"
        ) from error


def last_frame(path: Path) -> bytes:
    """JPEG bytes of a video file's last image.

    Raises:
        BrokenFile: it is no video.
        MissingExtra: there is no ffmpeg.
    """
    with tempfile.TemporaryDirectory() as directory:
        image = Path(directory, "last.jpg")
        # Of the last second each image is written in place of the one before.
        command = [
            _ffmpeg(), "-v", "error", "-nostdin", "-sseof", "-1", "-i", str(path),
            "-threads", "1", "-q:v", "4", "-update", "1", "-f", "image2", str(image),
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, check=False)
        if done.returncode != 0 or not image.is_file():
            raise BrokenFile(f"{path}: can't be read as a video; evaluate again")
        return image.read_bytes()


def film_rollout(
    path: Path, moments: Iterable[Moment], hz: float, episode: int, outcome: Outcome
) -> None:
    """Write a rollout's video: seen from outside, the wrist image inset, a caption below.

    Args:
        path: the mp4 file.
        moments: what the cameras saw at each step, at least one.
        hz: steps a second.
        episode: the rollout's number.
        outcome: how it ended.

    Raises:
        InvalidInput: a frame has another size, `path` another suffix.
        CannotWrite: the disk refuses.
    """
    frames = (
        caption(
            inset(moment.overview, moment.wrist),
            episode,
            moment.seconds,
            outcome,
            "goal reached" if moment.success else "",
        )
        for moment in moments
    )
    write_video(path, frames, hz)


# --- composing ----------------------------------------------------------------------------------


@functools.lru_cache(maxsize=8)
def font(size: int) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib, at a size in pixels."""
    return ImageFont.truetype(
        Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", size
    )


def inset(
    frame: Image,
    wrist: Image,
    label: str = "wrist camera",
    fraction: float = 0.34,
    corner: Corner = "top right",
) -> Image:
    """A copy of `frame` with the wrist image, bordered and labelled, in one of its corners.

    Args:
        frame: the overview, uint8 `(H, W, 3)`.
        wrist: the wrist camera's image, uint8 `(h, w, 3)`; resized to keep its proportions.
        label: written over the inset's lower edge; empty for none.
        fraction: the inset's greatest width and height as a part of the frame's, in (0, 1).
        corner: where it goes.

    Raises:
        InvalidInput: wrong shape or dtype, fraction outside (0, 1), or an unknown corner.
    """
    check_frame("frame", frame)
    check_frame("wrist", wrist)
    if not 0.0 < fraction < 1.0:
        raise InvalidInput(f"fraction: expected between 0 and 1, got {fraction}")
    if corner not in get_args(Corner):
        choices = ", ".join(get_args(Corner))
        raise InvalidInput(f"corner: expected one of {choices}, got {corner!r}")
    height, width = frame.shape[:2]
    scale = min(fraction * width / wrist.shape[1], fraction * height / wrist.shape[0])
    size = (max(1, round(wrist.shape[1] * scale)), max(1, round(wrist.shape[0] * scale)))
    border = max(1, round(0.004 * height))
    margin = max(border, round(0.02 * height))
    left = margin if corner.endswith("left") else width - size[0] - margin
    top = margin if corner.startswith("top") else height - size[1] - margin
    canvas = PillowImage.fromarray(np.ascontiguousarray(frame))
    draw = ImageDraw.Draw(canvas)
    right, bottom = left + size[0], top + size[1]
    draw.rectangle(
        (left - border, top - border, right + border - 1, bottom + border - 1), fill="white"
    )
    image = PillowImage.fromarray(np.ascontiguousarray(wrist))
    canvas.paste(image.resize(size, PillowImage.Resampling.BICUBIC), (left, top))
    text = font(max(8, round(0.03 * height)))
    box = text.getbbox(label)
    if label and box[2] + 8 <= size[0]:
        draw.rectangle((left, bottom - box[3] - 6, left + box[2] + 8, bottom - 1), fill=_STRIP)
        draw.text((left + 4, bottom - box[3] - 3), label, fill=_STRIP_TEXT, font=text)
    return np.asarray(canvas)


def caption(
    frame: Image,
    episode: int,
    seconds: float,
    outcome: Outcome | None = None,
    detail: str = "",
) -> Image:
    """A copy of `frame` with a strip below it: the outcome in its colour, episode, detail and time.

    Args:
        frame: uint8 `(H, W, 3)`; the result is taller by an even number of rows.
        episode: the rollout's number.
        seconds: time since the rollout began [s].
        outcome: how the rollout ends; `None` leaves it out.
        detail: more words, cut where there is no room.

    Raises:
        InvalidInput: wrong shape or dtype, an unknown outcome, or time not finite.
    """
    words = f"episode {episode}" + (f" · {detail}" if detail else "")
    return strip(frame, words, seconds, outcome)


def strip(frame: Image, words: str, seconds: float, outcome: Outcome | None = None) -> Image:
    """A copy of `frame` with a strip below it: words and time, after the outcome in its colour.

    Args:
        frame: uint8 `(H, W, 3)`; the result is taller by an even number of rows.
        words: what is said of it, cut where there is no room.
        seconds: time since it began [s].
        outcome: how it ends; `None` leaves it out.

    Raises:
        InvalidInput: wrong shape or dtype, an unknown outcome, or time not finite.
    """
    check_frame("frame", frame)
    if outcome is not None and outcome not in OUTCOME_COLOURS:
        raise InvalidInput(f"outcome: expected 'success', 'failure' or None, got {outcome!r}")
    if not np.isfinite(seconds):
        raise InvalidInput(f"seconds: expected a finite time, got {seconds}")
    height, width = frame.shape[:2]
    rows = 2 * max(9, round(0.032 * height))
    canvas = PillowImage.new("RGB", (width, height + rows), _STRIP)
    canvas.paste(PillowImage.fromarray(np.ascontiguousarray(frame)), (0, 0))
    draw = ImageDraw.Draw(canvas)
    text, pad, middle = font(max(9, round(0.55 * rows))), rows // 3, height + rows / 2
    clock = f"{seconds:.1f} s"
    x, end = float(pad), width - pad - text.getlength(clock)
    draw.text((width - pad, middle), clock, fill=_STRIP_TEXT, font=text, anchor="rm")
    if outcome is not None:
        right = x + text.getlength(outcome) + pad
        draw.rectangle((0, height, right, height + rows), fill=OUTCOME_COLOURS[outcome])
        draw.text((x, middle), outcome, fill="white", font=text, anchor="lm")
        x = right + pad
    while words and x + text.getlength(words) > end - pad:
        words = words[:-2].rstrip(" ·…") + "…" if len(words) > 2 else ""
    draw.text((x, middle), words, fill=_STRIP_TEXT, font=text, anchor="lm")
    return np.asarray(canvas)
