"""The only place that reads or writes files of ours: HDF5 for arrays, JSON for the rest.

Every write goes to a temporary name beside its target, is flushed to disk and then renamed, so a
reader sees the old file or the whole new one.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import io
import json
import lzma
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np

from sart_toolkit.data.records import (
    Annotation,
    CameraRecord,
    Demonstration,
    Episode,
    PrecisionSphere,
    Provenance,
    Rates,
    Steps,
)
from sart_toolkit.errors import (
    BrokenFile,
    CannotWrite,
    InvalidInput,
    MissingFile,
    OutputExists,
    SartError,
)

SCHEMA_VERSION = 4

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


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all.

    Raises:
        CannotWrite: the disk refuses.
    """
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write a JSON object, with its `schema_version`, whole or not at all.

    Raises:
        CannotWrite: the disk refuses.
        InvalidInput: a number is NaN or infinite, or a value isn't JSON.
    """
    try:
        text = json.dumps({"schema_version": SCHEMA_VERSION, **value}, indent=2, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"{path}: can't be written as JSON: {error}") from error
    write_text(path, text + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file of ours, without its `schema_version`.

    Raises:
        MissingFile: no such file.
        BrokenFile: not a JSON object, or a schema this version doesn't know.
    """
    path = _existing(path)
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise BrokenFile(
            f"{path}: not readable as JSON ({error}); fix it or make it again"
        ) from error
    except OSError as error:
        raise BrokenFile(f"{path}: {error.strerror}; check the path and its permissions") from error
    if not isinstance(value, dict):
        raise BrokenFile(f"{path}: expected a JSON object, got {type(value).__name__}")
    check_schema(path, value.pop("schema_version", None))
    return value


def append_json_line(path: Path, value: Mapping[str, Any]) -> None:
    """Add a JSON object as one line to the end of a file, made if needed.

    Raises:
        CannotWrite: the disk refuses.
    """
    with _cannot_write(Path(path)), open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps(value) + "\n")


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """The JSON objects in a file of lines; none if it isn't there, a line that was cut left out."""
    rows = []
    if Path(path).exists():
        for line in Path(path).read_text(encoding="utf-8", errors="replace").splitlines():
            with contextlib.suppress(ValueError):
                rows.append(json.loads(line))
    return [row for row in rows if isinstance(row, dict)]


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

    def __init__(self, path: Path, lock: OutputLock | None = None) -> None:
        """Open a journal, made if needed.

        Args:
            path: the file.
            lock: of the output that it is a journal of, released when the journal is closed; the
                file's own if left out.

        Raises:
            CannotWrite: the disk refuses, or another process has it open.
        """
        self.path = Path(path)
        self._lock = lock or OutputLock(path)
        try:
            with _cannot_write(self.path):
                linked(path).parent.mkdir(parents=True, exist_ok=True)
                self._file = open(self.path, "ab+")  # noqa: SIM115 - open until `close`
                self._file.seek(0)
                content = self._file.read()
                if not content.endswith(b"\n"):
                    self._file.truncate(content.rfind(b"\n") + 1)
            self.rows = read_json_lines(self.path)
        except BaseException:
            self._lock.close()
            raise

    def append(self, row: Mapping[str, Any]) -> None:
        """Add one row.

        Raises:
            CannotWrite: the disk refuses.
            InvalidInput: a number is NaN or infinite, or a value isn't JSON.
        """
        try:
            line = json.dumps(row, allow_nan=False).encode() + b"\n"
        except (TypeError, ValueError) as error:
            raise InvalidInput(f"{self.path}: can't be written as JSON: {error}") from error
        with _cannot_write(self.path):
            end = self._file.seek(0, os.SEEK_END)
            try:
                self._file.write(line)
                self._file.flush()
                os.fsync(self._file.fileno())
            except OSError:
                # What the disk has no room for must not stand before the next row.
                with contextlib.suppress(OSError):
                    os.ftruncate(self._file.fileno(), end)
                raise
        self.rows.append(dict(row))

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
        present = path.exists()
    except OSError as error:
        raise BrokenFile(f"{path}: {error.strerror}; check the path") from error
    if not present:
        raise MissingFile(f"{path}: no such file; check the path, or make it first")
    if path.is_dir():
        raise BrokenFile(f"{path}: is a directory; expected a file")
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


