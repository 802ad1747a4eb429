#!/usr/bin/env python3
"""Damage files of every kind in many ways, and see that each is refused, or read as it was.

    python tools/fuzz.py --count 100000 --out docs/results/fuzz.json

Mutation i of a seed is always the same one: `--only i` does it again and shows what comes of it.
Each must end in what was there before, or in an error of the toolkit's own. What is read and
differs is a failure where a hash covers it; so is any other error, a crash, more than 5 s, and
more than 500 MB of further address space. Half of the mutations are forged: the file's own hash is
made to fit again, so that what lies behind it is reached. Then no hash covers what only that one
did: it is counted apart.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import dataclasses
import functools
import hashlib
import json
import os
import queue
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sart_toolkit.backends.states import pack_state, unpack_state
from sart_toolkit.data import storage, structure
from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.records import (
    Annotation,
    CameraRecord,
    Demonstration,
    Episode,
    PrecisionSphere,
    Provenance,
    Steps,
    digest,
    library_versions,
)
from sart_toolkit.data.schemas import EvaluationFile, RunFile, TrainingFile
from sart_toolkit.data.writer import write_dataset
from sart_toolkit.errors import SartError
from sart_toolkit.poses import pose

# Of computing time: a busy machine is slow by itself. What inspects HDF5 has its own 2 s of the 5.
SECONDS, MEMORY_BYTES = 5.0 - structure.CPU_SECONDS, 500 * 10**6
# How long nothing may come back before a process counts as hung.
PATIENCE_SECONDS = 60.0
CHUNK = 200
HEAD = {"robot": "ur5e", "scene": "0" * 64, "bodies": ["peg"], "time": 0.5, "target": [0.0] * 6}
REQUEST = {"tasks": ["peg_in_hole"], "seed": 0}
GOOD = ("refused", "equal", "different, no hash covers")
BAD = ("different, a hash covers", "foreign content", "untyped", "slow", "memory", "crashed")

Rng = np.random.Generator
Fingerprint = dict[str, Any]


# --- small files of every kind -----------------------------------------------------------------


def make_steps(n: int, rng: Rng) -> Steps:
    """Steps with small images, whose content packs well."""
    Ts = np.stack([pose(rng.uniform(-0.3, 0.3, 3), rng.uniform(-1, 1, 3)) for _ in range(n)])
    camera = CameraRecord(
        rgb=rng.integers(0, 255, (n, 16, 16, 3), np.uint8) // 64 * 64,
        depth=np.round(rng.uniform(0, 2, (n, 16, 16))).astype(np.float32),
        intrinsics=np.diag([16.0, 16.0, 1.0]),
        frame="tool",
        T_frame_camera=pose([0.05, 0, -0.1]),
    )
    q = rng.normal(size=(3, n, 6))
    grip = rng.integers(0, 2, n).astype(float)
    return Steps(*q, Ts, Ts[::-1], grip, grip, np.zeros(n), {"wrist": camera})


def make_files(root: Path) -> None:
    """One small file or directory for each loader."""
    rng = np.random.default_rng(0)
    n = 6
    demonstration = Demonstration(
        task="peg_in_hole",
        task_parameters={"placement": {"x": 0.01, "y": 0.0, "yaw_deg": 0.0}, "note": "Lübeck"},
        robot="ur5e_2f85",
        backend="pybullet",
        steps=make_steps(n, rng),
        timestamps=np.arange(n) / 10,
        body_Ts_world={"block": np.tile(pose([0.5, 0, 0]), (n, 1, 1))},
        success=np.arange(n) > 3,
        touching=((), (("block", "peg"),)) * (n // 2),
        raw_commands=rng.normal(size=(3 * n, 7)),
        states=tuple(b"state %d" % i + bytes(500) for i in range(n)),
        operator="Åsa",
        device="none",
        seconds=3.0,
        seed=0,
        versions={"numpy": "2"},
        references={"task": "peg_in_hole"},
    )
    sha, Ts = demonstration.content_hash(), demonstration.steps.measured_Ts_world_tool
    spheres = [PrecisionSphere(t, Ts[t], 0.02, "ball", "suggested", 0.03, "a / b") for t in (0, 2)]
    annotation = Annotation(tuple(spheres), sha, 2.0, {"margin": 0.0005})
    proof = {"commanded": {"clearance": 0.001}, "measured": {"clearance": 0.0005}, "deviation": 0.0}
    episodes = [
        Episode(
            make_steps(4, rng),
            Provenance(sha, 0, k % 2, k // 2, 3, Ts[k], 0, "sart", "paper", proof),
            rng.normal(size=(20, 6)),
        )
        for k in range(3)
    ]
    storage.save_demonstration(root / "demonstration" / "demo.h5", demonstration)
    storage.save_annotation(root / "annotation" / "annotation.json", annotation)
    storage.save_episode(root / "episode" / "episode.h5", episodes[0])
    dataset = write_dataset(
        root / "dataset", [(demonstration, annotation)], episodes, {"task": "peg_in_hole"}
    )
    make_skill(root / "skill", dataset)
    make_results(root)
    (root / "saved state").mkdir()
    (root / "saved state" / "a.state").write_bytes(pack_state("pybullet", HEAD, bytes(100)))
    (root / "urdf").mkdir()
    (root / "urdf" / "arm.urdf").write_text(ARM)


def make_skill(path: Path, dataset: Any) -> None:
    """An untrained skill, and a tensor file like a checkpoint."""
    import torch

    from sart_toolkit.learn.skill import save_skill
    from sart_toolkit.learn.tensorfile import save_tensors
    from sart_toolkit.learn.training import EpochRecord, TrainConfig, TrainResult, build_policy

    torch.manual_seed(0)
    options = {"epochs": 1, "image_size": 16, "image_shift": 1, "hidden": 8, "device": "cpu"}
    config = TrainConfig.for_policy("compact_mlp", **options)
    policy = build_policy(config, {"wrist": (16, 16)})
    curve = (EpochRecord(1, 0.5, 1.0),)
    result = TrainResult(policy, config, curve, 100.0, 10, 4, "cpu", False)
    save_skill(path, result, dataset)
    tensors = {"policy/a": torch.randn(20), "step": torch.tensor(3)}
    save_tensors(path.parent / "tensors" / "a.safetensors", tensors, {"curve": [1.5], "batch": 3})


def make_results(root: Path) -> None:
    """What an evaluation, a run and a benchmark leave."""
    rows = [
        {
            "episode": k,
            "seed": [1000, k],
            "placement": {"block": {"x": 0.01, "y": 0.02, "yaw_deg": 0.0}},
            "outcome": "success" if k else "failure",
            "success_any": True,
            "steps": 50,
            "reason": None if k else "time limit",
        }
        for k in range(3)
    ]
    evaluation = {
        "task": "peg_in_hole", "backend": "pybullet", "robot": "ur5e_2f85",
        "policy": "compact_mlp", "n_episodes": 3, "n_success": 2, "success_rate": 2 / 3,
        "ci95": [0.2, 0.9], "n_success_any": 3, "success_rate_any": 1.0, "ci95_any": [0.4, 1.0],
        "seconds": 12.0, "episodes": rows, "config": {"episodes": 3}, "versions": {"numpy": "2"},
        "videos": [{"path": "videos/success_000.mp4", "episode": 1, "outcome": "success"}],
    }  # fmt: skip
    storage.write_json(root / "evaluation" / "evaluation.json", evaluation)
    run = {"config": {"task": "peg_in_hole", "n": 40}, "stages": {"record": 6.1}, "command": "sart"}
    storage.write_json(root / "evaluation" / "run.json", run)
    training = {
        "curve": [{"epoch": 1, "loss": 0.5, "seconds": 3.0}],
        "images_per_second": 900.0,
        "config": {"policy": "compact_mlp"},
    }
    storage.write_json(root / "evaluation" / "training.json", training)
    log = root / "result log" / "out.json.journal"
    log.parent.mkdir()
    for row in (REQUEST, {"cell": "a", "seconds": 1.5}, {"cell": "b", "seconds": 2.5}):
        storage.append_json_line(log, row)


_LINK = """<link name="{0}"><inertial><mass value="1"/><origin xyz="0 0 0" rpy="0 0 0"/>
  <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
  <visual><geometry><sphere radius="0.04"/></geometry></visual>
  <collision><origin xyz="0 0 0" rpy="0 0 0.1"/><geometry><box size="0.1 0.1 0.1"/></geometry>
  </collision></link>"""
_JOINT = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>
  <origin xyz="0 0 0.3" rpy="0 0 0"/><axis xyz="{3}"/>
  <limit lower="-2" upper="2" effort="10" velocity="1"/></joint>"""
