"""The structure that an HDF5 file of ours has, and its inspection in a process of its own.

A file may come from anyone. HDF5 follows links and external storage out of a file, declares more
than a file holds, and on a structure made to do so its C library loops for ever or crashes. So a
file's structure is first read by another process, which has little memory and little time: names,
types, ranks and storage of all that it holds, each of them exactly what we write.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import json
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np

from sart_toolkit.data.records import Steps

# What reading a file's structure may take in the process that inspects it.
CPU_SECONDS = 2.0
MEMORY_BYTES = 256 * 2**20
# What one file may hold when it is unpacked.
MAX_UNPACKED_BYTES = 8 * 2**30
# How images are packed: level 1 of DEFLATE, whose most for a bit is half of 258 bytes.
DEFLATE_LEVEL = 1
_DEFLATE_RATIO = 1032
_MAX_NAMES = 1000


@dataclasses.dataclass(frozen=True)
class Leaf:
    """A dataset: its type, the rank that it may have, and whether it is packed frame by frame."""

    dtype: str
    ranks: tuple[int, ...]
    frames: bool = False


# What a group holds by name; under "*" what any name may stand for.
Layout = Mapping[str, "Leaf | Layout"]
_CAMERA: Layout = {
    "rgb": Leaf("|u1", (4,), frames=True),
    "depth": Leaf("<f4", (3,), frames=True),
    "intrinsics": Leaf("<f8", (2,)),
    "T_frame_camera": Leaf("<f8", (2,)),
}
_STEPS: Layout = {
    **{f.name: Leaf("<f8", (1, 2, 3)) for f in dataclasses.fields(Steps) if f.name != "cameras"},
    "cameras": {"*": _CAMERA},
}
LAYOUTS: Mapping[str, Layout] = {
    "demonstration": {
        "meta": Leaf("|u1", (1,)),
        "steps": _STEPS,
        "timestamps": Leaf("<f8", (1,)),
        "raw_commands": Leaf("<f8", (2,)),
        "success": Leaf("|u1", (1,)),
        "body_Ts_world": {"*": Leaf("<f8", (3,))},
        "states": {"sizes": Leaf("<i8", (1,)), "xz": Leaf("|u1", (1,))},
    },
    "episode": {"meta": Leaf("|u1", (1,)), "steps": _STEPS, "joint_path": Leaf("<f8", (2,))},
}


def check_structure(file: h5py.File, kind: str, n_bytes: int) -> None:
    """Return if an open file of `n_bytes` has the structure that we write, and nothing else.

    Raises:
        ValueError: it leads out of the file, declares more than it holds, or holds other things.
    """
    sizes = [(0, 0)]
    _check_group(file.id, LAYOUTS[kind], "", sizes)
    unpacked, stored = map(sum, zip(*sizes, strict=True))
    if stored > n_bytes:
        raise ValueError(f"declares {stored} stored bytes, the file has {n_bytes}")
    if unpacked > MAX_UNPACKED_BYTES:
        raise ValueError(
            f"holds {unpacked / 2**30:.1f} GiB unpacked, at most {MAX_UNPACKED_BYTES / 2**30:.0f} "
            "can be read; record fewer steps, smaller images or fewer cameras"
        )


def _check_group(
    group: h5py.h5g.GroupID, layout: Layout, at: str, sizes: list[tuple[int, int]]
) -> None:
    names: list[bytes] = []

    def add(name: bytes) -> bool | None:
        names.append(name)
        # Anything but None ends the iteration.
        return True if len(names) > _MAX_NAMES else None

    group.links.iterate(add)
    if len(names) > _MAX_NAMES:
        raise ValueError(f"{at or '/'}: holds more than {_MAX_NAMES} names")
    _no_attributes(group, at)
    found = {name.decode("utf-8"): name for name in names}
    wanted = dict.fromkeys(found, layout["*"]) if "*" in layout else layout
    if wrong := sorted(found.keys() ^ wanted.keys()):
        raise ValueError(f"{at}/{wrong[0]}: {'unknown' if wrong[0] in found else 'is missing'}")
    for name, expected in wanted.items():
        inside = f"{at}/{name}"
        if group.links.get_info(found[name]).type != h5py.h5l.TYPE_HARD:
            raise ValueError(f"{inside}: is a link that leads elsewhere")
        object_ = h5py.h5o.open(group, found[name])
        if isinstance(expected, Leaf):
            if not isinstance(object_, h5py.h5d.DatasetID):
                raise ValueError(f"{inside}: expected a dataset")
            sizes.append(_check_leaf(object_, expected, inside))
        else:
            if not isinstance(object_, h5py.h5g.GroupID):
                raise ValueError(f"{inside}: expected a group")
            _check_group(object_, expected, inside, sizes)


def _no_attributes(object_: h5py.h5g.GroupID | h5py.h5d.DatasetID, at: str) -> None:
    if h5py.h5a.get_num_attrs(object_):
        raise ValueError(f"{at or '/'}: has an attribute")


def _check_leaf(leaf: h5py.h5d.DatasetID, expected: Leaf, at: str) -> tuple[int, int]:
    """How many bytes a dataset has unpacked, and how many as it is stored."""
    _no_attributes(leaf, at)
    type_, space, layout = leaf.get_type(), leaf.get_space(), leaf.get_create_plist()
    # Of a type that isn't a plain number no more is asked.
    numbers = (h5py.h5t.INTEGER, h5py.h5t.FLOAT)
    if type_.get_class() not in numbers or type_.committed() or type_.get_size() > 8:
        raise ValueError(f"{at}: expected numbers of type {expected.dtype}")
    dtype = np.dtype(expected.dtype)
    if type_.dtype != dtype:
        raise ValueError(f"{at}: expected type {dtype}, got {type_.dtype}")
    if space.get_simple_extent_type() != h5py.h5s.SIMPLE:
        raise ValueError(f"{at}: expected an array")
    shape = space.get_simple_extent_dims()
    if len(shape) not in expected.ranks or space.get_simple_extent_dims(True) != shape:
        raise ValueError(f"{at}: expected an array of rank {expected.ranks[0]}, got {shape}")
    if layout.get_external_count():
        raise ValueError(f"{at}: is stored in another file")
    unpacked = dtype.itemsize
    for n in shape:
        unpacked *= n
    if expected.frames:
        return unpacked, _check_frames(leaf, layout, shape, unpacked, at)
    if layout.get_layout() != h5py.h5d.CONTIGUOUS or layout.get_nfilters():
        raise ValueError(f"{at}: expected an array in one piece, in this file")
    # What was never written has no place in the file.
    if leaf.get_storage_size() != unpacked or (unpacked and leaf.get_offset() is None):
        raise ValueError(f"{at}: declares {unpacked} bytes, has {leaf.get_storage_size()}")
    return unpacked, unpacked


def _check_frames(
    leaf: h5py.h5d.DatasetID,
    layout: h5py.h5p.PropDCID,
    shape: tuple[int, ...],
    unpacked: int,
    at: str,
) -> int:
    """How many bytes images have as they are stored, each in a chunk of its own."""
    if layout.get_layout() != h5py.h5d.CHUNKED or layout.get_chunk() != (1, *shape[1:]):
        raise ValueError(f"{at}: expected images one by one, in this file")
    frame = unpacked // shape[0] if shape[0] else 0
    filters = [layout.get_filter(i)[::2] for i in range(layout.get_nfilters())]
    size = leaf.get_type().get_size()
    wanted = [(h5py.h5z.FILTER_SHUFFLE, (size,))] if size > 1 else []
    wanted += [(h5py.h5z.FILTER_DEFLATE, (DEFLATE_LEVEL,))]
    if filters != wanted:
        raise ValueError(f"{at}: expected the filters {wanted}, got {filters}")
    chunks: list[tuple[int, int]] = []
    leaf.chunk_iter(lambda chunk: chunks.append((chunk.filter_mask, chunk.size)))
    if len(chunks) != shape[0]:
        raise ValueError(f"{at}: declares {shape[0]} images, has {len(chunks)}")
    for mask, size in chunks:
        if mask or frame > _DEFLATE_RATIO * size:
            raise ValueError(f"{at}: an image of {frame} bytes is stored in {size}")
    return sum(size for _, size in chunks)


# --- inspection in another process -------------------------------------------------------------


def inspect(path: Path, kind: str) -> None:
    """Return if `check_structure` holds for a file, asked in a process that may crash or hang.

    The process is started at the first call and serves all later ones.

    Raises:
        ValueError: the structure is wrong, or can't be read within time and memory.
    """
    with _lock:
        answer = _ask(path, kind)
    if answer is None:
        raise ValueError(
            f"its structure can't be read in {CPU_SECONDS:g} s of computing time without a crash"
        )
    if answer:
        raise ValueError(answer)


_lock = threading.Lock()
_inspector: tuple[int, subprocess.Popen[str]] | None = None


def _ask(path: Path, kind: str) -> str | None:
    """What the inspector says; None if it ended instead."""
    global _inspector
    process = _inspector[1] if _inspector is not None and _inspector[0] == os.getpid() else None
    if process is None or process.poll() is not None:
        process = _started()
        _inspector = (os.getpid(), process)
    assert process.stdin is not None and process.stdout is not None
    try:
        process.stdin.write(json.dumps([str(Path(path).absolute()), kind]) + "\n")
        process.stdin.flush()
        line = process.stdout.readline()
    except OSError:
        line = ""
    if not line:
        _end()
        return None
    return str(json.loads(line))


_CHILD = (
    "import json, sys; sys.path = json.loads(sys.argv[1]); "
    "from sart_toolkit.data.structure import serve; serve()"
)


def _started() -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-P", "-c", _CHILD, json.dumps(sys.path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        # One thread is enough, and each would reserve memory.
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )


@atexit.register
def _end() -> None:
    global _inspector
    if _inspector is None or _inspector[0] != os.getpid():
        return
    process, _inspector = _inspector[1], None
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()


def serve() -> None:
    """Answer `inspect` until its process ends; the system ends this one where time runs out."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    limit = used + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit if most < 0 else min(limit, most), most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for line in sys.stdin:
        path, kind = json.loads(line)
        # Its signal's default action ends the process, also inside the C library.
        signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
        answer = ""
        try:
            with h5py.File(path, "r") as file:
                check_structure(file, kind, os.path.getsize(path))
        except Exception as error:
            answer = str(error) or type(error).__name__
        signal.setitimer(signal.ITIMER_PROF, 0)
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()
