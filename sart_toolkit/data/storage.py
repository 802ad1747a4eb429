"""The only place that reads or writes files of ours: HDF5 for arrays, JSON for the rest.

Every write goes to a temporary name beside its target, is flushed to disk and then renamed, so a
reader sees the old file or the whole new one. What is written carries a SHA-256 that is compared
before anything of it is used; it finds damage and mix-ups, not someone who computes it anew. What
an annotation holds is a person's to edit, so it alone has none; a dataset and a skill have it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import glob
import hashlib
import io
import json
import lzma
import os
import re
import shutil
import stat
import tempfile
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import h5py
import msgspec
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from sart_toolkit.data.records import (
    Annotation,
    CameraFrame,
    CameraRecord,
    Demonstration,
    Episode,
    PrecisionSphere,
    Provenance,
    Steps,
    digest,
)
from sart_toolkit.data.schemas import AnnotationFile, Matrix, References
from sart_toolkit.data.structure import DEFLATE_LEVEL, inspect
from sart_toolkit.errors import (
    BrokenFile,
    CannotWrite,
    InvalidInput,
    MissingFile,
    OutputExists,
    SartError,
)

SCHEMA_VERSION = 6
# Its type information has it as an exception, not as a class of these.
_IsalError: type[Exception] = isal_zlib.error  # type: ignore[assignment]

# The largest files that are read as JSON, and as lines of JSON.
MAX_JSON_BYTES = 16 * 2**20
MAX_LINES_BYTES = 256 * 2**20
_MAX_DEPTH = 50

# As `replacing` names them, with the eight characters of `mkstemp`.
_TEMPORARY = re.compile(r"\..+\.[a-z0-9_]{8}(\.(?!lock)\w+)?")


# --- writing safely -----------------------------------------------------------------------------


@contextlib.contextmanager
def _cannot_write(path: Path) -> Iterator[None]:
    try:
        yield
    except SartError:
        raise
    except PermissionError as error:
        raise CannotWrite(
            f"{path}: permission denied; choose another --out or fix its permissions"
        ) from error
    except OSError as error:
        raise CannotWrite(
            f"{path}: {error.strerror or error}; nothing was replaced, make "
            "room or choose another --out"
        ) from error


def linked(path: Path) -> Path:
    """The absolute path that is written where `path` is: links are followed, not replaced.

    Raises:
        CannotWrite: a link leads in a circle.
    """
    found = Path(os.path.realpath(path))
    if os.path.islink(found):
        raise CannotWrite(f"{path}: is a link to itself; remove it or choose another --out")
    return found


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that becomes `path` when the block ends without an error.

    Where `path` is a link, what it points to is replaced and the link stays.

    Raises:
        CannotWrite: the disk refuses; `path` is as it was.
    """
    temporary: Path | None = None
    with _cannot_write(path):
        path, real = Path(path), linked(path)
        real.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            dir=real.parent, prefix=f".{path.stem}.", suffix=path.suffix
        )
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            umask = os.umask(0)
            os.umask(umask)
            os.chmod(temporary, 0o666 & ~umask)
            os.replace(temporary, real)
        finally:
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing_directory(path: Path, mark: str, overwrite: bool = False) -> Iterator[Path]:
    """An empty directory beside `path` that becomes `path` when the block ends without an error.

    What a process that was killed has left of an earlier one is removed.

    Args:
        path: the directory; no other process can write it meanwhile.
        mark: the file that such a directory holds; one without it is never replaced.
        overwrite: whether such a directory may be replaced.

    Raises:
        OutputExists: it is there and may not be replaced.
        CannotWrite: the disk refuses, or another process is at work on it; `path` is as it was.
    """
    path = Path(path)
    with OutputLock(path):
        check_replaceable(path, mark, overwrite)
        with _cannot_write(path):
            real = linked(path)
            remove_left(real.parent, f".{real.name}.", "")
            temporary = Path(tempfile.mkdtemp(dir=real.parent, prefix=f".{real.name}."))
            try:
                yield temporary
                for inside in temporary.rglob("*"):
                    if inside.is_file():
                        with open(inside, "rb+") as file:
                            os.fsync(file.fileno())
                umask = os.umask(0)
                os.umask(umask)
                os.chmod(temporary, 0o777 & ~umask)
                if real.exists():
                    # Out of the way first: removing it takes time, renaming none.
                    old = Path(tempfile.mkdtemp(dir=real.parent, prefix=f".{real.name}."))
                    os.replace(real, old)
                    os.replace(temporary, real)
                    shutil.rmtree(old)
                else:
                    os.replace(temporary, real)
            finally:
                shutil.rmtree(temporary, ignore_errors=True)


