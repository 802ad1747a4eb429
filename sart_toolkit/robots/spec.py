"""A robot as data: which URDFs, how they join, where the tool frame and its cameras are."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array, check_array, check_pose, check_positive, frozen
from sart_toolkit.robots.references import resource_path

if TYPE_CHECKING:
    import trimesh

_log = logging.getLogger(__name__)
_SIDES = 16
_GREY = (0.7, 0.7, 0.7, 1.0)


@dataclass(frozen=True)
class Shape:
    """A convex primitive of a body: box, cylinder or sphere, at `T_body_shape (4,4)`.

    `size` [m]: box (x, y, z) edge lengths; cylinder (radius, length along z); sphere (radius,).
    `rgba` in [0, 1]. A shape with `collides` false is only drawn.
    """

    kind: Literal["box", "cylinder", "sphere"]
    size: tuple[float, ...]
    T_body_shape: Array = field(default_factory=lambda: np.eye(4))
    rgba: tuple[float, float, float, float] = _GREY
    collides: bool = True

    def __post_init__(self) -> None:
        lengths = {"box": 3, "cylinder": 2, "sphere": 1}
        if self.kind not in lengths:
            raise InvalidInput(f"shape kind: expected one of {sorted(lengths)}, got {self.kind!r}")
        if len(self.size) != lengths[self.kind]:
            raise InvalidInput(
                f"{self.kind} size: expected {lengths[self.kind]} numbers, got {len(self.size)}"
            )
        for value in self.size:
            check_positive(f"{self.kind} size", value, "m")
        if not isinstance(self.size, tuple):
            # An array, say: what is drawn and what tells scenes apart goes by its value.
            object.__setattr__(self, "size", tuple(map(float, self.size)))
        T = check_pose("T_body_shape", self.T_body_shape)
        object.__setattr__(self, "T_body_shape", frozen(T))

    @property
    def identity(self) -> tuple[Hashable, ...]:
        """What tells it from shapes of another form, wherever they are."""
        return self.kind, self.size

    def convex_parts(self) -> tuple[ConvexShape, ...]:
        """The convex parts that it collides as, in its own frame: itself."""
        return (Shape(self.kind, self.size),)

    def corners(self) -> Array:
        """Points `(n, 3)` in the body frame whose convex hull encloses the shape.

        For a cylinder they are those of a prism with sixteen sides, for a sphere of a cube.
        """
        if self.kind == "cylinder":
            angles = 2 * np.pi * np.arange(_SIDES) / _SIDES
            r, half = self.size[0] / np.cos(np.pi / _SIDES), self.size[1] / 2
            ring = np.stack([r * np.cos(angles), r * np.sin(angles), np.full(_SIDES, half)], 1)
            points = np.concatenate([ring, ring * [1, 1, -1]])
        else:
            half_edges = np.array(self.size) / 2 if self.kind == "box" else np.full(3, self.size[0])
            signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
            points = signs * half_edges
        return points @ self.T_body_shape[:3, :3].T + self.T_body_shape[:3, 3]


@dataclass(frozen=True)
class MeshShape:
    """A shape of a body from a mesh file, at `T_body_shape (4, 4)`.

    `file` is a path or `package:path/inside/it`, of type STL, OBJ, PLY, OFF, GLB or DAE; `scale`
    makes its lengths metres, one number or one for each axis. It collides as convex parts that
    enclose it, as `collision` says:

    - "hull": its convex hull, which fills hollows and handles;
    - "decomposed": parts that CoACD finds, an extra;
    - a tuple of files: the hulls of these meshes, of the same frame and scale. What stands out of
      them by less than 5 mm is taken in, more is refused.

    `rgba` in [0, 1]; where it is `None` the mesh has the colours that are in its file, or grey.
    `texture` is an image to be laid on it; each triangle is drawn in one colour, and there are at
    most 32. A shape with `collides` false is only drawn.

    Attributes:
        digests: of all files that decide where it is and how it collides, by their content.

    Raises:
        MissingFile: a file isn't there.
        BrokenFile: a file can't be read.
        InvalidInput: a mesh is empty, too large or too small, a file is of another type, or the
            parts leave some of the mesh out.
        MissingExtra: what reads or decomposes it isn't installed.
    """

    file: str
    scale: float | tuple[float, float, float] = 1.0
    collision: Literal["hull", "decomposed"] | tuple[str, ...] = "hull"
    T_body_shape: Array = field(default_factory=lambda: np.eye(4))
    rgba: tuple[float, float, float, float] | None = None
    texture: str | None = None
    collides: bool = True
    digests: tuple[str, ...] = field(init=False, repr=False)
    _texture_digest: str = field(init=False, repr=False)

    def __post_init__(self) -> None:
        from sart_toolkit.robots import meshes

        given = self.collision
        if isinstance(given, str):
            if given not in ("hull", "decomposed"):
                raise InvalidInput(
                    f"collision of mesh {self._name}: expected 'hull', 'decomposed' or a tuple of "
                    f"files, got {given!r}"
                )
            files: tuple[str, ...] = ()
        else:
            files = tuple(map(str, given))
            if not files:
                raise InvalidInput(
                    f"collision of mesh {self._name}: has no file; name one, or take 'hull'"
                )
            object.__setattr__(self, "collision", files)
        object.__setattr__(self, "file", str(self.file))
        scale = self.scale if isinstance(self.scale, tuple) else (self.scale,)
        if len(scale) not in (1, 3):
            raise InvalidInput(
                f"scale of mesh {self._name}: expected 1 or 3 numbers, got {len(scale)}"
            )
        for value in scale:
            check_positive(f"scale of mesh {self._name}", value)
        T = check_pose("T_body_shape", self.T_body_shape)
        object.__setattr__(self, "T_body_shape", frozen(T))
        paths = [_mesh_file(name) for name in (self.file, *files)]
        for path in paths:
            meshes.check_type(path)
        digests = tuple(meshes.file_digest(path) for path in paths)
        object.__setattr__(self, "digests", digests)
        meshes.check_body_mesh(self.mesh(), self._name)
        object.__setattr__(self, "_texture_digest", "")
        if self.texture is not None:
            if self.rgba is not None:
                raise InvalidInput(f"mesh {self._name}: has rgba and texture; give one of them")
            object.__setattr__(self, "texture", str(self.texture))
            digest = meshes.file_digest(_mesh_file(str(self.texture)))
            object.__setattr__(self, "_texture_digest", digest)
            meshes.check_texture(paths[0], digests[0], (_mesh_file(str(self.texture)), digest))
        if given == "decomposed":
            meshes.check_coacd(self._name)
        else:
            self.convex_parts()

    @property
    def _name(self) -> str:
        return Path(self.file).name

    @property
    def _scale(self) -> tuple[float, float, float]:
        x, y, z = self.scale if isinstance(self.scale, tuple) else (self.scale,) * 3
        return float(x), float(y), float(z)

    @property
    def identity(self) -> tuple[Hashable, ...]:
        """What tells it from shapes of another form, wherever they are: its files' content."""
        how = self.collision if isinstance(self.collision, str) else "parts"
        return "mesh", self.digests, self._scale, how

    @property
    def digest(self) -> str:
        """A SHA-256 of its form: the content of its files, scale, and how it collides."""
        return hashlib.sha256(repr(self.identity).encode()).hexdigest()

    def mesh(self) -> trimesh.Trimesh:
        """Its mesh, scaled, in its own frame; not to be changed.

        Raises:
            BrokenFile: the file has changed since the shape was made.
        """
        from sart_toolkit.robots import meshes

        return meshes.read_mesh(_mesh_file(self.file), self.digests[0], self._scale)

    def drawn(self) -> tuple[tuple[trimesh.Trimesh, tuple[float, float, float, float]], ...]:
        """What is drawn of it, in its own frame: meshes of one colour each."""
        from sart_toolkit.robots import meshes

        if self.rgba is not None:
            return ((meshes.creased(self.mesh()), self.rgba),)
        texture = (_mesh_file(self.texture), self._texture_digest) if self.texture else None
        path = _mesh_file(self.file)
        pieces = meshes.drawn_pieces(path, self.digests[0], self._scale, texture)
        return tuple((mesh, rgba or _GREY) for mesh, rgba in pieces)

    def convex_parts(self) -> tuple[ConvexShape, ...]:
        """The convex parts that enclose it, in its own frame: corners `(n, 3)` [m] of hulls."""
        from sart_toolkit.robots import meshes

        path, *others = (_mesh_file(file) for file in self._geometry_files)
        known = path, self.digests[0], self._scale
        if self.collision == "hull" or (self.collision == "decomposed" and not self.collides):
            return (meshes.mesh_hull(*known),)
        given = tuple(zip(others, self.digests[1:], strict=True))
        return meshes.enclosing_parts(*known, given or None)

    @property
    def _geometry_files(self) -> tuple[str, ...]:
        return self.file, *(() if isinstance(self.collision, str) else self.collision)

    def files_needed(self) -> list[Path]:
        """The files that it is made from."""
        textures = () if self.texture is None else (self.texture,)
        return [_mesh_file(file) for file in (*self._geometry_files, *textures)]

    def corners(self) -> Array:
        """Points `(n, 3)` in the body frame whose convex hull encloses the shape."""
        points = np.concatenate([np.asarray(part) for part in self.convex_parts()])
        return points @ self.T_body_shape[:3, :3].T + self.T_body_shape[:3, 3]


