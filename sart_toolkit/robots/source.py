"""A source URDF's links and joints, checked: what the file says is used, or refused by its place.

URDF readers drop a shape whose numbers they can't read, put one with a misspelt origin at its
link's, and each takes another view of what the format leaves open. So all that is used is checked
here, and numbers are written again in one way, before any of them sees it.
"""

from __future__ import annotations

import difflib
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from sart_toolkit.errors import BrokenFile, InvalidInput, SartError

_MAX_BYTES = 16 << 20
_MAX_DEPTH = 32
# A chain of more would overflow the stack of readers that recurse.
_MAX_LINKS = 1000
# Positions and sizes [m] above this are those of a file in millimetres, or damaged.
_MAX_LENGTH = 100.0
# Cables end far before four whole turns to either side.
_MOST_TURN = 8 * np.pi
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class _Numbers:
    """An attribute of `count` finite numbers: each "any", "length", "positive" or "nonzero"."""

    count: int = 1
    kind: str = "any"
    required: bool = True


@dataclass(frozen=True)
class _Rule:
    """What an element may hold: attributes, and children with how many at least and at most."""

    attributes: Mapping[str, _Numbers | None] = field(default_factory=dict)
    children: Mapping[str, tuple[int, int | None]] = field(default_factory=dict)
    # Attributes and children that mean nothing to us and are left out.
    ignored: tuple[str, ...] = ()
    # Whether anything else is refused, and not only what looks like a misspelling.
    strict: bool = False


_LENGTH, _POSITIVE = _Numbers(kind="length"), _Numbers(kind="positive")
_FREE = _Numbers(required=False)
_AT_MOST_ONE, _ONE, _MANY = (0, 1), (1, 1), (0, None)
_SHAPES = ("box", "sphere", "cylinder", "mesh")
_JOINTS = ("revolute", "continuous", "prismatic", "fixed")
# `None` is an attribute of text, which must be there and not be empty.
_RULES: dict[str, _Rule] = {
    "link": _Rule(
        {"name": None},
        {"visual": _MANY, "collision": _MANY, "inertial": _AT_MOST_ONE},
        ("origin", "type", "contact", "sensor"),
    ),
    "joint": _Rule(
        {"name": None, "type": None},
        {
            "origin": _AT_MOST_ONE,
            "parent": _ONE,
            "child": _ONE,
            "axis": _AT_MOST_ONE,
            "limit": _AT_MOST_ONE,
            "dynamics": _AT_MOST_ONE,
            "mimic": _AT_MOST_ONE,
        },
        ("safety_controller", "calibration"),
    ),
    "visual": _Rule(
        {}, {"origin": _AT_MOST_ONE, "geometry": _ONE}, ("name", "material", "verbose")
    ),
    "collision": _Rule(
        {}, {"origin": _AT_MOST_ONE, "geometry": _ONE}, ("name", "material", "verbose")
    ),
    "geometry": _Rule({}, dict.fromkeys(_SHAPES, _AT_MOST_ONE), strict=True),
    "inertial": _Rule({}, {"origin": _AT_MOST_ONE, "mass": _ONE, "inertia": _AT_MOST_ONE}),
    "origin": _Rule(
        {"xyz": _Numbers(3, "length", False), "rpy": _Numbers(3, "any", False)}, strict=True
    ),
    "box": _Rule({"size": _Numbers(3, "positive")}, strict=True),
    "sphere": _Rule({"radius": _POSITIVE}, strict=True),
    "cylinder": _Rule({"radius": _POSITIVE, "length": _POSITIVE}, strict=True),
    "mesh": _Rule({"filename": None, "scale": _Numbers(3, "nonzero", False)}, strict=True),
    "mass": _Rule({"value": _Numbers(kind="at least 0")}, strict=True),
    "inertia": _Rule(
        {
            **dict.fromkeys(("ixx", "iyy", "izz"), _Numbers(kind="at least 0")),
            **dict.fromkeys(("ixy", "ixz", "iyz"), _Numbers()),
        },
        strict=True,
    ),
    "parent": _Rule({"link": None}, strict=True),
    "child": _Rule({"link": None}, strict=True),
    "axis": _Rule({"xyz": _Numbers(3)}, strict=True),
    "limit": _Rule(
        {
            "lower": _FREE,
            "upper": _FREE,
            "effort": _Numbers(kind="at least 0", required=False),
            "velocity": _Numbers(kind="at least 0", required=False),
        }
    ),
    "dynamics": _Rule({"damping": _FREE, "friction": _FREE}),
    "mimic": _Rule({"joint": None, "multiplier": _FREE, "offset": _FREE}),
}


