"""Meshes to draw a robot and a scene with, whatever draws them."""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
import trimesh
from numpy.typing import NDArray

from sart_toolkit.poses import Array
from sart_toolkit.robots.meshes import creased
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import BodyShape, MeshShape, Shape, check_gripper
from sart_toolkit.robots.urdf import drawn_elements


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """A mesh to draw: corners `(n, 3)` [m], triangles `(m, 3)` of their indices, `rgba` [0, 1].

    `normals (n, 3)`: unit vectors outwards, smooth across what is round.
    """

    vertices: Array
    triangles: NDArray[np.int64]
    normals: Array
    rgba: tuple[float, float, float, float]

    def moved(self, T: Array) -> DrawnMesh:
        """The same mesh in the frame in which its own is at `T (4, 4)`."""
        R = T[:3, :3].T
        return DrawnMesh(self.vertices @ R + T[:3, 3], self.triangles, self.normals @ R, self.rgba)


def body_meshes(shapes: Iterable[BodyShape]) -> list[DrawnMesh]:
    """What is drawn of a body of these shapes, in its frame; of each colour a mesh."""
    return [
        _drawn(mesh, rgba).moved(shape.T_body_shape)
        for shape in shapes
        for mesh, rgba in (
            shape.drawn()
            if isinstance(shape, MeshShape)
            else ((_primitive_mesh(shape.kind, shape.size), shape.rgba),)
        )
    ]


# Scenes in other colours have the same shapes.
@functools.lru_cache(maxsize=256)
def _primitive_mesh(kind: str, size: tuple[float, ...]) -> trimesh.Trimesh:
    if kind == "box":
        mesh = trimesh.creation.box(size)
    elif kind == "sphere":
        mesh = trimesh.creation.icosphere(radius=size[0])
    else:
        mesh = trimesh.creation.cylinder(size[0], size[1], sections=48)
    return creased(mesh)


class RobotVisuals:
    """A robot as its URDF draws it, gripper and held bodies included.

    Attributes:
        bodies: the meshes of its rigid parts, in the frame of the joint that moves each, by that
            joint's name; what no joint moves is "universe", in the world frame.
        tool: names of those that the last arm joint carries.
    """

    def __init__(self, model: RobotModel) -> None:
        """Load the meshes of a robot and what it holds."""
        self._spec = model.spec
        self._model = pin.buildModelFromUrdf(str(model.urdf))
        self._data = self._model.createData()
        self._frames = {frame.name: frame for frame in self._model.frames}
        self._neutral = np.array(pin.neutral(self._model))
        self._at = {name: self._model.joints[i].idx_q for i, name in self._joints()}
        bodies: dict[str, list[DrawnMesh]] = {}
        for link, meshes in _link_meshes(model.urdf).items():
            joint, T_joint_link = self.mount(link)
            bodies.setdefault(joint, []).extend(mesh.moved(T_joint_link) for mesh in meshes)
        self.bodies = {name: tuple(meshes) for name, meshes in bodies.items()}
        wrist = self._model.getJointId(model.spec.arm_joints[-1])
        carried = {self._model.names[i] for i in self._model.subtrees[wrist]}
        self.tool = tuple(name for name in self.bodies if name in carried)

    def _joints(self) -> list[tuple[int, str]]:
        return list(enumerate(self._model.names))[1:]

    def mount(self, frame: str) -> tuple[str, Array]:
        """The name of the joint that moves a frame, or "universe", and the frame's pose in its.

        The frame is the robot's, or "world".
        """
        if frame == "world":
            return "universe", np.eye(4)
        found = self._frames[frame]
        return self._model.names[found.parentJoint], np.array(found.placement.homogeneous)

    def poses(self, positions: Mapping[str, float]) -> dict[str, Array]:
        """Where the joints' frames are in the world `(4, 4)`, by name, from all their positions."""
        q = self._neutral.copy()
        for name, position in positions.items():
            q[self._at[name]] = position
        pin.forwardKinematics(self._model, self._data, q)
        return {
            name: np.array(T.homogeneous)
            for name, T in zip(self._model.names, self._data.oMi, strict=True)
        }

    def poses_at(self, q: Array, gripper: float) -> dict[str, Array]:
        """Where the joints' frames are in the world `(4, 4)`, by name.

        Args:
            q: arm joints `(n,)` [rad].
            gripper: its opening in [0, 1].
        """
        linkage = self._spec.gripper.joint_positions(check_gripper(gripper))
        return self.poses(dict(zip(self._spec.arm_joints, q, strict=True)) | linkage)


# A URDF of ours stands in a folder named by its content.
@functools.lru_cache(maxsize=8)
def _link_meshes(urdf: Path) -> dict[str, list[DrawnMesh]]:
    """What is drawn of each link, in its frame."""
    found: dict[str, list[DrawnMesh]] = {}
    for link in ET.parse(urdf).getroot().findall("link"):
        meshes = [
            mesh
            for what, T_link_mesh, rgba in drawn_elements(link, urdf.parent)
            for mesh in (
                body_meshes([what])
                if isinstance(what, Shape)
                else [_drawn(what, rgba).moved(T_link_mesh)]
            )
        ]
        if meshes:
            found[link.get("name", "")] = meshes
    return found


def _drawn(mesh: trimesh.Trimesh, rgba: tuple[float, float, float, float]) -> DrawnMesh:
    return DrawnMesh(
        np.array(mesh.vertices), np.array(mesh.faces), np.array(mesh.vertex_normals), rgba
    )