def remove_left(directory: Path, prefix: str, suffix: str) -> None:
    """Remove what a process that was killed has left of writing something large.

    Only who holds the lock of that output can know that nobody is writing it any more.

    Args:
        directory: where it is.
        prefix, suffix: what stands before and after the characters drawn at random.

    Raises:
        CannotWrite: the disk refuses.
    """
    for left in directory.glob(f"{glob.escape(prefix)}*{glob.escape(suffix)}"):
        if re.fullmatch(r"[a-z0-9_]{8}", left.name[len(prefix) : len(left.name) - len(suffix)]):
            remove(left)


def link_file(source: Path, target: Path) -> None:
    """Have a file by another name too, or where the disk can't do that, copied.

    Raises:
        CannotWrite: the disk refuses.
    """
    remove(target)
    with _cannot_write(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(os.path.realpath(source), target)
            return
        except OSError:
            # Across disks, and where a file has as many names as it can have.
            pass
    with replacing(target) as temporary:
        shutil.copyfile(source, temporary)


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all.

    Raises:
        CannotWrite: the disk refuses.
    """
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Mapping[str, Any], sealed: bool = True) -> None:
    """Write a JSON object, with its `schema_version` and a hash of it, whole or not at all.

    Args:
        path: the file.
        value: what it is to hold.
        sealed: whether it has the hash; not where a person may edit it.

    Raises:
        CannotWrite: the disk refuses.
        InvalidInput: a number is NaN or infinite, or a value isn't JSON.
    """
    value = {"schema_version": SCHEMA_VERSION, **value}
    try:
        # Names become text, which sorts otherwise than numbers.
        value = json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"{path}: can't be written as JSON: {error}") from error
    write_text(path, json.dumps(with_seal(value) if sealed else value, indent=2) + "\n")


def with_seal(value: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON object with the hash of all else in it, as `read_json` expects it."""
    rest = {name: inside for name, inside in value.items() if name != "sha256"}
    return {**rest, "sha256": digest(rest)}


def read_json(path: Path, schema: Any, sealed: bool = True) -> dict[str, Any]:
    """The JSON object in a file of ours, without its `schema_version` and hash.

    Args:
        path: the file.
        schema: what its values must be, of `data.schemas`, or another type of msgspec's.
        sealed: whether it has a hash.

    Raises:
        MissingFile: no such file.
        BrokenFile: too large, not a JSON object, of a schema this version doesn't know, changed
            since it was written, or a value is missing or of another type.
    """
    path = _existing(path)
    value = parse_json(_content(path, MAX_JSON_BYTES), str(path))
    if not isinstance(value, dict):
        raise BrokenFile(f"{path}: expected a JSON object, got {type(value).__name__}")
    check_schema(path, value.get("schema_version"))
    if sealed and value.get("sha256") != with_seal(value)["sha256"]:
        raise BrokenFile(f"{path}: content differs from its hash; restore a copy or make it again")
    del value["schema_version"]
    if sealed:
        del value["sha256"]
    check_values(value, schema, str(path))
    return value


def check_values(value: Any, schema: Any, what: str) -> Any:
    """JSON values as the type that they must be.

    Raises:
        BrokenFile: a value is missing or of another type; the message says where.
    """
    try:
        return msgspec.convert(value, schema)
    except (msgspec.ValidationError, RecursionError) as error:
        raise BrokenFile(
            f"{what}: a field is missing or wrong ({error}); restore a copy or make it again"
        ) from error


def parse_json(content: bytes, what: str) -> Any:
    """The value in strict JSON: no name twice, finite numbers, whole ones of 64 bits, real text.

    Raises:
        BrokenFile: it is something else; the message begins with `what`.
    """
    try:
        value = msgspec.json.decode(content)
        json.loads(content, object_pairs_hook=_once_each, parse_int=_whole)
        _check_depth(value, _MAX_DEPTH)
    except (ValueError, RecursionError, msgspec.MsgspecError) as error:
        raise BrokenFile(
            f"{what}: not readable as JSON ({error}); fix it or make it again"
        ) from error
    return value


def _once_each(pairs: list[tuple[str, Any]]) -> None:
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{twice[:40]!r} stands there twice")


def _check_depth(value: Any, left: int) -> None:
    if left == 0:
        raise ValueError(f"nested more than {_MAX_DEPTH} deep")
    inside = value.values() if isinstance(value, dict) else value
    if isinstance(value, dict | list):
        for deeper in inside:
            _check_depth(deeper, left - 1)


def _whole(digits: str) -> None:
    # Ten times within 64 bits with a sign.
    if len(digits) > 18:
        raise ValueError(f"a whole number of {len(digits)} digits")


def _content(path: Path, limit: int) -> bytes:
    """All of a file that is no larger than the limit."""
    try:
        n = path.stat().st_size
        if n > limit:
            raise BrokenFile(
                f"{path}: has {n / 2**20:.0f} MiB, at most {limit / 2**20:.0f} are read; "
                "check that it is the file you mean"
            )
        return path.read_bytes()
    except SartError:
        raise
    except OSError as error:
        raise BrokenFile(f"{path}: {error.strerror}; check the path and its permissions") from error


# A line ends with the beginning of the SHA-256 of all before.
_LINE_SEAL = re.compile(rb'(?:, )?"check": "([0-9a-f]{16})"\}\Z')


def _to_line(row: Mapping[str, Any]) -> bytes:
    text = json.dumps(row, allow_nan=False).encode()
    check = hashlib.sha256(text).hexdigest()[:16]
    return text[:-1] + (b", " if row else b"") + f'"check": "{check}"}}\n'.encode()


def _of_line(line: bytes) -> dict[str, Any] | None:
    """The row that `_to_line` made a line of; None if it is no such line."""
    seal = _LINE_SEAL.search(line)
    if seal is None:
        return None
    text = line[: seal.start()] + b"}"
    if hashlib.sha256(text).hexdigest()[:16].encode() != seal[1]:
        return None
    try:
        row = msgspec.json.decode(text)
    except (ValueError, RecursionError, msgspec.MsgspecError):
        return None
    return row if isinstance(row, dict) else None


def append_json_line(path: Path, value: Mapping[str, Any]) -> None:
    """Add a JSON object as one line to the end of a file, made if needed.

    Raises:
        CannotWrite: the disk refuses.
    """
    with _cannot_write(Path(path)), open(path, "ab+") as file:
        _drop_cut_line(file)
        file.write(_to_line(value))


def write_json_lines(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write JSON objects as lines, the first with a `schema_version`, whole or not at all.

    Args:
        path: the file.
        rows: what the lines are to hold, one in memory at a time.

    Raises:
        CannotWrite: the disk refuses.
    """
    head: Mapping[str, Any] = {"schema_version": SCHEMA_VERSION}
    with replacing(path) as temporary, open(temporary, "wb") as file:
        for row in rows:
            file.write(_to_line({**head, **row}))
            head = {}


def _drop_cut_line(file: io.BufferedRandom | io.FileIO) -> None:
    """Cut off what a crash left of a last line."""
    end = file.seek(0, os.SEEK_END)
    file.seek(max(0, end - 1))
    if end and file.read() != b"\n":
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """The JSON objects in a file of lines; none if it isn't there, a last line cut short left out.

    Raises:
        BrokenFile: a line was changed since it was written, or the file is too large.
    """
    path = Path(path)
    if not path.exists():
        return []
    lines = _content(_existing(path), MAX_LINES_BYTES).split(b"\n")[:-1]
    rows = []
    for i, line in enumerate(lines, 1):
        row = _of_line(line)
        if row is None:
            if i == 1 and (found := re.match(rb'\{"schema_version": ?(\d{1,9})\b', line)):
                check_schema(path, int(found[1]))
            raise BrokenFile(
                f"{path}: line {i} differs from its hash; restore a copy, or remove the file and "
                "make it again"
            )
        rows.append(row)
    return rows


class OutputLock:
    """The right to write an output, a file or directory, that no other process has meanwhile.

    It is an advisory lock on `.NAME.lock` beside the output, so neither replacing nor clearing the
    output touches it; the kernel releases it when the process ends, however that happens.
    """

    def __init__(self, path: Path, nested: bool = False) -> None:
        """Take the lock.

        Args:
            path: the output; where it is a link, what it points to.
            nested: whether it is enough that this process holds the lock already, for a part of
                what the holder does.

        Raises:
            CannotWrite: another process has it, or this one has and `nested` is false; or the
                disk refuses.
        """
        self.path = Path(path)
        self._real = real = linked(path)
        self._lock = real.with_name(f".{real.name}.lock")
        self._descriptor: int | None = None
        self._made: list[Path] = []
        if nested and real in _HELD:
            return
        check_writable(path, overwrite=True)
        with _cannot_write(self.path):
            try:
                while self._descriptor is None:
                    self._descriptor = self._taken()
            except BaseException:
                self._remove_made()
                raise
        _HELD.add(real)

    def _taken(self) -> int | None:
        """A descriptor that holds the lock; None where its last holder has just removed the file.

        Raises:
            CannotWrite: another process has it.
        """
        missing = [p for p in self._lock.parents if not p.exists()]
        self._made += missing
        self._lock.parent.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(self._lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except FileNotFoundError:
            return None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(descriptor), os.stat(self._lock)):
                return descriptor
        except FileNotFoundError:
            pass
        except BlockingIOError:
            os.close(descriptor)
            raise CannotWrite(
                f"{self.path}: another process is using it; end that one first, or choose another "
                "--out"
            ) from None
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
        return None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let others have it."""
        if self._descriptor is None:
            return
        descriptor, self._descriptor = self._descriptor, None
        _HELD.discard(self._real)
        # Removed while it is held: who opened it meanwhile finds that it is no longer the file.
        with contextlib.suppress(OSError):
            self._lock.unlink()
        os.close(descriptor)
        self._remove_made()

    def _remove_made(self) -> None:
        """Remove the directories that only the lock was in."""
        for directory in self._made:
            try:
                directory.rmdir()
            except OSError:
                return


_HELD: set[Path] = set()


class Journal:
    """Rows appended to a file of lines, each on the disk when `append` returns.

    One process at a time has it. A row that a crash cut short is dropped when it is opened again.

    Attributes:
        path: the file.
        rows: what it holds.
    """

    def __init__(self, path: Path, lock: OutputLock | None = None, read: bool = True) -> None:
        """Open a journal, made if needed.

        Args:
            path: the file.
            lock: of the output that it is a journal of, released when the journal is closed; the
                file's own if left out.
            read: whether its rows matter; not where they are dropped next.

        Raises:
            CannotWrite: the disk refuses, or another process has it open.
            BrokenFile: a row was changed since it was written.
        """
        self.path = Path(path)
        self._lock = lock or OutputLock(path)
        try:
            with _cannot_write(self.path):
                linked(path).parent.mkdir(parents=True, exist_ok=True)
                # What a full disk refuses must not stay in a buffer and be written later.
                self._file = open(self.path, "ab+", buffering=0)  # noqa: SIM115 - until `close`
                _drop_cut_line(self._file)
            try:
                self.rows = read_json_lines(self.path) if read else []
            except BaseException:
                self._file.close()
                raise
        except BaseException:
            self._lock.close()
            raise

    def append(self, *rows: Mapping[str, Any]) -> None:
        """Add rows, all of them or none.

        Raises:
            CannotWrite: the disk refuses.
            InvalidInput: a number is NaN or infinite, or a value isn't JSON.
        """
        try:
            lines = b"".join(map(_to_line, rows))
        except (TypeError, ValueError) as error:
            raise InvalidInput(f"{self.path}: can't be written as JSON: {error}") from error
        with _cannot_write(self.path):
            end = self._file.seek(0, os.SEEK_END)
            try:
                left = memoryview(lines)
                while left:
                    left = left[self._file.write(left) :]
                os.fsync(self._file.fileno())
            except OSError:
                # What the disk has no room for must not stand before the next row.
                with contextlib.suppress(OSError):
                    os.ftruncate(self._file.fileno(), end)
                raise
        self.rows += map(dict, rows)

    def clear(self) -> None:
        """Drop all rows."""
        self._file.truncate(0)
        self.rows = []

    def close(self, remove: bool = False) -> None:
        """Let go of the file; with `remove`, remove it too."""
        if remove and not self._file.closed:
            self.path.unlink(missing_ok=True)
        self._file.close()
        self._lock.close()


def check_writable(path: Path, overwrite: bool = False) -> None:
    """Return if a stage may write `path` (a file or directory): absent, or to be overwritten.

    Raises:
        OutputExists: it is there and `overwrite` is false.
        CannotWrite: its nearest existing parent refuses new files.
    """
    with _cannot_write(path):
        real = linked(path)
        if real.exists() and not overwrite and not (real.is_dir() and not any(real.iterdir())):
            raise OutputExists(f"{path}: already exists; add --overwrite or choose another --out")
        parent = real if real.is_dir() else real.parent
        while not parent.exists():
            parent = parent.parent
        if not parent.is_dir():
            raise CannotWrite(f"{path}: {parent} is not a directory; choose another --out")
        with tempfile.TemporaryFile(dir=parent):
            pass


def check_room(path: Path, n_bytes: int) -> None:
    """Return if the disk has room for a file of so many bytes at `path`.

    Raises:
        CannotWrite: it hasn't.
    """
    parent = Path(path).absolute().parent
    while not parent.exists():
        parent = parent.parent
    free = shutil.disk_usage(parent).free
    if n_bytes > free:
        raise CannotWrite(
            f"{path}: needs {n_bytes / 1e9:.1f} GB and {free / 1e9:.1f} GB are free; make room or "
            "choose another --out"
        )


def remove(path: Path) -> None:
    """Remove a file or directory tree if it is there.

    Raises:
        CannotWrite: the disk refuses.
    """
    path = Path(path)
    with _cannot_write(path):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def check_replaceable(path: Path, mark: str, overwrite: bool) -> None:
    """Return if a stage may write a directory: empty, absent, or one of its own to be replaced.

    Args:
        path: the directory.
        mark: the file that such a directory holds; one without it is never replaced.
        overwrite: whether such a directory may be replaced.

    Raises:
        OutputExists: it is there and may not be replaced.
        CannotWrite: its nearest existing parent refuses new files.
    """
    path = Path(path)
    check_writable(path, overwrite)
    if path.is_file():
        raise OutputExists(f"{path}: is a file, so it won't be replaced; choose another --out")
    if path.is_dir() and any(path.iterdir()) and not (path / mark).exists():
        raise OutputExists(
            f"{path}: holds other things (no {mark}), so it won't be replaced; choose another --out"
        )


def clear_directory(path: Path, mark: str, overwrite: bool) -> None:
    """Make room for a directory that a stage writes: an empty one or none at all is left.

    The mark goes last: interrupted, the directory can still be replaced.

    Raises:
        OutputExists: it is there and may not be replaced, see `check_replaceable`.
        CannotWrite: another process writes something in it, or the disk refuses.
    """
    check_replaceable(path, mark, overwrite)
    if not Path(path).is_dir():
        return
    for lock in Path(path).rglob(".*.lock"):
        OutputLock(lock.with_name(lock.name[1:].removesuffix(".lock"))).close()
    for inside in sorted(Path(path).iterdir(), key=lambda inside: inside.name == mark):
        remove(inside)


def remove_temporary_files(directory: Path) -> None:
    """Remove what processes that were killed while they wrote have left in a directory.

    Raises:
        CannotWrite: the disk refuses.
    """
    for path in Path(directory).rglob(".*"):
        if _TEMPORARY.fullmatch(path.name):
            remove(path)


def _existing(path: Path) -> Path:
    path = Path(path)
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError, ValueError) as error:
        raise MissingFile(f"{path}: no such file; check the path, or make it first") from error
    except OSError as error:
        raise BrokenFile(f"{path}: {error.strerror}; check the path") from error
    if stat.S_ISDIR(mode):
        raise BrokenFile(f"{path}: is a directory; expected a file")
    if not stat.S_ISREG(mode):
        raise BrokenFile(f"{path}: is no regular file; pass another")
    return path


def check_schema(path: Path, version: Any) -> None:
    """Return if a file's `schema_version` is the one that this version reads.

    Raises:
        BrokenFile: it is another.
    """
    if version != SCHEMA_VERSION:
        raise BrokenFile(
            f"{path}: schema_version is {version!r}, this version reads {SCHEMA_VERSION}; "
            "make the file again or use the toolkit version that wrote it"
        )


# --- HDF5 ---------------------------------------------------------------------------------------


# An HDF5 file may begin with a block of its user's. Ours says what the file is, and the SHA-256 of
# all that follows, so that HDF5's library reads no byte that we did not write.
_BLOCK = 512
_MAGIC = b"sart_toolkit "
# What was compared with its hash and inspected, by this process, or written by it.
_inspected: set[str] = set()


def _header(kind: str, n_bytes: int, sha256: str) -> bytes:
    about = {"kind": kind, "schema_version": SCHEMA_VERSION, "bytes": n_bytes, "sha256": sha256}
    return (_MAGIC + json.dumps(about).encode() + b"\n").ljust(_BLOCK, b"\0")


def _header_of(path: Path, block: bytes) -> dict[str, Any]:
    """What the first block of a file says.

    Raises:
        BrokenFile: it is no file of ours, or of a schema this version doesn't know.
    """
    if block.startswith(b"\x89HDF"):
        raise BrokenFile(
            f"{path}: schema_version is older than {SCHEMA_VERSION}, or the file is not of "
            "sart_toolkit; record or generate it again, or use the toolkit version that wrote it"
        )
    try:
        about = msgspec.json.decode(block.removeprefix(_MAGIC).split(b"\n")[0])
        known = block.startswith(_MAGIC) and isinstance(about, dict)
    except (ValueError, RecursionError, msgspec.MsgspecError):
        known = False
    if not known:
        raise BrokenFile(
            f"{path}: truncated or not a file of sart_toolkit; restore a copy or make it again"
        )
    check_schema(path, about.get("schema_version"))
    return dict(about)


def check_bytes(path: Path, kind: str) -> str:
    """The SHA-256 of a file of `kind`, which is what its first block says.

    Raises:
        MissingFile: no such file.
        BrokenFile: it isn't; the file was changed since it was written.
    """
    with open(_existing(path), "rb") as file:
        block = file.read(_BLOCK)
        about = _header_of(path, block)
        if about.get("kind") != kind:
            raise BrokenFile(
                f"{path}: holds {about.get('kind')!r}, expected a {kind}; pass another file"
            )
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        n_bytes = file.tell() - _BLOCK
    if block != _header(kind, n_bytes, sha256):
        cut = n_bytes != about.get("bytes")
        what = f"truncated or not a {kind} file" if cut else "content differs from its hash"
        raise BrokenFile(f"{path}: {what}; restore a copy or make it again")
    return sha256


@contextlib.contextmanager
def _reading(path: Path, kind: str) -> Iterator[h5py.File]:
    path = _existing(path)
    try:
        sha256 = check_bytes(path, kind)
        if sha256 not in _inspected:
            inspect(path, kind)
            _inspected.add(sha256)
        with h5py.File(path, "r") as file:
            yield file
    except InvalidInput as error:
        raise BrokenFile(f"{path}: {error}; restore a copy or make it again") from error
    except SartError:
        raise
    # A damaged file may hold anything in place of a group, a number or JSON.
    except (
        OSError, LookupError, ValueError, TypeError, AttributeError, RuntimeError, MemoryError,
        OverflowError, lzma.LZMAError, _IsalError
    ) as error:  # fmt: skip
        raise BrokenFile(
            f"{path}: truncated or not a {kind} file ({error}); restore a copy or make it again"
        ) from error


@contextlib.contextmanager
def _writing(path: Path, kind: str, meta: Mapping[str, Any]) -> Iterator[h5py.File]:
    try:
        text = json.dumps(meta, allow_nan=False, default=dataclasses.asdict).encode()
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"{path}: can't be written as JSON: {error}") from error
    # In memory first: HDF5 crashes the process when a disk fills up under an open file.
    content = io.BytesIO()
    with h5py.File(content, "w", userblock_size=_BLOCK) as file:
        file["meta"] = np.frombuffer(text, dtype=np.uint8)
        yield file
    with content.getbuffer() as all_:
        sha256 = hashlib.sha256(all_[_BLOCK:]).hexdigest()
        all_[:_BLOCK] = _header(kind, len(all_) - _BLOCK, sha256)
        with replacing(path) as temporary:
            temporary.write_bytes(all_)
    _inspected.add(sha256)