BodyShape = Shape | MeshShape
# A primitive at its own origin, or the corners `(n, 3)` [m] of a convex hull.
ConvexShape = Shape | Array


def _mesh_file(name: str) -> Path:
    return resource_path(name, "check the path of the mesh or texture")


def mass_properties(shapes: Sequence[BodyShape], mass: float) -> tuple[Array, Array]:
    """The centre of mass `(3,)` [m] and the inertia `(3, 3)` [kg m²] about it, body axes.

    The mass [kg] is spread evenly over the volume of the shapes that collide, or of all shapes
    where none does; where two overlap both count. A mesh that isn't closed counts as its hull.
    """
    # Pinocchio's inertias need a mass for each shape, so volumes all the same, and a robot as data
    # doesn't need Pinocchio.
    solids = [_solid(shape) for shape in _heavy(shapes)]
    masses = mass * np.array([volume for _, volume, _, _ in solids])
    masses /= sum(volume for _, volume, _, _ in solids)
    p = np.stack([centre for _, _, centre, _ in solids])
    centre = masses @ p / mass
    inertia = np.zeros((3, 3))
    for m, (_, _, _, moments), offset in zip(masses, solids, p - centre, strict=True):
        # Steiner's theorem.
        inertia += m * (moments + offset @ offset * np.eye(3) - np.outer(offset, offset))
    return centre, inertia


