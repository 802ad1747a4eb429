"""The phases of a demonstration: runs of waypoints with one gripper command, grasp and contacts."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from sart_toolkit.data.records import Demonstration
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec

# How far a grasped object may move in the grasp [m]: in small spheres it does by up to 0.9 mm in
# PyBullet and 0.23 mm in SAPIEN, by more in wide ones. A segment on which it moves farther is
# rejected.
IN_GRASP_SLIP = 0.005
# How far [m] any point of a body that isn't grasped may be, on a segment, from where it was at t*:
# what rests on a table settles by up to 0.08 mm in PyBullet. All proofs leave that much room, and a
# segment on which one moves farther is rejected.
BODY_STILLNESS = 0.0001
# The same on a way out and back, which takes twice as long: in PyBullet bodies creep by 0.02 mm/s.
OUT_AND_BACK_STILLNESS = 2 * BODY_STILLNESS
# How far a gripper's opening may be outside of what it was at t* and what is commanded, as a share
# of its range. Proofs hold for all of it, and a segment on which it leaves that is rejected.
GRIPPER_TOLERANCE = 0.006
# A linkage that holds something gives way at each of its joints by itself: in PyBullet, with the
# toolbox in the grasp, fingers are up to 2.1 mm from where the measured opening has them, and
# without anything 0.008 mm. Of the former all but 0.4 mm is as at an opening that is wider by this
# share of the range; the rest [m] is taken off the distances of what the gripper moves.
HELD_TOLERANCE, HELD_PLAY = 0.05, 0.0005


@dataclass(frozen=True)
class Phase:
    """What a waypoint has in common with its neighbours until the gripper or a contact changes.

    `gripper`: its command in [0, 1]; `grasped`: names of the bodies in the grasp; `contacts`: pairs
    in which the robot, or what it has grasped, touches anything else.
    """

    gripper: float
    grasped: frozenset[str]
    contacts: frozenset[tuple[str, str]]

    def change(self, after: Phase) -> str:
        """What is different in the phase after this one."""
        if self.gripper != after.gripper:
            return "gripper command"
        if self.grasped != after.grasped:
            return "grasp of " + ", ".join(sorted(self.grasped ^ after.grasped))
        return "contact " + " / ".join(min(self.contacts ^ after.contacts))


def demonstration_phases(
    demonstration: Demonstration, robot: RobotSpec, scene: SceneSpec
) -> tuple[Phase, ...]:
    """The phase that each waypoint of a demonstration belongs to, from gripper and contacts."""
    commands = demonstration.steps.commanded_gripper
    phases = []
    for command, touching in zip(commands, demonstration.touching, strict=True):
        grasped = scene.grasped(touching, robot.gripper.finger_links)
        contacts = scene.outer_contacts(touching, grasped)
        phases.append(Phase(round(float(command), 2), grasped, contacts))
    # Before the first step no contacts are known yet.
    return (dataclasses.replace(phases[1], gripper=phases[0].gripper), *phases[1:])
