"""A page of ours in a browser, served by viser: for computers without a desktop.

The only module that imports viser; it is imported where a page is asked for.
"""

from __future__ import annotations

import base64
import contextlib
import getpass
import html
import io
import ipaddress
import queue
import socket
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Self
from urllib.parse import urlsplit

import numpy as np
from PIL import Image as PillowImage
from scipy.spatial.transform import Rotation

from sart_toolkit.data.records import Image
from sart_toolkit.errors import InvalidInput, MissingCapability, MissingExtra
from sart_toolkit.poses import Array
from sart_toolkit.robots.visuals import DrawnMesh

try:
    import viser
    import websockets.asyncio.server
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

# What our panels are made of.
_PANEL = """
.sart { font-size: 13px; line-height: 1.45; padding: 2px 8px; }
.sart .message { background: #21262f; color: #fff; border-radius: 4px; padding: 6px 9px; }
.sart .now { display: flex; align-items: flex-start; gap: 10px; margin: 8px 0; }
.sart img { flex: none; width: 144px; height: auto; border-radius: 4px; }
.sart td { vertical-align: top; padding: 0 8px 0 0; }
.sart td:first-child { color: #6b7380; }
@media (max-width: 36em) { .sart img { width: 96px; } }
"""
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
            MissingCapability: this version of viser can't be kept from answering other pages.
        """
        self._host, self._port = host or HOST, PORT if port is None else port
        check_port(host, port)
        self._view = np.array([1.0, -1.0, 1.0]), np.zeros(3)
        self._inputs: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self.server = _open_server(self._host, self._port, title)
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
        gui.add_html(_STYLE.format(title=title, css=_PANEL + _NARROW + css, let_go=_LET_GO))
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

    @property
    def watched(self) -> bool:
        """Whether a browser has it open."""
        return bool(self.server.get_clients())

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


def _open_server(host: str, port: int, title: str) -> Any:
    """viser's server, answering no page but its own.

    viser lets whatever page asks connect; a browser says which page does. The one place to refuse
    it before anything is said is where the connection is opened, which viser leaves to websockets.

    Raises:
        MissingCapability: this version of viser opens it otherwise.
    """
    module: Any = websockets.asyncio.server
    serve = module.serve
    guarded = False

    def guarded_serve(*args: Any, process_request: Any, **options: Any) -> Any:
        nonlocal guarded
        guarded = True

        def checked(connection: Any, request: Any) -> Any:
            if not asks_itself(request.headers.get("Host"), request.headers.get("Origin"), host):
                return connection.respond(403, _REFUSED)
            return process_request(connection, request)

        return serve(*args, process_request=checked, **options)

    module.serve = guarded_serve
    try:
        # What it prints would stand among results.
        with contextlib.redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host, port, label=title, verbose=False)
    finally:
        module.serve = serve
    if not guarded:
        server.stop()
        raise MissingCapability(
            f"viser {viser.__version__}: other web pages can't be kept from its port; pip install "
            "'viser==1.1.1'"
        )
    return server


_REFUSED = (
    "Refused: another web page asked, or this computer was called by a name that it doesn't know. "
    "Open the page by its address, or start it with --host NAME.\n"
)


def asks_itself(host: str | None, origin: str | None, served: str) -> bool:
    """Whether a request comes from the page that is asked, or from no page at all.

    Without the second condition a page anywhere could have its own name lead here.

    Args:
        host: what the browser takes this server for, name and port.
        origin: the page that asks, as browsers say it; programs other than browsers say none.
        served: the address that is served, which may be a name.
    """
    if host is None or (origin is not None and urlsplit(origin).netloc != host):
        return False
    name = urlsplit(f"//{host}").hostname or ""
    if name in ("localhost", served.lower(), socket.gethostname().lower()):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def panel(*parts: str) -> str:
    """HTML in the style of our panels."""
    return f'<div class="sart">{"".join(parts)}</div>'


def message(text: str) -> str:
    """Words that stand out, as HTML."""
    return f'<div class="message">{html.escape(text)}</div>'


def facts(lines: Mapping[str, str] | Iterable[Sequence[str]]) -> str:
    """Names and what is to be said of each, as an HTML table."""
    rows = lines.items() if isinstance(lines, Mapping) else lines
    cells = ("".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows)
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


def beside(image: Image | None, text: str) -> str:
    """An image `(H, W, 3)` uint8, if there is one, and HTML to the right of it."""
    shown = ""
    if image is not None:
        data = io.BytesIO()
        PillowImage.fromarray(image).save(data, "PNG")
        shown = f'<img src="data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}">'
    return f'<div class="now">{shown}{text}</div>'


def coloured(text: str, colour: Sequence[float]) -> str:
    """Words in a colour, in [0, 1], as HTML."""
    r, g, b = to_bytes(colour)
    return f'<span style="color:rgb({r},{g},{b})">{html.escape(text)}</span>'


def to_bytes(colour: Sequence[float]) -> tuple[int, int, int]:
    """A colour in [0, 1] as viser takes it."""
    r, g, b = (round(255 * value) for value in colour)
    return r, g, b


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
