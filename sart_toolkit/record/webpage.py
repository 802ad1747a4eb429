"""A page of ours in a browser, served by viser: for computers without a desktop.

The only module that imports viser; it is imported where a page is asked for.
"""

from __future__ import annotations

import contextlib
import getpass
import io
import queue
import socket
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from sart_toolkit.errors import InvalidInput, MissingExtra
from sart_toolkit.poses import Array
from sart_toolkit.robots.visuals import DrawnMesh

try:
    import viser
except ModuleNotFoundError as error:
    raise MissingExtra(
        "the page in a browser needs viser: pip install 'sart_toolkit[web]', or work without --web"
    ) from error

HOST, PORT = "127.0.0.1", 8080
# The input that follows once a slider or handle is let go, or a number typed.
LET_GO = "let go"
_LET_GO = "F24"
_BACKGROUND = 237
# The camera's vertical opening [rad]; by how much it is farther off in a narrow window.
_FOV, _FARTHER = np.deg2rad(50.0), 1.8
# viser's names of keys, and modifiers; other keys are called as they are.
_HOTKEYS: dict[str, tuple[tuple[str, str | None], ...]] = {
    "Right": (("arrowright", None),), "Left": (("arrowleft", None),),
    "Up": (("arrowup", None),), "Down": (("arrowdown", None),),
    "Page Down": (("pagedown", None),), "Page Up": (("pageup", None),),
    # On a keyboard with a key of its own, with Shift, and without having to press Shift.
    "+": (("[plus]", None), ("[plus]", "shift"), ("=", None)),
}  # fmt: skip
# What viser's page lacks. Arrows and letters steer its camera, here they are the page's keys; and
# a button or slider that was used must not take the keys that follow for itself. Scripts in an
# HTML element don't run, what an element is told to do on loading does. That the mouse is let go or
# a typed number left isn't among what viser tells: it is a key that no keyboard has, a moment later
# than the last value.
_STYLE = """<style onload="
document.title = '{title}';
const typed = e => e instanceof HTMLInputElement;
if (!window.ownKeys) {{
  window.ownKeys = true;
  document.documentElement.addEventListener('keydown', e => typed(e.target) || e.stopPropagation());
  const letGo = () => setTimeout(() => document.documentElement.dispatchEvent(
    new KeyboardEvent('keydown', {{key: '{let_go}'}})), 250);
  document.addEventListener('keydown', e => {{
    if (e.key === 'Enter' && typed(e.target)) e.target.blur();
  }}, true);
  document.addEventListener('focusout', e => typed(e.target) && letGo());
  document.addEventListener('pointerup', () => setTimeout(() => {{
    const used = document.activeElement;
    if (used && !typed(used)) used.blur();
    letGo();
  }}), true);
}}
">{css}</style>"""

# On a telephone viser's panel is a sheet at the bottom, neither wide enough nor low enough.
_NARROW = """
@media (max-width: 36em) {
  .mantine-Paper-root { width: 100% !important; max-height: 50% !important; }
  .mantine-Paper-root [style*="width: 20em"] { width: 100% !important; }
}
"""


