"""Steering with a 3Dconnexion SpaceMouse, read through hidapi."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from sart_toolkit.errors import DeviceLost, MissingExtra
from sart_toolkit.poses import Array
from sart_toolkit.record.devices.manual import ManualDevice

# Logitech sold them before 3Dconnexion had a number of its own.
_LOGITECH, _3DCONNEXION = 0x046D, 0x256F
_LOGITECH_PRODUCTS = {
    0xC603, 0xC605, 0xC606, 0xC621, 0xC623, 0xC625, 0xC626, 0xC627, 0xC628, 0xC629, 0xC62B,
}  # fmt: skip
_3DCONNEXION_PRODUCTS = {
    0xC62E, 0xC62F, 0xC631, 0xC632, 0xC633, 0xC635, 0xC636, 0xC638, 0xC63A, 0xC652,
}  # fmt: skip
# "Generic desktop", "multi-axis controller": what a newer model says it is.
_MULTI_AXIS = (1, 8)
_TRANSLATION, _ROTATION, _BUTTONS = 1, 2, 3
# What a report holds at full deflection.
_FULL = 350.0
_DEAD_ZONE = 0.06
# The cap's own axes are right, back and down; ours right, forward and up.
_FROM_CAP = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
# At most so many reports are waiting; the newest counts.
_MOST_REPORTS = 256


class SpaceMouse(ManualDevice):
    """The cap pushes and turns the tool as it is pushed and turned itself."""

    name = "spacemouse"
    key_map = (
        ("Cap", "push, turn"),
        ("Button 1", "gripper"),
        ("Button 2", "next speed"),
    )
    _device: Any = None

    def connect(self) -> None:
        try:
            import hid
        except ImportError as error:
            raise MissingExtra(
                f"a SpaceMouse needs hidapi ({error}); pip install sart_toolkit[teleop]"
            ) from error
        self.close()
        found = sorted(filter(is_spacemouse, hid.enumerate()), key=_preference)
        if not found:
            raise DeviceLost("no SpaceMouse found; plug it in, or record with --device keyboard")
        device = hid.device()
        try:
            device.open_path(found[0]["path"])
            device.set_nonblocking(1)
        except OSError as error:
            raise DeviceLost(
                f"the SpaceMouse can't be opened ({error}); set up its udev rule as "
                "docs/recording.md says, and quit other programs that use it"
            ) from error
        self._device = device
        self.let_go()

    def close(self) -> None:
        if self._device is not None:
            self._device.close()
            self._device = None

    def let_go(self) -> None:
        self._axes = np.zeros(6)
        self._buttons = 0

    def poll(self) -> Array:
        if self._device is None:
            raise DeviceLost("the SpaceMouse is not connected")
        try:
            for _ in range(_MOST_REPORTS):
                report = self._device.read(64)
                if not report:
                    break
                self._take(report)
        except (OSError, ValueError) as error:
            self.close()
            self.let_go()
            raise DeviceLost("the SpaceMouse was unplugged") from error
        moved = np.abs(self._axes) > _DEAD_ZONE
        free = np.sign(self._axes) * (np.abs(self._axes) - _DEAD_ZONE) / (1.0 - _DEAD_ZONE)
        return np.where(moved, free, 0.0) * _FROM_CAP

    def _take(self, report: Sequence[int]) -> None:
        """One report: its number, then little-endian 16-bit axes or a bit for each button."""
        kind, content = report[0], bytes(report[1:])
        if kind == _BUTTONS:
            self._press(int.from_bytes(content, "little"))
            return
        # Older models report translation and rotation in turn, newer ones both at once.
        wanted = {_TRANSLATION: 6 if len(content) >= 12 else 3, _ROTATION: 3}.get(kind, 0)
        if wanted and len(content) >= 2 * wanted:
            values = struct.unpack(f"<{wanted}h", content[: 2 * wanted])
            first = 3 if kind == _ROTATION else 0
            self._axes[first : first + wanted] = np.clip(np.array(values) / _FULL, -1.0, 1.0)

    def _press(self, buttons: int) -> None:
        pressed = buttons & ~self._buttons
        self._buttons = buttons
        if pressed & 1:
            self.switch_gripper()
        if pressed & 2:
            self.next_speed()


def is_spacemouse(info: dict[str, Any]) -> bool:
    """Whether what hidapi reports of a device is a SpaceMouse's."""
    known = {_LOGITECH: _LOGITECH_PRODUCTS, _3DCONNEXION: _3DCONNEXION_PRODUCTS}
    if info["vendor_id"] not in known:
        return False
    return info["product_id"] in known[info["vendor_id"]] or _usage(info) == _MULTI_AXIS


def _preference(info: dict[str, Any]) -> tuple[bool, int]:
    # A receiver has several interfaces; the one that says it has axes is the cap's.
    return _usage(info) != _MULTI_AXIS, info.get("interface_number", 0)


def _usage(info: dict[str, Any]) -> tuple[int, int]:
    return info.get("usage_page", 0), info.get("usage", 0)
