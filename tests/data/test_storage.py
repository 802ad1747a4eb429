"""Files: what is written is read back, what is damaged is reported, what was there survives."""

import contextlib
import dataclasses
import errno
import functools
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import tracemalloc
import zlib
from pathlib import Path

import h5py
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from sart_toolkit.data import storage
from sart_toolkit.data.records import (
    Annotation,
    CameraRecord,
    Demonstration,
    Episode,
    PrecisionSphere,
    Provenance,
    Rates,
    Steps,
    convergence_waypoint,
)
from sart_toolkit.data.storage import (
    SCHEMA_VERSION,
    annotation_from_json,
    annotation_to_json,
    append_json_line,
    check_room,
    check_writable,
    clear_directory,
    load_annotation,
    load_demonstration,
    load_episode,
    read_json,
    read_json_lines,
    remove,
    replacing,
    save_annotation,
    save_demonstration,
    save_episode,
    write_json,
    write_text,
)
from sart_toolkit.errors import (
    BrokenFile,
    CannotWrite,
    InvalidInput,
    MissingFile,
    OutputExists,
    SartError,
)
from sart_toolkit.poses import pose

ROOT = Path(__file__).parents[2]
PROPERTY = settings(deadline=None, derandomize=True, max_examples=25)


def make_steps(n, rng, cameras=("wrist",), bodies=0):
    Ts = np.stack([pose(rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3)) for _ in range(n)])
    return Steps(
        joint_positions=rng.normal(size=(n, 6)),
        joint_velocities=rng.normal(size=(n, 6)),
        commanded_joint_positions=rng.normal(size=(n, 6)),
        measured_Ts_world_tool=Ts,
        commanded_Ts_world_tool=Ts[::-1],
        measured_gripper=rng.uniform(0, 1, n),
        commanded_gripper=rng.uniform(0, 1, n),
        contact_force=np.where(rng.uniform(size=n) < 0.5, np.nan, 1.5),
        cameras={
            name: CameraRecord(
                rgb=rng.integers(0, 256, (n, 6, 8, 3), np.uint8),
                depth=rng.uniform(0, 2, (n, 6, 8)).astype(np.float32),
                intrinsics=np.diag([6.0, 6.0, 1.0]),
                frame="world" if name == "overview" else "tool",
                T_frame_camera=pose([0.05, 0, -0.1], [0.1, 0, 0]),
            )
            for name in cameras
        },
    )


def make_demonstration(n=5, seed=0, cameras=("wrist",), bodies=("block",), states=True):
    rng = np.random.default_rng(seed)
    return Demonstration(
        task="nothing",
        task_parameters={"placement": {"x": 0.01, "y": -0.02}, "note": "Lübeck"},
        robot="none",
        backend="synthetic",
        steps=make_steps(n, rng, cameras),
        timestamps=np.arange(n) / 10,
        body_Ts_world={
            name: np.stack([pose(rng.uniform(-1, 1, 3)) for _ in range(n)]) for name in bodies
        },
        success=rng.uniform(size=n) < 0.5,
        touching=((), (("block", "peg"),)) * (n // 2) + ((),) * (n % 2),
        raw_commands=rng.normal(size=(3 * n, 7)),
        states=tuple(rng.bytes(int(k)) for k in rng.integers(0, 30, n)) if states else (),
        operator="Åsa",
        device="none",
        seconds=12.25,
        seed=None if seed % 2 else seed,
        versions={"numpy": "1"},
        rates=Rates(record_hz=5 if seed % 2 else 10),
        judged_by="person",
    )


def make_annotation(demonstration, waypoints=(0, 2)):
    Ts = demonstration.steps.measured_Ts_world_tool
    spheres = [
        PrecisionSphere(w, Ts[w], 0.01 * (w + 1), "ball", "suggested", 0.1 / (w + 1), "peg / block")
        for w in waypoints
    ]
    human = PrecisionSphere(waypoints[-1] + 1, Ts[waypoints[-1] + 1], 1 / 3, "free_space")
    return Annotation((*spheres, human), demonstration.content_hash(), 24.5, {"margin": 0.002})


def make_episode(demonstration, seed=3, certificate=None):
    rng = np.random.default_rng(seed)
    provenance = Provenance(
        demonstration_hash=demonstration.content_hash(),
        source=0,
        sphere=1,
        k=seed,
        t_star=3,
        T_world_sampled=pose(rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3)),
        seed=5,
        strategy="sart",
        distribution="area",
        certificate=certificate,
    )
    return Episode(make_steps(4, rng), provenance)


