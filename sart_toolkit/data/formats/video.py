"""MP4 files by PyAV: frames at a constant rate in, the very frames that a reader decodes out."""

from __future__ import annotations

import contextlib
import importlib
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sart_toolkit.errors import BrokenFile, CannotWrite, MissingExtra


def required(module: str) -> Any:
    """A module that the extra `formats` brings.

    Raises:
        MissingExtra: it isn't installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtra(
            f"this format needs {module.partition('.')[0]}, which is not installed; "
            "pip install 'sart_toolkit[formats]'"
        ) from error


@dataclass(frozen=True)
class Codec:
    """An encoder: `name`, the pixel format that it stores, that of the frames given, and options.

    `canonical` is what the stream is called, whichever encoder made it.
    """

    name: str
    canonical: str
    pix_fmt: str
    given: str
    options: Mapping[str, str] = field(default_factory=dict)

    @property
    def available(self) -> bool:
        """Whether this build of FFmpeg has it."""
        av = required("av")
        try:
            av.codec.Codec(self.name, "w")
        except (av.FFmpegError, ValueError):
            return False
        return True


def best_codec(codecs: Sequence[Codec]) -> Codec:
    """The first that this build of FFmpeg has.

    Raises:
        MissingExtra: it has none.
    """
    for codec in codecs:
        if codec.available:
            return codec
    raise MissingExtra(
        f"this PyAV encodes none of {', '.join(codec.name for codec in codecs)}; "
        "pip install 'sart_toolkit[formats]' brings one that does"
    )


@contextlib.contextmanager
def _ordinary_scheduling() -> Iterator[None]:
    """Within it no thread of this process becomes a real-time one.

    SVT-AV1 makes its own threads and the one that calls it so, where it may, as root: whatever else
    is at work on the machine, and what this process starts later, would suffer.
    """
    if not hasattr(os, "sched_setscheduler"):
        yield
        return
    before, how, parameters = _threads(), os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        for thread in (_threads() - before) | {threading.get_native_id()}:
            with contextlib.suppress(ProcessLookupError):
                if os.sched_getscheduler(thread) != how:
                    os.sched_setscheduler(thread, how, parameters)


def _threads() -> set[int]:
    return {int(name) for name in os.listdir("/proc/self/task")}


class VideoWriter:
    """Writes frames of one size to an MP4 file, the first at time 0.

    Attributes:
        frames: how many there are so far.
        n_bytes: how many bytes of them were encoded so far.
    """

    def __init__(self, path: Path, codec: Codec, width: int, height: int, fps: int) -> None:
        """Begin a file.

        Raises:
            CannotWrite: FFmpeg or the disk refuses.
        """
        # SVT-AV1 tells its settings on the terminal unless it is asked not to.
        os.environ.setdefault("SVT_LOG", "1")
        self._av = required("av")
        self.path, self._codec = path, codec
        self.frames = self.n_bytes = 0
        path.parent.mkdir(parents=True, exist_ok=True)
        with self._encoding():
            self._container = self._av.open(str(path), "w", format="mp4")
            self._stream = self._container.add_stream(codec.name, rate=fps)
            self._stream.width, self._stream.height = width, height
            self._stream.pix_fmt = codec.pix_fmt
            self._stream.options = {**codec.options}
            # One thread: an encoder's own would take those of whatever else is at work.
            self._stream.codec_context.thread_count = 1
            self._stream.codec_context.time_base = Fraction(1, fps)

    @contextlib.contextmanager
    def _encoding(self) -> Iterator[None]:
        try:
            with _ordinary_scheduling():
                yield
        except self._av.FFmpegError as error:
            raise CannotWrite(
                f"{self.path.name}: {error.strerror}; nothing was replaced, make room or choose "
                "another --out"
            ) from error

    def add(self, frame: NDArray[Any]) -> None:
        """Add a frame, in the pixel format that the codec is given.

        Raises:
            CannotWrite: FFmpeg or the disk refuses.
        """
        with self._encoding():
            picture = self._av.VideoFrame.from_ndarray(
                np.ascontiguousarray(frame), format=self._codec.given
            )
            picture.pts = self.frames
            picture.time_base = self._stream.codec_context.time_base
            self._mux(picture)
        self.frames += 1

    def _mux(self, picture: Any) -> None:
        for packet in self._stream.encode(picture):
            self.n_bytes += packet.size
            self._container.mux(packet)

    def close(self) -> None:
        """Finish the file.

        Raises:
            CannotWrite: FFmpeg or the disk refuses.
        """
        with self._encoding():
            self._mux(None)
            self._container.close()

    def abandon(self) -> None:
        """Let go of the file, whatever becomes of it."""
        for end in (lambda: self._mux(None), self._container.close):
            with contextlib.suppress(self._av.FFmpegError, OSError):
                end()


@dataclass(frozen=True)
class VideoFacts:
    """What a video file says: size [pixels], rate [1/s], codec, frames, and when each is shown [s].

    `times (n,)` in the order of display.
    """

    width: int
    height: int
    fps: float
    codec: str
    pix_fmt: str
    times: NDArray[np.float64]


def inspect_video(path: Path) -> VideoFacts:
    """What a video file says, its packets counted but not decoded.

    Raises:
        BrokenFile: it can't be read as a video.
    """
    av = required("av")
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            base = float(stream.time_base)
            pts = [packet.pts for packet in container.demux(stream) if packet.pts is not None]
            return VideoFacts(
                stream.width,
                stream.height,
                float(stream.average_rate or 0),
                stream.codec.canonical_name,
                stream.pix_fmt or "",
                np.sort(np.array(pts, dtype=np.float64)) * base,
            )
    except (av.FFmpegError, IndexError) as error:
        raise BrokenFile(f"{path}: can't be read as a video ({error})") from error


def read_video(path: Path, pix_fmt: str, start: float = 0.0) -> Iterator[NDArray[Any]]:
    """The frames of a video in order, as arrays in a pixel format.

    Args:
        path: the file.
        pix_fmt: the pixel format.
        start: when the first one is shown [s].

    Raises:
        BrokenFile: it can't be read as a video.
    """
    av = required("av")
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            # Half a period early, as times are rounded.
            first = start - 0.5 / float(stream.average_rate or 1)
            if start > 0:
                container.seek(int(max(first, 0.0) / stream.time_base), stream=stream)
            for frame in container.decode(stream):
                if frame.time is None or frame.time >= first:
                    yield frame.to_ndarray(format=pix_fmt)
    except (av.FFmpegError, IndexError) as error:
        raise BrokenFile(f"{path}: can't be read as a video ({error})") from error