ARM = "".join(
    [
        '<robot name="tiny">',
        *(_LINK.format(name) for name in ("base_link", "upper", "flange")),
        _JOINT.format("shoulder", "base_link", "upper", "0 0 1"),
        _JOINT.format("wrist", "upper", "flange", "0 1 0"),
        "</robot>",
    ]
)
HAND = "".join(
    [
        '<robot name="hand">',
        *(_LINK.format(name) for name in ("base_link", "finger")),
        _JOINT.format("finger_joint", "base_link", "finger", "1 0 0"),
        "</robot>",
    ]
)


# --- loaders: what a file says, in two parts ----------------------------------------------------
#
# "covered" is what a hash still covers when a file's own hash was made to fit again.


def _other(record: Any) -> Any:
    """All of a record that its content hash leaves out."""
    left = {
        f.name: getattr(record, f.name)
        for f in dataclasses.fields(record)
        if f.name not in ("steps", "body_Ts_world", "states", "joint_path")
    }
    return json.loads(json.dumps(left, default=_plain))


def _plain(value: Any) -> Any:
    return dataclasses.asdict(value) if dataclasses.is_dataclass(value) else value.tolist()


def read_demonstration(at: Path) -> Fingerprint:
    """What a demonstration's file says."""
    found = storage.load_demonstration(at / "demo.h5")
    return {"covered": found.content_hash(), "rest": _other(found)}


