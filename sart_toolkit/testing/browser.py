"""A browser with hands: Chromium without a window, steered by its own protocol.

For tests of pages and for the programs that make the documentation's images. Needs the extra `web`.
"""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sart_toolkit.errors import MissingExtra

_NAMES = ("chromium", "chromium-browser", "google-chrome")
# Mesa's software renderer takes a third of the time of Chromium's own.
_FLAGS = (
    "--headless=new", "--no-sandbox", "--remote-debugging-port=0", "--hide-scrollbars",
    "--no-first-run", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist",
)  # fmt: skip
# What stands at the top of the panels of the toolkit's pages.
MESSAGE = ".sart .message"
_CENTRE = """(() => {
  const found = Array.from(document.querySelectorAll(%s)).filter(e => %s)[%d];
  if (!found) return null;
  found.scrollIntoView({block: 'center'});
  const box = found.getBoundingClientRect();
  return [box.x + box.width / 2, box.y + box.height / 2];
})()"""


def find_browser() -> str:
    """The program.

    Raises:
        MissingExtra: there is none.
    """
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        raise MissingExtra(f"no browser: none of {', '.join(_NAMES)} found; apt install chromium")
    return found


class Browser:
    """One page of a browser, which is ended when the `with` block ends."""

    def __init__(self, width: int = 1400, height: int = 900) -> None:
        """A page of `width` by `height` pixels.

        Raises:
            MissingExtra: no Chromium, or the extra `web` isn't installed.
        """
        program = find_browser()
        try:
            from websockets.sync.client import connect
        except ModuleNotFoundError as error:
            raise MissingExtra("websockets: pip install 'sart_toolkit[web]'") from error
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [program, *_FLAGS, f"--user-data-dir={self._folder.name}", "about:blank"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        told = Path(self._folder.name) / "DevToolsActivePort"
        self._wait(lambda: told.exists() and told.read_text().count("\n") > 0)
        with urllib.request.urlopen(f"http://127.0.0.1:{told.read_text().split()[0]}/json") as said:
            page = next(tab for tab in json.load(said) if tab["type"] == "page")
        self._socket = connect(page["webSocketDebuggerUrl"], max_size=None)
        self._numbers = itertools.count(1)
        self.call("Page.enable")
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait()
        self._folder.cleanup()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer to a call of the Chrome DevTools Protocol."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return dict(answer["result"])

    def open(self, url: str) -> None:
        """Go to a page."""
        self.call("Page.navigate", url=url)

    def open_page(self, url: str) -> None:
        """Go to one of the toolkit's own pages, and wait until its panel says something."""
        self.open(url)
        self.wait_for(f"!!document.querySelector('{MESSAGE}')")

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression."""
        answer = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in answer:
            raise RuntimeError(str(answer["exceptionDetails"]))
        return answer["result"].get("value")

    def wait_for(self, script: str, timeout_s: float = 60.0) -> Any:
        """The value of an expression, once it is something that counts as true.

        Raises:
            TimeoutError: it wasn't within `timeout_s` [s].
        """
        return self._wait(lambda: self.run(script), timeout_s)

    def text(self, selector: str) -> str:
        """What the first element that a CSS selector finds shows, empty where there is none."""
        found = self.run(f"document.querySelector({json.dumps(selector)})?.innerText")
        return str(found or "")

    def key(self, name: str, code: str = "") -> None:
        """Press and let go of a key by its JavaScript name (`a`, `ArrowUp`)."""
        code = code or (f"Key{name.upper()}" if name.isalpha() and len(name) == 1 else name)
        for kind in ("rawKeyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=name, code=code)

    def click(self, selector: str, text: str = "") -> None:
        """Click in the middle of the first element that a CSS selector finds, with that text."""
        self.drag(self.centre(selector, text), (0.0, 0.0))

    def centre(self, selector: str, text: str = "", index: int = 0) -> tuple[float, float]:
        """Where such an element is, of several the `index`-th, once it stays there [pixels]."""
        which = f"e.innerText.trim() === {json.dumps(text)}" if text else "true"
        script = _CENTRE % (json.dumps(selector), which, index)
        before, now = None, self.wait_for(script)
        while now != before:
            time.sleep(0.3)
            before, now = now, self.wait_for(script)
        return now[0], now[1]

    def drag(self, start: tuple[float, float], by: tuple[float, float], steps: int = 8) -> None:
        """Press the mouse at a point, move it, and let go; without a way to move, click."""
        x, y = start
        self._mouse("mouseMoved", x, y, 0)
        self._mouse("mousePressed", x, y, 1)
        if any(by):
            for i in range(1, steps + 1):
                self._mouse("mouseMoved", x + by[0] * i / steps, y + by[1] * i / steps, 1)
                time.sleep(0.03)
        self._mouse("mouseReleased", x + by[0], y + by[1], 0)

    def _mouse(self, kind: str, x: float, y: float, buttons: int) -> None:
        button = "none" if kind == "mouseMoved" and not buttons else "left"
        self.call(
            "Input.dispatchMouseEvent",
            type=kind, x=x, y=y, button=button, buttons=buttons, clickCount=1,
        )  # fmt: skip

    def screenshot(self, path: Path) -> None:
        """Write the page as it looks to a PNG file."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))

    @staticmethod
    def _wait(condition: Callable[[], Any], timeout_s: float = 60.0) -> Any:
        deadline = time.monotonic() + timeout_s
        while not (found := condition()):
            if time.monotonic() > deadline:
                raise TimeoutError(f"not within {timeout_s:g} s")
            time.sleep(0.05)
        return found
