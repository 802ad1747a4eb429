"""Intel RealSense cameras, depth aligned to colour, through `pyrealsense2`."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

import numpy as np

from sart_toolkit.errors import DeviceLost, MissingExtra
from sart_toolkit.hardware.drivers import CameraImage, Clock

_FIRST_IMAGE = 5.0


class RealSense:
    """A D400 camera. Its colour images are taken to be free of distortion, as the D435's are."""

    def __init__(
        self,
        serial: str | None = None,
        width: int = 640,
        height: int = 480,
        fps: int = 30,
        clock: Clock = time.monotonic,
    ) -> None:
        """A camera that isn't open yet.

        Args:
            serial: its serial number; the only camera that is plugged in if left out.
            width, height: of its images [pixels].
            fps: images a second.
            clock: the time that images are dated in.
        """
        self._serial, self._size, self._fps, self._clock = serial, (width, height), fps, clock
        self._pipeline: Any = None
        self._frames: Any = None
        self._time = 0.0

    def connect(self) -> None:
        try:
            import pyrealsense2 as rs
        except ImportError as error:
            raise MissingExtra(
                f"a RealSense needs pyrealsense2 ({error}); pip install sart_toolkit[realsense]"
            ) from error
        config, pipeline = rs.config(), rs.pipeline()
        if self._serial is not None:
            config.enable_device(self._serial)
        config.enable_stream(rs.stream.depth, *self._size, rs.format.z16, self._fps)
        config.enable_stream(rs.stream.color, *self._size, rs.format.rgb8, self._fps)
        profile = pipeline.start(config)
        self._pipeline, self._align = pipeline, rs.align(rs.stream.color)
        self._depth_unit = profile.get_device().first_depth_sensor().get_depth_scale()
        self._hardware_clock = rs.timestamp_domain.hardware_clock
        deadline = time.monotonic() + _FIRST_IMAGE
        while self._frames is None:
            self._poll()
            if time.monotonic() > deadline:
                self.disconnect()
                raise DeviceLost(
                    f"RealSense {self._serial or ''}: no image within {_FIRST_IMAGE:g} s; plug it "
                    "into a USB 3 port"
                )
            time.sleep(0.01)

    def newest(self) -> float:
        self._poll()
        return self._time

    def read(self) -> CameraImage:
        self._poll()
        frames = self._align.process(self._frames)
        colour, depth = frames.get_color_frame(), frames.get_depth_frame()
        k = colour.profile.as_video_stream_profile().intrinsics
        return CameraImage(
            rgb=np.array(colour.get_data()),
            depth=np.asarray(depth.get_data()).astype(np.float32) * np.float32(self._depth_unit),
            intrinsics=np.array([[k.fx, 0, k.ppx], [0, k.fy, k.ppy], [0, 0, 1.0]]),
            time=self._time,
        )

    def disconnect(self) -> None:
        pipeline, self._pipeline, self._frames = self._pipeline, None, None
        if pipeline is not None:
            with suppress(RuntimeError):
                pipeline.stop()

    def _poll(self) -> None:
        """Take over the newest images, if there are new ones."""
        if self._pipeline is None:
            raise DeviceLost("RealSense: isn't connected")
        while (frames := self._pipeline.poll_for_frames()).size():
            # Kept beyond the next ones, which would else take its place in the camera's memory.
            frames.keep()
            now = self._clock()
            colour = frames.get_color_frame()
            if not colour or not frames.get_depth_frame():
                continue
            self._frames, self._time = frames, now
            if colour.get_frame_timestamp_domain() != self._hardware_clock:
                # Its times are then the system's, in milliseconds.
                self._time = now - (time.time() - colour.get_timestamp() / 1e3)