_STEP_ARRAYS = [f.name for f in dataclasses.fields(Steps) if f.name != "cameras"]


def _put_steps(group: h5py.Group, steps: Steps) -> None:
    for name in _STEP_ARRAYS:
        group[name] = getattr(steps, name)
    cameras = group.create_group("cameras")
    for name, camera in steps.cameras.items():
        at = cameras.create_group(name)
        put_frames(at, "rgb", camera.rgb)
        put_frames(at, "depth", camera.depth)
        at["intrinsics"] = camera.intrinsics
        at["T_frame_camera"] = camera.T_frame_camera


def put_frames(group: h5py.Group, name: str, frames: NDArray[Any]) -> None:
    """Write images, each in a chunk of its own, so that a step can be read by itself.

    They are stored as HDF5's own filters shuffle and DEFLATE would, which every HDF5 library reads;
    ISA-L packs them in a fifth of the time.
    """
    stored = group.create_dataset(
        name,
        frames.shape,
        frames.dtype,
        chunks=(1, *frames.shape[1:]),
        compression="gzip",
        compression_opts=DEFLATE_LEVEL,
        shuffle=frames.itemsize > 1,
    )
    for i, frame in enumerate(np.ascontiguousarray(frames)):
        # All first bytes of the numbers, then all second ones, and so on.
        shuffled = frame.reshape(-1).view(np.uint8).reshape(-1, frames.itemsize).T
        packed = isal_zlib.compress(np.ascontiguousarray(shuffled), DEFLATE_LEVEL)
        stored.id.write_direct_chunk((i, *(0 for _ in frame.shape)), packed)