def links_and_joints(source: Path, content: bytes | None = None) -> list[ET.Element]:
    """The links and joints of a URDF, checked, without materials and extensions of vendors.

    Args:
        source: the file; its name is in the errors.
        content: its bytes, if they have been read.

    Raises:
        BrokenFile: it can't be read, is no URDF, or is too large for one.
        InvalidInput: a number, shape or reference in it isn't acceptable; the message names the
            link or joint, and the element.
    """
    root = parsed(source, content)
    kept = [_checked_top(source.name, e) for e in root if e.tag in ("link", "joint")]
    for element in root:
        if element.tag not in ("link", "joint"):
            _check_unknown(f"{source.name}: robot", element.tag, element, ("link", "joint"))
    if len(kept) > 2 * _MAX_LINKS:
        raise BrokenFile(
            f"{source.name}: {len(kept)} links and joints, expected at most {2 * _MAX_LINKS}"
        )
    return kept


def parsed(source: Path, content: bytes | None = None) -> ET.Element:
    """A URDF as XML, its `robot` element; what isn't plain XML of reasonable size is refused.

    Prefixes need not be declared: some packages use them (`drake:`) without.

    Raises:
        BrokenFile: it can't be read, isn't XML, has a DOCTYPE, or isn't a robot's.
    """
    if content is None:
        content = read_bytes(source, _MAX_BYTES)
    builder = ET.TreeBuilder()
    parser = expat.ParserCreate()
    depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if tag.startswith("xacro:"):
            name = source.name.partition(".")[0]
            raise InvalidInput(
                f"{source.name}: is xacro (it has <{tag}>), from which a URDF is still to be made; "
                f"type: xacro {source.name} > {name}.urdf (of ROS, or pip install xacro), and give "
                "that"
            )
        if depth > _MAX_DEPTH:
            raise BrokenFile(
                f"{source.name}: not a readable URDF (elements are nested more than {_MAX_DEPTH} "
                "deep); check the file"
            )
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def doctype(*_: object) -> None:
        # Entities may grow without bound, or read other files.
        raise BrokenFile(
            f"{source.name}: not a readable URDF (it has a DOCTYPE, which a URDF doesn't need and "
            "which isn't read); remove it"
        )

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content, True)
        root = builder.close()
    except SartError:
        raise
    # Encodings that don't exist or aren't supported are Lookup and Value errors.
    except (expat.ExpatError, ValueError, LookupError, AssertionError) as error:
        raise BrokenFile(f"{source.name}: not a readable URDF ({error}); check the file") from error
    if root.tag != "robot":
        raise BrokenFile(
            f"{source.name}: not a readable URDF (its root is <{root.tag}>, not <robot>); check "
            "the file"
        )
    return root


def read_bytes(path: Path, limit: int) -> bytes:
    """A file's bytes.

    Raises:
        BrokenFile: it can't be read, or is larger than `limit` bytes.
    """
    try:
        with path.open("rb") as file:
            content = file.read(limit + 1)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise BrokenFile(f"{path.name}: can't be read ({why}); check the file") from error
    if len(content) > limit:
        raise BrokenFile(f"{path.name}: larger than {limit >> 20} MB; use a smaller file")
    return content


def _checked_top(file: str, element: ET.Element) -> ET.Element:
    name = element.get("name", "").strip()
    where = f"{file}: {element.tag} {name!r}"
    _check(where, element)
    if element.tag == "joint":
        _check_joint(where, element)
    else:
        _check_inertia(where, element)
    return element


def _check(where: str, element: ET.Element) -> None:
    """Check an element and what is below it, and leave only what is known in it."""
    rule = _RULES[element.tag]
    for name in list(element.attrib):
        if name not in rule.attributes:
            _check_unknown(where, name, None, tuple(rule.attributes), rule)
            del element.attrib[name]
    for name, numbers in rule.attributes.items():
        value = element.get(name)
        if numbers is None:
            if not (value or "").strip():
                raise InvalidInput(f"{where}: <{element.tag}> has no {name}; give it one")
        elif value is not None:
            element.set(name, _checked_numbers(f"{where}: <{element.tag} {name}>", value, numbers))
        elif numbers.required:
            raise InvalidInput(f"{where}: <{element.tag}> has no {name}; give it one")
    for child in list(element):
        if child.tag not in rule.children:
            _check_unknown(where, child.tag, child, tuple(rule.children), rule)
            element.remove(child)
    for tag, (least, most) in rule.children.items():
        found = element.findall(tag)
        if len(found) < least or (most is not None and len(found) > most):
            raise InvalidInput(
                f"{where}: <{element.tag}> has {len(found)} <{tag}>, expected "
                f"{'one' if least else 'at most one'}"
            )
        for index, child in enumerate(found):
            number = f"{tag} {index + 1}" if most is None else ""
            _check(f"{where}: {number}" if number else where, child)
    if element.tag == "geometry" and len(element) != 1:
        raise InvalidInput(
            f"{where}: <geometry> has {len(element)} shapes, expected one of {', '.join(_SHAPES)}"
        )


