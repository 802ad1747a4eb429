"""The files of a trained skill, compared with the hashes that its `config.json` names.

Without torch, so that a command can describe a skill, and refuse a damaged one, at once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sart_toolkit.data.records import Annotation, Demonstration, digest
from sart_toolkit.data.schemas import SkillFile, TrainingFile
from sart_toolkit.data.storage import load_annotation, load_demonstration, read_json, write_json
from sart_toolkit.errors import Mismatch, MissingFile

CONFIG, MODEL, TRAINING = "config.json", "model.safetensors", "training.json"
DEMONSTRATION, ANNOTATION = "demo.h5", "annotation.json"


@dataclass(frozen=True)
class SkillFiles:
    """What a skill's directory holds besides its weights.

    Attributes:
        config: `config.json`, without the hashes of the files.
        training: `training.json`.
        demonstration, annotation: what it was made from; the annotation is `None` where it was
            made without.
    """

    config: Mapping[str, Any]
    training: Mapping[str, Any]
    demonstration: Demonstration
    annotation: Annotation | None


def write_config(path: Path, config: Mapping[str, Any]) -> None:
    """Write `config.json` of the skill whose other files are in the directory, with their hashes.

    Raises:
        MissingFile, BrokenFile: one of them can't be read.
        CannotWrite: the disk refuses.
    """
    hashes = _hashes(path, *_parts(path, (path / ANNOTATION).exists()))
    write_json(path / CONFIG, {**config, "files": hashes})


def check_directory(path: Path) -> None:
    """Return if there is such a directory.

    Raises:
        MissingFile: there isn't.
    """
    if not path.is_dir():
        raise MissingFile(f"{path}: no such skill directory; make it with `sart train`")


def load_files(path: Path) -> SkillFiles:
    """The files of the skill in a directory, each as it was when the skill was made.

    Raises:
        MissingFile: no such directory, or it lacks a file.
        BrokenFile: a file is truncated, was changed, or lacks a field.
        Mismatch: its files belong to different skills.
    """
    check_directory(path)
    config = read_json(path / CONFIG, SkillFile)
    expected = config.pop("files")
    demonstration, annotation, training = _parts(path, ANNOTATION in expected)
    of = {DEMONSTRATION: demonstration.content_hash()}
    if annotation is not None:
        of[ANNOTATION] = annotation.demonstration_hash
    for name, found in of.items():
        if found != config["demonstration_hash"]:
            raise Mismatch(
                f"{path / name}: belongs to another demonstration than {CONFIG}; copy the whole "
                "skill directory again"
            )
    for name, found in _hashes(path, demonstration, annotation, training).items():
        if found != expected.get(name):
            raise Mismatch(
                f"{path / name}: isn't the one that {CONFIG} was written with (hash {found[:12]}, "
                f"expected {str(expected.get(name))[:12]}); copy the whole skill directory again"
            )
    return SkillFiles(config, training, demonstration, annotation)


def _parts(path: Path, annotated: bool) -> tuple[Demonstration, Annotation | None, dict[str, Any]]:
    return (
        load_demonstration(path / DEMONSTRATION),
        load_annotation(path / ANNOTATION) if annotated else None,
        read_json(path / TRAINING, TrainingFile),
    )


def _hashes(
    path: Path,
    demonstration: Demonstration,
    annotation: Annotation | None,
    training: Mapping[str, Any],
) -> dict[str, str]:
    if not (path / MODEL).is_file():
        raise MissingFile(f"{path / MODEL}: no such file; check the path, or train again")
    with open(path / MODEL, "rb") as file:
        model = hashlib.file_digest(file, "sha256").hexdigest()
    return {
        DEMONSTRATION: demonstration.content_hash(),
        **({} if annotation is None else {ANNOTATION: annotation.content_hash()}),
        TRAINING: digest(training),
        MODEL: model,
    }