def mass_from_density(shapes: Sequence[BodyShape], density: float) -> float:
    """The mass [kg] of shapes at a density [kg/m³].

    Those that collide count, or all shapes where none does; where two overlap both count. Of a
    mesh that isn't closed nobody knows the volume, so its hull's is taken, and a warning says so.
    """
    check_positive("density", density, "kg/m³")
    mass = 0.0
    for shape in _heavy(shapes):
        closed, volume, _, _ = _solid(shape)
        mass += density * volume
        if not closed:
            assert isinstance(shape, MeshShape)
            _log.warning(
                "mesh %s: isn't closed, so its hull's volume is taken: %.3g kg; close it, or give "
                "the mass",
                Path(shape.file).name, density * volume,
            )  # fmt: skip
    return mass


def _heavy(shapes: Sequence[BodyShape]) -> list[BodyShape]:
    return [shape for shape in shapes if shape.collides] or list(shapes)


def _solid(shape: BodyShape) -> tuple[bool, float, Array, Array]:
    """Whether a shape is closed, its volume [m³], centre `(3,)` [m] and inertia per mass there.

    The inertia `(3, 3)` [m²] is about body axes.
    """
    R, p = shape.T_body_shape[:3, :3], shape.T_body_shape[:3, 3]
    if isinstance(shape, MeshShape):
        from sart_toolkit.robots.meshes import solid

        closed, volume, centre, inertia = solid(shape.mesh())
        return closed, volume, R @ centre + p, R @ inertia @ R.T
    volume, moments = _volume_and_moments(shape)
    return True, volume, p, R @ np.diag(moments) @ R.T