@contextlib.contextmanager
def _reading(path: Path, kind: str) -> Iterator[h5py.File]:
    path = _existing(path)
    try:
        with h5py.File(path, "r") as file:
            found = file.attrs.get("kind")
            if found != kind:
                raise BrokenFile(f"{path}: holds {found!r}, expected a {kind}; pass another file")
            version = file.attrs.get("schema_version")
            check_schema(path, version.item() if isinstance(version, np.generic) else version)
            yield file
    except InvalidInput as error:
        raise BrokenFile(f"{path}: {error}; restore a copy or make it again") from error
    except SartError:
        raise
    # A damaged file may hold anything in place of a group, a number or JSON.
    except (
        OSError, LookupError, ValueError, TypeError, AttributeError, RuntimeError, lzma.LZMAError
    ) as error:  # fmt: skip
        raise BrokenFile(
            f"{path}: truncated or not a {kind} file ({error}); restore a copy or make it again"
        ) from error


@contextlib.contextmanager
def _writing(path: Path, kind: str) -> Iterator[h5py.File]:
    # In memory first: HDF5 crashes the process when a disk fills up under an open file.
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file.attrs["kind"] = kind
        file.attrs["schema_version"] = SCHEMA_VERSION
        yield file
    with replacing(path) as temporary:
        temporary.write_bytes(content.getbuffer())


_STEP_ARRAYS = [f.name for f in dataclasses.fields(Steps) if f.name != "cameras"]


def _put_steps(group: h5py.Group, steps: Steps) -> None:
    for name in _STEP_ARRAYS:
        group[name] = getattr(steps, name)
    for name, camera in steps.cameras.items():
        at = group.create_group(f"cameras/{name}")
        # One chunk an image, LZF: a tenth of gzip's time, and a step can be read by itself.
        for part, frames in (("rgb", camera.rgb), ("depth", camera.depth)):
            at.create_dataset(
                part, data=frames, chunks=(1, *frames.shape[1:]), compression="lzf", shuffle=True
            )
        at["intrinsics"] = camera.intrinsics
        at["T_frame_camera"] = camera.T_frame_camera
        at.attrs["frame"] = camera.frame


def _get_steps(group: h5py.Group) -> Steps:
    cameras = {
        name: CameraRecord(
            rgb=at["rgb"][()],
            depth=at["depth"][()],
            intrinsics=at["intrinsics"][()],
            frame=at.attrs["frame"],
            T_frame_camera=at["T_frame_camera"][()],
        )
        for name, at in group.get("cameras", {}).items()
    }
    return Steps(cameras=cameras, **{name: group[name][()] for name in _STEP_ARRAYS})


def save_demonstration(path: Path, demonstration: Demonstration) -> None:
    """Write a demonstration to an HDF5 file, whole or not at all.

    Raises:
        CannotWrite: the disk refuses.
    """
    d = demonstration
    with _writing(path, "demonstration") as file:
        _put_steps(file.create_group("steps"), d.steps)
        file["timestamps"] = d.timestamps
        file["raw_commands"] = d.raw_commands
        file["success"] = d.success
        file["touching"] = json.dumps(d.touching)
        for name, Ts in d.body_Ts_world.items():
            file[f"body_Ts_world/{name}"] = Ts
        sizes = np.array([len(state) for state in d.states], dtype=np.int64)
        file["states/sizes"] = sizes
        # States are nearly alike, and farther apart than the windows of HDF5's filters reach.
        packed = lzma.compress(b"".join(d.states), preset=0)
        file["states/xz"] = np.frombuffer(packed, dtype=np.uint8)
        file.attrs["meta"] = json.dumps(
            {
                "task": d.task,
                "task_parameters": dict(d.task_parameters),
                "robot": d.robot,
                "backend": d.backend,
                "operator": d.operator,
                "device": d.device,
                "seconds": d.seconds,
                "seed": d.seed,
                "versions": dict(d.versions),
                "rates": dataclasses.asdict(d.rates),
                "judged_by": d.judged_by,
                "references": dict(d.references),
                "content_hash": d.content_hash(),
            }
        )


