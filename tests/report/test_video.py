from __future__ import annotations

import io
import os
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image as PillowImage

from sart_toolkit.data.records import Image
from sart_toolkit.errors import BrokenFile, CannotWrite, InvalidInput, MissingExtra
from sart_toolkit.evaluate.rollout import Moment
from sart_toolkit.report.video import (
    caption,
    check_frame,
    film_rollout,
    font,
    inset,
    last_frame,
    write_video,
)


def images(n: int, height: int = 64, width: int = 96) -> Iterator[Image]:
    """Grey images with a white bar that moves right."""
    for t in range(n):
        image = np.full((height, width, 3), 90, np.uint8)
        image[:, 4 * t : 4 * t + 8] = 255
        yield image


def grey(height: int, width: int, value: int = 90) -> Image:
    return np.full((height, width, 3), value, np.uint8)


def ffmpeg(*arguments: str) -> subprocess.CompletedProcess[bytes]:
    # Not imageio's reader: it leaves its pipes open, and warnings are errors here.
    return subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), *arguments],
        check=False,
        stdin=subprocess.DEVNULL,
        capture_output=True,
    )


def probe(path: Path) -> str:
    """What ffmpeg says of a file."""
    return ffmpeg("-i", str(path)).stderr.decode()


def decode(path: Path, height: int, width: int) -> Image:
    """All frames `(n, H, W, 3)` of a video."""
    assert f" {width}x{height}" in probe(path)
    raw = ffmpeg("-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-").stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)


def boxes(content: bytes) -> list[bytes]:
    """The kinds of an mp4 file's top-level boxes, in order."""
    kinds, at = [], 0
    while at < len(content):
        kinds.append(content[at + 4 : at + 8])
        at += int.from_bytes(content[at : at + 4], "big")
    return kinds


def test_video_decodes_to_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "videos" / "a.mp4"
    assert write_video(path, images(12), fps=10) == 12
    decoded = decode(path, 64, 96)
    assert decoded.shape == (12, 64, 96, 3)
    for t, image in enumerate(images(12)):
        assert np.abs(decoded[t].astype(int) - image).mean() < 4
    assert os.listdir(path.parent) == ["a.mp4"]


@pytest.mark.parametrize("n", [1, 12, 20])
def test_the_last_image_of_a_film_is_found_however_long_it_is(tmp_path: Path, n: int) -> None:
    write_video(tmp_path / "a.mp4", images(n), fps=10)
    with PillowImage.open(io.BytesIO(last_frame(tmp_path / "a.mp4"))) as found:
        *_, expected = images(n)
        assert found.format == "JPEG"
        assert np.abs(np.asarray(found).astype(int) - expected).mean() < 6