def read_annotation(at: Path) -> Fingerprint:
    """What an annotation says."""
    found = storage.load_annotation(at / "annotation.json")
    return {"covered": None, "rest": found.content_hash()}


def read_episode(at: Path) -> Fingerprint:
    """What an episode's file says."""
    return {"covered": storage.load_episode(at / "episode.h5").content_hash(), "rest": None}


def read_dataset(at: Path) -> Fingerprint:
    """What a dataset says, every part of it read."""
    found = load_dataset(at)
    parts = [found.content_hash, [e.content_hash() for e in found]]
    rest = [dict(found.info)]
    for source in found.sources:
        parts += [source.demonstration.content_hash(), source.annotation.content_hash()]
        rest.append(_other(source.demonstration))
    return {"covered": parts, "rest": rest}


def read_skill(at: Path) -> Fingerprint:
    """What a skill says."""
    from sart_toolkit.learn.skill import load_skill
    from sart_toolkit.learn.tensorfile import tensors_digest

    found = load_skill(at)
    weights = tensors_digest(found._policy.state_dict())
    parts = [found.demonstration.content_hash(), found.annotation.content_hash(), found.training]
    rest = [found.config.to_json(), _other(found.demonstration)]
    return {"covered": [weights, *parts], "rest": rest}


def read_tensors(at: Path) -> Fingerprint:
    """What a tensor file says."""
    from sart_toolkit.learn.tensorfile import load_tensors, tensors_digest

    tensors, about = load_tensors(at / "a.safetensors")
    return {"covered": [tensors_digest(tensors), about], "rest": None}


def read_evaluation(at: Path) -> Fingerprint:
    """What a report and `sart info` read of a run."""
    from sart_toolkit.cli.info import without_rows

    evaluation = storage.read_json(at / "evaluation.json", EvaluationFile)
    without_rows(evaluation)
    run = storage.read_json(at / "run.json", RunFile)
    training = storage.read_json(at / "training.json", TrainingFile)
    return {"covered": None, "rest": [evaluation, run, training]}


def read_result_log(at: Path) -> Fingerprint:
    """What a benchmark that was interrupted left."""
    from sart_toolkit.data.result_log import ResultLog

    with ResultLog(at / "out.json", REQUEST, overwrite=False) as log:
        return {"covered": None, "rest": log.rows}


def read_state(at: Path) -> Fingerprint:
    """What a saved state says, before a simulator has it."""
    state = (at / "a.state").read_bytes()
    head, world = unpack_state("pybullet", state, HEAD["robot"], HEAD["scene"], HEAD["bodies"])
    return {"covered": None, "rest": [head, world.hex()]}


def read_urdf(at: Path) -> Fingerprint:
    """The robot that is made of a URDF."""
    from sart_toolkit.robots.model import RobotModel
    from sart_toolkit.robots.spec import CameraSpec, GripperSpec, RobotSpec

    (at.parent / "hand.urdf").write_text(HAND)
    gripper = GripperSpec(
        urdf=str(at.parent / "hand.urdf"),
        parent_frame="flange",
        driver="gripper_finger_joint",
        followers={},
        closed_position=1.0,
        finger_links=("gripper_finger",),
    )
    spec = RobotSpec(
        name="tiny",
        urdf=str(at / "arm.urdf"),
        arm_joints=("shoulder", "wrist"),
        home=np.zeros(2),
        velocity_limits=np.ones(2),
        acceleration_limits=np.ones(2),
        jerk_limits=np.ones(2),
        gripper=gripper,
        gripper_base="gripper_base_link",
        T_gripper_tool=pose([0, 0, 0.1]),
        cameras=(CameraSpec("wrist", "gripper_base_link", np.eye(4)),),
    )
    try:
        model = RobotModel(spec)
        return {"covered": None, "rest": hashlib.sha256(model.urdf.read_bytes()).hexdigest()}
    finally:
        shutil.rmtree(os.environ["SART_CACHE"], ignore_errors=True)


@dataclasses.dataclass(frozen=True)
class Loader:
    """How one kind of file is read: `weight` is its share of the mutations."""

    name: str
    read: Callable[[Path], Fingerprint]
    weight: int = 1


LOADERS = (
    Loader("demonstration", read_demonstration, 3),
    Loader("annotation", read_annotation),
    Loader("episode", read_episode, 2),
    Loader("dataset", read_dataset, 2),
    Loader("skill", read_skill, 2),
    Loader("tensors", read_tensors),
    Loader("evaluation", read_evaluation),
    Loader("result log", read_result_log),
    Loader("saved state", read_state),
    Loader("urdf", read_urdf),
)


# --- mutations of bytes ------------------------------------------------------------------------


def _place(rng: Rng, n: int) -> int:
    return int(rng.integers(0, max(1, n)))


