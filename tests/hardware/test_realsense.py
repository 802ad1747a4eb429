"""The RealSense driver on a stand-in for pyrealsense2; the library itself is not tested here."""

from __future__ import annotations

import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from sart_toolkit.errors import DeviceLost, MissingExtra
from sart_toolkit.hardware.realsense import RealSense

HARDWARE, SYSTEM = "hardware_clock", "system_time"


class Frames:
    """A colour and a depth frame, taken so long [s] ago."""

    def __init__(self, age=0.05, domain=SYSTEM, level=7):
        self.stamp, self.domain, self.level = (time.time() - age) * 1e3, domain, level

    def size(self):
        return 2

    def keep(self):
        pass

    def get_color_frame(self):
        intrinsics = SimpleNamespace(fx=600.0, fy=601.0, ppx=31.0, ppy=23.0)
        profile = SimpleNamespace(intrinsics=intrinsics)
        return SimpleNamespace(
            get_data=lambda: np.full((48, 64, 3), self.level, np.uint8),
            get_timestamp=lambda: self.stamp,
            get_frame_timestamp_domain=lambda: self.domain,
            profile=SimpleNamespace(as_video_stream_profile=lambda: profile),
        )

    def get_depth_frame(self):
        return SimpleNamespace(get_data=lambda: np.full((48, 64), 500, np.uint16))


@pytest.fixture
def library(monkeypatch):
    """The stand-in; frames that are put into `waiting` arrive with the next poll."""
    waiting, stopped, none = [Frames()], [], SimpleNamespace(size=lambda: 0)
    depth = SimpleNamespace(get_depth_scale=lambda: 0.001)
    device = SimpleNamespace(first_depth_sensor=lambda: depth)
    pipeline = SimpleNamespace(
        start=lambda config: SimpleNamespace(get_device=lambda: device),
        poll_for_frames=lambda: waiting.pop(0) if waiting else none,
        stop=lambda: stopped.append(True),
    )
    config = SimpleNamespace(enable_device=lambda serial: None, enable_stream=lambda *args: None)
    fake = SimpleNamespace(
        config=lambda: config,
        pipeline=lambda: pipeline,
        align=lambda stream: SimpleNamespace(process=lambda frames: frames),
        stream=SimpleNamespace(color=0, depth=1),
        format=SimpleNamespace(z16=0, rgb8=1),
        timestamp_domain=SimpleNamespace(hardware_clock=HARDWARE),
    )
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake)
    return SimpleNamespace(waiting=waiting, stopped=stopped)


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(MissingExtra, match=r"pip install sart_toolkit\[realsense\]"):
        RealSense().connect()


def test_an_image_has_depth_in_metres_intrinsics_and_the_time_at_which_it_was_taken(library):
    camera = RealSense()
    camera.connect()
    image = camera.read()
    assert image.rgb.shape == (48, 64, 3) and image.depth.dtype == np.float32
    np.testing.assert_allclose(image.depth, 0.5)
    np.testing.assert_array_equal(image.intrinsics, [[600, 0, 31], [0, 601, 23], [0, 0, 1]])
    assert 0.04 < time.monotonic() - image.time < 2.0


def test_the_newest_of_all_that_arrived_is_read(library):
    camera = RealSense()
    camera.connect()
    library.waiting += [Frames(level=1), Frames(level=2, age=0.01)]
    first = camera.newest()
    assert camera.read().rgb[0, 0, 0] == 2
    assert camera.newest() == first


def test_without_the_system_s_time_it_was_taken_when_it_arrived(library):
    library.waiting[:] = [Frames(age=1e6, domain=HARDWARE)]
    camera = RealSense()
    camera.connect()
    assert time.monotonic() - camera.newest() < 1.0


def test_a_camera_that_gives_no_image_is_closed_and_named(library, monkeypatch):
    library.waiting.clear()
    monkeypatch.setattr("sart_toolkit.hardware.realsense._FIRST_IMAGE", 0.05)
    with pytest.raises(DeviceLost, match="RealSense 12: no image within .* USB 3"):
        RealSense(serial="12").connect()
    assert library.stopped == [True]


def test_a_closed_camera_is_no_camera(library):
    camera = RealSense()
    camera.connect()
    camera.disconnect()
    camera.disconnect()
    with pytest.raises(DeviceLost, match="isn't connected"):
        camera.newest()
