"""An HDF5 file that isn't exactly what we write is refused before HDF5 follows what it says."""

from __future__ import annotations

import hashlib
import json
import lzma
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest

from sart_toolkit.data import storage, structure
from sart_toolkit.data.storage import load_demonstration, load_episode, save_demonstration
from sart_toolkit.errors import BrokenFile


@pytest.fixture
def path(source_of, tmp_path):
    """A demonstration's file."""
    save_demonstration(tmp_path / "demo.h5", source_of(0)[0])
    return tmp_path / "demo.h5"


def forge(path, edit):
    """Edit a file and make the hash of its bytes fit again."""
    kind = json.loads(path.read_bytes().split(b"\n")[0].removeprefix(storage._MAGIC))["kind"]
    with h5py.File(path, "r+") as file:
        edit(file)
    body = path.read_bytes()[storage._BLOCK :]
    path.write_bytes(storage._header(kind, len(body), hashlib.sha256(body).hexdigest()) + body)


def replace(name, make):
    def edit(file):
        array = file[name][()]
        del file[name]
        make(file, name, array)

    return edit


# --- bytes --------------------------------------------------------------------------------------


def test_one_flipped_bit_anywhere_in_a_file_is_refused(path, tmp_path):
    whole = path.read_bytes()
    places = {*range(0, 520, 3), *np.linspace(512, len(whole) - 1, 150).astype(int).tolist()}
    for at in places:
        flipped = bytearray(whole)
        flipped[at] ^= 1
        (tmp_path / "flipped.h5").write_bytes(flipped)
        with pytest.raises(BrokenFile, match="flipped.h5: "):
            load_demonstration(tmp_path / "flipped.h5")


def test_bytes_that_were_not_written_never_reach_the_hdf5_library(path, monkeypatch):
    path.write_bytes(path.read_bytes()[:-1] + b"\0\0")
    monkeypatch.setattr(h5py, "File", None)
    with pytest.raises(BrokenFile, match="truncated or not a demonstration file; restore a copy"):
        load_demonstration(path)


@pytest.mark.parametrize("name", ["body_Ts_world/block", "timestamps", "raw_commands"])
def test_shifted_numbers_are_refused_even_where_the_file_s_own_hash_fits(path, name):
    def shift(file):
        file[name][..., 0] += 0.3 * (file[name].ndim < 3)
        if file[name].ndim == 3:
            file[name][:, 0, 3] += 0.3

    forge(path, shift)
    with pytest.raises(BrokenFile, match="content differs from its hash; restore a copy or record"):
        load_demonstration(path)


def test_other_states_are_refused_even_where_the_file_s_own_hash_fits(path):
    packed = lzma.compress(b"STATE" * 6, preset=0)

    def exchange(file):
        del file["states/xz"]
        file["states/xz"] = np.frombuffer(packed, np.uint8)

    forge(path, exchange)
    with pytest.raises(BrokenFile, match="content differs from its hash; restore a copy or record"):
        load_demonstration(path)


# --- foreign content ----------------------------------------------------------------------------


def _external_link(file, name, array):
    with h5py.File(file.filename + ".other", "w") as other:
        other["x"] = array
    file[name] = h5py.ExternalLink(file.filename + ".other", "/x")


def _soft_link(file, name, array):
    file["aside"] = array
    file[name] = h5py.SoftLink("/aside")


def _external_storage(file, name, array):
    with open(file.filename + ".raw", "wb") as raw:
        raw.write(array.tobytes())
    where = [(file.filename + ".raw", 0, array.nbytes)]
    file.create_dataset(name, array.shape, array.dtype, external=where)


def _virtual(file, name, array):
    with h5py.File(file.filename + ".other", "w") as other:
        other["x"] = array
    layout = h5py.VirtualLayout(array.shape, array.dtype)
    layout[...] = h5py.VirtualSource(file.filename + ".other", "x", array.shape)
    file.create_virtual_dataset(name, layout)