def mutate_bytes(content: bytes, rng: Rng) -> tuple[str, bytes]:
    """Some bytes changed, lost, added or exchanged."""
    data, n = bytearray(content), len(content)
    at, size = _place(rng, n), int(rng.choice([1, 2, 4, 8, 64, 512, 4096]))
    other = _place(rng, n)
    kind = str(
        rng.choice(
            ["flip", "flips", "byte", "cut", "insert", "delete", "splice", "swap", "zero", "fill"]
        )
    )
    if kind == "flip":
        data[at] ^= 1 << int(rng.integers(8))
    elif kind == "flips":
        for _ in range(int(rng.integers(2, 20))):
            data[_place(rng, n)] ^= 1 << int(rng.integers(8))
    elif kind == "byte":
        data[at] = int(rng.integers(256))
    elif kind == "cut":
        data = data[:at]
    elif kind == "insert":
        data[at:at] = rng.bytes(size)
    elif kind == "delete":
        del data[at : at + size]
    elif kind == "splice":
        data[at : at + size] = content[other : other + size]
    elif kind == "swap":
        low, high = sorted((at, other))
        size = min(size, high - low, n - high)
        data[low : low + size] = content[high : high + size]
        data[high : high + size] = content[low : low + size]
    else:
        size = min(size, n - at)
        data[at : at + size] = (b"\0" if kind == "zero" else b"\xff") * size
    return kind, bytes(data)


# --- mutations of JSON -------------------------------------------------------------------------

_ODD = (
    None, True, False, 0, -1, 10**18, 10**400, -(10**30), 0.5, 1e308, "", "text", "../../etc/hosts",
    "/etc/hosts", "a\0b", "..", "\ud800", "NaN", [], {}, [[]], {"": {}}, [None] * 50, "x" * 10**5,
)  # fmt: skip
_RAW = ("NaN", "Infinity", "-Infinity", "1e999", "[" * 100_000, '{"a":' * 50_000, "1" * 5000)


def _places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    inside = value.items() if isinstance(value, dict) else ()
    inside = enumerate(value) if isinstance(value, list) else inside
    for key, deeper in inside:
        yield (*at, key)
        yield from _places(deeper, (*at, key))


def mutate_json(value: Any, rng: Rng) -> tuple[str, str | Any]:
    """A JSON value that was changed in one place, or its text where no value has it."""
    value = json.loads(json.dumps(value))
    places = list(_places(value))
    *way, key = places[_place(rng, len(places))]
    inside = functools.reduce(lambda deeper, k: deeper[k], way, value)
    kind = str(rng.choice(["drop", "odd", "number", "deepen", "raw", "twice", "rename", "swap"]))
    if kind == "drop":
        del inside[key]
    elif kind == "odd":
        inside[key] = _ODD[_place(rng, len(_ODD))]
    elif kind == "number":
        old = inside[key]
        number = isinstance(old, int | float) and not isinstance(old, bool)
        inside[key] = old + float(rng.normal()) if number else float(rng.normal())
    elif kind == "deepen":
        for _ in range(int(rng.choice([1, 10, 600]))):
            inside[key] = [inside[key]]
    elif kind == "rename" and isinstance(inside, dict):
        inside[key + "x"] = inside.pop(key)
    elif kind == "swap":
        *way, other = places[_place(rng, len(places))]
        there = functools.reduce(lambda deeper, k: deeper[k], way, value)
        with contextlib.suppress(ValueError):
            inside[key] = json.loads(json.dumps(there[other]))
    elif kind in ("raw", "twice"):
        mark = "f2a9-here"
        old = json.dumps(inside[key])
        inside[key] = mark
        text = json.dumps(value)
        raw = str(rng.choice(_RAW)) if kind == "raw" else old
        if kind == "twice" and isinstance(inside, dict):
            raw = f"{old}, {json.dumps(key)}: 3"
        return kind, text.replace(f'"{mark}"', raw)
    return kind, value


def mutate_json_file(path: Path, rng: Rng) -> tuple[str, bool]:
    """Change one place of a JSON file."""
    sealed = path.name != "annotation.json"
    kind, value = mutate_json(json.loads(path.read_text()), rng)
    forged = bool(rng.integers(2)) and sealed and not isinstance(value, str)
    if forged and isinstance(value, dict):
        with contextlib.suppress(ValueError, RecursionError):
            value = storage.with_seal(value)
    path.write_text(value if isinstance(value, str) else json.dumps(value))
    # No hash covers what a person may edit.
    return f"json {kind}" + (", forged" if forged else ""), forged or not sealed


