"""Videos as PyAV writes them, and what writing them leaves alone."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.data.formats.lerobot import DEPTH_CODECS, RGB_CODECS
from sart_toolkit.data.formats.video import Codec, VideoWriter


@pytest.mark.parametrize("codec", [*RGB_CODECS, *DEPTH_CODECS], ids=lambda codec: codec.name)
def test_no_thread_is_a_real_time_one_while_videos_are_written_or_after(
    codec: Codec, tmp_path: Path
) -> None:
    """An encoder that is let makes itself and its caller so, and everything else waits."""
    if not codec.available:
        pytest.skip(f"this FFmpeg has no {codec.name}")

    def policies() -> set[int]:
        return {os.sched_getscheduler(int(name)) for name in os.listdir("/proc/self/task")}

    before = policies()
    shape, kind = ((64, 64, 3), np.uint8) if "rgb" in codec.given else ((64, 64), np.uint16)
    writer = VideoWriter(tmp_path / "video.mp4", codec, 64, 64, 10)
    for _ in range(3):
        writer.add(np.zeros(shape, kind))
        assert policies() == before
    writer.close()
    assert policies() == before