def _volume_and_moments(shape: Shape) -> tuple[float, Array]:
    """The volume [m³] and the principal moments `(3,)` per mass [m²] about the shape's centre."""
    if shape.kind == "box":
        square = np.square(shape.size)
        return float(np.prod(shape.size)), (square.sum() - square) / 12
    r = shape.size[0]
    if shape.kind == "sphere":
        return 4 / 3 * np.pi * r**3, np.full(3, 0.4 * r**2)
    length = shape.size[1]
    across = r**2 / 4 + length**2 / 12
    return np.pi * r**2 * length, np.array([across, across, r**2 / 2])


@dataclass(frozen=True)
class Attachment:
    """A rigid body fixed to a frame of the robot: what a gripper holds, or a camera's housing."""

    name: str
    frame: str
    shapes: tuple[BodyShape, ...]
    T_frame_body: Array = field(default_factory=lambda: np.eye(4))
    mass: float = 0.1

    def __post_init__(self) -> None:
        check_positive(f"mass of {self.name}", self.mass, "kg")
        if not self.shapes:
            raise InvalidInput(f"attachment {self.name!r}: has no shape; give it at least one")
        T = check_pose("T_frame_body", self.T_frame_body)
        object.__setattr__(self, "T_frame_body", frozen(T))


@dataclass(frozen=True)
class CameraSpec:
    """An RGB-D camera on a frame of the robot, or in the world where `frame` is "world".

    `T_frame_camera`: camera frame z forward, x right, y down. `fov_y_deg`: vertical field of view;
    images are square-pixel, the horizontal field follows from the image's shape.
    """

    name: str
    frame: str
    T_frame_camera: Array
    fov_y_deg: float = 60.0
    near: float = 0.02
    far: float = 3.0

    def __post_init__(self) -> None:
        if not 1.0 <= self.fov_y_deg <= 170.0:
            raise InvalidInput(f"fov_y_deg: expected 1 to 170 degrees, got {self.fov_y_deg}")
        check_positive("near", self.near, "m")
        if check_positive("far", self.far, "m") <= self.near:
            raise InvalidInput(f"far: expected more than near ({self.near} m), got {self.far} m")
        T = check_pose("T_frame_camera", self.T_frame_camera)
        object.__setattr__(self, "T_frame_camera", frozen(T))

    def intrinsics(self, width: int, height: int) -> Array:
        """The pinhole matrix `(3, 3)` [pixels]; (0, 0) is the centre of the first pixel."""
        f = 0.5 * height / np.tan(0.5 * np.deg2rad(self.fov_y_deg))
        return np.array([[f, 0, 0.5 * (width - 1)], [0, f, 0.5 * (height - 1)], [0, 0, 1.0]])


ImageSize = int | str | tuple[int, int]