def mutate_lines(path: Path, rng: Rng) -> tuple[str, bool]:
    """Change, lose, repeat or exchange a line."""
    lines = path.read_bytes().splitlines(keepends=True)
    i, kind = _place(rng, len(lines)), str(rng.choice(["row", "drop", "twice", "swap", "cut"]))
    forged = False
    if kind == "row":
        row = storage._of_line(lines[i][:-1])
        what, value = mutate_json(row, rng)
        kind = f"row {what}"
        if isinstance(value, str):
            lines[i] = value.encode() + b"\n"
        else:
            forged = bool(rng.integers(2))
            lines[i] = storage._to_line(value) if forged else json.dumps(value).encode() + b"\n"
    elif kind == "drop":
        del lines[i]
        forged = True
    elif kind == "twice":
        lines.insert(i, lines[i])
        forged = True
    elif kind == "swap":
        j = _place(rng, len(lines))
        lines[i], lines[j] = lines[j], lines[i]
        forged = True
    else:
        lines = [*lines[:-1], lines[-1][: _place(rng, len(lines[-1]))]]
        forged = True
    path.write_bytes(b"".join(lines))
    return f"lines {kind}" + (", forged" if forged else ""), forged


# --- mutations of HDF5 -------------------------------------------------------------------------


def _reseal(path: Path, kind: str) -> None:
    body = path.read_bytes()[storage._BLOCK :]
    sha = hashlib.sha256(body).hexdigest()
    path.write_bytes(storage._header(kind, len(body), sha) + body)


def _kind_of(path: Path) -> str:
    return "episode" if "sphere" in path.name or path.name == "episode.h5" else "demonstration"


def _names(file: h5py.File) -> list[str]:
    names: list[str] = []
    file.visit(names.append)
    return names


_FOREIGN = ("external link", "soft link", "external storage", "virtual")


def _change_hdf5(file: h5py.File, kind: str, rng: Rng, stranger: Path) -> None:
    names = _names(file)
    name = names[_place(rng, len(names))]
    leaves = [n for n in names if isinstance(file[n], h5py.Dataset)]
    leaf = leaves[_place(rng, len(leaves))]
    if kind in ("external link", "soft link"):
        content = file[name]
        with h5py.File(stranger, "w") as other:
            content.copy(content, other, "x") if isinstance(content, h5py.Group) else file.copy(
                content, other, "x"
            )
        file.move(name, "aside") if kind == "soft link" else file.pop(name)
        outside = h5py.ExternalLink(str(stranger), "/x")
        file[name] = h5py.SoftLink("/aside") if kind == "soft link" else outside
    elif kind == "external storage":
        array = file[leaf][()]
        raw = stranger.with_suffix(".raw")
        raw.write_bytes(array.tobytes())
        del file[leaf]
        where = [(str(raw), 0, max(1, array.nbytes))]
        file.create_dataset(leaf, array.shape, array.dtype, external=where)
    elif kind == "virtual":
        array = file[leaf][()]
        with h5py.File(stranger, "w") as other:
            other["x"] = array
        del file[leaf]
        layout = h5py.VirtualLayout(array.shape, array.dtype)
        layout[...] = h5py.VirtualSource(str(stranger), "x", array.shape)
        file.create_virtual_dataset(leaf, layout)
    elif kind == "huge":
        shape, dtype = file[leaf].shape, file[leaf].dtype
        del file[leaf]
        huge = (int(rng.choice([10**6, 10**9, 2**40])), *shape[1:])
        chunks = (1, *shape[1:]) if len(shape) > 2 else None
        shuffle = dtype.itemsize > 1
        packed = {"compression": "gzip", "compression_opts": 1, "shuffle": shuffle}
        file.create_dataset(leaf, huge, dtype, chunks=chunks, **(packed if chunks else {}))
    elif kind == "longer":
        array = file[leaf][()]
        del file[leaf]
        file[leaf] = np.concatenate([array, array]) if array.ndim else array
    elif kind == "drop":
        del file[name]
    elif kind == "rename":
        file.move(name, name + "x")
    elif kind == "add":
        file[f"{name}x"] = np.zeros(3)
    elif kind == "exchange":
        other = names[_place(rng, len(names))]
        if not (f"{name}/").startswith(f"{other}/") and not f"{other}/".startswith(f"{name}/"):
            file.move(name, "aside")
            file.move(other, name)
            file.move("aside", other)
    elif kind == "hard link":
        target = file[names[_place(rng, len(names))]]
        del file[leaf]
        with contextlib.suppress(KeyError, RuntimeError, ValueError, OSError):
            file[leaf] = target
    elif kind == "type":
        array = file[leaf][()]
        del file[leaf]
        texts = np.array(["a", "b"], dtype=object)
        new = [array.astype("f2"), array.astype(">i4"), array.astype("c16"), "text", texts]
        file.create_dataset(leaf, data=new[_place(rng, len(new))])
    elif kind == "reference":
        there = file[name].ref
        del file[leaf]
        file.create_dataset(leaf, data=there, dtype=h5py.ref_dtype)
    elif kind == "filter":
        array = file[leaf][()]
        if array.ndim:
            del file[leaf]
            file.create_dataset(leaf, data=array, compression="lzf", chunks=True)
    elif kind == "attribute":
        file[name].attrs["x"] = rng.bytes(10)
    elif kind == "value":
        array = file[leaf][()]
        if array.size:
            array.reshape(-1)[_place(rng, array.size)] += 1
            file[leaf][...] = array
    elif kind == "shift":
        for body in file.get("body_Ts_world", {}).values():
            body[:, 0, 3] += 0.3
    elif kind == "states" and "states" in file:
        sizes = file["states/sizes"][()]
        sizes[_place(rng, len(sizes))] = int(rng.choice([-1, 0, 10, 2**31, 2**62]))
        file["states/sizes"][...] = sizes