def get_frames(stored: h5py.Dataset) -> NDArray[Any]:
    """The images that `put_frames` wrote.

    HDF5 itself would unpack whatever a chunk says; here one never takes more than its image.

    Raises:
        ValueError: one unpacks to another size.
    """
    frames = np.empty(stored.shape, stored.dtype)
    for i, frame in enumerate(frames):
        _, packed = stored.id.read_direct_chunk((i, *(0 for _ in frame.shape)))
        unpacker = isal_zlib.decompressobj()
        shuffled = unpacker.decompress(packed, frame.nbytes + 1)
        if len(shuffled) != frame.nbytes or not unpacker.eof:
            raise ValueError(f"{stored.name}: image {i} unpacks to another size")
        # All first bytes of the numbers go to their places, then all second ones, and so on.
        numbers = frame.reshape(-1).view(np.uint8).reshape(-1, frames.itemsize)
        rows = np.frombuffer(shuffled, np.uint8).reshape(numbers.shape[::-1])
        for byte, row in enumerate(rows):
            numbers[:, byte] = row
    return frames


def _get_steps(group: h5py.Group, frames: Mapping[str, CameraFrame]) -> Steps:
    cameras = {
        name: CameraRecord(
            frame=frame,
            **{
                part: get_frames(stored) if part in ("rgb", "depth") else stored[()]
                for part, stored in group["cameras"][name].items()
            },
        )
        for name, frame in sorted(frames.items())
    }
    if cameras.keys() != group["cameras"].keys():
        raise InvalidInput(f"cameras: expected {list(cameras)}, got {list(group['cameras'])}")
    return Steps(cameras=cameras, **{name: group[name][()] for name in _STEP_ARRAYS})


