"""Recording by a person's hand, for `sart record`: the window, and where the result goes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from sart_toolkit.cli.arguments import Record
from sart_toolkit.cli.console import say
from sart_toolkit.data.records import Demonstration
from sart_toolkit.data.storage import (
    OutputLock,
    append_json_line,
    check_writable,
    linked,
    remove,
    save_demonstration,
)
from sart_toolkit.errors import Discarded, NoDisplay
from sart_toolkit.motion.config import ControllerConfig
from sart_toolkit.record.checks import check_recording
from sart_toolkit.record.desk import RecordingDesk
from sart_toolkit.record.devices.manual import ManualDevice
from sart_toolkit.record.screen import Screen, start_sdl
from sart_toolkit.record.session import DeviceSetup, SessionConfig, TeleopSession
from sart_toolkit.record.window import RecordingWindow
from sart_toolkit.tasks.task import Placement


def record_by_hand(
    args: Record,
    setup: DeviceSetup,
    device: ManualDevice,
    placement: Placement,
    config: SessionConfig,
) -> Demonstration:
    """The demonstration that a person steered and saved at `args.out`.

    Args:
        args: what was typed.
        setup: what the device was made for.
        device: what is held.
        placement: where the object stands.
        config: how it is recorded; how it ends and how joints are limited is decided here.

    Raises:
        Discarded: the person threw it away.
        MissingCapability: the backend takes no images.
        UnknownName: there is no such camera.
        DeviceLost: there is nothing to steer with.
        NoDisplay: no window can be opened.
        MissingExtra: a library isn't installed.
    """

    backend, task = setup.backend, setup.task

    def save(demonstration: Demonstration) -> None:
        check_recording(demonstration, backend.robot)
        check_writable(args.out, args.overwrite)
        save_demonstration(args.out, demonstration)

    def watch(status: Mapping[str, Any]) -> None:
        if args.status is not None:
            append_json_line(args.status, status)

    backend.check_cameras(config.cameras)
    status_lock = None if args.status is None else OutputLock(args.status)
    desk: RecordingDesk | None = None
    try:
        if args.status is not None:
            check_writable(args.status, args.overwrite)
            remove(linked(args.status))
        start_sdl()
        device.connect()
        robot = backend.robot
        # No joint goes faster than it can, so nothing jumps near the edge of what can be reached.
        slowest = float(np.min(robot.velocity_limits)) / backend.rates.control_hz
        config = dataclasses.replace(
            config,
            end_on_success=True,
            controller=ControllerConfig(max_joint_step=slowest),
        )
        session = TeleopSession(backend, task, setup.model, placement, config)
        desk = RecordingDesk(session, device, save, watch)
        with Screen(f"sart record {task.name}") as screen:
            RecordingWindow(desk, screen, str(args.out)).run()
    except KeyboardInterrupt:
        if desk is None or desk.demonstration is None:
            say("sart: the recording was cut off, nothing was written")
        raise
    except NoDisplay as error:
        raise NoDisplay(f"{error}; or let a script steer: --device scripted") from error
    finally:
        device.close()
        if status_lock is not None:
            status_lock.close()
    if desk.demonstration is None:
        raise Discarded("the recording was discarded, nothing was written; record again")
    return desk.demonstration