@pytest.mark.parametrize(
    ("foreign", "message"),
    [
        (_external_link, "/timestamps: is a link that leads elsewhere"),
        (_soft_link, "/aside: unknown|/timestamps: is a link that leads elsewhere"),
        (_external_storage, "/timestamps: is stored in another file"),
        (_virtual, "/timestamps: expected an array in one piece, in this file"),
    ],
)
def test_what_leads_out_of_a_file_is_refused_though_the_same_is_there(path, foreign, message):
    forge(path, replace("timestamps", foreign))
    with pytest.raises(BrokenFile, match=message):
        load_demonstration(path)


def _as(change=lambda array: array, **options):
    """Puts a dataset's array back otherwise."""

    def make(file, name, array):
        file.create_dataset(name, data=change(array), **options)

    return make


def _huge(file, name, array):
    file.create_dataset(name, (10**9,), "f8")


def _attribute(file, name, array):
    file.create_dataset(name, data=array).attrs["x"] = 1


def _one_more(file, name, array):
    file[name], file["x"] = array, 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda *_: None, "/timestamps: is missing"),
        (lambda file, name, _: file.create_group(name), "/timestamps: expected a dataset"),
        (_as(lambda _: "text"), "expected numbers of type"),
        (_as(lambda a: a.astype("f4")), "expected type float64"),
        (_as(lambda a: a.astype(">f8")), "expected type float64"),
        (_as(lambda _: 1.5), "/timestamps: expected an array"),
        (_as(lambda a: a[None]), "expected an array of rank 1"),
        (_as(compression="gzip"), "in one piece"),
        (_as(maxshape=(None,)), "expected an array of rank"),
        (_huge, "declares 8000000000 bytes, has 0"),
        (_one_more, "/x: unknown"),
        (_attribute, "has an attribute"),
    ],
)
def test_what_we_do_not_write_is_refused(path, make, message):
    forge(path, replace("timestamps", make))
    with pytest.raises(BrokenFile, match=message):
        load_demonstration(path)


@pytest.fixture
def with_images(tmp_path):
    """Structure of images that are declared in other ways: an open file's check."""

    def check(n_bytes=10**6, **options):
        with h5py.File(tmp_path / "x.h5", "w") as file:
            images = np.zeros((4, 8, 8, 3), np.uint8)
            given = {"chunks": (1, 8, 8, 3), "compression": "gzip", "compression_opts": 1} | options
            if "shape" in given:
                file.create_dataset("rgb", dtype="u1", **given)
            else:
                file.create_dataset("rgb", data=images, **given)
            leaf = structure.Leaf("|u1", (4,), frames=True)
            return structure._check_leaf(file["rgb"].id, leaf, "/rgb")

    return check


def test_images_may_take_what_is_there_and_no_more(with_images):
    unpacked, stored = with_images()
    assert unpacked == 4 * 8 * 8 * 3 and 0 < stored < unpacked
    with pytest.raises(ValueError, match="declares 1000000 images, has 0"):
        with_images(shape=(10**6, 8, 8, 3))
    with pytest.raises(ValueError, match="expected images one by one"):
        with_images(chunks=(2, 8, 8, 3))
    for other in (
        {"compression_opts": 2},
        {"shuffle": True},
        {"compression": "lzf", "compression_opts": None},
    ):
        with pytest.raises(ValueError, match="/rgb: expected the filters .*, got"):
            with_images(**other)


def test_more_than_the_bytes_of_the_file_or_than_fits_in_memory_is_refused(path, monkeypatch):
    with h5py.File(path, "r") as file:
        with pytest.raises(ValueError, match=r"declares \d+ stored bytes, the file has 100"):
            structure.check_structure(file, "demonstration", 100)
        monkeypatch.setattr(structure, "MAX_UNPACKED_BYTES", 1000)
        with pytest.raises(ValueError, match="can be read; record fewer steps, smaller images"):
            structure.check_structure(file, "demonstration", 10**6)


def test_a_group_of_more_names_than_anyone_needs_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(structure, "_MAX_NAMES", 3)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        for name in "abcd":
            file[name] = 1
        with pytest.raises(ValueError, match="holds more than 3 names"):
            structure.check_structure(file, "episode", 10**6)


