"""What a person does, done by machine hands in the real windows: `python tools/human_path.py DIR`.

A screen that nobody looks at shows the windows, keys are pressed on it as fingers would, and
pictures are taken. The hands know no more than eyes would tell them: where the tool is and what the
window says, read from `--status`; and where the object stands. Each stage is a function and a line
in `STAGES`; they leave what a person's work would leave in DIR.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit.errors import SartError, unknown_name
from sart_toolkit.poses import Array, relative_motion
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.storage import load_demonstration, read_json_lines
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement, Stage
from sart_toolkit.teach.devices.keyboard import KEYS
from sart_toolkit.teach.devices.manual import SPEEDS, views
from sart_toolkit.testing.desktop import Desktop

_SART = (sys.executable, "-c", "from sart_toolkit.cli import main; main()")
# Slow within this [m] of where the hand is heading, and how long [s] it takes to react.
_NEAR, _REACTION = 0.06, 0.2
# Between the legs of the way a person looks where they are.
_LOOK = 0.6


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of doing the named stages, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path, help="where the results go")
    parser.add_argument("--task", default="peg_in_hole", help="what is done")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the windows")
    parser.add_argument("--stages", nargs="*", default=list(STAGES), help=f"of {', '.join(STAGES)}")
    options = parser.parse_args(arguments)
    pictures = options.pictures or options.directory / "pictures"
    try:
        for folder in (options.directory, pictures):
            folder.mkdir(parents=True, exist_ok=True)
        for stage in options.stages:
            if stage not in STAGES:
                raise unknown_name("stage", stage, STAGES)
            started = time.monotonic()
            said = STAGES[stage](options.task, options.directory, pictures)
            print(f"{stage:<9} {time.monotonic() - started:6.1f} s  {said}")
    except (SartError, TimeoutError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


# --- recording ----------------------------------------------------------------------------------


def record(name: str, directory: Path, pictures: Path) -> str:
    """What came of recording `demo.h5` with the keyboard; pictures of each phase are taken."""
    task = get_task(name)
    model = RobotModel(get_robot(task.robot), task.scene.held)
    out, status = directory / "demo.h5", directory / "status.jsonl"
    with Desktop() as desktop:
        program = desktop.start(
            [*_SART, "record", name, "--out", str(out), "--device", "keyboard", "--overwrite",
             "--operator", "machine hands", "--status", str(status)]
        )  # fmt: skip
        desktop.window(f"sart record {name}")
        hands = _Hands(desktop, program, status, views(model, task.scene).R_world_hand)
        hands.see("phase", "ready")
        time.sleep(_LOOK)
        desktop.screenshot(pictures / "record_ready.png")
        desktop.key("Right")
        for leg in task.plan(task.initial_state(model, Placement())):
            hands.steer(leg)
            if hands.look()["phase"] == "recording":
                desktop.screenshot(pictures / "record_recording.png")
        hands.see("phase", "ended")
        desktop.screenshot(pictures / "record_ended.png")
        desktop.key("Right")
        hands.see("phase", "saved")
        desktop.screenshot(pictures / "record_saved.png")
        said, errors = program.communicate(timeout=60)
        if program.returncode != 0:
            raise TimeoutError(f"sart record ended with code {program.returncode}: {errors}{said}")
    shown = load_demonstration(out)
    return f"{out}: {shown.timestamps[-1]:.1f} s long, {shown.seconds:.1f} s of a person's time"


class _Hands:
    """Press and release keys by what the recording's status says."""

    def __init__(
        self,
        desktop: Desktop,
        program: subprocess.Popen[str],
        status: Path,
        R_world_hand: Array,
    ) -> None:
        self._desktop, self._program, self._status = desktop, program, status
        self._R_world_hand = R_world_hand
        self._held: set[str] = set()
        self._speed = ""
        self._gripper: float | None = None

    def look(self) -> dict[str, Any]:
        """What the window shows now, or showed last before it closed in good order."""
        if self._program.poll():
            said, errors = self._program.communicate()
            raise TimeoutError(f"the window closed: {errors}{said}")
        rows = read_json_lines(self._status)
        return rows[-1] if rows else {}

    def see(self, what: str, value: object, timeout_s: float = 60.0) -> dict[str, Any]:
        """What the window shows once it shows a certain value."""
        deadline = time.monotonic() + timeout_s
        while (now := self.look()).get(what) != value:
            if time.monotonic() > deadline:
                raise TimeoutError(f"{what} did not become {value!r}: {now.get('notice')}")
            time.sleep(0.05)
        return now

    def steer(self, leg: Stage, timeout_s: float = 60.0) -> None:
        """Bring the tool to the end of a leg, or until the recording ends by itself."""
        deadline = time.monotonic() + timeout_s
        while (now := self.look())["phase"] != "ended":
            if time.monotonic() > deadline:
                raise TimeoutError(f"the tool did not get there: {now['notice']}")
            if now["phase"] == "recording":
                self._close_or_open(now["gripper"], leg.gripper)
                speed, wanted = self._keys(np.array(now["T_world_tool"]), leg)
                self._choose_speed(speed)
                self._hold(wanted)
                if not wanted:
                    break
            time.sleep(0.03)
        self._hold(set())
        time.sleep(_LOOK + leg.pause)

    def _keys(self, T_world_tool: Array, leg: Stage) -> tuple[str, set[str]]:
        """The speed to choose and the keys to hold, so as to come nearer to the end of a leg."""
        motion = relative_motion(T_world_tool, leg.T_world_tool)
        R_hand_tool = self._R_world_hand.T @ T_world_tool[:3, :3]
        left = np.concatenate([R_hand_tool @ motion[:3], R_hand_tool @ motion[3:]])
        careful = leg.speed < 0.04 or float(np.abs(left[:3]).max()) < _NEAR
        speed = SPEEDS[0] if careful else SPEEDS[1]
        # Let go a reaction's way before the end.
        reach = _REACTION * np.repeat([speed.linear, np.deg2rad(speed.turn_deg)], 3)
        wanted = {key for key, (axis, way) in KEYS.items() if way * left[axis] > reach[axis]}
        return ("1" if careful else "2"), wanted

    def _hold(self, wanted: set[str]) -> None:
        self._desktop.release(*sorted(self._held - wanted))
        self._desktop.press(*sorted(wanted - self._held))
        self._held = wanted

    def _choose_speed(self, key: str) -> None:
        if key != self._speed:
            self._desktop.key(key)
            self._speed = key

    def _close_or_open(self, told: float, wanted: float) -> None:
        if (told > 0.5) != (wanted > 0.5) and wanted != self._gripper:
            self._desktop.key("space")
            self._gripper = wanted


# Later stages may build on what earlier ones left in the directory.
STAGES: dict[str, Callable[[str, Path, Path], str]] = {"record": record}

if __name__ == "__main__":
    sys.exit(main())
