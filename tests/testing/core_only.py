"""The core of a backend without any ability, as a hardware arm might have it."""

import dataclasses
from pathlib import Path

import sart_toolkit as sart

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "07_own_backend.py"


class CoreOnly(sart.Backend):
    """The example of one's own backend with all but its core hidden."""

    name, no_images = "core_only", "it has no cameras"

    def __init__(self, robot, scene, *options):
        super().__init__(robot, scene, *options)
        self._whole = sart.get_backend(f"{EXAMPLE}:Kinematic")(robot, scene, *options)

    def observe(self, cameras=(), image_size=None):
        self.check_cameras(cameras)
        return dataclasses.replace(self._whole.observe(), Ts_world_body={})

    def command(self, q, gripper):
        return self._whole.command(q, gripper)

    def step(self):
        self._whole.step()

    def close(self):
        self._whole.close()