def _check_unknown(
    where: str,
    name: str,
    child: ET.Element | None,
    known: tuple[str, ...],
    rule: _Rule | None = None,
) -> None:
    """Return if an unknown child or attribute can be left out without loss."""
    if ":" in name or (rule is not None and name in rule.ignored):
        return
    what = f"<{name}>" if child is not None else f"attribute {name!r}"
    near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.7)
    if near:
        raise InvalidInput(f"{where}: unknown {what}; did you mean {near[0]!r}?")
    if rule is not None and rule.strict:
        raise InvalidInput(
            f"{where}: unknown {what}; expected {', '.join(known) or 'nothing'} here"
        )
    if child is not None and child.find(".//geometry") is not None:
        raise InvalidInput(f"{where}: unknown {what}, which holds a <geometry>; remove it")


def _checked_numbers(where: str, text: str, expected: _Numbers) -> str:
    """An attribute's numbers, each as Python writes it.

    Raises:
        InvalidInput: too many or too few, or not such as they must be.
    """
    words = text.split()
    shown = text if len(text) <= 60 else text[:57] + "..."
    if len(words) != expected.count or not all(_NUMBER.fullmatch(word) for word in words):
        count = f"{expected.count} numbers" if expected.count > 1 else "a number"
        raise InvalidInput(f"{where}: expected {count}, got {shown!r}")
    values = np.array([float(word) for word in words])
    fits, what = {
        "any": (True, "finite numbers"),
        "length": (np.abs(values) <= _MAX_LENGTH, f"at most {_MAX_LENGTH:g} m"),
        "positive": ((values > 0) & (values <= _MAX_LENGTH), f"above 0, at most {_MAX_LENGTH:g} m"),
        "nonzero": (values != 0, "other than 0"),
        "at least 0": (values >= 0, "at least 0"),
    }[expected.kind]
    if not (np.isfinite(values).all() and np.all(fits)):
        raise InvalidInput(f"{where}: expected {what}, got {shown!r}")
    return " ".join(repr(float(value)) for value in values)


def _check_joint(where: str, joint: ET.Element) -> None:
    kind = joint.get("type")
    if kind not in _JOINTS:
        raise InvalidInput(f"{where}: type: expected one of {', '.join(_JOINTS)}, got {kind!r}")
    axis, limit = joint.find("axis"), joint.find("limit")
    if axis is not None and kind != "fixed":
        xyz = np.array([float(word) for word in axis.get("xyz", "").split()])
        length = float(np.linalg.norm(xyz))
        if not 1e-6 < length < 1e6:
            raise InvalidInput(f"{where}: <axis xyz>: expected a direction, got {xyz.tolist()}")
        if abs(length - 1) > 1e-9:
            axis.set("xyz", " ".join(repr(float(x)) for x in xyz / length))
    if kind in ("revolute", "prismatic"):
        if limit is None:
            raise InvalidInput(f"{where}: a {kind} joint has no <limit>; give it one")
        lower, upper = (float(limit.get(name, "0")) for name in ("lower", "upper"))
        if lower > upper:
            raise InvalidInput(f"{where}: <limit>: lower {lower} is above upper {upper}")
        if kind == "revolute" and max(abs(lower), abs(upper)) > _MOST_TURN:
            raise InvalidInput(
                f"{where}: <limit>: from {lower:g} to {upper:g} rad is more than any arm turns; "
                "give it in rad, not degrees"
            )


def _check_inertia(where: str, link: ET.Element) -> None:
    inertia = link.find("inertial/inertia")
    if inertia is None:
        return
    rows = [[float(inertia.get("i" + "".join(sorted(a + b)), 0)) for b in "xyz"] for a in "xyz"]
    moments = np.linalg.eigvalsh(np.array(rows))
    if (least := float(moments.min())) < -1e-9 - 1e-3 * float(moments.sum()):
        raise InvalidInput(
            f"{where}: <inertia>: no body has it, its least principal moment is {least:.3g} kg m²; "
            "correct it, or remove <inertia> for that of a ball"
        )