def check_image_size(value: ImageSize) -> tuple[int, int]:
    """An image's width and height [pixels].

    Args:
        value: (width, height), text such as "160x120", or one number for a square.

    Raises:
        InvalidInput: it is none of these, or has no pixel.
    """
    numbers = value.lower().split("x") if isinstance(value, str) else np.ravel(value).tolist()
    try:
        sizes = [int(str(number)) for number in numbers]
    except ValueError:
        sizes = []
    if len(sizes) not in (1, 2) or min(sizes) < 1:
        raise InvalidInput(
            f"image_size: expected pixels, at least 1, as a number or WIDTHxHEIGHT, got {value!r}"
        )
    return sizes[0], sizes[-1]


def look_at(p_camera: Array, p_target: Array, up: Array) -> Array:
    """The camera pose `(4, 4)` at `p_camera`, z axis through `p_target`, `up` upwards.

    Raises:
        InvalidInput: the camera would look at itself, or along `up`.
    """
    z = np.asarray(p_target, float) - p_camera
    x = np.cross(z, up)
    if not np.linalg.norm(x) > 0:
        raise InvalidInput(
            "look_at: target and camera coincide, or lie along up; choose another up"
        )
    z /= np.linalg.norm(z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = x, np.cross(z, x), z, p_camera
    return T


def check_gripper(gripper: float) -> float:
    """`gripper` if it is a command in [0, 1].

    Raises:
        InvalidInput: it is not.
    """
    if not 0.0 <= gripper <= 1.0:
        raise InvalidInput(f"gripper: expected 0 (open) to 1 (closed), got {gripper}")
    return float(gripper)


@dataclass(frozen=True)
class GripperSpec:
    """A gripper: where it is, its linkage, and what its one command means.

    `urdf` is its own URDF, fixed to `parent_frame` of the arm at `T_parent_gripper`; its links and
    joints are then called `gripper_...`. Without `urdf` it is part of the arm's.

    The command is 0 open, 1 closed. `driver` is the joint that the motor moves, from
    `open_position` to `closed_position` ([rad], or [m] where it slides; either may be 0);
    `followers` maps each linked joint to its ratio to the driver, as the URDF's `<mimic>` has them.
    Without `driver` the tool has no fingers. `finger_links` are the links that may touch what is
    grasped. `force` ([N m] or [N]) and `speed` ([rad/s] or [m/s]) bound the driver. `armature`
    ([kg m²] or [kg]) is the drive's inertia reflected to each joint through its gears: links of a
    few grams alone would hold a heavy object badly in any simulator.
    """

    urdf: str | None = None
    parent_frame: str | None = None
    driver: str | None = None
    followers: Mapping[str, float] = field(default_factory=dict)
    closed_position: float = 0.0
    finger_links: tuple[str, ...] = ()
    T_parent_gripper: Array = field(default_factory=lambda: np.eye(4))
    force: float = 20.0
    speed: float = 2.0
    armature: float = 0.0
    open_position: float = 0.0

    def __post_init__(self) -> None:
        if (self.urdf is None) != (self.parent_frame is None):
            raise InvalidInput(
                f"gripper: expected both or neither of urdf and parent_frame, got {self.urdf!r} "
                f"and {self.parent_frame!r}; without urdf it is part of the arm's URDF"
            )
        if self.driver is None and (self.followers or self.closed_position != self.open_position):
            raise InvalidInput(
                "gripper: has followers or positions but no driver; name the joint that moves it"
            )
        if self.driver is not None and not abs(self.closed_position - self.open_position) > 0:
            raise InvalidInput(
                f"gripper: open_position and closed_position are both {self.closed_position}; "
                "expected two positions of the driver"
            )
        for name in ("open_position", "closed_position"):
            if not np.isfinite(getattr(self, name)):
                raise InvalidInput(f"{name}: expected a number, got {getattr(self, name)}")
        check_positive("force", self.force)
        check_positive("speed", self.speed)
        T = check_pose("T_parent_gripper", self.T_parent_gripper)
        object.__setattr__(self, "T_parent_gripper", frozen(T))

    def driver_position(self, command: float) -> float:
        """The driver's position [rad or m] at a command in [0, 1]."""
        return self.open_position + (self.closed_position - self.open_position) * command

    def command_at(self, position: float) -> float:
        """The command that a position [rad or m] of the driver is that of."""
        return (position - self.open_position) / (self.closed_position - self.open_position)

    @property
    def ratios(self) -> dict[str, float]:
        """Each joint of the linkage with its ratio to the driver, which comes first."""
        return {} if self.driver is None else {self.driver: 1.0, **self.followers}

    def joint_positions(self, command: float) -> dict[str, float]:
        """Every linkage joint's position [rad or m] at a command in [0, 1]."""
        at = self.driver_position(command)
        return {name: at * ratio for name, ratio in self.ratios.items()}


@dataclass(frozen=True)
class RobotSpec:
    """An arm with a gripper as data; everything else about it is derived from its URDFs.

    `urdf` is `package:path/inside/it` or a path; `package_dirs` are folders to look in for the
    `package://` meshes of both URDFs. Joint arrays follow `arm_joints`, [rad] of joints that turn
    and [m] of those that slide: `home`, `velocity_limits` [/s], `acceleration_limits` [/s²],
    `jerk_limits` [/s³] (a URDF has no such entries). Joints of neither arm nor gripper are held at
    `held_joints`, or at 0 or the limit nearest to it. The arm's URDF stands at `T_world_base`.
    `T_gripper_tool`: the tool frame in `gripper_base`, a link of gripper or arm; z pointing out
    between the fingertips, x along the direction in which they close. `cameras` are mounted on its
    frames; policies use the one called "wrist" unless specified otherwise.
    """

    name: str
    urdf: str
    arm_joints: tuple[str, ...]
    home: Array
    velocity_limits: Array
    acceleration_limits: Array
    jerk_limits: Array
    gripper: GripperSpec
    gripper_base: str
    T_gripper_tool: Array
    cameras: tuple[CameraSpec, ...] = ()
    attachments: tuple[Attachment, ...] = ()
    link_colours: Mapping[str, tuple[float, float, float, float]] = field(default_factory=dict)
    tool_frame: str = "tool"
    T_world_base: Array = field(default_factory=lambda: np.eye(4))
    package_dirs: tuple[str, ...] = ()
    held_joints: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.arm_joints)
        if len(set(self.arm_joints)) < n or not n:
            raise InvalidInput(
                f"arm_joints of {self.name}: expected different names, got {list(self.arm_joints)}"
            )
        for name in ("home", "velocity_limits", "acceleration_limits", "jerk_limits"):
            object.__setattr__(self, name, frozen(check_array(name, getattr(self, name), (n,))))
            if name != "home" and (getattr(self, name) <= 0).any():
                raise InvalidInput(f"{name}: expected numbers > 0, got {getattr(self, name)}")
        for name in ("T_gripper_tool", "T_world_base"):
            object.__setattr__(self, name, frozen(check_pose(name, getattr(self, name))))
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < len(names):
            raise InvalidInput(f"cameras of {self.name}: expected different names, got {names}")
        for joint in self.held_joints:
            if joint in self.arm_joints or joint in self.gripper.ratios:
                raise InvalidInput(
                    f"held_joints of {self.name}: {joint!r} is a joint of arm or gripper, which "
                    "move; remove it there"
                )

    @property
    def sources(self) -> tuple[str, ...]:
        """The URDFs of arm and gripper, one or two."""
        return (self.urdf,) if self.gripper.urdf is None else (self.urdf, self.gripper.urdf)

    def files_needed(self) -> list[Path]:
        """The URDFs that are named by a path, and the meshes that they name.

        Meshes of attachments are added by the parcel that holds them.

        Raises:
            MissingFile, BrokenFile: a URDF can't be read.
        """
        from sart_toolkit.robots.urdf import source_files

        named = [urdf for urdf in self.sources if ":" not in urdf]
        dirs = self.package_dirs
        return [file for urdf in named for file in source_files(resource_path(urdf), dirs)]
