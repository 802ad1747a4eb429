"""A robot examined in seconds, before anything is recorded: a finding for each thing that matters.

Each step needs what those before it found right: files, then joints, then geometry, then physics.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path

import imageio.v3 as imageio
import numpy as np

from sart_toolkit.backends import DEFAULT_BACKEND, get_backend
from sart_toolkit.backends.interface import Backend, Draws, Resets, SensesContacts
from sart_toolkit.bringup.fingers import fingers_of
from sart_toolkit.collision.model import CollisionModel
from sart_toolkit.doctor import Finding
from sart_toolkit.errors import SartError, nearest_name
from sart_toolkit.poses import Array
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.references import resource_path
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.robots.urdf import assumptions, extents
from sart_toolkit.scenes.spec import SceneSpec, SceneState

# [m]: no link of an arm is longer, and none that is drawn is as small.
_LONGEST, _SHORTEST = 4.0, 5e-4
_MASS = 1e-3, 300.0
# How far [rad or m] a joint may be from its command at rest, and behind it while it moves.
_AT_REST, _MOVING = 5e-3, 0.02
_TURN, _SECONDS = 0.15, 2.0
_GOALS = 16
_SINGULAR = 0.02
_SAMPLES = 2000
_IMAGE = 256
# So near [m] to a camera is only what it looks out of.
_BLOCKED = 0.04


def examine(robot: RobotSpec, image: Path | None = None) -> list[Finding]:
    """What was found about a robot, in the order of what depends on what.

    A finding that isn't `ok` is required where nothing works without it, and says what to do.

    Args:
        robot: the robot.
        image: where to write what its cameras see at home, side by side; nowhere if left out.
    """
    findings: list[Finding] = []
    steps: dict[str, Callable[[], Iterator[Finding]]] = {
        "files": lambda: _files(robot),
        "model": lambda: _model(robot),
        "joints": lambda: _joints(robot),
        "gripper": lambda: _gripper(robot),
        "cameras": lambda: _cameras(robot, image),
        "home": lambda: _geometry(robot),
        "physics": lambda: _physics(robot),
    }
    for name, step in steps.items():
        try:
            findings += step()
        except SartError as error:
            what, _, remedy = str(error).rpartition("; ")
            findings.append(_bad(name, what or remedy, remedy if what else "see the message", True))
        if any(finding.required and not finding.ok for finding in findings):
            break
    return findings


def _ok(name: str, detail: str) -> Finding:
    return Finding(name, True, detail)


def _bad(name: str, detail: str, remedy: str, required: bool = False) -> Finding:
    return Finding(name, False, detail, remedy, required)


def _files(robot: RobotSpec) -> Iterator[Finding]:
    meshes = 0
    for source in robot.sources:
        sizes = extents(resource_path(source), robot.package_dirs)
        meshes += len(sizes)
        for link, mesh, size in sizes:
            if not size:
                yield _bad(
                    "mesh", f"link {link!r}: {mesh} has no triangles", "export it again", True
                )
            elif size > _LONGEST:
                yield _bad(
                    "mesh size", f"link {link!r}: {mesh} is {size:.4g} m long",
                    'if its file is in millimetres, give its <mesh> scale="0.001 0.001 0.001"',
                    True,
                )  # fmt: skip
            elif size < _SHORTEST:
                yield _bad(
                    "mesh size", f"link {link!r}: {mesh} is {size * 1e3:.2g} mm long",
                    "its scale is too small; remove it, or give one that makes it metres", True,
                )  # fmt: skip
    yield _ok("files", f"{' and '.join(map(_short, robot.sources))}, {meshes} meshes")


def _short(source: str) -> str:
    return source.rpartition("/")[2]


def _model(robot: RobotSpec) -> Iterator[Finding]:
    model = RobotModel(robot)
    alike: dict[tuple[str, str], list[str]] = {}
    for note in assumptions(model.urdf):
        kind, name, rest = note.split("'", 2)
        alike.setdefault((kind, rest), []).append(repr(name))
    for (kind, rest), named in alike.items():
        what, _, taken = f"{kind}{', '.join(named)}{rest}".rpartition(": ")
        yield _bad("assumed", what, f"{taken}; if that isn't right, correct the URDF or RobotSpec")
    frames = [frame.name for frame in model.pinocchio_model.frames]
    wanted = [("finger_links", name) for name in robot.gripper.finger_links]
    wanted += [(f"camera {camera.name!r}", camera.frame) for camera in robot.cameras]
    wanted += [("link_colours", name) for name in robot.link_colours]
    for what, name in wanted:
        if name not in (*frames, "world"):
            near = nearest_name(name, frames)
            remedy = f"did you mean {near!r}?" if near else f"choose from {', '.join(frames[:40])}"
            yield _bad("frames", f"{what}: no frame {name!r}", remedy, what != "link_colours")
    for j, inertia in enumerate(model.pinocchio_model.inertias[1:]):
        if not _MASS[0] <= inertia.mass <= _MASS[1]:
            yield _bad(
                "mass", f"what joint {robot.arm_joints[j]!r} carries weighs {inertia.mass:.3g} kg",
                "correct its links' <mass>",
            )  # fmt: skip


def _joints(robot: RobotSpec) -> Iterator[Finding]:
    model = RobotModel(robot)
    n = len(robot.arm_joints)
    out = (robot.home < model.lower) | (robot.home > model.upper)
    for j in np.flatnonzero(out).tolist():
        yield _bad(
            "home", f"{robot.arm_joints[j]} at {robot.home[j]:.3f} is outside its limits "
            f"[{model.lower[j]:.3f}, {model.upper[j]:.3f}]", "choose a home within", True,
        )  # fmt: skip
    if out.any():
        return
    slide = int(model.slides.sum())
    kinds = f"{n - slide} turn" + (f", {slide} slide" if slide else "")
    yield _ok("joints", f"{n} of the arm ({kinds})")
    if n < 6:
        yield _bad(
            "joints", f"an arm of {n} joints can't turn its tool freely",
            "none needed: it goes to positions, and turns as far as it can",
        )  # fmt: skip
    given = model.pinocchio_model.velocityLimit
    fast = (given > 0) & (given < 0.99 * robot.velocity_limits)
    if fast.any():
        names = ", ".join(np.array(robot.arm_joints)[fast])
        yield _bad(
            "velocity", f"{names}: faster than the URDF's {', '.join(f'{v:.3g}' for v in given)}/s",
            "lower velocity_limits to what the robot can do",
        )  # fmt: skip
    least = float(np.linalg.svd(model.jacobian(robot.home), compute_uv=False)[-1])
    if least < _SINGULAR and n >= 6:
        yield _bad(
            "home", f"is nearly singular (least singular value {least:.3f})",
            "bend elbow and wrist away from straight",
        )  # fmt: skip
    rng = np.random.default_rng(0)
    low, high = np.maximum(model.lower, -np.pi), np.minimum(model.upper, np.pi)
    p = np.array([model.fk(q)[:3, 3] for q in rng.uniform(low, high, (_SAMPLES, n))])
    p_base = robot.T_world_base[:3, 3]
    far = float(np.linalg.norm(p - p_base, axis=1).max())
    at = ", ".join(f"{x:.3f}" for x in model.fk(robot.home)[:3, 3])
    yield _ok("reach", f"{far:.2f} m from its base; the tool at home is at ({at}) m")


def _gripper(robot: RobotSpec) -> Iterator[Finding]:
    gripper = robot.gripper
    if gripper.driver is None:
        yield _ok("gripper", "none: the tool has no fingers")
        return
    if not gripper.finger_links:
        yield _bad(
            "gripper", "finger_links names no link", "name the links that touch what is grasped",
            True,
        )  # fmt: skip
        return
    fingers = fingers_of(RobotModel(robot))
    if fingers is None:
        yield _bad(
            "gripper", "the gap can't be told: not two of finger_links have collision parts",
            "name the two links that touch what is grasped, if there are two",
        )  # fmt: skip
        return
    gaps = ", ".join(f"{gap * 1e3:.1f}" for gap in fingers.gaps)
    positions = f"{gripper.open_position:g} and {gripper.closed_position:g}"
    if fingers.gaps[-1] >= fingers.gaps[0]:
        yield _bad(
            "gripper", f"its gap grows as it closes: {gaps} mm",
            f"swap open_position and closed_position ({positions})", True,
        )  # fmt: skip
        return
    if (np.diff(fingers.gaps) > 1e-4).any():
        yield _bad(
            "gripper", f"its gap doesn't shrink all the way: {gaps} mm",
            "check the ratios of its followers, and closed_position", True,
        )  # fmt: skip
        return
    if fingers.gaps[0] <= 0:
        yield _bad(
            "gripper", f"its fingers' hulls overlap even open ({gaps} mm): the gap can't be told",
            "look at the image, or give the fingers finer collision shapes",
        )  # fmt: skip
    else:
        yield _ok("gripper", f"gap from open to closed: {gaps} mm")
    if abs(fingers.closing[0]) < 0.9:
        direction = ", ".join(f"{x:.2f}" for x in np.round(fingers.closing, 2) + 0.0)
        yield _bad(
            "tool frame", f"its fingers close along ({direction}) of it, expected x",
            "turn T_gripper_tool so that x is where the fingers close, and z points out",
        )  # fmt: skip
    off = float(np.linalg.norm(fingers.tips))
    if off > 0.06:
        at = ", ".join(f"{x * 1e3:.0f}" for x in fingers.tips)
        yield _bad(
            "tool frame", f"the fingertips are {off * 1e3:.0f} mm from it, at ({at}) mm",
            "move T_gripper_tool between the fingertips",
        )  # fmt: skip


def _cameras(robot: RobotSpec, image: Path | None) -> Iterator[Finding]:
    if not robot.cameras:
        yield _bad("cameras", "none", 'add a CameraSpec("wrist", ...), which policies look through')
        return
    if "wrist" not in {camera.name for camera in robot.cameras}:
        yield _bad("cameras", "none is called 'wrist'", "name that of the wrist so, or tell verbs")
    backend = _backend(DEFAULT_BACKEND, robot)
    state = SceneState(robot.home, 0.0, {})
    assert isinstance(backend, Draws)
    views = []
    for camera in robot.cameras:
        view = backend.draw(state, camera, _IMAGE, _IMAGE)
        views.append(view.rgb)
        near = (view.depth > 0) & (view.depth < _BLOCKED)
        if near.mean() > 0.5:
            yield _bad(
                "cameras", f"{camera.name!r} is behind or inside the robot: {near.mean():.0%} of "
                f"its view is nearer than {_BLOCKED * 1e3:.0f} mm",
                "move T_frame_camera out of the housing, z along its view",
            )  # fmt: skip
            continue
        model = RobotModel(robot)
        T_world_camera = (
            camera.T_frame_camera if camera.frame == "world"
            else model.fk(robot.home, camera.frame) @ camera.T_frame_camera
        )  # fmt: skip
        p = T_world_camera[:3, :3].T @ (model.fk(robot.home)[:3, 3] - T_world_camera[:3, 3])
        half = np.tan(np.deg2rad(camera.fov_y_deg) / 2)
        seen = p[2] > 0 and (np.abs(p[:2]) < half * p[2]).all()
        if not seen and model.mount_of(camera.frame) == "tool":
            yield _bad(
                "cameras", f"{camera.name!r} doesn't see the tool's centre",
                "turn T_frame_camera towards it (look_at does), or widen fov_y_deg",
            )  # fmt: skip
        else:
            yield _ok("cameras", f"{camera.name!r} sees the tool's centre" if seen else camera.name)
    backend.close()
    if image is not None:
        imageio.imwrite(image, np.concatenate(views, axis=1))
        yield _ok("image", f"{image}: what the cameras see at home")


def _geometry(robot: RobotSpec) -> Iterator[Finding]:
    overlapping = CollisionModel(robot, SceneSpec(())).overlapping_at_home
    for a, b in overlapping:
        yield _bad(
            "home", f"hulls of {a!r} and {b!r} overlap, so the two are never kept apart",
            "choose another home, or give finer collision shapes",
        )  # fmt: skip
    if not overlapping:
        yield _ok("home", "no two links are in each other")


def _physics(robot: RobotSpec) -> Iterator[Finding]:
    for name in ("pybullet", "sapien"):
        if importlib.util.find_spec(name) is None:
            yield Finding(name, True, "is not installed: not tested", tested=False)
            continue
        yield from _moved(name, robot)


def _moved(name: str, robot: RobotSpec) -> Iterator[Finding]:
    """Whether a robot holds its home in a simulator, goes where it is sent, and closes."""
    backend = _backend(name, robot)
    hz = backend.rates.control_hz
    touching: set[tuple[str, str]] = set()

    def go(q_from: Array, q_to: Array, gripper: tuple[float, float], seconds: float) -> float:
        """The farthest that a joint was from its command."""
        worst, steps = 0.0, int(seconds * hz)
        for i in range(1, steps + 1):
            q = q_from + (q_to - q_from) * i / steps
            backend.command(q, gripper[0] + (gripper[1] - gripper[0]) * i / steps)
            backend.step()
            worst = max(worst, float(np.abs(backend.observe().q - q).max()))
            assert isinstance(backend, SensesContacts)
            touching.update((contact.a, contact.b) for contact in backend.contacts())
        return worst

    try:
        rested = go(robot.home, robot.home, (0.0, 0.0), 1.0)
        if not rested < _AT_REST:
            pairs = "; ".join(f"{a} touches {b}" for a, b in sorted(touching)[:3])
            yield _bad(
                name, f"doesn't hold its home: a joint is off by {rested:.3g} rad"
                + (f" ({pairs})" if pairs else ""),
                "choose a home where nothing touches" if pairs
                else "raise <limit effort> of the joints, or correct <mass> and <inertia>", True,
            )  # fmt: skip
            return
        goal = _goal(robot)
        lagged = go(robot.home, goal, (0.0, 1.0), _SECONDS)
        if not lagged < _MOVING:
            yield _bad(
                name, f"doesn't follow: a joint is {lagged:.3g} rad from its command",
                "raise <limit effort>, or look at what it touches: "
                + ("; ".join(f"{a} and {b}" for a, b in sorted(touching)[:3]) or "nothing"), True,
            )  # fmt: skip
            return
        go(goal, goal, (1.0, 1.0), 1.0)
        closed = backend.observe().gripper
        if robot.gripper.driver is not None and closed < 0.5:
            yield _bad(
                name, f"the gripper is told to close and is at {closed:.2f} after a second",
                "raise the gripper's force or speed, or its followers' ratios are wrong", True,
            )  # fmt: skip
            return
        yield _ok(name, f"holds to {rested:.1g} rad and follows to {lagged:.1g} rad")
    finally:
        backend.close()


def _goal(robot: RobotSpec) -> Array:
    """Joints `(n,)` a little away from home, all of them, with nothing in the way if there are."""
    collision = CollisionModel(robot, SceneSpec(()))
    model, placed = collision.kinematics, collision.placed({}, (0.0, 1.0))
    rng = np.random.default_rng(0)
    goal = robot.home
    for _ in range(_GOALS):
        turn = _TURN * rng.choice([-1.0, 1.0], len(robot.home))
        goal = np.clip(robot.home + turn, model.lower, model.upper)
        way = np.linspace(robot.home, goal, 6)
        if not any(placed.too_close(q, 0.01) for q in way):
            break
    return goal


def _backend(name: str, robot: RobotSpec) -> Backend:
    make: Callable[..., Backend] = get_backend(name)
    backend = make(robot, SceneSpec(()))
    assert isinstance(backend, Resets)
    backend.reset(SceneState(robot.home, 0.0, {}))
    return backend
