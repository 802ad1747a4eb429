"""Meshes to draw a robot and a scene with, whatever draws them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import trimesh
from numpy.typing import NDArray

from sart_toolkit.collision.parts import primitive
from sart_toolkit.poses import Array
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape, check_gripper
from sart_toolkit.scenes.spec import Body


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """A mesh to draw: corners `(n, 3)` [m], triangles `(m, 3)` of their indices, `rgba` [0, 1]."""

    vertices: Array
    triangles: NDArray[np.int64]
    rgba: tuple[float, float, float, float]


def shape_mesh(shape: Shape) -> DrawnMesh:
    """A shape's mesh in the frame of its body."""
    if shape.kind == "box":
        mesh = trimesh.creation.box(shape.size)
    elif shape.kind == "sphere":
        mesh = trimesh.creation.icosphere(radius=shape.size[0])
    else:
        mesh = trimesh.creation.cylinder(shape.size[0], shape.size[1], sections=32)
    mesh.apply_transform(shape.T_body_shape)
    return DrawnMesh(np.array(mesh.vertices), np.array(mesh.faces), shape.rgba)


def body_meshes(body: Body) -> list[DrawnMesh]:
    """The meshes of a scene's body, in its frame."""
    return [shape_mesh(shape) for shape in body.shapes]


class DrawnRobot:
    """A robot as its URDF draws it, gripper and held bodies included.

    Attributes:
        meshes: its rigid parts, each in a frame of its own.
        tool: indices of those that the last arm joint carries.
    """

    def __init__(self, model: RobotModel) -> None:
        """Load the meshes of a robot and what it holds."""
        self._spec = model.spec
        self._model = pin.buildModelFromUrdf(str(model.urdf))
        self._data = self._model.createData()
        self._drawn = pin.buildGeomFromUrdf(
            self._model,
            str(model.urdf),
            pin.GeometryType.VISUAL,
            package_dirs=str(model.urdf.parent),
        )
        self._placements = self._drawn.createData()
        items = self._drawn.geometryObjects
        self.meshes = tuple(_mesh(item) for item in items)
        wrist = self._model.getJointId(model.spec.arm_joints[-1])
        moved = [wrist in list(support) for support in self._model.supports]
        self.tool = tuple(i for i, item in enumerate(items) if moved[item.parentJoint])

    def poses(self, q: Array, gripper: float) -> Array:
        """Where the parts are: poses `(n, 4, 4)` in the world.

        Args:
            q: arm joints `(n,)` [rad].
            gripper: its opening in [0, 1].
        """
        linkage = self._spec.gripper.joint_positions(check_gripper(gripper))
        whole = pin.neutral(self._model)
        arm = dict(zip(self._spec.arm_joints, q, strict=True))
        for name, position in {**arm, **linkage}.items():
            whole[self._model.joints[self._model.getJointId(name)].idx_q] = position
        pin.forwardKinematics(self._model, self._data, whole)
        pin.updateGeometryPlacements(self._model, self._data, self._drawn, self._placements)
        return np.array([T.homogeneous for T in self._placements.oMg])


def _mesh(item: pin.GeometryObject) -> DrawnMesh:
    red, green, blue, alpha = (float(x) for x in item.meshColor)
    rgba = red, green, blue, alpha
    if not item.meshPath.endswith(".obj"):
        found = shape_mesh(primitive(item.geometry))
        return DrawnMesh(found.vertices, found.triangles, rgba)
    loaded = trimesh.load(item.meshPath, force="mesh", process=False)
    assert isinstance(loaded, trimesh.Trimesh)
    return DrawnMesh(np.array(loaded.vertices), np.array(loaded.faces), rgba)