def same(a, b):
    """Whether two records hold the same, arrays and all."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(
            same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)
        )
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    return a == b


def read_any(path):
    return read_json(path, dict)


def rewritten(path, edit):
    """Edit an HDF5 file of ours by hand and give it the right hash of its bytes again."""
    kind = json.loads(path.read_bytes()[:512].removeprefix(storage._MAGIC).split(b"\n")[0])["kind"]
    with h5py.File(path, "r+") as file:
        edit(file)
    body = path.read_bytes()[512:]
    path.write_bytes(storage._header(kind, len(body), hashlib.sha256(body).hexdigest()) + body)


SAVED = {
    "demonstration": (save_demonstration, load_demonstration, make_demonstration),
    "episode": (save_episode, load_episode, lambda: make_episode(make_demonstration())),
    "annotation": (save_annotation, load_annotation, lambda: make_annotation(make_demonstration())),
}


@pytest.fixture(params=SAVED)
def saved(request, tmp_path):
    """(save, load, record, path where it is saved)."""
    save, load, make = SAVED[request.param]
    record = make()
    path = tmp_path / ("record.json" if request.param == "annotation" else "record.h5")
    save(path, record)
    return save, load, record, path


# --- round trips --------------------------------------------------------------------------------


def test_a_record_is_read_back_as_it_was_written(saved):
    _, load, record, path = saved
    assert same(load(path), record)


@PROPERTY
@given(
    n=st.integers(2, 6),
    seed=st.integers(0, 2**32 - 1),
    cameras=st.sampled_from([(), ("wrist",), ("wrist", "overview")]),
    bodies=st.sampled_from([(), ("block",), ("block", "table top")]),
    states=st.booleans(),
)
def test_a_demonstration_of_any_make_is_read_back(n, seed, cameras, bodies, states):
    demonstration = make_demonstration(n, seed, cameras, bodies, states)
    with tempfile.TemporaryDirectory() as directory:
        save_demonstration(Path(directory) / "demo.h5", demonstration)
        loaded = load_demonstration(Path(directory) / "demo.h5")
    assert same(loaded, demonstration)
    assert loaded.content_hash() == demonstration.content_hash()


@pytest.mark.parametrize("kind", ["noise", "plain"])
def test_images_are_readable_one_by_one_by_any_hdf5_library(tmp_path, kind):
    demonstration = make_demonstration()
    camera = demonstration.steps.cameras["wrist"]
    if kind == "plain":
        camera = dataclasses.replace(
            camera, rgb=np.full_like(camera.rgb, 7), depth=np.full_like(camera.depth, 0.5)
        )
        steps = dataclasses.replace(demonstration.steps, cameras={"wrist": camera})
        demonstration = dataclasses.replace(demonstration, steps=steps)
    save_demonstration(tmp_path / "demo.h5", demonstration)
    # By HDF5's own filters.
    with h5py.File(tmp_path / "demo.h5", "r") as file:
        for part in ("rgb", "depth"):
            stored, expected = file["steps/cameras/wrist"][part], getattr(camera, part)
            assert stored.chunks == (1, *expected.shape[1:]) and stored.dtype == expected.dtype
            assert all(np.array_equal(stored[i], image) for i, image in enumerate(expected))
    assert same(load_demonstration(tmp_path / "demo.h5"), demonstration)


@pytest.mark.parametrize(
    "chunk", [zlib.compress(bytes(10**6)), zlib.compress(bytes(5)), b"no stream at all" * 8]
)
def test_an_image_that_unpacks_to_another_size_is_refused_before_it_takes_memory(tmp_path, chunk):
    save_demonstration(tmp_path / "demo.h5", make_demonstration())

    def exchange(file):
        file["steps/cameras/wrist/rgb"].id.write_direct_chunk((2, 0, 0, 0), chunk)

    rewritten(tmp_path / "demo.h5", exchange)
    tracemalloc.start()
    with pytest.raises(BrokenFile, match="truncated or not a demonstration file"):
        load_demonstration(tmp_path / "demo.h5")
    assert tracemalloc.get_traced_memory()[1] < 10**6
    tracemalloc.stop()


def test_states_that_are_nearly_alike_take_hardly_more_room_than_one(tmp_path):
    world = np.random.default_rng(0).bytes(100_000)
    alike = tuple(b"step %d " % i + world for i in range(20))
    demonstration = dataclasses.replace(make_demonstration(20), states=alike)
    save_demonstration(tmp_path / "demo.h5", demonstration)
    assert (tmp_path / "demo.h5").stat().st_size < 200_000
    assert load_demonstration(tmp_path / "demo.h5").states == alike


@pytest.mark.parametrize("name", ["lid/hinge", "."])
def test_a_body_of_any_name_is_read_back_or_refused(tmp_path, name):
    try:
        demonstration = make_demonstration(bodies=(name,))
        save_demonstration(tmp_path / "demo.h5", demonstration)
    except InvalidInput:
        return
    assert same(load_demonstration(tmp_path / "demo.h5"), demonstration)


def test_a_certificate_of_any_size_is_read_back(tmp_path):
    episode = make_episode(make_demonstration(), certificate={"margins": list(range(20000))})
    save_episode(tmp_path / "episode.h5", episode)
    assert same(load_episode(tmp_path / "episode.h5"), episode)


def test_saving_again_gives_the_same_content(saved, tmp_path):
    save, load, _, path = saved
    again = tmp_path / f"again{path.suffix}"
    save(again, load(path))
    assert same(load(again), load(path))


def test_json_is_read_back_without_its_schema_version(tmp_path):
    value = {"a": [1, 2.5, None], "name": "Å", "deep": {"x": True}}
    write_json(tmp_path / "x.json", value)
    assert read_any(tmp_path / "x.json") == value
    assert json.loads((tmp_path / "x.json").read_bytes())["schema_version"] == SCHEMA_VERSION


def test_text_is_written_to_a_folder_that_is_made_for_it(tmp_path):
    write_text(tmp_path / "a" / "b" / "x.txt", "hello")
    assert (tmp_path / "a" / "b" / "x.txt").read_text() == "hello"


def test_a_written_file_has_the_mode_that_any_new_file_has(tmp_path):
    write_text(tmp_path / "ours.txt", "")
    (tmp_path / "plain.txt").write_text("")
    assert (tmp_path / "ours.txt").stat().st_mode == (tmp_path / "plain.txt").stat().st_mode


# --- files that can't be read -------------------------------------------------------------------

LOADERS = [load_demonstration, load_episode, load_annotation, read_any]


@pytest.mark.parametrize("load", LOADERS)
def test_a_missing_file_is_reported(load, tmp_path):
    with pytest.raises(MissingFile, match="nowhere.h5: no such file; check the path"):
        load(tmp_path / "nowhere.h5")


@pytest.mark.parametrize("load", LOADERS)
def test_a_directory_in_place_of_a_file_is_reported(load, tmp_path):
    with pytest.raises(BrokenFile, match="is a directory; expected a file"):
        load(tmp_path)


@pytest.mark.parametrize("load", LOADERS)
def test_a_name_that_the_disk_does_not_take_is_no_other_error(load, tmp_path):
    with pytest.raises((MissingFile, BrokenFile), match="x{300}"):
        load(tmp_path / ("x" * 300))


@pytest.mark.parametrize("load", [load_demonstration, load_episode])
@pytest.mark.parametrize("content", [b"", b"{}", b"sart_toolkit []", bytes(5000)])
def test_a_file_that_is_not_hdf5_is_broken(load, content, tmp_path):
    (tmp_path / "x.h5").write_bytes(content)
    with pytest.raises(BrokenFile, match="x.h5: truncated or not a"):
        load(tmp_path / "x.h5")


@pytest.mark.parametrize("kind", ["demonstration", "episode"])
def test_a_truncated_hdf5_file_is_broken_wherever_it_was_cut(kind, tmp_path):
    save, load, make = SAVED[kind]
    save(tmp_path / "whole.h5", make())
    content = (tmp_path / "whole.h5").read_bytes()
    cuts = {*np.linspace(0, len(content) - 1, 150).astype(int), *range(96), len(content) - 1}
    for cut in cuts:
        (tmp_path / "cut.h5").write_bytes(content[:cut])
        with pytest.raises(BrokenFile, match="cut.h5: truncated"):
            load(tmp_path / "cut.h5")


def test_a_truncated_annotation_is_broken_wherever_it_was_cut(tmp_path):
    save_annotation(tmp_path / "whole.json", make_annotation(make_demonstration()))
    content = (tmp_path / "whole.json").read_bytes().rstrip()
    for cut in range(0, len(content), 7):
        (tmp_path / "cut.json").write_bytes(content[:cut])
        with pytest.raises(BrokenFile, match="cut.json: not readable as JSON"):
            load_annotation(tmp_path / "cut.json")


def test_a_file_of_another_kind_is_reported_with_both_kinds(tmp_path):
    demonstration = make_demonstration()
    save_demonstration(tmp_path / "demo.h5", demonstration)
    save_episode(tmp_path / "episode.h5", make_episode(demonstration))
    with pytest.raises(BrokenFile, match="holds 'demonstration', expected a episode"):
        load_episode(tmp_path / "demo.h5")
    with pytest.raises(BrokenFile, match="holds 'episode', expected a demonstration"):
        load_demonstration(tmp_path / "episode.h5")
    with h5py.File(tmp_path / "other.h5", "w"):
        pass
    with pytest.raises(
        BrokenFile, match=f"older than {SCHEMA_VERSION}, or the file is not of sart_toolkit; rec"
    ):
        load_demonstration(tmp_path / "other.h5")


@pytest.mark.parametrize("version", [0, SCHEMA_VERSION + 1, "new"])
def test_a_schema_of_another_version_is_reported(saved, version):
    _, load, _, path = saved
    if path.suffix == ".h5":
        old = json.dumps({"schema_version": SCHEMA_VERSION})[1:-1].encode()
        new = json.dumps({"schema_version": version})[1:-1].encode()
        path.write_bytes(path.read_bytes().replace(old, new, 1))
    else:
        path.write_text(json.dumps({**json.loads(path.read_text()), "schema_version": version}))
    with pytest.raises(BrokenFile, match=f"schema_version is '?{version}'?, this version reads"):
        load(path)


def test_a_json_file_without_schema_is_reported(tmp_path):
    (tmp_path / "x.json").write_text("{}")
    with pytest.raises(BrokenFile, match="schema_version is None"):
        read_any(tmp_path / "x.json")


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe{}", b"[" * 100_000, b"{'a': 1}"])
def test_what_is_not_json_is_broken(content, tmp_path):
    (tmp_path / "x.json").write_bytes(content)
    with pytest.raises(BrokenFile, match="x.json: not readable as JSON"):
        read_any(tmp_path / "x.json")


@pytest.mark.parametrize("content", ["[]", "3", "null", '"text"'])
def test_json_that_is_no_object_is_broken(content, tmp_path):
    (tmp_path / "x.json").write_text(content)
    with pytest.raises(BrokenFile, match="x.json: expected a JSON object, got"):
        read_any(tmp_path / "x.json")


def test_a_json_file_that_may_not_be_read_is_reported(tmp_path, monkeypatch):
    (tmp_path / "x.json").write_text("{}")

    def refused(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "read_text", refused)
    monkeypatch.setattr(Path, "read_bytes", refused)
    with pytest.raises(BrokenFile, match="x.json: Permission denied; check the path"):
        read_any(tmp_path / "x.json")


def _meta_is(text):
    def edit(file):
        del file["meta"]
        file["meta"] = np.frombuffer(text.encode(), np.uint8)

    return edit


def _change_meta(file, **change):
    meta = {**json.loads(file["meta"][()].tobytes()), **change}
    _meta_is(json.dumps(meta))(file)


def _delete_steps(file):
    del file["steps"]


def _replace_steps(file):
    del file["steps"]
    file["steps"] = 3


def _shear(file):
    file["steps/measured_Ts_world_tool"][0, 0, 0] = 5


def _spoil(file):
    file["steps/measured_gripper"][0] = np.nan


def _shorten(file):
    del file["timestamps"]
    file["timestamps"] = [0.0]


def _misname_sizes(file):
    del file["states/sizes"]
    file["states/sizes"] = "many"


def _scramble_states(file):
    file["states/xz"][40:60] = 0


@pytest.mark.parametrize(
    "damage",
    [
        _delete_steps,
        _replace_steps,
        _shear,
        _spoil,
        _shorten,
        _misname_sizes,
        _scramble_states,
        functools.partial(_change_meta, colour="red"),
        functools.partial(_change_meta, task=None),
        _meta_is("5"),
        _meta_is("[1]"),
        _meta_is("{"),
    ],
    ids=[
        "no steps", "steps no group", "not rigid", "NaN", "short", "sizes", "states",
        "unknown meta", "other task", "meta a number", "meta a list", "meta no JSON",
    ],
)  # fmt: skip
def test_a_demonstration_file_whose_content_is_wrong_is_broken(damage, tmp_path):
    save_demonstration(tmp_path / "demo.h5", make_demonstration())
    rewritten(tmp_path / "demo.h5", damage)
    with pytest.raises(BrokenFile, match="demo.h5"):
        load_demonstration(tmp_path / "demo.h5")


def test_a_changed_demonstration_is_reported_by_its_hash(tmp_path):
    save_demonstration(tmp_path / "demo.h5", make_demonstration())
    with h5py.File(tmp_path / "demo.h5", "r+") as file:
        file["steps/cameras/wrist/rgb"][0, 0, 0, 0] ^= 1
    with pytest.raises(BrokenFile, match="content differs from its hash"):
        load_demonstration(tmp_path / "demo.h5")


@pytest.mark.parametrize("provenance", ["{}", "[]", "5", '{"colour": 1}', "{"])
def test_an_episode_file_whose_provenance_is_wrong_is_broken(provenance, tmp_path):
    save_episode(tmp_path / "episode.h5", make_episode(make_demonstration()))
    value = json.dumps({"provenance": None, "cameras": {"wrist": "tool"}, "content_hash": "0"})
    rewritten(tmp_path / "episode.h5", _meta_is(value.replace("null", provenance)))
    with pytest.raises(BrokenFile, match="episode.h5"):
        load_episode(tmp_path / "episode.h5")


# --- annotations that a person has edited -------------------------------------------------------


@pytest.fixture
def edited(tmp_path):
    """Loads an annotation after an edit of its JSON values."""
    demonstration = make_demonstration()
    path = tmp_path / "annotation.json"
    save_annotation(path, make_annotation(demonstration))

    def load(edit):
        value = json.loads(path.read_text())
        edit(value)
        path.write_text(json.dumps(value))
        return load_annotation(path)

    return load


@pytest.mark.parametrize("radius", [0, -0.02, -1e300])
def test_an_edited_radius_that_is_not_positive_is_reported_with_file_and_waypoint(edited, radius):
    with pytest.raises(InvalidInput, match="annotation.json: radius of the sphere at waypoint 2"):
        edited(lambda value: value["spheres"][1].update(radius_m=radius))


def test_an_unknown_sphere_field_is_reported(edited):
    with pytest.raises(
        BrokenFile, match="annotation.json: not an annotation: .*unknown field `radius` - "
    ):
        edited(lambda value: value["spheres"][0].update(radius=0.1))


def test_an_unknown_annotation_field_is_reported(edited):
    with pytest.raises(BrokenFile, match="annotation.json: .*unknown field `second_spent`"):
        edited(lambda value: value.update(second_spent=3))


@pytest.mark.parametrize("field", ["waypoint", "radius_m", "T_world_key"])
def test_a_missing_sphere_field_is_reported(edited, field):
    with pytest.raises(BrokenFile, match=f"annotation.json: not an annotation: .*`{field}`"):
        edited(lambda value: value["spheres"][0].pop(field))


@pytest.mark.parametrize("field", ["spheres", "demonstration_hash"])
def test_a_missing_annotation_field_is_reported(edited, field):
    with pytest.raises(BrokenFile, match=f"annotation.json: not an annotation: .*`{field}`"):
        edited(lambda value: value.pop(field))


def test_fields_that_a_person_may_leave_out_have_defaults(edited):
    def shorten(value):
        del value["about"], value["seconds_spent"], value["settings"]
        for field in ("kind", "source", "clearance_m", "limited_by"):
            del value["spheres"][0][field]

    annotation = edited(shorten)
    assert annotation.seconds == 0
    assert annotation.spheres[0].source == "human"
    assert annotation.spheres[0].clearance is None


json_values = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 6),
    st.floats(),
    st.sampled_from(["0.05", "ball", "wide", ""]),
    st.just([]),
    st.just({}),
    st.just([[1], [2, 3]]),
    st.just(np.eye(4).tolist()),
)
_DEMONSTRATION = make_demonstration()
_ANNOTATION = annotation_to_json(make_annotation(_DEMONSTRATION))


@settings(PROPERTY, max_examples=300)
@given(
    st.sampled_from([*_ANNOTATION, *(f"spheres/{name}" for name in _ANNOTATION["spheres"][0])]),
    json_values,
)
def test_an_annotation_with_any_value_anywhere_works_or_is_refused(field, value):
    values = json.loads(json.dumps(_ANNOTATION))
    inside = values["spheres"][1] if field.startswith("spheres/") else values
    inside[field.removeprefix("spheres/")] = value
    with contextlib.suppress(SartError):
        annotation = annotation_from_json(values, Path("edited.json"))
        annotation.check_matches(_DEMONSTRATION)
        for sphere in annotation.spheres:
            assert 0 < convergence_waypoint(_DEMONSTRATION, sphere) < len(_DEMONSTRATION)
        written = annotation_to_json(annotation)
        assert same(annotation_from_json(written, Path("again.json")), annotation)
        json.dumps(written)


# --- writes that fail ---------------------------------------------------------------------------


def content_of(directory):
    """Every file below a directory with its bytes, hidden ones too."""
    return {str(p): p.read_bytes() for p in directory.rglob("*") if p.is_file()}


class Interrupted(BaseException):
    """Stands for whatever may end a program, as KeyboardInterrupt does."""


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path):
    (tmp_path / "x.txt").write_text("old")
    before = content_of(tmp_path)
    with pytest.raises(Interrupted), replacing(tmp_path / "x.txt") as temporary:
        temporary.write_text("half of the ne")
        raise Interrupted
    assert content_of(tmp_path) == before


def test_an_interrupted_write_leaves_no_new_file(tmp_path):
    with pytest.raises(Interrupted), replacing(tmp_path / "x.txt") as temporary:
        assert temporary.parent == tmp_path
        raise Interrupted
    assert content_of(tmp_path) == {}


def test_a_reader_sees_the_old_file_until_the_new_one_is_whole(tmp_path):
    (tmp_path / "x.txt").write_text("old")
    with replacing(tmp_path / "x.txt") as temporary:
        temporary.write_text("new")
        assert (tmp_path / "x.txt").read_text() == "old"
    assert content_of(tmp_path) == {str(tmp_path / "x.txt"): b"new"}


def test_an_error_of_ours_passes_through_a_write_unchanged(tmp_path):
    with pytest.raises(InvalidInput, match="mine"), replacing(tmp_path / "x.txt"):
        raise InvalidInput("mine")


def refuse(monkeypatch, owner, name, code):
    def raises(*_, **__):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(owner, name, raises)


@pytest.mark.parametrize("step", ["fsync", "chmod", "replace"])
def test_a_disk_that_is_full_at_any_step_leaves_the_old_file(saved, step, tmp_path, monkeypatch):
    save, _, record, path = saved
    before = content_of(tmp_path)
    refuse(monkeypatch, os, step, errno.ENOSPC)
    with pytest.raises(CannotWrite, match=f"{path.name}: No space left on device; nothing was"):
        save(path, record)
    assert content_of(tmp_path) == before


_SAVE_ON_A_FULL_DISK = """
import resource, sys
from sart_toolkit.errors import CannotWrite
from sart_toolkit.data.storage import load_demonstration, save_demonstration

