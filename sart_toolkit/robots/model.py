"""Kinematics of a robot through Pinocchio: forward kinematics, Jacobian and inverse kinematics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from sart_toolkit.data.records import CameraFrame
from sart_toolkit.errors import (
    BrokenFile,
    InvalidInput,
    MotionRejected,
    Unreachable,
    unknown_name,
)
from sart_toolkit.poses import Array, check_array, check_pose, frozen, inverse
from sart_toolkit.robots.spec import Attachment, RobotSpec, check_gripper
from sart_toolkit.robots.urdf import composed_urdf

_IK_STEPS = 60
_IK_DAMPING = 1e-4
_IK_TOLERANCE = 1e-6
_IK_MAX_STEP = 0.4
# An orientation that is far off should not shake the joints of an arm that can't reach it.
_IK_DAMPING_OF_FEW = 0.03
# Of its way home, a redundant arm goes so much with each solution.
_HOMING = 0.01
_LIMIT_TOLERANCE = 1e-6


class RobotModel:
    """The kinematics of a robot, its gripper at a fixed opening.

    Joint vectors `q` are `(n,)` [rad] in the order of `spec.arm_joints`; [m] of joints that slide.

    Attributes:
        spec: the robot.
        urdf: path of its composed URDF.
        lower, upper: joint limits `(n,)` [rad], or [m] of joints that slide.
        slides: which joints do `(n,)`.
    """

    def __init__(
        self, spec: RobotSpec, held: Sequence[Attachment] = (), gripper: float = 0.0
    ) -> None:
        """Read the URDF.

        Args:
            spec: the robot.
            held: bodies fixed to its frames.
            gripper: gripper command in [0, 1] at which link poses are computed.

        Raises:
            InvalidInput: gripper command out of range, or a source URDF isn't acceptable.
            UnknownName: a joint or frame of `spec` or `held` isn't in the URDF.
            MissingExtra, MissingFile, BrokenFile: a source URDF or mesh is missing or unreadable.
            CannotWrite: the composed URDF can't be written.
        """
        self.spec = spec
        self.held = tuple(held)
        self.gripper = check_gripper(gripper)
        self.urdf = composed_urdf(spec, held)
        try:
            full = pin.buildModelFromUrdf(str(self.urdf))
        except (ValueError, RuntimeError) as error:
            raise BrokenFile(
                f"{spec.name}: Pinocchio can't read its URDF ({error}); check the source URDFs"
            ) from error
        linkage = spec.gripper.joint_positions(gripper)
        reference = pin.neutral(full)
        for name, position in linkage.items():
            reference[full.joints[full.getJointId(name)].idx_q] = position
        locked = [
            full.getJointId(name) for name in list(full.names)[1:] if name not in spec.arm_joints
        ]
        self._model = pin.buildReducedModel(full, locked, reference)
        self._data = self._model.createData()
        self._tool = self._frame(spec.tool_frame)
        self.lower = frozen(self._model.lowerPositionLimit)
        self.upper = frozen(self._model.upperPositionLimit)
        joints = list(self._model.joints)[1:]
        self.slides = frozen([joint.shortname() == "JointModelPZ" for joint in joints], bool)
        self._posture = np.clip(spec.home, self.lower, self.upper)

    @property
    def pinocchio_model(self) -> pin.Model:
        """The Pinocchio model of the arm, the gripper's joints locked."""
        return self._model

    def _frame(self, name: str) -> int:
        if not self._model.existFrame(name):
            raise unknown_name("frame", name, [f.name for f in self._model.frames])
        return int(self._model.getFrameId(name))

    def mount_of(self, frame: str) -> CameraFrame | None:
        """What a frame (or "world") is rigid to: the tool, the world, or neither of them.

        Raises:
            UnknownName: no such frame.
        """
        joint = 0 if frame == "world" else self._model.frames[self._frame(frame)].parentJoint
        if joint == self._model.frames[self._tool].parentJoint:
            return "tool"
        return "world" if joint == 0 else None

    def mounted_cameras(self) -> dict[str, tuple[CameraFrame, Array]]:
        """Of the robot's cameras that move with the tool or stand still, by name: with which, and
        their pose `(4, 4)` there, camera frame z forward, x right, y down.
        """
        found: dict[str, tuple[CameraFrame, Array]] = {}
        for camera in self.spec.cameras:
            mount = self.mount_of(camera.frame)
            if mount is not None:
                q = np.array(self.spec.home)
                fixed = camera.frame == "world"
                T_world_frame = np.eye(4) if fixed else self.fk(q, camera.frame)
                T_world_mount = self.fk(q) if mount == "tool" else np.eye(4)
                T_mount_frame = inverse(T_world_mount) @ T_world_frame
                found[camera.name] = mount, T_mount_frame @ camera.T_frame_camera
        return found

    def check_q(self, q: Array) -> Array:
        """A float64 copy of a joint configuration `(n,)`.

        Raises:
            InvalidInput: wrong shape or not finite.
        """
        return check_array("q", q, (self._model.nq,))

    def check_limits(self, q: Array) -> Array:
        """A float64 copy of one joint configuration `(n,)`, or several `(m, n)`, within limits.

        Raises:
            InvalidInput: wrong shape, not finite, or outside the limits.
        """
        shape = (None, self._model.nq) if np.ndim(q) == 2 else (self._model.nq,)
        q = check_array("q", q, shape)
        over = (q < self.lower - _LIMIT_TOLERANCE) | (q > self.upper + _LIMIT_TOLERANCE)
        if over.any():
            at = np.unravel_index(int(np.argmax(over)), over.shape)
            j = at[-1]
            raise InvalidInput(
                f"{self.spec.arm_joints[j]}: {q[at]:.3f} {'m' if self.slides[j] else 'rad'} is "
                "outside its limits "
                f"[{self.lower[j]:.3f}, {self.upper[j]:.3f}]"
            )
        return q

    def fk(self, q: Array, frame: str | None = None) -> Array:
        """The pose `(4, 4)` of a frame (default: the tool) in the world at `q`.

        Raises:
            InvalidInput: `q` has the wrong shape or isn't finite.
            UnknownName: no such frame.
        """
        index = self._tool if frame is None else self._frame(frame)
        pin.framesForwardKinematics(self._model, self._data, self.check_q(q))
        return np.array(self._data.oMf[index].homogeneous)

    def jacobian(self, q: Array, frame: str | None = None) -> Array:
        """The Jacobian `(6, n)` of a frame: linear then angular velocity, in that frame's axes.

        Raises:
            InvalidInput: `q` has the wrong shape or isn't finite.
            UnknownName: no such frame.
        """
        index = self._tool if frame is None else self._frame(frame)
        J = pin.computeFrameJacobian(
            self._model, self._data, self.check_q(q), index, pin.ReferenceFrame.LOCAL
        )
        return np.array(J)

    def ik(self, T_world_tool: Array, q_near: Array, max_step: float | None = None) -> Array:
        """The joint configuration `(n,)` near `q_near` that puts the tool at a pose.

        Damped least squares from `q_near`, within joint limits, to 1 µm and 1 µrad. An arm of more
        than six joints also goes a little towards its home where that doesn't move the tool. One
        of fewer goes to the position, and turns the tool as far as it can: `reached` says where
        that is.

        Args:
            T_world_tool: desired tool pose `(4, 4)`.
            q_near: where to start `(n,)`, the last command for instance.
            max_step: reject an answer farther than this [rad] from `q_near` in any joint.

        Raises:
            InvalidInput: wrong shape or not a pose.
            Unreachable: no configuration within limits was found.
            MotionRejected: the answer is farther than `max_step`.
        """
        desired = pin.SE3(check_pose("T_world_tool", T_world_tool))
        start = self.check_q(q_near)
        q = np.clip(start, self.lower, self.upper)
        model, data, tool = self._model, self._data, self._tool
        step = self._step if len(start) >= 6 else self._step_of_few
        # Once: again and again it would keep the rest from converging.
        home = _HOMING * (self._posture - q) if len(start) > 6 else np.zeros(len(start))
        error = np.zeros(6)
        for _ in range(_IK_STEPS):
            pin.computeJointJacobians(model, data, q)
            pin.updateFramePlacement(model, data, tool)
            J = pin.getFrameJacobian(model, data, tool, pin.ReferenceFrame.LOCAL)
            error = pin.log6(data.oMf[tool].actInv(desired)).vector
            dq, left = step(J, error, home)
            if left < _IK_TOLERANCE:
                break
            home = np.zeros(len(start))
            largest = np.abs(dq).max()
            if largest > _IK_MAX_STEP:
                dq *= _IK_MAX_STEP / largest
            q = np.clip(q + dq, self.lower, self.upper)
        else:
            p = ", ".join(f"{x:.3f}" for x in T_world_tool[:3, 3])
            raise Unreachable(
                f"tool pose at ({p}) m is out of reach: {np.linalg.norm(error[:3]) * 1e3:.1f} mm "
                f"and {np.rad2deg(np.linalg.norm(error[3:])):.1f} deg remain within joint limits; "
                "choose a pose nearer to the robot or another start"
            )
        moved = float(np.abs(q - start).max())
        if max_step is not None and moved > max_step:
            raise MotionRejected(
                f"joint jump: a step of {moved:.2f} rad exceeds {max_step:.2f} rad, the pose is on "
                "another branch or too far; move in smaller steps"
            )
        return q

    def _step(self, J: Array, error: Array, home: Array) -> tuple[Array, float]:
        """The joints' next step `(n,)` towards a pose, and how far it is yet.

        `home (n,)` is the way towards a posture, of which what doesn't move the tool is gone.
        """
        return home + _damped(J, error - J @ home), float(np.abs(error).max())

    def _step_of_few(self, J: Array, error: Array, home: Array) -> tuple[Array, float]:
        """The same for an arm of fewer than six joints: position first, then what turns it.

        `error` is that of a motion by both at once; for the position alone its chord counts.
        """
        p = pin.exp6(pin.Motion(error)).translation
        dq = _damped(J[:3], p)
        # What turns the tool about its place.
        still = np.eye(len(dq)) - _damped(J[:3], J[:3])
        turning = J[3:] @ still
        more = still @ _damped(turning, error[3:] - J[3:] @ dq, _IK_DAMPING_OF_FEW)
        return dq + more, float(max(np.abs(p).max(), np.abs(more).max()))

    def reached(self, T_world_tool: Array, q: Array) -> Array:
        """The pose `(4, 4)` that `ik` meant by `q (n,)`: the one desired, if the arm can have it.

        An arm of fewer than six joints may only have turned the tool as far as it can.
        """
        return T_world_tool if len(q) >= 6 else self.fk(q)

    def link_poses(self, q: Array) -> dict[str, Array]:
        """Every frame's pose `(4, 4)` in the world at `q`, by name."""
        pin.framesForwardKinematics(self._model, self._data, self.check_q(q))
        return {
            frame.name: np.array(self._data.oMf[i].homogeneous)
            for i, frame in enumerate(self._model.frames)
        }


def _damped(J: Array, x: Array, damping: float = _IK_DAMPING) -> Array:
    """The damped least-squares solution of J y = x."""
    return np.asarray(J.T @ np.linalg.solve(J @ J.T + damping**2 * np.eye(len(J)), x))
