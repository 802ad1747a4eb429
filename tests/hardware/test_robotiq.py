"""The gripper's driver against a server that speaks its protocol on loopback."""

from __future__ import annotations

import dataclasses
import socket
import threading

import pytest

from sart_toolkit.errors import InvalidInput
from sart_toolkit.hardware.robotiq import RobotiqSocket
from sart_toolkit.testing.emulated import EmulatedWorld, Emulation

from .conftest import EMPTY


@pytest.fixture(scope="module")
def asleep(robot):
    """A world whose gripper hasn't been activated."""
    emulation = dataclasses.replace(Emulation(), activated=False)
    world = EmulatedWorld(robot, EMPTY, 32, emulation)
    yield world
    world.close()


@pytest.fixture
def gripper(world):
    options = world.cell().gripper.options
    gripper = RobotiqSocket(**options)
    gripper.connect()
    yield gripper
    gripper.disconnect()


def test_it_goes_where_it_is_sent(gripper, world):
    gripper.start()
    for target in (1.0, 0.3, 0.0):
        gripper.move(target)
        world.advance(1.5)
        assert gripper.position() == pytest.approx(target, abs=0.02)


def test_activation_goes_through_the_states_of_the_manual(asleep):
    gripper = RobotiqSocket(**asleep.cell().gripper.options)
    gripper.connect()
    asleep.advance(0.1)
    gripper.move(1.0)
    asleep.advance(1.0)
    assert gripper.position() < 0.02  # Not activated, it doesn't move.
    gripper.start()
    gripper.move(1.0)
    asleep.advance(1.5)
    assert gripper.position() > 0.97
    gripper.disconnect()


@pytest.fixture
def answering():
    """Makes a gripper whose server gives fixed bytes, in pieces, to any line."""
    servers = []

    def make(*pieces: bytes) -> RobotiqSocket:
        server = socket.create_server(("127.0.0.1", 0))
        servers.append(server)

        def serve() -> None:
            connection, _ = server.accept()
            with connection:
                while connection.recv(100):
                    for piece in pieces:
                        connection.sendall(piece)

        threading.Thread(target=serve, daemon=True).start()
        gripper = RobotiqSocket("127.0.0.1", server.getsockname()[1], timeout=0.2)
        gripper.connect()
        return gripper

    yield make
    for server in servers:
        server.close()


def test_an_answer_in_pieces_and_without_a_line_s_end_is_understood(answering):
    gripper = answering(b"PO", b"S 3")
    assert gripper.position() == 0.0
    gripper.disconnect()


@pytest.mark.parametrize(
    ("answer", "does", "says"),
    [
        (b"?\n", lambda g: g.move(0.5), "refuses SET POS 116 .* answers '\\?'"),
        (b"STA 3\n", lambda g: g.position(), "answers GET POS with 'STA 3'"),
        (b"POS x\n", lambda g: g.position(), "answers GET POS with 'POS x'"),
        (b"", lambda g: g.position(), "doesn't answer .*timed out"),
    ],
)
def test_what_isn_t_an_answer_is_an_error_that_says_what_came(answering, answer, does, says):
    gripper = answering(answer)
    with pytest.raises(ConnectionError, match=says):
        does(gripper)
    gripper.disconnect()


def test_a_server_that_hangs_up_is_an_error(gripper, world):
    gripper.position()  # By now the server has it among those that are connected.
    world.inject("gripper_lost", world.time)
    world.advance(0.01)
    with pytest.raises(ConnectionError, match="doesn't answer"):
        gripper.position()


@pytest.mark.parametrize("options", [{"force": 256}, {"speed": 1.5}, {"open_position": 228}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(InvalidInput, match="expected"):
        RobotiqSocket("host", **options)
