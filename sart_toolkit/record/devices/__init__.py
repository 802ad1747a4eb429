"""What steers the tool in teleoperation: keyboard, SpaceMouse, gamepad, or a script.

A new device is one file and one line in `DEVICES`: what is named there is called with a
`DeviceSetup`.
"""

from __future__ import annotations

from sart_toolkit.record.session import Device, DeviceSetup
from sart_toolkit.registry import lookup

DEVICES = {
    "scripted": "sart_toolkit.record.scripted:scripted_operator",
    "keyboard": "sart_toolkit.record.devices.keyboard:Keyboard",
    "spacemouse": "sart_toolkit.record.devices.spacemouse:SpaceMouse",
    "gamepad": "sart_toolkit.record.devices.gamepad:Gamepad",
}


def make_device(name: str, setup: DeviceSetup) -> Device:
    """The device called `name`, made for a recording; one that a person holds isn't connected yet.

    Args:
        name: one of `DEVICES`.
        setup: what the recording is of.

    Raises:
        UnknownName: no such device; the message offers the nearest.
    """
    made = lookup("device", name, DEVICES)(setup)
    assert isinstance(made, Device)
    return made