_HDF5 = (
    *_FOREIGN, "huge", "longer", "drop", "rename", "add", "exchange", "hard link", "type",
    "reference", "filter", "attribute", "value", "shift", "states", "meta", "meta", "bytes",
    "bytes", "bytes",
)  # fmt: skip


def mutate_hdf5(path: Path, rng: Rng) -> tuple[str, bool]:
    """Change what is behind a file's hash, which is made to fit again."""
    kind = str(rng.choice(_HDF5))
    if kind == "bytes":
        content = path.read_bytes()
        what, body = mutate_bytes(content[storage._BLOCK :], rng)
        path.write_bytes(content[: storage._BLOCK] + body)
        _reseal(path, _kind_of(path))
        return f"hdf5 {kind} {what}, forged", True
    with h5py.File(path, "r+") as file:
        if kind == "meta":
            what, value = mutate_json(json.loads(file["meta"][()].tobytes()), rng)
            kind = f"meta {what}"
            text = value if isinstance(value, str) else json.dumps(value)
            del file["meta"]
            file["meta"] = np.frombuffer(text.encode(), np.uint8)
        else:
            # What HDF5 itself can't do leaves the file as it is by then.
            with contextlib.suppress(ValueError, TypeError, KeyError, RuntimeError, OSError):
                _change_hdf5(file, kind, rng, path.parent / "stranger.h5")
    _reseal(path, _kind_of(path))
    return f"hdf5 {kind}, forged", True


# --- mutations of tensors and URDFs ------------------------------------------------------------


def mutate_tensors(path: Path, rng: Rng) -> tuple[str, bool]:
    """Change the length, header or weights of a tensor file."""
    content = path.read_bytes()
    n = int.from_bytes(content[:8], "little")
    kind = str(rng.choice(["length", "header", "weight"]))
    if kind == "length":
        n = int(rng.choice([0, 1, n - 1, n + 8, 2**20, 2**31, 2**63]))
        content = n.to_bytes(8, "little") + content[8:]
    elif kind == "header":
        what, value = mutate_json(json.loads(content[8 : 8 + n]), rng)
        kind = f"header {what}"
        text = value if isinstance(value, str) else json.dumps(value)
        header = text.encode("utf-8", "surrogatepass")
        content = len(header).to_bytes(8, "little") + header + content[8 + n :]
    else:
        at = 8 + n + _place(rng, len(content) - 8 - n)
        content = (
            content[:at] + bytes([content[at] ^ (1 << int(rng.integers(8)))]) + content[at + 1 :]
        )
    path.write_bytes(content)
    return f"tensors {kind}", False


def mutate_state(path: Path, rng: Rng) -> tuple[str, bool]:
    """Change what a saved state says of itself, and make its hash fit again."""
    kind, value = mutate_json(HEAD, rng)
    text = value if isinstance(value, str) else json.dumps(value)
    magic = path.read_bytes().split(b"\n")[0] + b"\n"
    body = text.encode() + b"\n" + bytes(100)
    path.write_bytes(magic + hashlib.sha256(body).digest() + body)
    return f"state {kind}, forged", True


_WORDS = (
    "",
    "inf",
    "nan",
    "-1",
    "0",
    "1e400",
    "wide",
    "0 0",
    "0 0 0 0",
    "../x",
    "\u2028",
    "x" * 5000,
)


def mutate_urdf(path: Path, rng: Rng) -> tuple[str, bool]:
    """Change, lose, repeat or move one element or attribute."""
    root = ET.fromstring(path.read_text())
    parents = {child: parent for parent in root.iter() for child in parent}
    elements = list(parents)
    element = elements[_place(rng, len(elements))]
    kind = str(rng.choice(["attribute", "lose", "remove", "twice", "rename", "move"]))
    if kind in ("attribute", "lose"):
        element = next((e for e in [element, *elements] if e.attrib), element)
        name = sorted(element.attrib)[_place(rng, len(element.attrib))]
        if kind == "lose":
            del element.attrib[name]
        else:
            element.set(name, _WORDS[_place(rng, len(_WORDS))])
    elif kind == "remove":
        parents[element].remove(element)
    elif kind == "twice":
        parents[element].append(element)
    elif kind == "rename":
        element.tag = str(rng.choice(["mesh", "box", "cylinder", "sphere", "link", "joint", "odd"]))
    else:
        root.append(element)
    path.write_bytes(ET.tostring(root))
    return f"urdf {kind}", True


