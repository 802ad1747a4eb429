"""A page of ours: who may use it, what is taken from it, where it can be served."""

from __future__ import annotations

import http.client
import importlib
import socket

import numpy as np
import pytest

from sart_toolkit.errors import InvalidInput, MissingCapability

viser = pytest.importorskip("viser")
webpage = importlib.import_module("sart_toolkit.record.webpage")


@pytest.fixture
def page(free_port):
    with webpage.WebPage("a page", port=free_port) as page:
        yield page


def connected(page, origin, host="127.0.0.1"):
    """The status with which the page's port answers someone who wants to steer."""
    client = pytest.importorskip("websockets.sync.client")
    exceptions = importlib.import_module("websockets.exceptions")
    port = int(page.url.rpartition(":")[2])
    try:
        # The name that is asked for needn't be where the connection leads.
        with (
            socket.create_connection(("127.0.0.1", port)) as sock,
            client.connect(
                f"ws://{host}:{port}", sock=sock, origin=origin and origin.format(port=port),
                subprotocols=[f"viser-v{viser.__version__}"], max_size=None,
            ) as connection,
        ):  # fmt: skip
            assert connection.recv(timeout=30)
            return 101
    except exceptions.InvalidStatus as error:
        return error.response.status_code


@pytest.mark.parametrize(
    ("origin", "host", "status"),
    [
        ("http://127.0.0.1:{port}", "127.0.0.1", 101),
        ("http://localhost:{port}", "localhost", 101),
        # A program, no browser.
        (None, "127.0.0.1", 101),
        ("http://news.example", "127.0.0.1", 403),
        # Another page of this computer, and one without an address, such as a file.
        ("http://127.0.0.1:9", "127.0.0.1", 403),
        ("null", "127.0.0.1", 403),
        # A name of somebody else's that was made to lead here.
        ("http://news.example:{port}", "news.example", 403),
    ],
)
def test_no_other_page_can_connect(page, origin, host, status):
    assert connected(page, origin, host) == status


def test_nothing_is_served_under_a_foreign_name(page):
    address, _, port = page.url.removeprefix("http://").partition(":")
    for host, status in ((f"{address}:{port}", 200), (f"news.example:{port}", 403)):
        connection = http.client.HTTPConnection(address, int(port), timeout=30)
        connection.request("GET", "/", headers={"Host": host})
        answer = connection.getresponse()
        assert answer.status == status
        assert (b"--host NAME" in answer.read()) == (status == 403)
        connection.close()


def test_the_name_that_is_served_is_known():
    name = socket.gethostname().lower()
    for host in ("robot.lab:8080", f"{name}:8080", "192.0.2.7:8080", "[::1]:8080", "192.0.2.7"):
        assert webpage.asks_itself(host, f"http://{host}", "robot.lab")
    assert not webpage.asks_itself("robot.lab:8080", "http://robot.lab:8080", "127.0.0.1")
    assert not webpage.asks_itself(None, None, "127.0.0.1")


def test_other_servers_of_the_process_are_left_as_they_are(free_port):
    module = importlib.import_module("websockets.asyncio.server")
    before = module.serve
    with webpage.WebPage("a page", port=free_port):
        assert module.serve is before


def test_a_viser_that_can_t_be_guarded_is_refused(monkeypatch, free_port):
    stopped = []

    class Unguarded:
        def __init__(self, *_, **__):
            pass

        def stop(self):
            stopped.append(True)

    monkeypatch.setattr(viser, "ViserServer", Unguarded)
    with pytest.raises(MissingCapability, match="can't be kept from its port; pip install"):
        webpage.WebPage("a page", port=free_port)
    assert stopped


def test_of_values_of_a_slider_that_wait_only_the_last_is_taken(free_port):
    with webpage.WebPage("a page", port=free_port) as page:
        assert page.take(0.0) == []
        for name, value in (("go", 1), ("go", 2), ("add", None), ("add", None), ("go", 3)):
            page.put(name, value)
        assert page.take(0.0) == [("go", 2), ("add", None), ("add", None), ("go", 3)]
    with socket.create_server(("127.0.0.1", free_port)):
        pass


def test_rotations_are_in_the_order_of_viser():
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, -1], [1, 0]]
    assert np.allclose(webpage.wxyz(quarter), [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


@pytest.mark.parametrize(("host", "port"), [("192.0.2.1", 8080), (None, 0), (None, 65536)])
def test_addresses_that_cant_be_had_are_refused(host, port):
    with pytest.raises(InvalidInput, match=r"192\.0\.2\.1:8080: can't serve|--port: expected 1 to"):
        webpage.check_port(host, port)