def load_demonstration(path: Path) -> Demonstration:
    """The demonstration in an HDF5 file.

    Raises:
        MissingFile: no such file.
        BrokenFile: truncated, another kind of file, or its content no longer matches its hash.
    """
    with _reading(path, "demonstration") as file:
        meta = json.loads(file.attrs["meta"])
        expected = meta.pop("content_hash")
        packed = lzma.decompress(file["states/xz"][()].tobytes())
        ends = np.cumsum(file["states/sizes"][()])
        starts = ends - file["states/sizes"][()]
        demonstration = Demonstration(
            steps=_get_steps(file["steps"]),
            timestamps=file["timestamps"][()],
            raw_commands=file["raw_commands"][()],
            success=file["success"][()],
            touching=json.loads(file["touching"][()]),
            body_Ts_world={k: v[()] for k, v in file.get("body_Ts_world", {}).items()},
            states=tuple(packed[a:b] for a, b in zip(starts, ends, strict=True)),
            rates=Rates(**meta.pop("rates")),
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
    """
    provenance = dataclasses.asdict(episode.provenance)
    provenance["T_world_sampled"] = episode.provenance.T_world_sampled.tolist()
    content_hash = episode.content_hash()
    with _writing(path, "episode") as file:
        _put_steps(file.create_group("steps"), episode.steps)
        file["joint_path"] = episode.joint_path
        file.attrs["provenance"] = json.dumps(provenance)
        file.attrs["content_hash"] = content_hash
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
    with _reading(path, "episode") as file:
        provenance = Provenance(**json.loads(file.attrs["provenance"]))
        episode = Episode(_get_steps(file["steps"]), provenance, file["joint_path"][()])
        found = episode.content_hash()
        if found != file.attrs["content_hash"] or content_hash not in (None, found):
            raise BrokenFile(f"{path}: content differs from its hash; generate it again")
        return episode


def load_recording(path: Path) -> Demonstration | Episode:
    """The demonstration or the episode in an HDF5 file.

    Raises:
        MissingFile: no such file.
        BrokenFile: truncated or another kind of file.
    """
    try:
        return load_demonstration(path)
    except BrokenFile as error:
        if "holds 'episode'" not in str(error):
            raise
    return load_episode(path)


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
        BrokenFile: a field is missing or unknown.
        InvalidInput: a value is out of range, such as a radius <= 0 or NaN.
    """
    try:
        unknown = set(value) - {
            "about", "demonstration_hash", "seconds_spent", "settings", "spheres"
        }  # fmt: skip
        if unknown:
            raise BrokenFile(f"{path}: unknown field {sorted(unknown)[0]!r}; remove it")
        spheres = []
        for row in value["spheres"]:
            unknown = set(row) - {
                "waypoint", "radius_m", "kind", "source", "clearance_m", "limited_by", "T_world_key"
            }  # fmt: skip
            if unknown:
                raise BrokenFile(f"{path}: unknown sphere field {sorted(unknown)[0]!r}; remove it")
            spheres.append(
                PrecisionSphere(
                    waypoint=row["waypoint"],
                    T_world_key=row["T_world_key"],
                    radius=row["radius_m"],
                    kind=row.get("kind", "ball"),
                    source=row.get("source", "human"),
                    clearance=row.get("clearance_m"),
                    limited_by=row.get("limited_by"),
                )
            )
        return Annotation(
            tuple(spheres),
            value["demonstration_hash"],
            float(value.get("seconds_spent", 0.0)),
            value.get("settings", {}),
        )
    except SartError as error:
        if isinstance(error, InvalidInput):
            raise InvalidInput(f"{path}: {error}") from error
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise BrokenFile(f"{path}: not an annotation, {error!r} is missing or wrong") from error


def save_annotation(path: Path, annotation: Annotation) -> None:
    """Write an annotation to a JSON file that a person can read and edit.

    Raises:
        CannotWrite: the disk refuses.
    """
    write_json(path, annotation_to_json(annotation))


def load_annotation(path: Path) -> Annotation:
    """The annotation in a JSON file.

    Raises:
        MissingFile: no such file.
        BrokenFile: not JSON, or a field is missing or unknown.
        InvalidInput: a value is out of range.
    """
    return annotation_from_json(read_json(path), Path(path))