def test_a_file_that_is_no_film_has_no_last_image(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no film")
    with pytest.raises(BrokenFile, match="a.mp4: can't be read as a video; evaluate again"):
        last_frame(tmp_path / "a.mp4")


@pytest.mark.parametrize("n", [1, 5])
def test_a_rollout_s_film_shows_outside_wrist_and_outcome_at_each_moment(
    tmp_path: Path, n: int
) -> None:
    moments = [Moment(grey(96, 96, 90), grey(32, 32, 200), t / 10, t == 3) for t in range(n)]
    path = tmp_path / "videos" / "success_007.mp4"
    film_rollout(path, moments, 10, 7, "success")
    expected = [
        caption(inset(m.overview, m.wrist), 7, m.seconds, "success", "goal reached" * m.success)
        for m in moments
    ]
    decoded = decode(path, *expected[0].shape[:2])
    assert len(decoded) == n and "10 fps" in probe(path)
    assert np.abs(decoded.astype(int) - np.array(expected)).mean() < 5


def test_video_is_what_browsers_play(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_video(path, images(12), fps=10)
    for words in ("Video: h264", "yuv420p(tv, bt709", " 10 fps", "Duration: 00:00:01.20"):
        assert words in probe(path)
    order = boxes(path.read_bytes())
    assert order.index(b"moov") < order.index(b"mdat")


def test_colours_survive(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    colour = np.array([200, 60, 40], np.uint8)
    write_video(path, [np.broadcast_to(colour, (32, 32, 3))] * 3, fps=10, crf=5)
    assert np.abs(decode(path, 32, 32)[1].astype(int) - colour).max() < 6


def test_odd_sizes_are_padded_to_even_ones(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_video(path, [grey(63, 95)] * 3, fps=10)
    decoded = decode(path, 64, 96)
    assert decoded.shape == (3, 64, 96, 3)
    assert np.abs(decoded.astype(int) - 90).max() < 6


def test_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mp4", "b.mp4"):
        write_video(tmp_path / name, images(5), fps=10)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


def test_failure_on_the_way_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"before")

    def broken() -> Iterator[Image]:
        yield from images(3)
        raise RuntimeError("camera unplugged")

    with pytest.raises(RuntimeError, match="camera unplugged"):
        write_video(path, broken(), fps=10)
    assert path.read_bytes() == b"before"
    assert os.listdir(tmp_path) == ["a.mp4"]


@pytest.mark.parametrize(
    ("frames", "changes", "message"),
    [
        ([], {}, "no frames to write; pass at least one image"),
        ([np.zeros((8, 8), np.uint8)], {}, r"frame 0: expected uint8 of shape \(H, W, 3\)"),
        ([np.zeros((8, 8, 4), np.uint8)], {}, r"frame 0: .*got uint8 \(8, 8, 4\)"),
        ([np.zeros((8, 8, 3))], {}, r"frame 0: .*got float64 \(8, 8, 3\)"),
        ([np.zeros((0, 8, 3), np.uint8)], {}, r"frame 0: .*got uint8 \(0, 8, 3\)"),
        ([grey(8, 8), np.zeros((8, 8, 3))], {}, "frame 1: .*got float64"),
        ([grey(8, 8), grey(8, 10)], {}, "frame 1: expected the first frame's shape"),
        ([grey(8, 8)], {"fps": 0}, "fps: expected a finite number > 0"),
        ([grey(8, 8)], {"crf": 52}, "crf: expected 0 .lossless. to 51, got 52"),
        ([grey(8, 8)], {"path": "a.avi"}, "expected a file name that ends in .mp4"),
    ],
)
def test_refuses_what_is_no_video(
    tmp_path: Path, frames: list[Any], changes: dict[str, Any], message: str
) -> None:
    arguments = {"fps": 10, **changes}
    path = tmp_path / arguments.pop("path", "a.mp4")
    with pytest.raises(InvalidInput, match=message):
        write_video(path, frames, **arguments)
    assert os.listdir(tmp_path) == []


def test_ffmpeg_that_fails_is_reported_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = tmp_path / "ffmpeg"
    fake.write_text("#!/bin/sh\necho 'No space left on device' >&2\nexit 3\n")
    fake.chmod(fake.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(fake))
    out = tmp_path / "out"
    with pytest.raises(CannotWrite, match=r"could not write the video \(No space left on device"):
        write_video(out / "a.mp4", images(50, 240, 320), fps=10)
    assert os.listdir(out) == []


def test_missing_ffmpeg_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> str:
        raise RuntimeError("No ffmpeg exe could be found")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", missing)
    with pytest.raises(MissingExtra, match="pip install --force-reinstall imageio-ffmpeg"):
        write_video(tmp_path / "a.mp4", images(3), fps=10)


def test_inset_shows_the_wrist_in_its_corner_and_leaves_the_rest() -> None:
    frame, wrist = grey(240, 320, 90), grey(64, 64, 20)
    result = inset(frame, wrist)
    assert result.shape == frame.shape and result.dtype == np.uint8
    assert (frame == 90).all()
    changed = (result != frame).any(axis=2)
    rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
    assert rows.min() < 10 and columns.max() > 310
    assert rows.max() < 0.4 * 240 and columns.min() > 0.6 * 320
    assert (result[rows.min(), columns.min() : columns.max() + 1] == 255).all()
    assert (result[20, 270] == 20).all()


@pytest.mark.parametrize("corner", ["top left", "top right", "bottom left", "bottom right"])
def test_inset_goes_where_it_is_reported(corner: Any) -> None:
    frame = grey(240, 320)
    changed = (inset(frame, grey(64, 96, 20), corner=corner) != frame).any(axis=2)
    y, x = np.argwhere(changed).mean(axis=0)
    assert (y < 120) == corner.startswith("top")
    assert (x < 160) == corner.endswith("left")


def test_inset_keeps_the_wrist_images_proportions() -> None:
    frame = grey(240, 320)
    changed = (inset(frame, grey(40, 80, 20), label="") != frame).any(axis=2)
    height, width = (int(changed.any(axis=axis).sum()) for axis in (1, 0))
    assert width / height == pytest.approx(2.0, rel=0.06)


def test_inset_label_appears_only_where_it_fits() -> None:
    frame, wrist = grey(240, 320), grey(64, 64, 20)
    unlabelled = inset(frame, wrist, label="")
    assert (inset(frame, wrist) != unlabelled).any()
    assert (inset(frame, wrist, label="far too many words " * 9) == unlabelled).all()


def test_caption_adds_a_strip_below_and_leaves_the_image() -> None:
    frame = grey(240, 320)
    result = caption(frame, 3, 2.5, "success", "block at +31 mm")
    assert result.shape[1:] == (320, 3) and result.shape[0] > 240
    assert (result.shape[0] - 240) % 2 == 0
    assert (result[:240] == frame).all()
    assert tuple(result[242, 1]) == (0x00, 0x9E, 0x73)


def test_caption_says_outcome_episode_and_time() -> None:
    def strip(*arguments: Any) -> Image:
        return caption(grey(240, 320), *arguments)[240:]

    plain = strip(3, 2.5)
    assert (strip(4, 2.5) != plain).any()
    assert (strip(3, 2.6) != plain).any()
    assert tuple(strip(3, 2.5, "failure")[2, 1]) == (0xD5, 0x5E, 0x00)
    assert (strip(3, 2.5, None, "why") != plain).any()


def test_caption_cuts_words_that_have_no_room() -> None:
    narrow = grey(120, 150)
    assert caption(narrow, 3, 2.5, "success", "far too many words " * 9).shape[1] == 150
    assert caption(grey(32, 24), 3, 2.5, "success", "words").shape[1] == 24


def test_text_is_drawn_with_every_letter_it_may_need() -> None:
    missing = font(20).getmask("\uffff")
    for letter in "·…°±üé":
        assert bytes(font(20).getmask(letter)) != bytes(missing)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: check_frame("image", np.zeros(3, np.uint8)), r"image: .*got uint8 \(3,\)"),
        (lambda: inset(np.zeros((8, 8, 3)), grey(4, 4)), "frame: expected uint8"),
        (lambda: inset(grey(8, 8), np.zeros((4, 4, 3))), "wrist: expected uint8"),
        (lambda: inset(grey(8, 8), grey(4, 4), fraction=1.0), "fraction: expected between 0 and 1"),
        (
            lambda: inset(grey(8, 8), grey(4, 4), corner="middle"),  # type: ignore[arg-type]
            "corner: expected one of top left, .*got 'middle'",
        ),
        (lambda: caption(np.zeros((8, 8, 3)), 0, 0.0), "frame: expected uint8"),
        (
            lambda: caption(grey(8, 8), 0, 0.0, "won"),  # type: ignore[arg-type]
            "outcome: expected 'success', 'failure' or None, got 'won'",
        ),
        (lambda: caption(grey(8, 8), 0, float("nan")), "seconds: expected a finite time, got nan"),
    ],
)
def test_refuses_what_can_not_be_composed(call: Any, message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        call()
