"""What verbs that serve a page have in common: `--web`, `--host`, `--port`."""

from __future__ import annotations

import importlib
from typing import Protocol

from sart_toolkit.errors import InvalidInput


class Served(Protocol):
    """The options of a verb that serves a page."""

    @property
    def web(self) -> bool: ...
    @property
    def host(self) -> str | None: ...
    @property
    def port(self) -> int | None: ...


def check_web(args: Served, instead: str, needed: bool = True) -> None:
    """Refuse what can't be served, before anything is read.

    Args:
        args: the verb's options.
        instead: the option given that asks for something else than a page, if any.
        needed: whether the page is what the verb is for; else it goes on where the address can't be
            had.

    Raises:
        InvalidInput: options that exclude each other, or an address that can't be had.
        MissingExtra: viser isn't installed.
    """
    if not args.web:
        for name, value in (("--host", args.host), ("--port", args.port)):
            if value is not None:
                raise InvalidInput(f"{name}: says where the page of --web is; add --web")
        return
    if instead:
        raise InvalidInput(f"--web and {instead}: choose one of them")
    webpage = importlib.import_module("sart_toolkit.record.webpage")
    if needed:
        webpage.check_port(args.host, args.port)