def _frames(steps: Steps) -> dict[str, str]:
    """What each camera is mounted on."""
    return {name: camera.frame for name, camera in steps.cameras.items()}


def _schema_of(record: type, without: Sequence[str] = (), **other: Any) -> type[msgspec.Struct]:
    """The types of a record's fields, those `without` left out and `other` in place or besides."""
    hints = typing.get_type_hints(record)
    names = [f.name for f in dataclasses.fields(record) if f.name not in without]
    fields = {**{name: hints[name] for name in names}, **other}
    return msgspec.defstruct(f"{record.__name__}Meta", fields.items(), forbid_unknown_fields=True)


_DEMONSTRATION_ARRAYS = (
    "steps", "timestamps", "body_Ts_world", "success", "raw_commands", "states"
)  # fmt: skip
_DemonstrationMeta = _schema_of(
    Demonstration,
    _DEMONSTRATION_ARRAYS,
    references=References,
    cameras=dict[str, CameraFrame],
    content_hash=str,
)
_ProvenanceMeta = _schema_of(Provenance, T_world_sampled=Matrix)
_EpisodeMeta = _schema_of(
    Episode,
    ("steps", "joint_path"),
    provenance=_ProvenanceMeta,
    cameras=dict[str, CameraFrame],
    content_hash=str,
)


