"""Cameras that OpenCV opens: USB cameras, network streams, without depth."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from sart_toolkit.errors import DeviceLost, InvalidInput, MissingExtra
from sart_toolkit.hardware.drivers import CameraImage, Clock
from sart_toolkit.poses import check_array

_FIRST_IMAGE = 5.0
_DISTORTION = (4, 5, 8, 12, 14)


class OpenCVCamera:
    """A colour camera through `cv2.VideoCapture`. Its depth images are 0 everywhere: none measured.

    A policy needs no depth. What needs it, such as obstacles from a cloud, needs another camera.
    """

    def __init__(
        self,
        camera_matrix: Sequence[float],
        device: int | str = 0,
        distortion: Sequence[float] = (),
        width: int = 640,
        height: int = 480,
        fps: int = 30,
        clock: Clock = time.monotonic,
    ) -> None:
        """A camera that isn't open yet.

        Args:
            camera_matrix: its fx, fy, cx, cy [pixels], at `width` and `height`.
            device: its number, or the path or address that OpenCV is to open.
            distortion: its coefficients in OpenCV's order, 4, 5, 8, 12 or 14 of them; images are
                freed of it.
            width, height: of its images [pixels].
            fps: images a second.
            clock: the time that images are dated in.

        Raises:
            InvalidInput: a value is not acceptable.
        """
        fx, fy, cx, cy = check_array("camera_matrix", camera_matrix, (4,))
        if min(fx, fy) <= 0:
            raise InvalidInput(f"camera_matrix: expected fx and fy above 0, got {fx:g} and {fy:g}")
        if len(distortion) not in (0, *_DISTORTION):
            raise InvalidInput(
                f"distortion: expected 4, 5, 8, 12 or 14 coefficients, got {len(distortion)}"
            )
        self._intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        self._distortion = np.array(distortion, float)
        self._device, self._size, self._fps, self._clock = device, (width, height), fps, clock
        self._opened: Any = None
        self._thread: threading.Thread | None = None
        self._lock, self._closing = threading.Lock(), threading.Event()
        self._image: tuple[Any, float] | None = None
        self._lost = False

    def connect(self) -> None:
        try:
            import cv2
        except ImportError as error:
            raise MissingExtra(
                f"a camera by OpenCV needs cv2 ({error}); pip install sart_toolkit[calibrate]"
            ) from error
        opened = cv2.VideoCapture(self._device)
        if not opened.isOpened():
            opened.release()
            raise DeviceLost(
                f"camera {self._device!r}: OpenCV can't open it; check that it is plugged in, that "
                "nothing else uses it and that you may read it"
            )
        for setting, value in (
            (cv2.CAP_PROP_FRAME_WIDTH, self._size[0]),
            (cv2.CAP_PROP_FRAME_HEIGHT, self._size[1]),
            (cv2.CAP_PROP_FPS, self._fps),
        ):
            opened.set(setting, value)
        self._cv2, self._opened = cv2, opened
        self._maps = cv2.initUndistortRectifyMap(
            self._intrinsics, self._distortion, np.eye(3), self._intrinsics, self._size,
            cv2.CV_16SC2,
        )  # fmt: skip
        self._image, self._lost = None, False
        self._closing.clear()
        self._thread = threading.Thread(target=self._take, name="camera", daemon=True)
        self._thread.start()
        deadline = time.monotonic() + _FIRST_IMAGE
        while self._image is None and not self._lost and time.monotonic() < deadline:
            time.sleep(0.005)
        if self._image is None:
            self.disconnect()
            raise DeviceLost(
                f"camera {self._device!r}: no image within {_FIRST_IMAGE:g} s; plug it in again"
            )
        height, width = self._image[0].shape[:2]
        if (width, height) != self._size:
            self.disconnect()
            raise InvalidInput(
                f"camera {self._device!r}: gives {width}x{height} images, not "
                f"{self._size[0]}x{self._size[1]}; set width and height to what it can give, and "
                "camera_matrix to that size"
            )

    def newest(self) -> float:
        return self._newest()[1]

    def read(self) -> CameraImage:
        image, taken = self._newest()
        if self._distortion.any():
            image = self._cv2.remap(image, *self._maps, self._cv2.INTER_LINEAR)
        return CameraImage(
            rgb=np.ascontiguousarray(image[:, :, ::-1]),
            depth=np.zeros(image.shape[:2], np.float32),
            intrinsics=self._intrinsics.copy(),
            time=taken,
        )

    def disconnect(self) -> None:
        self._closing.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join()
        opened, self._opened = self._opened, None
        if opened is not None:
            opened.release()

    def _newest(self) -> tuple[Any, float]:
        if self._thread is None:
            raise DeviceLost(f"camera {self._device!r}: isn't connected")
        with self._lock:
            if self._lost or self._image is None:
                raise DeviceLost(f"camera {self._device!r}: gives no more images; plug it in again")
            return self._image

    def _take(self) -> None:
        """Take every image as it comes: OpenCV keeps some, and the oldest would be read first."""
        while not self._closing.is_set():
            arrived = self._opened.grab()
            taken = self._clock()
            ok, image = self._opened.retrieve() if arrived else (False, None)
            with self._lock:
                if not ok:
                    self._lost = True
                    return
                self._image = image, taken
