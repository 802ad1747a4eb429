"""The dataset formats of the field, by name; each is a `Format` that writes and checks one.

A new format is one file and one line in `FORMATS`; one outside the repository needs no line,
`package.module:NAME` or `path/to/file.py:NAME` names it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sart_toolkit.errors import UnknownName
from sart_toolkit.registry import expect, resolve

if TYPE_CHECKING:
    from sart_toolkit.data.formats.format import Format

FORMATS = {
    "lerobot": "sart_toolkit.data.formats.lerobot:LeRobot",
    "robomimic": "sart_toolkit.data.formats.robomimic:Robomimic",
    "rmb": "sart_toolkit.data.formats.rmb:Rmb",
    "rmb_hdf5": "sart_toolkit.data.formats.rmb:RmbHdf5",
    "zarr": "sart_toolkit.data.formats.zarr:ZarrReplayBuffer",
}


def get_format(format: str | Format | type[Format]) -> Format:
    """The format that a name, a reference or a class names; a format itself is returned.

    Raises:
        UnknownName: there is none, or its class needs arguments; the message says which part is
            wrong.
    """
    from sart_toolkit.data.formats.format import Format

    found = resolve("format", format, FORMATS)
    if isinstance(found, type) and issubclass(found, Format):
        try:
            return found()
        except TypeError as error:
            raise UnknownName(
                f"format {found.__name__}: can't be made without arguments ({error}); name an "
                "instance, or give every argument a default"
            ) from error
    return expect("format", format, found, Format)