def _meta(file: h5py.File, path: Path, schema: type[msgspec.Struct]) -> dict[str, Any]:
    """What a file says besides its arrays."""
    value = parse_json(file["meta"][()].tobytes(), str(path))
    return msgspec.structs.asdict(check_values(value, schema, str(path)))


def save_demonstration(path: Path, demonstration: Demonstration) -> None:
    """Write a demonstration to an HDF5 file, whole or not at all.

    Raises:
        CannotWrite: the disk refuses.
        InvalidInput: a parameter of its task is no JSON value.
    """
    d = demonstration
    meta = {
        f.name: getattr(d, f.name)
        for f in dataclasses.fields(d)
        if f.name not in _DEMONSTRATION_ARRAYS
    } | {"cameras": _frames(d.steps), "content_hash": d.content_hash()}
    with _writing(path, "demonstration", meta) as file:
        _put_steps(file.create_group("steps"), d.steps)
        file["timestamps"] = d.timestamps
        file["raw_commands"] = d.raw_commands
        file["success"] = d.success.astype(np.uint8)
        bodies = file.create_group("body_Ts_world")
        for name, Ts in d.body_Ts_world.items():
            bodies[name] = Ts
        file["states/sizes"] = np.array([len(state) for state in d.states], dtype="<i8")
        # States are nearly alike, and farther apart than the windows of HDF5's filters reach.
        packed = lzma.compress(b"".join(d.states), filters=_STATES_FILTERS)
        file["states/xz"] = np.frombuffer(packed, dtype=np.uint8)


