"""A person's hand on a real arm, which lets itself be moved."""

from __future__ import annotations

import numpy as np

from sart_toolkit.backends.interface import Guides, require
from sart_toolkit.poses import Array
from sart_toolkit.record.devices.manual import ManualDevice
from sart_toolkit.record.session import DeviceSetup


class HandGuiding(ManualDevice):
    """The arm itself, moved by hand while it records; a key is for the gripper."""

    name = "hand_guiding"
    guides = True
    key_map = (("Your hand", "moves it while recording"),)

    def __init__(self, setup: DeviceSetup) -> None:
        """Guide the arm of a backend that can be guided.

        Raises:
            MissingCapability: it can't.
        """
        require(setup.backend, Guides, f"{self.name} moves its arm by hand")
        super().__init__(setup)

    def connect(self) -> None:
        self.let_go()

    def key(self, name: str, down: bool) -> bool:
        # A hand needs neither speeds nor directions.
        return name == "space" and super().key(name, down)

    def poll(self) -> Array:
        return np.zeros(6)
