"""Images by SAPIEN's rasteriser, and whether it can draw on this machine."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from sart_toolkit.backends.interface import CameraView
from sart_toolkit.collision.parts import primitive
from sart_toolkit.errors import CannotWrite, MissingCapability, MissingExtra
from sart_toolkit.poses import Array
from sart_toolkit.robots.references import cache_dir
from sart_toolkit.robots.spec import CameraSpec, MeshShape, Shape
from sart_toolkit.robots.visuals import body_meshes
from sart_toolkit.scenes.spec import Light, SceneSpec

try:
    with warnings.catch_warnings():
        # SAPIEN says which of its own Vulkan libraries it falls back to.
        warnings.simplefilter("ignore")
        import sapien
except ImportError as error:
    raise MissingExtra(f"SAPIEN: {error}; pip install 'sart_toolkit[sapien]'") from error

sapien.set_log_level("critical")
sapien.render.set_log_level("critical")

_SHADOW_REACH, _SHADOW_PIXELS = 1.5, 1024
_BACKGROUND = 255
# SAPIEN's camera looks along x with y left and z up; ours looks along z with x right and y down.
_R_CAMERA_SAPIEN = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

# SAPIEN's own shaders first compute tables for shiny surfaces, which takes a CPU some seconds in
# every process. These know one light and dull surfaces only: a face shows its colour times ambient
# + intensity * cos(angle to the light). SAPIEN finds blocks and their members by these names.
_BLOCKS = """#version 450
layout(set = 1, binding = 0) uniform ObjectTransformBuffer {
  mat4 modelMatrix;
} objectTransformBuffer;
layout(set = 1, binding = 1) uniform ObjectDataBuffer {
  uvec4 segmentation; float transparency; int shadeFlat;
} objectDataBuffer;
"""
_CAMERA = """layout(set = 0, binding = 0) uniform CameraBuffer {
  mat4 viewMatrix; mat4 projectionMatrix; mat4 viewMatrixInverse; mat4 projectionMatrixInverse;
  float width; float height;
} cameraBuffer;
"""
_VERTEX = """layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;
layout(location = 3) in vec3 tangent;
layout(location = 4) in vec3 bitangent;
"""
_LIGHT_BUFFER = """
  mat4 viewMatrix; mat4 viewMatrixInverse; mat4 projectionMatrix; mat4 projectionMatrixInverse;
  int width; int height;
"""
_SHADERS = {
    "shadow.vert": f"""{_BLOCKS}{_VERTEX}
layout(set = 0, binding = 0) uniform LightBuffer {{{_LIGHT_BUFFER}}} lightBuffer;
void main() {{
  gl_Position = lightBuffer.projectionMatrix * lightBuffer.viewMatrix
    * objectTransformBuffer.modelMatrix * vec4(position, 1);
}}
""",
    "gbuffer.vert": f"""{_BLOCKS}{_CAMERA}{_VERTEX}
layout(location = 0) out vec4 outPosition;
layout(location = 1) out vec3 outWorld;
layout(location = 2) out vec3 outNormal;
void main() {{
  vec4 world = objectTransformBuffer.modelMatrix * vec4(position, 1);
  outWorld = world.xyz;
  outNormal = transpose(inverse(mat3(objectTransformBuffer.modelMatrix))) * normal;
  outPosition = cameraBuffer.viewMatrix * world;
  gl_Position = cameraBuffer.projectionMatrix * outPosition;
}}
""",
    "gbuffer.frag": f"""{_BLOCKS}{_CAMERA}