# The dictionary holds several states, so that the next is found to be like the last.
_STATES_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 0, "dict_size": 2**19}]
# States may be so much larger than they are packed, and a few always so large.
_STATES_RATIO = 1000
_STATES_BYTES = 256 * 2**20


def _unpacked_states(sizes: Sequence[int], packed: bytes) -> tuple[bytes, ...]:
    """States of given sizes, out of one xz stream.

    Raises:
        ValueError: they are others, or larger than any demonstration's.
    """
    total = sum(sizes)
    if min(sizes, default=0) < 0 or total > max(_STATES_BYTES, _STATES_RATIO * len(packed)):
        raise ValueError(
            f"states: {total} bytes packed into {len(packed)}; record fewer steps at once"
        )
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=64 * 2**20)
    states = []
    for size in sizes:
        state = b""
        while len(state) < size:
            if unpacker.eof or (unpacker.needs_input and not packed):
                raise ValueError("states: end before their sizes say so")
            state += unpacker.decompress(packed, max_length=size - len(state))
            packed = b""
        states.append(state)
    # What is left is the stream's own end.
    if not unpacker.eof and unpacker.decompress(packed, max_length=1):
        raise ValueError("states: go on after their sizes say so")
    return tuple(states)


def load_demonstration(path: Path) -> Demonstration:
    """The demonstration in an HDF5 file.

    Raises:
        MissingFile: no such file.
        BrokenFile: truncated, another kind of file, or its content no longer matches its hash.
    """
    path = Path(path)
    with _reading(path, "demonstration") as file:
        meta = _meta(file, path, _DemonstrationMeta)
        expected, frames = meta.pop("content_hash"), meta.pop("cameras")
        demonstration = Demonstration(
            steps=_get_steps(file["steps"], frames),
            timestamps=file["timestamps"][()],
            raw_commands=file["raw_commands"][()],
            success=file["success"][()].astype(bool),
            body_Ts_world={k: v[()] for k, v in file["body_Ts_world"].items()},
            states=_unpacked_states(
                file["states/sizes"][()].tolist(), file["states/xz"][()].tobytes()
            ),
            **meta,
        )
        if demonstration.content_hash() != expected:
            raise BrokenFile(
                f"{path}: content differs from its hash; restore a copy or record again"
            )
    return demonstration


