"""HDF5 files of other formats, written so that a full disk is an error and not a crash."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from sart_toolkit.errors import BrokenFile, SartError

# What damaged files make HDF5's library raise.
_ERRORS = (OSError, LookupError, ValueError, TypeError, AttributeError, RuntimeError)


class _Shielded(io.RawIOBase):
    """A file whose writes never fail: HDF5's library ends the process where one does.

    `error` is the first that was kept from it.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._file = open(path, "wb+", buffering=0)  # noqa: SIM115 - until `close`
        self.error: OSError | None = None

    @contextlib.contextmanager
    def _kept(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.error = self.error or error

    def readinto(self, buffer: Any) -> int:
        """What is there; zeros for what couldn't be written."""
        view = memoryview(buffer).cast("B")
        found = self._file.readinto(view) or 0
        view[found:] = bytes(len(view) - found)
        return len(view)

    def write(self, data: Any) -> int:
        """All of it, or as much as the disk takes."""
        left = memoryview(data).cast("B")
        n = len(left)
        with self._kept():
            while left and self.error is None:
                left = left[self._file.write(left) :]
        return n

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def truncate(self, size: int | None = None) -> int:
        with self._kept():
            self._file.truncate(size)
        return size or 0

    def flush(self) -> None:
        """Nothing is held back."""

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def close(self) -> None:
        self._file.close()
        super().close()

    def check(self) -> None:
        """Return if the disk took everything so far.

        Raises:
            OSError: what it said instead.
        """
        if self.error is not None:
            raise self.error


class Hdf5Output:
    """A new HDF5 file: `file` to write to, and `check` to be called now and then."""

    def __init__(self, path: Path) -> None:
        self._shielded = _Shielded(path)
        self.file = h5py.File(self._shielded, "w")

    def __enter__(self) -> Hdf5Output:
        return self

    def __exit__(self, failed: type[BaseException] | None, *_: object) -> None:
        try:
            self.file.close()
        except (RuntimeError, OSError):
            # Only after what the disk said, which is told below.
            if self._shielded.error is None and failed is None:
                raise
        finally:
            self._shielded.close()
        if failed is None:
            self._shielded.check()

    def check(self) -> None:
        """Return if the disk took everything so far.

        Raises:
            OSError: what it said instead.
        """
        self.file.flush()
        self._shielded.check()


@contextlib.contextmanager
def reading_hdf5(path: Path) -> Iterator[h5py.File]:
    """A file of another format, whose content anyone may have made.

    Raises:
        BrokenFile: it isn't there, or isn't what was expected in it.
    """
    try:
        with h5py.File(path, "r") as file:
            yield file
    except SartError:
        raise
    except _ERRORS as error:
        raise BrokenFile(f"{path}: can't be read as such a file ({error})") from error


def rows(group: h5py.Group, name: str) -> NDArray[np.float64]:
    """An array of numbers `(n, k)`; one of a single column may lack its second axis.

    Raises:
        KeyError, ValueError: there is none.
    """
    values = np.asarray(group[name][()], dtype=np.float64)
    if values.ndim not in (1, 2):
        raise ValueError(f"{name}: expected rows of numbers, got shape {values.shape}")
    return values.reshape(len(values), -1)