layout(set = 2, binding = 0) uniform MaterialBuffer {{
  vec4 emission; vec4 baseColor;
  float fresnel; float roughness; float metallic; float transmission; float ior;
  float transmissionRoughness; int textureMask; int padding1; vec4 textureTransforms[6];
}} materialBuffer;
layout(set = 2, binding = 1) uniform sampler2D colorTexture;
layout(set = 2, binding = 2) uniform sampler2D roughnessTexture;
layout(set = 2, binding = 3) uniform sampler2D normalTexture;
layout(set = 2, binding = 4) uniform sampler2D metallicTexture;
layout(set = 2, binding = 5) uniform sampler2D emissionTexture;
layout(set = 2, binding = 6) uniform sampler2D transmissionTexture;
struct PointLight {{ vec4 position; vec4 emission; }};
struct DirectionalLight {{ vec4 direction; vec4 emission; }};
struct SpotLight {{ vec4 position; vec4 direction; vec4 emission; }};
layout(set = 3, binding = 0) uniform SceneBuffer {{
  vec4 ambientLight; PointLight pointLights[1]; DirectionalLight directionalLights[1];
  SpotLight spotLights[1]; SpotLight texturedLights[1];
}} sceneBuffer;
struct LightBuffer {{{_LIGHT_BUFFER}}};
layout(set = 3, binding = 1) uniform ShadowBuffer {{
  LightBuffer pointLightBuffers[6]; LightBuffer directionalLightBuffers[1];
  LightBuffer spotLightBuffers[1]; LightBuffer texturedLightBuffers[1];
}} shadowBuffer;
layout(set = 3, binding = 2) uniform samplerCube samplerPointLightDepths[1];
layout(set = 3, binding = 3) uniform sampler2D samplerDirectionalLightDepths[1];
layout(set = 3, binding = 4) uniform sampler2D samplerSpotLightDepths[1];
layout(set = 3, binding = 5) uniform sampler2D samplerTexturedLightDepths[1];
layout(set = 3, binding = 6) uniform sampler2D samplerTexturedLightTextures[1];
layout(location = 0) in vec4 inPosition;
layout(location = 1) in vec3 inWorld;
layout(location = 2) in vec3 inNormal;
layout(location = 0) out vec4 outColor;
layout(location = 1) out vec4 outPosition;
void main() {{
  vec4 at = shadowBuffer.directionalLightBuffers[0].projectionMatrix
    * shadowBuffer.directionalLightBuffers[0].viewMatrix * vec4(inWorld, 1);
  vec2 texel = 1.0 / textureSize(samplerDirectionalLightDepths[0], 0);
  float lit = 0;
  for (int x = -1; x <= 1; ++x)
    for (int y = -1; y <= 1; ++y) {{
      vec2 uv = at.xy * 0.5 + 0.5 + vec2(x, y) * texel;
      lit += step(at.z - 5e-4, texture(samplerDirectionalLightDepths[0], uv).x) / 9;
    }}
  if (any(greaterThan(abs(at.xyz), vec3(1)))) lit = 1;
  vec3 lamp = sceneBuffer.directionalLights[0].emission.rgb;
  float facing = -dot(normalize(inNormal), sceneBuffer.directionalLights[0].direction.xyz);
  vec3 light = sceneBuffer.ambientLight.rgb + lit * max(facing, 0) * lamp;
  outColor = vec4(clamp(materialBuffer.baseColor.rgb * light, 0, 1), 1);
  outPosition = inPosition;
}}
""",
}

_PROBE_SECONDS = 60
# How long a found answer holds: a failure may have been the machine's bad moment.
_TRUSTED_SECONDS, _TRUSTED_FAILURE_SECONDS = 3600, 60
_PROBE = """
import sys
import warnings
warnings.simplefilter("ignore")
import sapien
scene = sapien.Scene([sapien.render.RenderSystem()])
for component in (
    sapien.render.RenderDirectionalLightComponent(),
    sapien.render.RenderCameraComponent(4, 4, sys.argv[1]),
):
    entity = sapien.Entity()
    entity.add_component(component)
    scene.add_entity(entity)
