"""A person's way through the real windows, by scripted input: `python tools/human_path.py DIR`.

A demonstration is recorded with the keyboard and annotated, then augmented and trained on, and the
skill is evaluated. A virtual screen shows the windows, keys are pressed on it as fingers
would, and images are taken. The hands know no more than eyes would show them: where the tool is
and what the windows say, read from `--status` and from the annotator's journal; and where the
object stands. Each stage is a function and a line in `STAGES`; they leave what a person's work
would leave in DIR, and `human_path.json` holds the result of each.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit import doctor
from sart_toolkit.data.records import library_versions
from sart_toolkit.data.storage import (
    load_annotation,
    load_demonstration,
    read_json,
    read_json_lines,
    write_json,
)
from sart_toolkit.errors import Mismatch, SartError, unknown_name
from sart_toolkit.poses import Array, relative_motion
from sart_toolkit.record.devices.keyboard import KEYS
from sart_toolkit.record.devices.manual import SPEEDS, views
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement, PlanStep
from sart_toolkit.testing.desktop import Desktop

_SART = (sys.executable, "-c", "from sart_toolkit.cli import main; main()")
# Slow within this [m] of where the hand is heading, and how long [s] it takes to react.
_NEAR, _REACTION = 0.06, 0.2
# Between plan steps a person checks where the tool is.
_LOOK = 0.6
# Keys of the annotator by their X names. By hand: a sphere at the start made larger in coarse
# steps, then one at each convergence waypoint as far as there is room, save, leave.
BY_HAND = ("Return", *["Up"] * 8, *["c", "Return"] * 4, "w", "q")
SUGGESTED = ("a", "w", "q")


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of doing the named stages, or all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("directory", type=Path, help="where the results go")
    parser.add_argument("--task", default="peg_in_hole", help="what is done")
    parser.add_argument("--images", type=Path, help="folder for images of the windows")
    parser.add_argument("--stages", nargs="*", default=list(STAGES), help=f"of {', '.join(STAGES)}")
    parser.add_argument("--episodes", type=int, default=50, help="rollouts of the skill")
    options = parser.parse_args(arguments)
    images = options.images or options.directory / "images"
    report_file = options.directory / "human_path.json"
    try:
        for stage in options.stages:
            if stage not in STAGES:
                raise unknown_name("stage", stage, STAGES)
        get_task(options.task)
        for folder in (options.directory, images):
            folder.mkdir(parents=True, exist_ok=True)
        report: dict[str, Any] = (
            read_json(report_file, dict) if report_file.exists() else {"stages": {}}
        )
        report |= {
            "task": options.task,
            "machine": doctor.machine(),
            "versions": library_versions(),
        }
        for stage in options.stages:
            started = time.monotonic()
            said = STAGES[stage](options, images)
            seconds = round(time.monotonic() - started, 1)
            report["stages"][stage] = said | {"wall_seconds": seconds}
            write_json(report_file, report)
            words = ", ".join(f"{k} {v}" for k, v in said.items() if not isinstance(v, list | dict))
            print(f"{stage:<9} {seconds:6.1f} s  {words}")
    except (SartError, TimeoutError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


# --- recording ----------------------------------------------------------------------------------


def record(options: argparse.Namespace, images: Path) -> dict[str, Any]:
    """The result of recording `demo.h5` with the keyboard; images of each state are taken."""
    name, directory = options.task, options.directory
    task = get_task(name)
    model = RobotModel(get_robot(task.robot), task.scene.held)
    out, status = directory / "demo.h5", directory / "status.jsonl"
    with Desktop() as desktop:
        program = desktop.start(
            [*_SART, "record", name, "--out", str(out), "--device", "keyboard", "--overwrite",
             "--operator", "scripted input", "--status", str(status)]
        )  # fmt: skip
        desktop.window(f"sart record {name}")
        hands = _Hands(desktop, program, status, views(model, task.scene).R_world_hand)
        hands.see("state", "ready")
        time.sleep(_LOOK)
        desktop.screenshot(images / "record_ready.png")
        desktop.key("Right")
        for step in task.plan(task.initial_state(model, Placement())):
            hands.steer(step)
            if hands.look()["state"] == "recording":
                desktop.screenshot(images / "record_recording.png")
        hands.see("state", "ended")
        desktop.screenshot(images / "record_ended.png")
        desktop.key("Right")
        hands.see("state", "saved")
        desktop.screenshot(images / "record_saved.png")
        said, errors = program.communicate(timeout=60)
        if program.returncode != 0:
            raise TimeoutError(f"sart record ended with code {program.returncode}: {errors}{said}")
    demonstration = load_demonstration(out)
    return {
        "recorded_seconds": round(float(demonstration.timestamps[-1]), 1),
        "seconds_of_a_person": round(demonstration.seconds, 1),
        "reached_the_goal": task.achieved(demonstration.success),
    }


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

    def steer(self, step: PlanStep, timeout_s: float = 60.0) -> None:
        """Bring the tool to the end of a plan step, or until the recording ends by itself."""
        deadline = time.monotonic() + timeout_s
        while (now := self.look())["state"] != "ended":
            if time.monotonic() > deadline:
                raise TimeoutError(f"the tool did not get there: {now['notice']}")
            if now["state"] == "recording":
                self._close_or_open(now["gripper"], step.gripper)
                speed, wanted = self._keys(np.array(now["T_world_tool"]), step)
                self._choose_speed(speed)
                self._hold(wanted)
                if not wanted:
                    break
            time.sleep(0.03)
        self._hold(set())
        time.sleep(_LOOK + step.pause)

    def _keys(self, T_world_tool: Array, step: PlanStep) -> tuple[str, set[str]]:
        """The speed to choose and the keys to hold, to come nearer to the end of a plan step."""
        motion = relative_motion(T_world_tool, step.T_world_tool)
        R_hand_tool = self._R_world_hand.T @ T_world_tool[:3, :3]
        left = np.concatenate([R_hand_tool @ motion[:3], R_hand_tool @ motion[3:]])
        careful = step.speed < 0.04 or float(np.abs(left[:3]).max()) < _NEAR
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

    def _close_or_open(self, commanded: float, wanted: float) -> None:
        if (commanded > 0.5) != (wanted > 0.5) and wanted != self._gripper:
            self._desktop.key("space")
            self._gripper = wanted


# --- annotating ---------------------------------------------------------------------------------


def annotate(options: argparse.Namespace, images: Path) -> dict[str, Any]:
    """The result of annotating by hand: `annotation.json`."""
    return _annotated(options, "annotation", BY_HAND, images)


def suggest(options: argparse.Namespace, images: Path) -> dict[str, Any]:
    """The result of taking all suggestions instead: `suggested.json`."""
    return _annotated(options, "suggested", SUGGESTED, images)


def _annotated(
    options: argparse.Namespace, name: str, keys: Sequence[str], images: Path
) -> dict[str, Any]:
    """The result of pressing keys in the annotator's window, the last of which save and leave.

    The next key is pressed once the one before has been done, which the journal tells; `seconds`
    are those from the first key to the window's end, without those for an image of it.
    """
    demo, out = options.directory / "demo.h5", options.directory / f"{name}.json"
    journal = out.with_name(f"{out.name}.journal")
    with Desktop() as desktop:
        opened = time.monotonic()
        program = desktop.start(
            [*_SART, "annotate", str(demo), "--out", str(out), "--overwrite", "--json"]
        )
        desktop.window("sart annotate")
        started = time.monotonic()
        for key in keys[:-1]:
            done = len(read_json_lines(journal))
            desktop.key(key)
            while program.poll() is None and len(read_json_lines(journal)) <= done:
                time.sleep(0.01)
        seconds = time.monotonic() - started
        # With the whole cloud and the sampled poses, which wait until nothing is pressed.
        time.sleep(3.0)
        desktop.screenshot(images / f"annotate_{name}.png")
        started_leaving = time.monotonic()
        desktop.key(keys[-1])
        said, errors = program.communicate(timeout=60)
        seconds += time.monotonic() - started_leaving
    if program.returncode != 0:
        raise Mismatch(f"the annotator ended with {program.returncode}: {errors[-300:]}")
    annotation = load_annotation(out)
    annotation.check_matches(load_demonstration(demo))
    return {
        "presses": len(keys),
        "presses_counted_by_the_annotator": json.loads(said)["presses"],
        "seconds": round(seconds, 2),
        "opening_seconds": round(started - opened, 2),
        "seconds_in_the_file": annotation.seconds,
        "spheres": [
            {"waypoint": s.waypoint, "radius_mm": round(1e3 * s.radius, 1), "source": s.source}
            for s in annotation.spheres
        ],
    }


# --- learning -----------------------------------------------------------------------------------


def augment(options: argparse.Namespace, images: Path) -> dict[str, Any]:
    """The result of augmenting with the annotation by hand: `dataset/`."""
    folder = options.directory
    made = _sart("augment", folder / "demo.h5", folder / "annotation.json",
                 "--out", folder / "dataset", "--workers", 2, "--overwrite")  # fmt: skip
    return {name: made[name] for name in ("n_trajectories", "n_kept", "n_attempted")}


def train(options: argparse.Namespace, images: Path) -> dict[str, Any]:
    """The result of training on the dataset: `skill/`."""
    folder = options.directory
    made = _sart("train", folder / "dataset", "--out", folder / "skill", "--overwrite")
    return {"policy": made["policy"], "seconds": made["seconds"]}


def evaluate(options: argparse.Namespace, images: Path) -> dict[str, Any]:
    """The result of trying the skill: `evaluation.json`."""
    folder = options.directory
    made = _sart("evaluate", folder / "skill", "--out", folder / "evaluation.json",
                 "--episodes", options.episodes, "--workers", 2, "--overwrite")  # fmt: skip
    return {name: made[name] for name in ("n_success", "n_episodes", "ci95")}


def _sart(*arguments: object) -> dict[str, Any]:
    """What a verb of `sart` says came of it."""
    done = subprocess.run(
        [*_SART, *map(str, arguments), "--json"], stdout=subprocess.PIPE, text=True, check=False
    )
    if done.returncode != 0:
        raise Mismatch(f"sart {arguments[0]} ended with {done.returncode}")
    result: dict[str, Any] = json.loads(done.stdout)
    return result


STAGES: dict[str, Callable[[argparse.Namespace, Path], dict[str, Any]]] = {
    "record": record,
    "annotate": annotate,
    "suggest": suggest,
    "augment": augment,
    "train": train,
    "evaluate": evaluate,
}

if __name__ == "__main__":
    sys.exit(main())