def mutate(directory: Path, rng: Rng) -> tuple[str, bool]:
    """Damage one file in a directory; what was done, and whether the file's own hash fits again."""
    files = sorted(p for p in directory.rglob("*") if p.is_file())
    path = files[_place(rng, len(files))]
    special = {
        ".json": mutate_json_file,
        ".jsonl": mutate_lines,
        ".journal": mutate_lines,
        ".h5": mutate_hdf5,
        ".safetensors": mutate_tensors,
        ".urdf": mutate_urdf,
        ".state": mutate_state,
    }[path.suffix]
    if rng.integers(5) < 3:
        what, forged = special(path, rng)
    else:
        what, content = mutate_bytes(path.read_bytes(), rng)
        forged = path.suffix == ".urdf" or path.name == "annotation.json"
        # Where the last line of a log is cut short, it counts as never written.
        forged = forged or path.name.endswith(".journal")
        path.write_bytes(content)
    return f"{path.name}: {what}", forged


# --- one mutation, and many --------------------------------------------------------------------


def _address_space() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


def _chain(error: BaseException) -> Iterator[BaseException]:
    following: BaseException | None = error
    while following is not None:
        yield following
        following = following.__cause__ or following.__context__


def _out_of_memory(error: BaseException) -> bool:
    return any(isinstance(e, MemoryError) or "allocate memory" in str(e) for e in _chain(error))


def same(a: Any, b: Any) -> bool:
    """Whether two fingerprints say the same."""
    return digest({"": a}) == digest({"": b})


class Bench:
    """The whole files, and what each of them says."""

    def __init__(self, root: Path) -> None:
        self.root = root
        make_files(root / "whole")
        self.whole = {}
        for loader in LOADERS:
            self.whole[loader.name] = loader.read(root / "whole" / loader.name)

    def loader(self, i: int) -> Loader:
        table = [loader for loader in LOADERS for _ in range(loader.weight)]
        return table[i % len(table)]

    def run(self, seed: int, i: int) -> dict[str, Any]:
        loader, rng = self.loader(i), np.random.default_rng([seed, i])
        directory = self.root / "damaged"
        shutil.rmtree(directory, ignore_errors=True)
        shutil.copytree(self.root / "whole" / loader.name, directory)
        what, forged = mutate(directory, rng)
        row = {"i": i, "loader": loader.name, "mutation": what}
        # A busy machine is slow by itself: what is slow must be so twice.
        for _ in range(2):
            found = self._read(loader, directory, what, forged)
            if found["outcome"] != "slow":
                break
        return row | found

    def _read(self, loader: Loader, at: Path, what: str, forged: bool) -> dict[str, Any]:
        # What this process has read before must not count as inspected.
        storage._inspected.clear()
        before = _address_space()
        _, most = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (before + MEMORY_BYTES, most))
        detail, started = "", time.process_time()
        try:
            outcome = self._compare(loader, loader.read(at), what, forged)
        except SartError as error:
            outcome, detail = "memory" if _out_of_memory(error) else "refused", str(error)
        except Exception as error:
            outcome = "memory" if _out_of_memory(error) else "untyped"
            detail = "".join(traceback.format_exception(error))[-1500:]
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
        seconds = time.process_time() - started
        if seconds > SECONDS:
            outcome = "slow"
        return {"outcome": outcome, "seconds": seconds, "detail": detail}

    def _compare(self, loader: Loader, found: Fingerprint, what: str, forged: bool) -> str:
        whole = self.whole[loader.name]
        if any(f"hdf5 {kind}," in what for kind in _FOREIGN):
            # Unless HDF5 itself couldn't do it.
            content = b"".join(p.read_bytes() for p in (self.root / "damaged").rglob("*.h5"))
            if b"stranger" in content or b"/aside" in content:
                return "foreign content"
        if same(found, whole):
            return "equal"
        if forged and same(found["covered"], whole["covered"]):
            return "different, no hash covers"
        return "different, a hash covers"


def serve() -> None:
    """Do mutations by the numbers that come in, until the process ends."""
    with tempfile.TemporaryDirectory() as directory:
        os.environ["SART_CACHE"] = str(Path(directory) / "cache")
        bench = Bench(Path(directory))
        answers = os.fdopen(os.dup(1), "w")
        # Nothing that a library prints may stand between the answers.
        os.dup2(2, 1)
        answers.write("ready\n")
        answers.flush()
        for line in sys.stdin:
            seed, first, last = map(int, line.split())
            for i in range(first, last):
                answers.write(json.dumps(bench.run(seed, i)) + "\n")
                answers.flush()


