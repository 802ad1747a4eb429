"""What travels to a worker on another machine and back: objects with the files that they name.

No disk need be shared. Every `Path` in an object that is packed takes along the content of the file
or folder that it names; unpacked, it names a copy. The copies lie under one folder of the process,
each at the path that it has on the machine that sent it (`userfiles.mirror`), so that files which
name each other, as a URDF names its meshes, are found as before. Assets of the toolkit are not
sent: every machine has them. What a worker writes goes to an `Output`; a result that names a file
or folder there takes its content back, and what it names has it by the time the result is there.
"""

from __future__ import annotations

import io
import os
import pickle
import site
import sys
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sart_toolkit.data.assets import assets_folder
from sart_toolkit.data.storage import replacing
from sart_toolkit.errors import InvalidInput, Mismatch
from sart_toolkit.userfiles import copy_of, load_file, mirror, original_path

_PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class Output:
    """A folder that workers write into; on another machine an empty one, of which results name
    parts.
    """

    path: Path


@dataclass(frozen=True)
class Parcel:
    """An object on its way: pickled, with the content of its files by path, and its outputs."""

    pickled: bytes
    files: Mapping[str, Any]
    outputs: frozenset[Path]


def pack(
    value: Any,
    store: Callable[[bytes], Any] = bytes,
    outputs: Collection[Path] | None = None,
) -> Parcel:
    """An object and its files. Other files than those of its paths are what `files_needed()` of an
    object in it says.

    Args:
        value: the object; picklable.
        store: makes of a file's content what the parcel is to hold.
        outputs: only files in these folders go along; all if left out.

    Raises:
        InvalidInput: it names a folder that holds the current folder, which can't be meant.
    """
    buffer = io.BytesIO()
    packer = _Packer(buffer, store, outputs)
    packer.dump(value)
    return Parcel(buffer.getvalue(), packer.files, frozenset(packer.outputs))


def unpack(
    parcel: Parcel,
    fetch: Callable[[Any], bytes] = bytes,
    outputs: Collection[Path] | None = None,
) -> Any:
    """The object in a parcel; the files that it names are on the disk.

    Args:
        parcel: from `pack`.
        fetch: the content that `store` made something of.
        outputs: of a worker's result, the folders that it may write into; each file is written
            whole or not at all, in the order in which the worker made them.

    Raises:
        Mismatch: a result writes elsewhere.
        CannotWrite: the disk refuses.
    """
    for name, stored in parcel.files.items():
        path = copy_of(name)
        if outputs is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(fetch(stored))
            continue
        if not _within(path, outputs):
            raise Mismatch(f"{path}: a worker sent it, but it is in no folder that work goes to")
        with replacing(path) as temporary:
            temporary.write_bytes(fetch(stored))
    return _Unpacker(io.BytesIO(parcel.pickled)).load()


class _Packer(pickle.Pickler):
    def __init__(
        self,
        buffer: io.BytesIO,
        store: Callable[[bytes], Any],
        only: Collection[Path] | None,
    ) -> None:
        super().__init__(buffer, pickle.HIGHEST_PROTOCOL)
        self._store, self._only = store, only
        self.files: dict[str, Any] = {}
        self.outputs: set[Path] = set()

    def persistent_id(self, obj: Any) -> tuple[str, str] | None:
        if isinstance(obj, Output):
            self.outputs.add(original_path(obj.path))
            return "output", str(original_path(obj.path))
        if isinstance(obj, Path):
            return self._place(obj)
        if (needed := getattr(type(obj), "files_needed", None)) is not None:
            for path in needed(obj):
                self._place(path)
        return None

    def _place(self, path: Path) -> tuple[str, str]:
        """How a path is known on the other machine; its content goes along."""
        whole = Path(os.path.abspath(path))
        if whole.is_relative_to(assets_folder()):
            return "asset", str(whole.relative_to(assets_folder()))
        name = original_path(whole)
        sent = self._only is None or _within(name, self._only)
        if not sent or not whole.exists():
            return "elsewhere", str(path)
        if whole.is_dir():
            if Path.cwd().is_relative_to(whole):
                raise InvalidInput(
                    f"{path}: is or holds the current folder, too much to send to a worker; name "
                    "the file or folder that the work needs"
                )
            # The file that says that the others are whole was made last.
            for file in sorted(whole.rglob("*"), key=lambda p: (p.lstat().st_mtime_ns, p)):
                self._take(file)
        self._take(whole)
        return "copy", str(name)

    def _take(self, file: Path) -> None:
        name = str(original_path(file))
        if file.is_file() and name not in self.files:
            self.files[name] = self._store(file.read_bytes())


def _within(path: Path, folders: Iterable[Path]) -> bool:
    return any(path.is_relative_to(folder) for folder in folders)


class _Unpacker(pickle.Unpickler):
    def persistent_load(self, pid: tuple[str, str]) -> Any:
        kind, name = pid
        if kind == "asset":
            return assets_folder() / name
        if kind == "output":
            copy_of(name).mkdir(parents=True, exist_ok=True)
            return Output(copy_of(name))
        return Path(name) if kind == "elsewhere" else copy_of(name)

    def find_class(self, module: str, name: str) -> Any:
        if _home is not None and _home.script and module in ("__main__", "__mp_main__"):
            module = load_file(Path(_home.script)).__name__
        return super().find_class(module, name)


# --- a person's own modules ---------------------------------------------------------------------


def own_modules() -> list[Path]:
    """The files of the modules that were imported from neither Python, packages nor the toolkit."""
    others = [sys.prefix, sys.base_prefix, *site.getsitepackages(), site.getusersitepackages()]
    folders = [_PACKAGE, *map(Path, others)]
    files = [getattr(module, "__file__", None) for module in list(sys.modules.values())]
    paths = {Path(os.path.abspath(file)) for file in files if file is not None}
    # Some modules name a file that isn't there, as torch's `_classes.py`.
    own = (path for path in sorted(paths) if path.suffix == ".py" and path.is_file())
    return [path for path in own if not _within(path, folders)]


def _script() -> str | None:
    found = getattr(sys.modules["__main__"], "__file__", None)
    return None if found is None else os.path.abspath(found)


@dataclass(frozen=True)
class Home:
    """Where the work comes from: what its machine's paths and names of modules refer to."""

    folder: str = field(default_factory=os.getcwd)
    search: tuple[str, ...] = field(
        default_factory=lambda: tuple(os.path.abspath(entry) for entry in sys.path)
    )
    script: str | None = field(default_factory=_script)

    def files_needed(self) -> list[Path]:
        """The person's own modules."""
        return own_modules()

    def settle(self) -> None:
        """Let this process, which has copies of the files, find them as that machine does."""
        global _home
        _home = self
        folder = copy_of(self.folder)
        folder.mkdir(parents=True, exist_ok=True)
        os.chdir(folder)
        sys.path[:0] = [str(copy_of(entry)) for entry in self.search if copy_of(entry).is_dir()]


_home: Home | None = None


def arrive(home: Parcel, root: Path, fetch: Callable[[Any], bytes]) -> None:
    """Prepare this process for parcels from a `Home`'s machine; files are to lie in `root`."""
    mirror(root.resolve())
    unpack(home, fetch).settle()
