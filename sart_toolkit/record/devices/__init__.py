"""What steers the tool: keyboard, SpaceMouse, gamepad, a hand on the arm itself, or a script.

A new device is one file and one line in `DEVICES`: what is named there is called with a
`DeviceSetup`. One outside the repository needs no line, `package.module:NAME` or
`path/to/file.py:NAME` names it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from sart_toolkit.registry import expect, resolve

if TYPE_CHECKING:
    from sart_toolkit.record.session import Device, DeviceSetup

DEVICES = {
    "scripted": "sart_toolkit.record.scripted:scripted_operator",
    "keyboard": "sart_toolkit.record.devices.keyboard:Keyboard",
    "spacemouse": "sart_toolkit.record.devices.spacemouse:SpaceMouse",
    "gamepad": "sart_toolkit.record.devices.gamepad:Gamepad",
    "hand_guiding": "sart_toolkit.record.devices.hand_guiding:HandGuiding",
}


def make_device(device: str | Callable[[DeviceSetup], Device], setup: DeviceSetup) -> Device:
    """A device made for a recording; one that a person holds isn't connected yet.

    Args:
        device: what makes it, or a name or reference that names that.
        setup: what the recording is of.

    Raises:
        UnknownName: no such device; the message says which part is wrong.
    """
    from sart_toolkit.record.session import Device

    make = resolve("device", device, DEVICES)
    return expect("device", device, make(setup) if callable(make) else make, Device)