scene.update_render()
component.take_picture()
assert component.get_picture("Color").shape == (4, 4, 4), "its image has another shape"
"""
REMEDY = (
    "install Mesa 24.3 or newer (Debian: sudo bash tools/setup_debian.sh sapien) or the GPU's "
    "driver, or use another backend for images"
)


def why_no_images() -> str:
    """Why SAPIEN can't draw on this machine; empty where it can.

    A process of its own draws a tiny image, since a broken driver may end it. The answer holds
    for all processes with the same drivers and settings, for an hour where it can draw.
    """
    drivers = [
        (str(path), path.stat().st_mtime)
        for folder in ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
        for path in sorted(Path(folder).glob("*.json"))
    ]
    names = ("VK_", "SAPIEN_", "CUDA_VISIBLE", "LD_LIBRARY_PATH", "XDG_", "DISPLAY")
    settings = sorted(item for item in os.environ.items() if item[0].startswith(names))
    version = importlib.metadata.version("sapien")
    key = repr((version, sys.prefix, drivers, settings, _PROBE, _SHADERS))
    return _why_no_images(hashlib.sha256(key.encode()).hexdigest()[:16])


@functools.cache
def _why_no_images(key: str) -> str:
    path = cache_dir() / f"sapien-{key}.json"
    with suppress(OSError, ValueError, KeyError, TypeError):
        known = json.loads(path.read_text())
        trusted = _TRUSTED_FAILURE_SECONDS if known["reason"] else _TRUSTED_SECONDS
        if 0 <= time.time() - known["time"] < trusted:
            return str(known["reason"])
    reason = _probe()
    # What can't be kept is found again by the next process.
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "w") as file:
            json.dump({"time": time.time(), "reason": reason}, file)
        os.replace(temporary, path)
    return reason


@functools.cache
def _shader_folder() -> str:
    """Where SAPIEN finds the shaders."""
    key = hashlib.sha256(repr(_SHADERS).encode()).hexdigest()[:16]
    folder = cache_dir() / f"sapien-shaders-{key}"
    if not folder.exists():
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder.parent) as work:
                made = Path(work) / folder.name
                made.mkdir()
                for name, text in _SHADERS.items():
                    (made / name).write_text(text)
                made.rename(folder)
        except OSError as error:
            # Another process may just have put the same files there.
            if folder.exists():
                return str(folder)
            raise CannotWrite(
                f"{folder}: {error.strerror or error}; set SART_CACHE to a folder that can be "
                "written"
            ) from error
    return str(folder)


def _probe() -> str:
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE, _shader_folder()],
            capture_output=True,
            text=True,
            timeout=_PROBE_SECONDS,
        )
    except subprocess.TimeoutExpired:
        return f"no image within {_PROBE_SECONDS} s"
    if done.returncode == 0:
        return ""
    said = done.stderr.strip().splitlines() or [f"its process ended with {done.returncode}"]
    return said[-1]


def sapien_pose(T: Array) -> Any:
    """SAPIEN's pose of a `(4, 4)`: float32, its quaternion wxyz."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return sapien.Pose(T[:3, 3].tolist(), [float(w), float(x), float(y), float(z)])


def sapien_axis(axis: Array) -> Array:
    """A pose `(4, 4)` whose x axis is `axis (3,)`, as SAPIEN has its cylinders and joints."""
    T = np.eye(4)
    across = np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis)
    T[:3, 0], T[:3, 1] = axis, across / np.linalg.norm(across)
    T[:3, 2] = np.cross(axis, T[:3, 1])
    return T


ALONG_Z = sapien_axis(np.array([0.0, 0.0, 1.0]))


class Renderer:
    """A scene and robot as SAPIEN draws them: meshes and light, but nothing that moves.

    Nothing here depends on the physics, so bodies are drawn wherever they are said to be.
    """

    def __init__(self, robot: pin.GeometryModel, scene: SceneSpec) -> None:
        """Load what is drawn.

        Args:
            robot: its visual geometry.
            scene: the bodies and the light.

        Raises:
            MissingCapability: SAPIEN finds no device to draw with.
        """
        try:
            self._system = sapien.render.RenderSystem()
        except RuntimeError as error:
            raise MissingCapability(f"SAPIEN can't draw here ({error}); {REMEDY}") from error
        self._scene = sapien.Scene([self._system])
        self._joints: dict[int, Any] = {}
        for item in robot.geometryObjects:
            entity = self._joints.setdefault(int(item.parentJoint), _Drawn())
            entity.add(_robot_shape(item))
        self._bodies: dict[str, Any] = {}
        for body in scene.bodies:
            entity = self._bodies[body.name] = _Drawn()
            for shape in body.shapes:
                for drawn in _meshes(shape) if isinstance(shape, MeshShape) else [_shape(shape)]:
                    entity.add(drawn)
        for drawn in (*self._joints.values(), *self._bodies.values()):
            drawn.join(self._scene)
        self._add_light(scene.light)
        self._cameras: dict[tuple[Any, ...], Any] = {}

    def _add_light(self, light: Light) -> None:
        self._system.ambient_light = [light.ambient] * 3
        lamp = sapien.render.RenderDirectionalLightComponent()
        lamp.color = [light.intensity] * 3
        # The shaders need a map of shadows; what it doesn't reach is lit.
        lamp.shadow = True
        lamp.shadow_half_size = _SHADOW_REACH if light.shadows else 1e-6
        lamp.shadow_near, lamp.shadow_far = 0.0, 4 * _SHADOW_REACH
        lamp.shadow_map_size = _SHADOW_PIXELS if light.shadows else 1
        T = sapien_axis(-light.direction)
        T[:3, 3] = 2 * _SHADOW_REACH * light.direction
        entity = sapien.Entity()
        entity.add_component(lamp)
        entity.set_pose(sapien_pose(T))
        self._scene.add_entity(entity)

    def take(
        self,
        cameras: Sequence[tuple[CameraSpec, Array]],
        size: tuple[int, int],
        joints: Mapping[int, Array],
        bodies: Mapping[str, Array],
    ) -> dict[str, CameraView]:
        """The images of cameras, by name.

        Args:
            cameras: each camera and the pose `(4, 4)` of its frame in the world.
            size: width and height [pixels].
            joints: pose `(4, 4)` of the robot's joint frames, by the index of their joint.
            bodies: pose `(4, 4)` of the scene's bodies.
        """
        for index, drawn in self._joints.items():
            drawn.move(joints[index])
        for name, drawn in self._bodies.items():
            drawn.move(bodies[name])
        taken = {}
        for camera, T_world_frame in cameras:
            T_world_camera = T_world_frame @ camera.T_frame_camera
            T_world_sapien = T_world_camera.copy()
            T_world_sapien[:3, :3] = T_world_camera[:3, :3] @ _R_CAMERA_SAPIEN
            component = self._camera(camera, *size)
            component.entity.set_pose(sapien_pose(T_world_sapien))
            taken[camera.name] = component, T_world_camera
        self._system.step()
        return {name: _view(*shown) for name, shown in taken.items()}

    def _camera(self, camera: CameraSpec, width: int, height: int) -> Any:
        key = (camera.name, camera.fov_y_deg, camera.near, camera.far, width, height)
        if key not in self._cameras:
            component = sapien.render.RenderCameraComponent(width, height, _shader_folder())
            K = camera.intrinsics(width, height)
            # SAPIEN counts pixels from the image's corner.
            component.set_perspective_parameters(
                camera.near, camera.far, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, 0.0
            )
            entity = sapien.Entity()
            entity.add_component(component)
            self._scene.add_entity(entity)
            self._cameras[key] = component
        return self._cameras[key]