@pytest.mark.parametrize("sizes", [[2**62, 0], [-5, 5], [5, 6], [5, 4]])
def test_states_of_other_sizes_than_what_is_packed_are_refused(sizes):
    packed = lzma.compress(b"state" * 2, preset=0)
    assert storage._unpacked_states([5, 5], packed) == (b"state", b"state")
    assert storage._unpacked_states([], lzma.compress(b"", preset=0)) == ()
    with pytest.raises(ValueError, match="states: "):
        storage._unpacked_states(sizes, packed)


def test_states_are_unpacked_no_further_than_their_sizes_say():
    bomb = lzma.compress(bytes(10**8), preset=0)
    with pytest.raises(ValueError, match="states: go on after their sizes say so"):
        storage._unpacked_states([5, 5], bomb)
    with pytest.raises(ValueError, match=r"states: 1000000000 bytes packed into \d+; record fewer"):
        storage._unpacked_states([10**9], bomb)


# --- the process that looks first ---------------------------------------------------------------


@pytest.fixture
def unknown_files(monkeypatch):
    """No file counts as inspected."""
    monkeypatch.setattr(storage, "_inspected", set())


def test_a_structure_is_read_by_another_process_first_and_once(path, unknown_files, monkeypatch):
    asked = []
    inspect = structure.inspect
    monkeypatch.setattr(storage, "inspect", lambda *args: (asked.append(args), inspect(*args)))
    load_demonstration(path)
    load_demonstration(path)
    assert asked == [(path, "demonstration")]


@pytest.mark.parametrize(
    "does",
    [
        "import signal; signal.setitimer(signal.ITIMER_PROF, 0.05)\nwhile True: pass",
        "import os; os.kill(os.getpid(), 11)",
    ],
    ids=["loops for ever", "crashes"],
)
def test_a_file_on_which_the_library_loops_or_crashes_is_broken(
    path, unknown_files, monkeypatch, does
):
    structure._end()
    monkeypatch.setattr(structure, "_CHILD", f"import sys; sys.stdin.readline()\n{does}")
    with pytest.raises(BrokenFile, match="can't be read in 2 s of computing time without a crash"):
        load_demonstration(path)
    monkeypatch.undo()
    load_demonstration(path)


def test_the_process_that_looks_ends_itself_when_its_time_is_over(path, tmp_path, monkeypatch):
    """Also inside the C library, where no exception reaches."""
    structure._end()
    hang = "; h5py = sys.modules['h5py']; import sart_toolkit.data.structure as s; "
    hang += "s.CPU_SECONDS = 0.05; s.check_structure = lambda *_: sum(range(10**11)); serve()"
    monkeypatch.setattr(structure, "_CHILD", structure._CHILD.replace("; serve()", hang))
    with pytest.raises(ValueError, match="without a crash"):
        structure.inspect(path, "demonstration")


def test_the_process_that_looks_ends_with_the_one_that_asks(path):
    code = (
        "import sys; from pathlib import Path; from sart_toolkit.data import structure as s; "
        "s.inspect(Path(sys.argv[1]), 'demonstration'); print(s._inspector[1].pid, flush=True); "
        "import os; os.kill(os.getpid(), 9)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True)
    pid = int(done.stdout)
    for _ in range(500):
        try:
            with open(f"/proc/{pid}/stat") as file:
                if file.read().rsplit(")", 1)[1].split()[0] == "Z":
                    return
        except FileNotFoundError:
            return
        time.sleep(0.02)
    raise AssertionError(f"{pid} is still there")


def test_an_episode_s_structure_is_no_demonstration_s(path, episode_of, source_of, tmp_path):
    storage.save_episode(tmp_path / "episode.h5", episode_of(source_of(0)[0]))
    with h5py.File(tmp_path / "episode.h5", "r") as file:
        structure.check_structure(file, "episode", 10**6)
        with pytest.raises(ValueError, match="/body_Ts_world: is missing"):
            structure.check_structure(file, "demonstration", 10**6)
    assert len(load_episode(tmp_path / "episode.h5")) == 4