class WebPage:
    """viser's server on one port, and what was done in the browser, in that order.

    Attributes:
        server: viser's, to draw with.
        url: where the page is, as seen from this computer.
    """

    def __init__(self, title: str, css: str = "", host: str | None = None, port: int | None = None):
        """Serve an empty page.

        Args:
            title: of the browser's tab and of the panel.
            css: style of the page's own elements.
            host: the address at which to be reached; this computer only if left out.
            port: 8080 if left out.

        Raises:
            InvalidInput: the address isn't this computer's, or the port is taken.
        """
        self._host, self._port = host or HOST, PORT if port is None else port
        check_port(host, port)
        self._view = np.array([1.0, -1.0, 1.0]), np.zeros(3)
        self._inputs: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        # What it prints would stand among results.
        with contextlib.redirect_stdout(io.StringIO()):
            self.server = viser.ViserServer(self._host, self._port, label=title, verbose=False)
        self.url = f"http://{self._host}:{self._port}"
        gui, scene = self.server.gui, self.server.scene
        gui.configure_theme(
            control_width="large",
            show_logo=False,
            show_share_button=False,
            brand_color=(44, 84, 120),
        )
        scene.configure_default_lights(cast_shadow=False)
        scene.set_background_image(np.full((1, 1, 3), _BACKGROUND, np.uint8), "png")
        gui.add_html(_STYLE.format(title=title, css=_NARROW + css, let_go=_LET_GO))
        self.add_key(_LET_GO, LET_GO, "what was dragged or typed counts")
        self.server.on_client_connect(self._aim)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop serving."""
        self.server.flush()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    @property
    def how_to_open(self) -> str:
        """What to do, on this computer and on others, to see the page."""
        said = f"open {self.url} in a browser; Ctrl-C ends this"
        if _is_loopback(self._host):
            at = f"{getpass.getuser()}@{socket.gethostname()}"
            tunnel = f"ssh -N -L {self._port}:{self._host}:{self._port} {at}"
            return f"{said}\nfrom another computer: type there `{tunnel}`, then open the same"
        return (
            f"{said}\nwarning: whoever reaches {self._host}:{self._port} can use it without a "
            "password; leave out --host to let in only users of this computer"
        )

    # --- inputs ---------------------------------------------------------------------------------

    def take(self, timeout_s: float) -> list[tuple[str, Any]]:
        """What was done since the last call, by name and value, waited for until something is.

        Of values that one thing took one after the other only the last is there.
        """
        found: list[tuple[str, Any]] = []
        with contextlib.suppress(queue.Empty):
            found.append(
                self._inputs.get(timeout=timeout_s) if timeout_s else self._inputs.get(False)
            )
            while True:
                name, value = self._inputs.get(False)
                if value is not None and found[-1][0] == name:
                    found.pop()
                found.append((name, value))
        return found

    @property
    def waiting(self) -> bool:
        """Whether something was done that isn't taken yet."""
        return not self._inputs.empty()

    def put(self, name: str, value: Any = None) -> None:
        """Have an input taken; from any thread."""
        self._inputs.put((name, value))

    def add_key(self, key: str, name: str, text: str) -> None:
        """Have the input `name` taken when a key is pressed; `text` says what it does."""
        for hotkey, modifier in _HOTKEYS.get(key, ((key.lower() if key[1:] else key, None),)):
            gui: Any = self.server.gui
            command = gui.add_command(text, description=name, hotkey=hotkey, modifier=modifier)

            # A coroutine keeps the order; else viser calls it on some thread.
            @command.on_trigger
            async def _(_: object) -> None:
                self.put(name)

    def add_buttons(self, label: str, names: Sequence[str]) -> None:
        """Buttons in a row, each of which is an input of its name."""
        group: Any = self.server.gui.add_button_group(label, names)

        @group.on_click
        async def _(event: Any) -> None:
            self.put(event.target.value)

    def add_slider(self, label: str, name: str, low: float, high: float, step: float) -> Any:
        """A slider whose values, where a person sets them, are inputs called `name`."""
        slider: Any = self.server.gui.add_slider(label, low, high, step, low)

        @slider.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                self.put(name, event.target.value)

        return slider

    # --- drawing --------------------------------------------------------------------------------

    def add_mesh(self, name: str, mesh: DrawnMesh) -> None:
        """A mesh in the frame of the node that its name is under."""
        self.server.scene.add_mesh_simple(
            name,
            mesh.vertices,
            mesh.triangles,
            color=mesh.rgba[:3],
            opacity=mesh.rgba[3] if mesh.rgba[3] < 1.0 else None,
            cast_shadow=False,
            receive_shadow=False,
        )

    def look(self, eye: Array, at: Array) -> None:
        """Show all browsers the scene from `eye` towards `at`, points of the world `(3,)` [m]."""
        self._view = eye, at
        first = self.server.initial_camera
        first.position, first.look_at, first.up, first.fov = eye, at, (0.0, 0.0, 1.0), _FOV
        for client in self.server.get_clients().values():
            self._aim(client)

    def _aim(self, client: Any) -> None:
        eye, at = self._view
        camera = client.camera
        if camera.aspect < 1.0:
            # A narrow window's panel hides its lower half: from farther off, what is looked at is
            # in the middle of the upper.
            back = _FARTHER * (eye - at)
            down = np.tan(_FOV / 2) / 2 * np.linalg.norm(back) * np.array([0.0, 0.0, 1.0])
            eye, at = at + back - down, at - down
        with client.atomic():
            camera.position, camera.look_at = eye, at


def place(node: Any, T: Array) -> None:
    """Put a node of viser's at a pose `(4, 4)` in the frame of the node above it."""
    node.position, node.wxyz = T[:3, 3], wxyz(T)


def wxyz(T: Array) -> Array:
    """The rotations of poses `(..., 4, 4)` as viser takes them, `(..., 4)`."""
    return np.array(Rotation.from_matrix(T[..., :3, :3]).as_quat(scalar_first=True))


def check_port(host: str | None, port: int | None) -> None:
    """Return if a page can be served there.

    Raises:
        InvalidInput: the address isn't this computer's, or the port is taken.
    """
    host, port = host or HOST, PORT if port is None else port
    if not 0 < port < 65536:
        raise InvalidInput(f"--port: expected 1 to 65535, got {port}")
    try:
        # viser itself would take the next one that is free, or look for one for ever.
        socket.create_server((host, port)).close()
    except OSError as error:
        raise InvalidInput(
            f"{host}:{port}: can't serve a page there ({error.strerror or error}); choose another "
            "--port where another program has it, and as --host an address of this computer"
        ) from error


def _is_loopback(host: str) -> bool:
    return socket.gethostbyname(host).startswith("127.")