demonstration = load_demonstration(sys.argv[1])
_, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
for limit in map(int, sys.argv[2:]):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        save_demonstration(sys.argv[1], demonstration)
    except CannotWrite:
        sys.stdout.write(f"{limit} ")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no limit to file sizes")
def test_a_disk_that_fills_up_while_hdf5_writes_leaves_the_old_file_and_the_process(tmp_path):
    path = tmp_path / "demo.h5"
    save_demonstration(path, make_demonstration())
    before = content_of(tmp_path)
    size = path.stat().st_size
    limits = [str(limit) for limit in (0, 100, size // 8, size // 2, size - 1)]
    words = [sys.executable, "-c", _SAVE_ON_A_FULL_DISK, str(path), *limits]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()) == (0, limits), done.stderr[-2000:]
    assert content_of(tmp_path) == before


def test_a_folder_that_may_not_be_written_is_reported(saved, tmp_path, monkeypatch):
    save, _, record, path = saved
    before = content_of(tmp_path)
    refuse(monkeypatch, tempfile, "mkstemp", errno.EACCES)
    with pytest.raises(CannotWrite, match="permission denied; choose another --out or fix"):
        save(path, record)
    assert content_of(tmp_path) == before


def test_a_path_below_a_file_is_reported(saved, tmp_path):
    save, _, record, path = saved
    before = content_of(tmp_path)
    with pytest.raises(CannotWrite, match=f"below{path.suffix}: "):
        save(path / f"below{path.suffix}", record)
    assert content_of(tmp_path) == before


def test_a_directory_is_never_replaced_by_a_file(saved, tmp_path):
    save, _, record, path = saved
    (tmp_path / "folder").mkdir()
    with pytest.raises(CannotWrite, match="folder: Is a directory"):
        save(tmp_path / "folder", record)
    assert [p.name for p in tmp_path.iterdir() if p != path] == ["folder"]


@pytest.mark.parametrize(
    "value", [float("nan"), float("inf"), [0, float("-inf")], np.zeros(2), object(), {1j: 2}]
)
def test_what_json_can_not_hold_is_refused_and_nothing_is_written(value, tmp_path):
    write_json(tmp_path / "x.json", {"a": 1})
    before = content_of(tmp_path)
    with pytest.raises(InvalidInput, match="x.json: can't be written as JSON"):
        write_json(tmp_path / "x.json", {"a": value})
    assert content_of(tmp_path) == before


# --- outputs ------------------------------------------------------------------------------------


def test_an_output_that_exists_is_refused_without_overwrite(tmp_path):
    (tmp_path / "x.txt").write_text("old")
    for path in (tmp_path / "x.txt", tmp_path):
        with pytest.raises(OutputExists, match="already exists; add --overwrite or choose another"):
            check_writable(path)
        check_writable(path, overwrite=True)
    assert content_of(tmp_path) == {str(tmp_path / "x.txt"): b"old"}


def test_an_absent_output_or_an_empty_folder_may_be_written(tmp_path):
    for path in (tmp_path, tmp_path / "new.txt", tmp_path / "a" / "b" / "new.txt"):
        check_writable(path)
    assert list(tmp_path.iterdir()) == []


def test_an_output_below_a_file_is_refused(tmp_path):
    (tmp_path / "x.txt").write_text("old")
    with pytest.raises(CannotWrite, match="x.txt is not a directory; choose another --out"):
        check_writable(tmp_path / "x.txt" / "a" / "b")


def test_an_output_in_a_folder_that_may_not_be_written_is_refused(tmp_path, monkeypatch):
    refuse(monkeypatch, tempfile, "TemporaryFile", errno.EACCES)
    with pytest.raises(CannotWrite, match="new.txt: permission denied; choose another --out"):
        check_writable(tmp_path / "new.txt")


def test_an_output_with_a_name_that_the_disk_does_not_take_is_refused(tmp_path):
    with pytest.raises(CannotWrite, match="File name too long"):
        check_writable(tmp_path / ("x" * 300))


def test_a_disk_has_room_or_says_how_much_is_missing(tmp_path):
    path = tmp_path / "new" / "x.bin"
    check_room(path, shutil.disk_usage(tmp_path).free // 2)
    with pytest.raises(CannotWrite, match=r"x.bin: needs 1000000000.0 GB and \d+.\d GB are free"):
        check_room(path, 10**18)
    assert not path.parent.exists()


def test_remove_takes_files_and_folders_and_what_is_not_there(tmp_path):
    write_text(tmp_path / "folder" / "deep" / "x.txt", "")
    write_text(tmp_path / "x.txt", "")
    for name in ("folder", "x.txt", "nothing"):
        remove(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_remove_takes_a_link_and_leaves_what_it_points_to(tmp_path):
    write_text(tmp_path / "folder" / "x.txt", "kept")
    (tmp_path / "link").symlink_to(tmp_path / "folder")
    remove(tmp_path / "link")
    assert content_of(tmp_path) == {str(tmp_path / "folder" / "x.txt"): b"kept"}


def test_what_the_disk_does_not_let_go_is_reported(tmp_path, monkeypatch):
    write_text(tmp_path / "x.txt", "")
    refuse(monkeypatch, os, "unlink", errno.EACCES)
    with pytest.raises(CannotWrite, match="x.txt: permission denied"):
        remove(tmp_path / "x.txt")


def test_a_directory_is_cleared_only_where_it_is_marked_and_may_be_replaced(tmp_path):
    write_text(tmp_path / "ours" / "mark.json", "{}")
    with pytest.raises(OutputExists, match="ours: already exists; add --overwrite"):
        clear_directory(tmp_path / "ours", "mark.json", overwrite=False)
    assert (tmp_path / "ours" / "mark.json").exists()
    clear_directory(tmp_path / "ours", "mark.json", overwrite=True)
    assert [str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")] == ["ours"]
    clear_directory(tmp_path / "absent", "mark.json", overwrite=False)


def test_a_directory_of_other_things_is_never_cleared(tmp_path):
    write_text(tmp_path / "theirs" / "thesis.tex", "years of work")
    with pytest.raises(OutputExists, match=r"holds other things \(no mark.json\)"):
        clear_directory(tmp_path / "theirs", "mark.json", overwrite=True)
    assert (tmp_path / "theirs" / "thesis.tex").read_text() == "years of work"


def test_a_file_in_place_of_a_directory_is_never_cleared(tmp_path):
    write_text(tmp_path / "thesis.tex", "years of work")
    with pytest.raises((OutputExists, CannotWrite), match="thesis.tex"):
        clear_directory(tmp_path / "thesis.tex", "mark.json", overwrite=True)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_lines_are_added_one_by_one_and_a_cut_one_is_left_out(tmp_path):
    path = tmp_path / "log.jsonl"
    assert read_json_lines(path) == []
    for k in range(3):
        append_json_line(path, {"k": k})
    path.write_bytes(path.read_bytes()[:-3])
    assert read_json_lines(path) == [{"k": 0}, {"k": 1}]


def test_a_line_that_the_disk_refuses_is_an_error_of_ours(tmp_path):
    with pytest.raises(CannotWrite, match="log.jsonl: "):
        append_json_line(tmp_path / "nowhere" / "log.jsonl", {"k": 0})
