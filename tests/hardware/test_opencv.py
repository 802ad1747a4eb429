"""The OpenCV camera driver on video files, opened by OpenCV itself."""

import sys
import time
from contextlib import closing, contextmanager

import cv2
import numpy as np
import pytest

from sart_toolkit.errors import DeviceLost, InvalidInput, MissingExtra
from sart_toolkit.hardware import DRIVERS
from sart_toolkit.hardware.cell import Part
from sart_toolkit.hardware.opencv import OpenCVCamera

WIDTH, HEIGHT = 96, 64
MATRIX = (80.0, 80.0, 47.5, 31.5)
# Blue, green, red, as OpenCV writes them.
ORANGE, BLUE = (20, 120, 230), (220, 60, 30)


def _video(path, images):
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (WIDTH, HEIGHT), True
    )
    for image in images:
        writer.write(image)
    writer.release()
    return str(path)


def _plain(colour):
    return np.full((HEIGHT, WIDTH, 3), colour, np.uint8)


@pytest.fixture
def paced(monkeypatch):
    """A file gives its images as fast as they are asked for; here one each 50 ms, as a camera."""
    opened = cv2.VideoCapture

    class Paced:
        def __init__(self, device):
            self._file = opened(device)

        def grab(self):
            time.sleep(0.05)
            return self._file.grab()

        def __getattr__(self, name):
            return getattr(self._file, name)

    monkeypatch.setattr(cv2, "VideoCapture", Paced)


@contextmanager
def _open(device, **options):
    camera = OpenCVCamera(MATRIX, device, width=WIDTH, height=HEIGHT, **options)
    with closing(_Closing(camera)):
        camera.connect()
        yield camera


class _Closing:
    def __init__(self, camera):
        self.close = camera.disconnect


def test_an_image_is_red_green_blue_without_depth_and_has_the_time_it_arrived(paced, tmp_path):
    with _open(_video(tmp_path / "a.avi", [_plain(ORANGE)] * 40)) as camera:
        image = camera.read()
        assert image.rgb.shape == (HEIGHT, WIDTH, 3) and image.rgb.flags.c_contiguous
        assert np.abs(image.rgb.reshape(-1, 3).mean(0) - ORANGE[::-1]).max() < 6
        assert image.depth.shape == (HEIGHT, WIDTH) and not image.depth.any()
        np.testing.assert_array_equal(image.intrinsics, [[80, 0, 47.5], [0, 80, 31.5], [0, 0, 1]])
        assert 0 <= time.monotonic() - image.time < 1.0


def test_the_newest_image_is_read_however_long_nobody_asked(paced, tmp_path):
    images = [_plain(ORANGE)] * 4 + [_plain(BLUE)] * 40
    with _open(_video(tmp_path / "a.avi", images)) as camera:
        first = camera.newest()
        time.sleep(0.5)
        image = camera.read()
        assert image.time > first + 0.2
        assert np.abs(image.rgb.reshape(-1, 3).mean(0) - BLUE[::-1]).max() < 6


def test_images_are_freed_of_distortion(paced, tmp_path):
    coefficients = (-1.0, 0.6, 0.0, 0.0)
    matrix = np.array([[80, 0, 47.5], [0, 80, 31.5], [0, 0, 1.0]])
    # What a camera with that distortion sees of a straight edge 24 pixels above the middle.
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    ideal = cv2.undistortPoints(
        np.stack([u, v], -1).reshape(-1, 1, 2), matrix, np.array(coefficients), P=matrix
    ).reshape(HEIGHT, WIDTH, 2)
    seen = np.where(ideal[..., 1:] < 7.5, 255, 0).astype(np.uint8).repeat(3, 2)

    def bend(rgb):
        edges = (rgb[..., 0] > 127).sum(0)[10:-10]
        return int(edges.max() - edges.min())

    video = _video(tmp_path / "a.avi", [seen] * 40)
    with _open(video) as camera:
        assert bend(camera.read().rgb) >= 6
    with _open(video, distortion=coefficients) as camera:
        assert bend(camera.read().rgb) <= 2


def test_a_camera_that_gives_no_more_images_is_lost(tmp_path):
    with _open(_video(tmp_path / "a.avi", [_plain(ORANGE)] * 3)) as camera:
        deadline = time.monotonic() + 5.0
        with pytest.raises(DeviceLost, match="gives no more images"):
            while time.monotonic() < deadline:
                camera.newest()
                camera.read()


def test_a_camera_that_is_not_there_is_named(tmp_path):
    camera = OpenCVCamera(MATRIX, str(tmp_path / "none.avi"))
    with pytest.raises(DeviceLost, match=r"none\.avi': OpenCV can't open it; check"):
        camera.connect()
    camera.disconnect()


def test_another_size_of_images_than_asked_for_is_refused(paced, tmp_path):
    camera = OpenCVCamera(MATRIX, _video(tmp_path / "a.avi", [_plain(ORANGE)] * 40))
    with pytest.raises(InvalidInput, match="gives 96x64 images, not 640x480; set width and height"):
        camera.connect()
    with pytest.raises(DeviceLost, match="isn't connected"):
        camera.read()


def test_a_closed_camera_is_no_camera_and_can_be_opened_again(paced, tmp_path):
    camera = OpenCVCamera(
        MATRIX, _video(tmp_path / "a.avi", [_plain(ORANGE)] * 40), width=WIDTH, height=HEIGHT
    )
    camera.connect()
    camera.disconnect()
    camera.disconnect()
    with pytest.raises(DeviceLost, match="isn't connected"):
        camera.newest()
    camera.connect()
    assert camera.read().rgb.any()
    camera.disconnect()


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtra, match=r"pip install sart_toolkit\[calibrate\]"):
        OpenCVCamera(MATRIX).connect()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"camera_matrix": (1, 2, 3)}, r"camera_matrix: .*\(4,\)"),
        ({"camera_matrix": (0, 80, 1, 1)}, "camera_matrix: expected fx and fy above 0"),
        ({"camera_matrix": MATRIX, "distortion": (1, 2, 3)}, "4, 5, 8, 12 or 14 coefficients"),
    ],
)
def test_an_option_that_can_not_be_is_refused(options, said):
    with pytest.raises(InvalidInput, match=said):
        OpenCVCamera(**options)


def test_a_cell_s_file_names_it(tmp_path):
    assert "opencv" in DRIVERS["camera"]
    part = Part("camera", "opencv", {"camera_matrix": list(MATRIX), "device": 3})
    assert isinstance(part.made(clock=time.monotonic), OpenCVCamera)
