"""Where the files are that a robot's URDF and its meshes are named by."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import unquote

from sart_toolkit.data.assets import asset
from sart_toolkit.errors import InvalidInput, MissingExtra, MissingFile
from sart_toolkit.userfiles import local_file

_DRIVE = re.compile(r"[A-Za-z]:/")
_IN_PACKAGE = re.compile(r"(?:package|model)://([^/]+)/(.+)")


def cache_dir() -> Path:
    """Where derived files are kept: `$SART_CACHE`, or the user's cache directory."""
    root = os.environ.get("SART_CACHE") or os.environ.get("XDG_CACHE_HOME")
    return Path(root or Path.home() / ".cache") / "sart_toolkit"


def resource_path(resource: str, remedy: str = "check the robot's urdf entries") -> Path:
    """The file that `package:path/inside/it` or a plain path names; `sart_toolkit:` is `assets/`.

    A package is a module that Python can import, or what pip installed under that name; the path
    of the latter starts where pip installs.

    Args:
        resource: names the file.
        remedy: what to do where it isn't there.

    Raises:
        MissingExtra: the package isn't installed.
        MissingFile: the file isn't there.
    """
    package, colon, inside = resource.partition(":")
    if colon and package == "sart_toolkit":
        path = asset(inside)
    elif colon:
        folder = _module_folder(package)
        if folder is None:
            try:
                folder = Path(str(importlib.metadata.distribution(package).locate_file("")))
            except (importlib.metadata.PackageNotFoundError, ValueError):
                raise MissingExtra(
                    f"{resource}: package {package!r} missing; pip install {package}"
                ) from None
        path = folder / inside
    else:
        path = local_file(resource)
    if not path.is_file():
        raise MissingFile(f"{resource}: no such file ({path.name}); {remedy}")
    return path


def mesh_path(reference: str, urdf: Path, package_dirs: Sequence[str] = ()) -> Path:
    """Where a mesh is that a URDF names, in whatever form; of what is nowhere, the likeliest path.

    A relative path starts at the URDF's folder. `package://NAME/rest` (or `model://`) is looked for
    in the folders given, those of `ROS_PACKAGE_PATH` and `AMENT_PREFIX_PATH`, the folders above the
    URDF, and installed Python packages; a folder is the package NAME if it is called so or its
    `package.xml` says so, or has such a folder.

    Args:
        reference: the mesh's `filename`.
        urdf: the file that has it.
        package_dirs: folders to look in first.

    Raises:
        InvalidInput: it names a file of another machine or by another protocol.
    """
    text = reference.strip().replace("\\", "/")
    if text.startswith("file:"):
        host, slash, rest = text.removeprefix("file:").removeprefix("//").partition("/")
        if text.startswith("file://") and host in ("", "localhost"):
            host = ""
        text = unquote(f"{host}{slash}{rest}")
    inside = _IN_PACKAGE.fullmatch(text)
    if inside is not None:
        name, rest = inside.groups()
        return _in_package(name, unquote(rest), urdf.parent, package_dirs)
    if "://" in text:
        raise InvalidInput(
            f"{urdf.name}: mesh {reference!r}: expected a path, file:// or package://; download "
            "the mesh and give its path"
        )
    if _DRIVE.match(text) and os.name != "nt":
        raise InvalidInput(
            f"{urdf.name}: mesh {reference!r}: is a path of another machine; copy the mesh beside "
            "the URDF and give its path from there"
        )
    try:
        path = local_file(text)
    except OSError:
        # No file system has so long a name.
        path = Path(text)
    return Path(os.path.normpath(urdf.parent / path))


def where_to_look(reference: str, package_dirs: Sequence[str]) -> str:
    """What to do about a mesh that is nowhere, for a message."""
    inside = _IN_PACKAGE.fullmatch(reference.strip().replace("\\", "/"))
    if inside is None:
        return "put it there, or correct its filename in the URDF"
    given = f" (now: {', '.join(package_dirs)})" if package_dirs else ""
    return (
        f"give the folder that holds the package {inside[1]!r} as package_dirs of the "
        f"RobotSpec{given} or in ROS_PACKAGE_PATH, or pip install the package"
    )


def _in_package(name: str, rest: str, folder: Path, package_dirs: Sequence[str]) -> Path:
    tried = []
    for package in _packages(name, folder, package_dirs):
        tried.append(path := Path(os.path.normpath(package / rest)))
        if os.path.isfile(path):
            return path
    # A copy of the package whose folder has another name.
    for above in (folder, *folder.parents):
        if os.path.isfile(path := above / rest):
            return path
    return tried[0] if tried else folder / rest


def _packages(name: str, folder: Path, package_dirs: Sequence[str]) -> Iterator[Path]:
    """Folders that may be a package, the likeliest first."""
    given = [local_file(each) for each in package_dirs]
    ros = os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    ros += [os.path.join(each, "share") for each in prefixes if each]
    for place in [*given, *(Path(each) for each in ros if each), folder, *folder.parents]:
        if place.name == name or _ros_name(place) == name:
            yield place
        if os.path.isdir(place / name):
            yield place / name
    for place in [*given, *(Path(each) for each in ros if each)]:
        # As deep as ROS workspaces keep their packages.
        for pattern in ("*/", "*/*/"):
            yield from sorted(place.glob(pattern + name))
    installed = _module_folder(name)
    if installed is not None:
        yield installed
    for site in map(Path, sys.path):
        # Where pip puts a ROS package's files, those of cmeel's packages too.
        for share in (site / "share", site / "cmeel.prefix" / "share"):
            if os.path.isdir(share / name):
                yield share / name
    if os.path.isdir(shared := Path(sys.prefix) / "share" / name):
        yield shared


def _ros_name(folder: Path) -> str | None:
    """What a folder's `package.xml` calls it."""
    try:
        return (ET.parse(folder / "package.xml").getroot().findtext("name") or "").strip()
    except (OSError, ValueError, ET.ParseError):
        return None


def _module_folder(package: str) -> Path | None:
    """The folder of an importable package, without importing it."""
    try:
        found = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return None
    if found is None:
        return None
    places = list(found.submodule_search_locations or ())
    if places:
        return Path(places[0])
    return Path(found.origin).parent if found.origin and found.has_location else None