class Process:
    """A process that does mutations one after the other, and is replaced when one ends it."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--serve"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )
        self._rest = b""
        if self._line(600.0) != b"ready":
            raise SystemExit("the files could not be made; see `python tools/fuzz.py --only 0`")

    def _line(self, patience: float) -> bytes | None:
        """The next line; None if there is none within `patience` seconds."""
        assert self._process.stdout is not None
        deadline = time.monotonic() + patience
        while b"\n" not in self._rest:
            left = deadline - time.monotonic()
            ready, _, _ = select.select([self._process.stdout], [], [], max(0.0, left))
            more = os.read(self._process.stdout.fileno(), 2**16) if ready else b""
            if not more:
                return None
            self._rest += more
        line, self._rest = self._rest.split(b"\n", 1)
        return line

    def rows(self, seed: int, first: int, last: int) -> Iterator[dict[str, Any]]:
        i = first
        while i < last:
            assert self._process.stdin is not None
            self._process.stdin.write(f"{seed} {i} {last}\n".encode())
            self._process.stdin.flush()
            while i < last:
                line = self._line(PATIENCE_SECONDS)
                if line is None:
                    ended = None
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        ended = self._process.wait(1.0)
                    self.close()
                    yield {
                        "i": i,
                        "loader": "?",
                        "mutation": "?",
                        "outcome": "crashed" if ended is not None else "slow",
                        "seconds": PATIENCE_SECONDS,
                        "detail": f"the process ended with {ended}",
                    }
                    i += 1
                    self._start()
                    break
                yield json.loads(line)
                i += 1

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()


def all_rows(seed: int, count: int, workers: int) -> Iterator[dict[str, Any]]:
    """What comes of the first `count` mutations, in any order."""
    chunks, found = iter(range(0, count, CHUNK)), queue.SimpleQueue[dict[str, Any] | None]()
    ended = threading.Event()
    lock, processes = threading.Lock(), [Process() for _ in range(workers)]

    def work(process: Process) -> None:
        try:
            while True:
                with lock:
                    first = next(chunks, None)
                if first is None:
                    return
                for row in process.rows(seed, first, min(first + CHUNK, count)):
                    found.put(row)
        except (OSError, ValueError):
            # Its pipes are closed where all of it is interrupted.
            if not ended.is_set():
                raise
        finally:
            found.put(None)

    try:
        for process in processes:
            threading.Thread(target=work, args=[process], daemon=True).start()
        at_work = workers
        while at_work:
            row = found.get()
            if row is None:
                at_work -= 1
            else:
                yield row
    finally:
        ended.set()
        for process in processes:
            process.close()


def summary(rows: Iterator[dict[str, Any]], progress: Callable[[int], None]) -> dict[str, Any]:
    """How the mutations of each loader ended."""
    names = [loader.name for loader in LOADERS]
    tables: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    slowest: dict[str, float] = collections.defaultdict(float)
    failures = []
    done = 0
    # Interrupted, it says what came of those that were done.
    with contextlib.suppress(KeyboardInterrupt):
        for row in rows:
            tables[row["loader"]][row["outcome"]] += 1
            slowest[row["loader"]] = max(slowest[row["loader"]], row["seconds"])
            if row["outcome"] in BAD:
                # `--only` shows its details, which name places on this machine.
                failures.append({k: v for k, v in row.items() if k != "detail"})
            done += 1
            progress(done)
    failures.sort(key=lambda row: row["i"])
    return {
        "count": done,
        "loaders": {
            name: {
                "mutations": tables[name].total(),
                **{outcome: tables[name][outcome] for outcome in (*GOOD, *BAD)},
                "slowest_s": round(slowest[name], 3),
            }
            for name in [*names, *(name for name in tables if name not in names)]
        },
        "n_failures": len(failures),
        "failures": failures[:200],
    }


def print_table(found: dict[str, Any]) -> None:
    """Print `summary` by loader."""
    columns = ("mutations", *GOOD, *BAD, "slowest_s")
    print("loader".ljust(14), *(column.rjust(len(column)) for column in columns), sep="  ")
    for name, row in found["loaders"].items():
        print(name.ljust(14), *(str(row[c]).rjust(len(c)) for c in columns), sep="  ")


def main() -> int:
    """The exit status: 1 where something failed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--count", type=int, default=1000, help="how many mutations")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument(
        "--only", type=int, help="do this one again, here, and show what comes of it"
    )
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        serve()
        return 0
    if args.only is not None:
        with tempfile.TemporaryDirectory() as directory:
            os.environ["SART_CACHE"] = str(Path(directory) / "cache")
            row = Bench(Path(directory)).run(args.seed, args.only)
        print(json.dumps(row, indent=2))
        return int(row["outcome"] in BAD)
    started = time.monotonic()
    # Ctrl-C interrupts, also in the background of a script.
    signal.signal(signal.SIGINT, signal.default_int_handler)

    def progress(done: int) -> None:
        if done % 1000 == 0:
            print(f"{done}/{args.count}, {time.monotonic() - started:.0f} s", file=sys.stderr)

    rows = all_rows(args.seed, args.count, args.workers)
    with contextlib.closing(rows):
        found = {"seed": args.seed, **summary(rows, progress)}
    found["versions"] = library_versions()
    if args.out is not None:
        storage.write_json(args.out, found)
    print_table(found)
    for row in found["failures"][:20]:
        print(f"FAILURE {row['i']} {row['loader']}, {row['mutation']}: {row['outcome']}")
    return int(found["n_failures"] > 0)


if __name__ == "__main__":
    sys.exit(main())
