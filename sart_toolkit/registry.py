"""Names into objects, and back: robots, tasks, backends, strategies, policies, devices, formats.

A reference is a name in one of the literal tables, the name of an installed entry point (of the
group `sart_toolkit.robots`, say), `package.module:NAME`, or `path/to/file.py:NAME`. The current
folder is on the path as with `python -m`.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import os
import pkgutil
import sys
import traceback
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from sart_toolkit.errors import InvalidInput, SartError, UnknownName, nearest_name, unknown_name
from sart_toolkit.userfiles import file_of, load_file, local_file

_HOW = "or name your own as package.module:NAME or path/to/file.py:NAME"


def resolve(kind: str, reference: Any, table: Mapping[str, str]) -> Any:
    """What a reference names, imported now and not before; an object that is no text is returned.

    Args:
        kind: what is looked up, such as "task", for messages and entry points.
        reference: the reference, or the object itself.
        table: one of the literal tables, of values "module:attribute".

    Raises:
        UnknownName: no such name, module, file or attribute, or running its code fails; the
            message says which.
    """
    if not isinstance(reference, str):
        return reference
    check_known(kind, reference, table)
    if reference in table:
        return pkgutil.resolve_name(table[reference])
    target = reference
    if reference in (installed := _installed(kind)):
        target = installed[reference].value
    place, _, name = target.rpartition(":")
    found: Any = _module(kind, reference, place)
    for part in name.split("."):
        if not hasattr(found, part):
            near = nearest_name(part, [n for n in dir(found) if not n.startswith("_")])
            raise UnknownName(
                f"{kind} {reference!r}: {place} has no {name!r}; "
                + (f"did you mean {near!r}?" if near else "check the name after the colon")
            )
        found = getattr(found, part)
    return found


def check_known(kind: str, reference: Any, table: Mapping[str, str]) -> None:
    """Return if there is such a name, module or file; nothing of ours or a person's is imported.

    Raises:
        UnknownName: there is not; the message says which part is missing.
    """
    if not isinstance(reference, str) or reference in table:
        return
    installed = _installed(kind)
    if reference in installed:
        return
    place, colon, name = reference.rpartition(":")
    if not colon and reference.endswith(".py"):
        raise UnknownName(f"{kind} {reference!r}: says no name in the file; add :NAME to it")
    if not colon:
        raise UnknownName(f"{unknown_name(kind, reference, [*table, *installed])}, {_HOW}")
    if not name or not place:
        raise UnknownName(
            f"{kind} {reference!r}: expected package.module:NAME or path/to/file.py:NAME"
        )
    if place.endswith(".py"):
        if not local_file(place).is_file():
            raise UnknownName(
                f"{kind} {reference!r}: no file {place} from {Path.cwd()}; "
                "pass a path that exists, or change to its folder"
            )
    else:
        _import_from_here()
        # Of `a.b` only whether there is an `a`: more would run its code.
        top = place.partition(".")[0]
        if not top or (top not in sys.modules and importlib.util.find_spec(top) is None):
            raise UnknownName(
                f"{kind} {reference!r}: no module {place!r}, neither installed nor in {Path.cwd()}"
            )


def expect(kind: str, reference: Any, found: Any, wanted: type[Any]) -> Any:
    """What a reference names, which is to be an instance of `wanted`.

    Raises:
        UnknownName: it is something else.
    """
    if not isinstance(found, wanted):
        raise _wrong(kind, reference, f"a {wanted.__name__}", found)
    return found


def expect_class(kind: str, reference: Any, found: Any, wanted: type[Any]) -> Any:
    """What a reference names, which is to be a subclass of `wanted`.

    Raises:
        UnknownName: it is something else.
    """
    if not (isinstance(found, type) and issubclass(found, wanted)):
        raise _wrong(kind, reference, f"a subclass of {wanted.__name__}", found)
    return found


def reference_to(kind: str, obj: Any, table: Mapping[str, str]) -> str | None:
    """How a file names an object so that `resolve` finds it again; None if there is no way.

    An object has a reference if it is in a table or installed, if it is a class or function at the
    top of a module, or if a module has it under a name. An instance of a class that takes no
    arguments has the reference of its class. A file is named from the current folder.

    Args:
        kind: what it is, as for `resolve`.
        obj: the object, or a reference, which is returned.
        table: the literal table of its kind.
    """
    if isinstance(obj, str):
        return obj
    known = {**table, **{name: entry.value for name, entry in _installed(kind).items()}}
    for name, target in known.items():
        module, _, attribute = target.partition(":")
        if module in sys.modules and getattr(sys.modules[module], attribute, None) is obj:
            return name
    if isinstance(obj, type) or inspect.isfunction(obj):
        at_top = "<locals>" not in obj.__qualname__
        return _reference(obj.__module__, obj.__qualname__) if at_top else None
    # The module that defines it before the script that imports it.
    for module in sorted(sys.modules, key=lambda name: name in ("__main__", "__mp_main__")):
        for name, value in list(getattr(sys.modules[module], "__dict__", {}).items()):
            if value is obj and (reference := _reference(module, name)) is not None:
                return reference
    if not inspect.signature(type(obj)).parameters:
        return reference_to(kind, type(obj), table)
    return None


def lasting_reference(kind: str, obj: Any, table: Mapping[str, str]) -> str:
    """The reference of what a file has to name, see `reference_to`.

    Raises:
        InvalidInput: it has none.
    """
    reference = reference_to(kind, obj, table)
    if reference is None:
        raise InvalidInput(
            f"{kind}: no file could name this {type(obj).__name__}; give it a name at the top of a "
            "module"
        )
    return reference


def _reference(module: str, name: str) -> str | None:
    file = file_of(module)
    if module in ("__main__", "__mp_main__"):
        main = sys.modules[module]
        if main.__spec__ is not None:
            return f"{main.__spec__.name}:{name}"
        if getattr(main, "__file__", None) is None:
            return None
        file = Path(str(main.__file__)).resolve()
    if file is None:
        return f"{module}:{name}"
    here = Path.cwd()
    return f"{file.relative_to(here) if file.is_relative_to(here) else file}:{name}"


def _installed(kind: str) -> dict[str, EntryPoint]:
    plural = f"{kind[:-1]}ies" if kind.endswith("y") else f"{kind}s"
    return {entry.name: entry for entry in entry_points(group=f"sart_toolkit.{plural}")}


def _import_from_here() -> None:
    # Worker processes are given this path, too.
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())


def _module(kind: str, reference: str, place: str) -> ModuleType:
    try:
        if place.endswith(".py"):
            return load_file(Path(place))
        return importlib.import_module(place)
    except SartError:
        raise
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and f"{place}.".startswith(f"{error.name}."):
            raise UnknownName(f"{kind} {reference!r}: no module {error.name!r}") from error
        line = traceback.extract_tb(error.__traceback__)[-1]
        raise UnknownName(
            f"{kind} {reference!r}: running {place} fails in {Path(line.filename).name}, line "
            f"{line.lineno}: {type(error).__name__}: {error}"
        ) from error


def _wrong(kind: str, reference: Any, wanted: str, found: Any) -> UnknownName:
    named = f"{kind} {reference!r}" if isinstance(reference, str) else kind
    what = f"the class {found.__name__}" if isinstance(found, type) else type(found).__name__
    return UnknownName(f"{named}: expected {wanted}, got {what}")