def save_episode(path: Path, episode: Episode) -> str:
    """The content hash of one generated episode, written to an HDF5 file whole or not at all.

    Raises:
        CannotWrite: the disk refuses.
        InvalidInput: its certificate is no JSON value.
    """
    provenance = dataclasses.asdict(episode.provenance)
    provenance["T_world_sampled"] = episode.provenance.T_world_sampled.tolist()
    content_hash = episode.content_hash()
    meta = {
        "provenance": provenance,
        "cameras": _frames(episode.steps),
        "content_hash": content_hash,
    }
    with _writing(path, "episode", meta) as file:
        _put_steps(file.create_group("steps"), episode.steps)
        file["joint_path"] = episode.joint_path
    return content_hash


def load_episode(path: Path, content_hash: str | None = None) -> Episode:
    """The episode in an HDF5 file.

    Args:
        path: the file.
        content_hash: what the episode's must be, where more is known than the file's own word.

    Raises:
        MissingFile: no such file.
        BrokenFile: truncated, another kind of file, or its content doesn't match its hash.
    """
    path = Path(path)
    with _reading(path, "episode") as file:
        meta = _meta(file, path, _EpisodeMeta)
        episode = Episode(
            _get_steps(file["steps"], meta["cameras"]),
            Provenance(**msgspec.structs.asdict(meta["provenance"])),
            file["joint_path"][()],
        )
        found = episode.content_hash()
        if found != meta["content_hash"] or content_hash not in (None, found):
            raise BrokenFile(f"{path}: content differs from its hash; generate it again")
        return episode


def load_recording(path: Path) -> Demonstration | Episode:
    """The demonstration or the episode in an HDF5 file.

    Raises:
        MissingFile: no such file.
        BrokenFile: truncated or another kind of file.
    """
    with open(_existing(path), "rb") as file:
        block = file.read(_BLOCK)
    episode = _header_of(Path(path), block).get("kind") == "episode"
    return load_episode(path) if episode else load_demonstration(path)


# --- annotations ---------------------------------------------------------------------------------

_ANNOTATION_NOTE = (
    "Precision spheres: the tool may stray radius_m [m] around its pose at each key waypoint. "
    "Edit a radius_m freely (set source to 'human'); the certificate of a suggested radius no "
    "longer covers a larger one, and augmentation still rejects every segment that touches."
)


def annotation_to_json(annotation: Annotation) -> dict[str, Any]:
    """An annotation as JSON values that a person can read and edit."""
    return {
        "about": _ANNOTATION_NOTE,
        "demonstration_hash": annotation.demonstration_hash,
        "seconds_spent": annotation.seconds,
        "settings": dict(annotation.settings),
        "spheres": [
            {
                "waypoint": sphere.waypoint,
                "radius_m": sphere.radius,
                "kind": sphere.kind,
                "source": sphere.source,
                "clearance_m": sphere.clearance,
                "limited_by": sphere.limited_by,
                "T_world_key": sphere.T_world_key.tolist(),
            }
            for sphere in annotation.spheres
        ],
    }


def annotation_from_json(value: Mapping[str, Any], path: Path) -> Annotation:
    """The annotation in JSON values read from `path`.

    Raises:
        BrokenFile: a field is missing, unknown or of another type.
        InvalidInput: a value is out of range, such as a radius <= 0.
    """
    found: AnnotationFile = check_values(value, AnnotationFile, f"{path}: not an annotation")
    try:
        spheres = [
            PrecisionSphere(
                waypoint=sphere.waypoint,  # type: ignore[arg-type] # checked there to be whole
                T_world_key=sphere.T_world_key,  # type: ignore[arg-type] # becomes an array there
                radius=sphere.radius_m,
                kind=sphere.kind,
                source=sphere.source,
                clearance=sphere.clearance_m,
                limited_by=sphere.limited_by,
            )
            for sphere in found.spheres
        ]
        return Annotation(
            tuple(spheres), found.demonstration_hash, found.seconds_spent, found.settings
        )
    except InvalidInput as error:
        raise InvalidInput(f"{path}: {error}") from error


def save_annotation(path: Path, annotation: Annotation) -> None:
    """Write an annotation to a JSON file that a person can read and edit.

    Raises:
        CannotWrite: the disk refuses.
    """
    write_json(path, annotation_to_json(annotation), sealed=False)


def load_annotation(path: Path) -> Annotation:
    """The annotation in a JSON file.

    Raises:
        MissingFile: no such file.
        BrokenFile: not JSON, or a field is missing, unknown or of another type.
        InvalidInput: a value is out of range.
    """
    return annotation_from_json(read_json(path, dict, sealed=False), Path(path))