class _Drawn:
    """What is drawn rigidly together."""

    def __init__(self) -> None:
        self._entity = sapien.Entity()
        self._body = sapien.render.RenderBodyComponent()

    def add(self, shape: Any) -> None:
        self._body.attach(shape)

    def join(self, scene: Any) -> None:
        self._entity.add_component(self._body)
        scene.add_entity(self._entity)

    def move(self, T: Array) -> None:
        self._entity.set_pose(sapien_pose(T))


def _view(component: Any, T_world_camera: Array) -> CameraView:
    component.take_picture()
    rgb = component.get_picture("Color")[..., :3]
    # OpenGL's camera looks along -z; what nothing is drawn over stays 0.
    depth = 0 - component.get_picture("Position")[..., 2]
    rgb = np.where(depth[..., None] > 0, np.round(255 * rgb), _BACKGROUND).astype(np.uint8)
    return CameraView(rgb, depth, T_world_camera)


def _shape(shape: Shape) -> Any:
    material, T = sapien.render.RenderMaterial(base_color=list(shape.rgba)), shape.T_body_shape
    if shape.kind == "box":
        made = sapien.render.RenderShapeBox([edge / 2 for edge in shape.size], material)
    elif shape.kind == "sphere":
        made = sapien.render.RenderShapeSphere(shape.size[0], material)
    else:
        radius, length = shape.size
        made = sapien.render.RenderShapeCylinder(radius, length / 2, material)
        T = T @ ALONG_Z
    made.local_pose = sapien_pose(T)
    return made


def _meshes(shape: MeshShape) -> list[Any]:
    made = []
    for mesh in body_meshes([shape]):
        material = sapien.render.RenderMaterial(base_color=list(mesh.rgba))
        uvs = np.zeros((len(mesh.vertices), 2), np.float32)
        made.append(
            sapien.render.RenderShapeTriangleMesh(
                mesh.vertices.astype(np.float32),
                mesh.triangles.astype(np.uint32),
                mesh.normals.astype(np.float32),
                uvs,
                material,
            )
        )
    return made


def _robot_shape(item: pin.GeometryObject) -> Any:
    T, rgba = np.array(item.placement.homogeneous), item.meshColor.tolist()
    if not item.meshPath.endswith(".obj"):
        shape = primitive(item.geometry)
        return _shape(dataclasses.replace(shape, T_body_shape=T, rgba=tuple(rgba)))
    material = sapien.render.RenderMaterial(base_color=rgba)
    made = sapien.render.RenderShapeTriangleMesh(item.meshPath, material=material)
    made.local_pose = sapien_pose(T)
    return made
