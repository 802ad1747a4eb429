"""RGB-D images of rigid bodies by casting rays at their meshes, on one CPU core.

Each body has a scene of rays of its own, made once for a process: rays are moved into the body's
frame, so that nothing is built again when bodies move. The same poses give the same bytes.
"""

from __future__ import annotations

import functools
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from sart_toolkit.backends.interface import CameraView
from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots.spec import CameraSpec
from sart_toolkit.robots.visuals import DrawnMesh
from sart_toolkit.scenes.spec import Light

_BACKGROUND = 255
# [m]: rays towards the light start this far from what they start from.
_OFF_SURFACE = 5e-4
# [m]: how far beside a face its edge still is, so that none shows a gap.
_EDGE = 1e-7
_MOST_PLANES = 6
_MOST_CARRIED = 32

# The corners of a unit cube, and its edges by them.
_CORNERS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
_EDGES = np.array([[i, i | bit] for i in range(8) for bit in (1, 2, 4) if not i & bit])
_NOTHING = np.zeros(0, np.intp)

_Floats = NDArray[np.float32]
_Indices = NDArray[np.intp]


class RayCaster:
    """Rigid bodies and a light, of which it takes images wherever bodies and camera are.

    A point shows its colour times ambient + intensity * cos(angle to the light), and only the
    ambient part on far sides and, where the light has shadows, in the shadow of a body.
    """

    def __init__(self, bodies: Mapping[str, Sequence[DrawnMesh]], light: Light) -> None:
        """Prepare the bodies, by name, each of meshes in the body's frame."""
        self._light = light
        colours = sorted({mesh.rgba[:3] for meshes in bodies.values() for mesh in meshes})
        self._palette = np.array(colours, np.float32).reshape(-1, 3)
        self._names = [name for name, meshes in bodies.items() if meshes]
        self._bodies = [
            _Body.of(bodies[name], [colours.index(mesh.rgba[:3]) for mesh in bodies[name]])
            for name in self._names
        ]
        self._corners = np.array([body.corners for body in self._bodies]).reshape(-1, 8, 3)
        # Images of what moves with a camera, by all that they depend on.
        self._carried: dict[tuple[Hashable, ...], _Image] = {}

    def view(
        self,
        camera: CameraSpec,
        T_world_frame: Array,
        size: tuple[int, int],
        Ts_world_body: Mapping[str, Array],
        Ts_frame_body: Mapping[str, Array] | None = None,
    ) -> CameraView:
        """The image that a camera takes.

        Args:
            camera: its field of view, its range, and where it is on its frame.
            T_world_frame: where that frame is `(4, 4)`.
            size: width and height [pixels].
            Ts_world_body: where the bodies are `(4, 4)`, by name.
            Ts_frame_body: where those of them are in the camera's frame that move with it. What
                they show is remembered for as long as they are there to the bit.
        """
        T_world_camera = T_world_frame @ camera.T_frame_camera
        T_camera_world, T_camera_frame = inverse(T_world_camera), inverse(camera.T_frame_camera)
        carried = Ts_frame_body or {}
        Ts = np.array(
            [
                T_camera_frame @ carried[name]
                if name in carried
                else T_camera_world @ Ts_world_body[name]
                for name in self._names
            ]
        ).reshape(-1, 4, 4)
        corners = self._corners @ Ts[:, :3, :3].transpose(0, 2, 1) + Ts[:, None, :3, 3]
        # What is near hides what is far, whose rays then end early.
        middles = corners.mean(axis=1)
        order = np.argsort((middles * middles).sum(axis=1), kind="stable")
        in_view = _in_view(camera, size, corners)
        fixed = [i for i in order if self._names[i] in carried]
        key = (
            *(camera.fov_y_deg, camera.near, camera.far, size),
            *((self._names[i], Ts[i].tobytes()) for i in fixed),
        )
        if key not in self._carried:
            if len(self._carried) >= _MOST_CARRIED:
                self._carried.clear()
            self._carried[key] = _Image(camera, size)
            for i in fixed:
                self._carried[key].add(i, self._bodies[i], Ts[i], corners[i])
        image = self._carried[key].copy()
        for i in order:
            if in_view[i] and self._names[i] not in carried:
                image.add(i, self._bodies[i], Ts[i], corners[i])
        to_light = T_camera_world[:3, :3] @ self._light.direction
        facing = image.facing(to_light)
        if self._light.shadows:
            lit = np.flatnonzero(facing > 0)
            facing[lit[image.hidden(lit, self._bodies, Ts, corners, to_light)]] = 0.0
        return image.shown(facing, self._palette, self._light, T_world_camera)


def _in_view(camera: CameraSpec, size: tuple[int, int], corners: Array) -> NDArray[np.bool_]:
    """Whether boxes, by their corners `(n, 8, 3)`, may be in a camera's view, in its frame."""
    x, y, z = corners.transpose(2, 0, 1)
    across, up = np.array(size) / (2 * camera.intrinsics(*size)[0, 0])
    limits = np.stack(
        [z - camera.near, camera.far - z, across * z - x, across * z + x, up * z - y, up * z + y]
    )
    # A box is out of it where all of its corners are beyond one limit.
    return np.asarray((limits > 0).any(axis=2).all(axis=0))


class _Body(NamedTuple):
    """A body's scene of rays, and what is shown where a ray hits it.

    Attributes:
        scene: its triangles.
        corners: of the box around it `(8, 3)`.
        normals: at the corners of its triangles `(n, 3, 3)`, or `(n, 1, 3)` where all are flat.
        colours: of its triangles `(n,)`, by their place in the palette.
        planes: outer normals and offsets `(k, 4)` of its faces where it is convex, has few of them
            and one colour; else none. No point of it is then in the shadow of another.
    """

    scene: Any
    corners: Array
    normals: _Floats
    colours: _Indices
    planes: Array

    @staticmethod
    def of(meshes: Sequence[DrawnMesh], colours: Sequence[int]) -> _Body:
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        vertices = np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float32)
        triangles = np.concatenate(
            [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]
        ).astype(np.int32)
        normals = np.concatenate([mesh.normals for mesh in meshes]).astype(np.float32)[triangles]
        flat = bool((normals == normals[:, :1]).all())
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        return _Body(
            scene=_scene(vertices.tobytes(), triangles.tobytes()),
            corners=np.where(_CORNERS, high, low).astype(np.float64),
            normals=normals[:, :1] if flat else normals,
            colours=np.repeat(colours, [len(mesh.triangles) for mesh in meshes]),
            planes=_planes(meshes[0]) if flat and len(meshes) == 1 else np.zeros((0, 4)),
        )


def _planes(mesh: DrawnMesh) -> Array:
    """The planes `(k, 4)` of a convex mesh with few flat faces; else none."""
    normals = mesh.normals[mesh.triangles[:, 0]]
    offsets = (normals * mesh.vertices[mesh.triangles[:, 0]]).sum(axis=1)
    planes = np.column_stack([normals, offsets])
    _, first = np.unique(np.round(planes, 9), axis=0, return_index=True)
    planes = planes[np.sort(first)]
    out = mesh.vertices @ planes[:, :3].T - planes[:, 3]
    return planes if len(planes) <= _MOST_PLANES and out.max() < 1e-9 else np.zeros((0, 4))


@functools.lru_cache(maxsize=256)
def _scene(vertices: bytes, triangles: bytes) -> Any:
    """The scene of rays of a mesh, which needs not be built again in other places or colours."""
    scene = EmbreeScene()
    TriangleMesh(
        scene,
        np.frombuffer(vertices, np.float32).reshape(-1, 3),
        np.frombuffer(triangles, np.int32).reshape(-1, 3),
    )
    return scene


class _Image:
    """What the pixels show so far; pixels are counted along rows.

    Attributes:
        depth: along z [m], the camera's farthest where nothing was hit yet.
        shades: of each body drawn, later ones before earlier ones, its number, its pixels, normals
            `(k, 3)` in the camera's frame, and which of them each pixel shows.
        colour: place in the palette, -1 where nothing was hit yet.
    """

    def __init__(self, camera: CameraSpec, size: tuple[int, int]) -> None:
        self._camera, self._size = camera, size
        self._rays = _rays(camera.fov_y_deg, *size)
        n = self._rays.shape[1]
        self.depth = np.full(n, camera.far, np.float32)
        self.shades: list[tuple[int, _Indices, _Floats, _Indices]] = []
        self.colour = np.full(n, -1, np.int16)

    def copy(self) -> _Image:
        """The same image, to be drawn on alone."""
        made = _Image.__new__(_Image)
        made._camera, made._size, made._rays = self._camera, self._size, self._rays
        made.depth, made.colour = self.depth.copy(), self.colour.copy()
        made.shades = self.shades.copy()
        return made

    def add(self, number: int, body: _Body, T_camera_body: Array, corners: Array) -> None:
        """Draw a body where it is nearer than what is there; `corners` as `hidden` has them."""
        pixels = self._around(corners)
        if not len(pixels):
            return
        if len(body.planes):
            pixels, depth, normals, shown = self._meet(body, T_camera_body, pixels)
            self.colour[pixels] = body.colours[0]
        else:
            pixels, depth, triangles, normals, shown = self._cast(body, T_camera_body, pixels)
            self.colour[pixels] = body.colours[triangles]
        self.depth[pixels] = depth
        self.shades.append((number, pixels, normals, shown))

    def _cast(
        self, body: _Body, T_camera_body: Array, pixels: _Indices
    ) -> tuple[_Indices, _Floats, _Indices, _Floats, _Indices]:
        """Those pixels whose rays hit a body's triangles, their depth, and which triangle it is.

        Then normals, and which of them each shows.
        """
        near = np.float32(self._camera.near)
        R = T_camera_body[:3, :3].astype(np.float32)
        rays = R.T @ self._rays.take(pixels, axis=1)
        start = (-T_camera_body[:3, 3] @ T_camera_body[:3, :3]).astype(np.float32)
        starts = start[:, None] + near * rays
        hit = body.scene.run(starts.T, rays.T, self.depth[pixels] - near, output=1)
        at = np.flatnonzero(hit["primID"] >= 0)
        triangle = hit["primID"][at]
        if body.normals.shape[1] == 1:
            normals, shown = body.normals[:, 0], triangle
        else:
            u, v = hit["u"][at, None], hit["v"][at, None]
            corners = body.normals.take(triangle, axis=0)
            normals = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
            normals /= np.sqrt(np.einsum("ni,ni->n", normals, normals))[:, None]
            shown = np.arange(len(at))
        return pixels[at], hit["tfar"][at] + near, triangle, normals @ R.T, shown

    def _meet(
        self, body: _Body, T_camera_body: Array, pixels: _Indices
    ) -> tuple[_Indices, _Floats, _Floats, _Indices]:
        """Those pixels whose rays meet a convex body with few faces, their depth, and normals.

        Then which of the normals each shows. This is several times faster than asking triangles.
        """
        normals = body.planes[:, :3] @ T_camera_body[:3, :3].T
        offsets = body.planes[:, 3] + normals @ T_camera_body[:3, 3]
        slopes = normals.astype(np.float32) @ self._rays.take(pixels, axis=1)
        at_corners = normals @ self._rays[:, self._corner_pixels()]
        depth, face = self.depth[pixels], np.full(len(pixels), -1)
        # The camera sees a face only from the outer side of its plane.
        for seen in np.flatnonzero(offsets < 0):
            others = [other for other in range(len(offsets)) if other != seen]
            with np.errstate(divide="ignore", invalid="ignore"):
                z = offsets[seen] / at_corners[seen]
                # A face is convex: what all corners of the image show, all of the image shows.
                everywhere = (z > self._camera.near).all() and (
                    at_corners[others] * z <= offsets[others, None]
                ).all()
                z = np.float32(offsets[seen]) / slopes[seen]
                inside = (z > self._camera.near) & (z < depth)
                for other in [] if everywhere else others:
                    inside &= slopes[other] * z <= np.float32(offsets[other] + _EDGE)
            depth[inside], face[inside] = z[inside], seen
        at = np.flatnonzero(face >= 0)
        return pixels[at], depth[at], normals.astype(np.float32), face[at]

    def _around(self, corners: Array) -> _Indices:
        """The pixels where a box may be seen, from its corners `(8, 3)` in `_CORNERS`' order."""
        z = corners[:, 2]
        near = self._camera.near
        if z.min() <= near:
            # Where its edges come through the plane before which nothing is seen.
            a, b = corners[_EDGES[:, 0]], corners[_EDGES[:, 1]]
            through = (a[:, 2] > near) != (b[:, 2] > near)
            a, b = a[through], b[through]
            t = (near - a[:, 2]) / (b[:, 2] - a[:, 2])
            corners = np.concatenate([corners[z > near], a + t[:, None] * (b - a)])
            if not len(corners):
                return _NOTHING
        width, height = self._size
        K = self._camera.intrinsics(width, height)
        at = corners[:, :2] / corners[:, 2:] * K[0, 0] + K[:2, 2]
        left, top = np.maximum(np.floor(at.min(axis=0)), 0).astype(int)
        right, bottom = np.minimum(np.ceil(at.max(axis=0)) + 1, self._size).astype(int)
        if left >= right or top >= bottom:
            return _NOTHING
        nearest = corners[:, 2].min()
        if right - left == width:
            first = top * width
            return np.flatnonzero(self.depth[first : bottom * width] > nearest) + first
        pixels = np.arange(top, bottom)[:, None] * width + np.arange(left, right)
        return pixels[self.depth.reshape(height, width)[top:bottom, left:right] > nearest]

    def _corner_pixels(self) -> list[int]:
        width, height = self._size
        return [0, width - 1, (height - 1) * width, height * width - 1]

    def facing(self, to_light: Array) -> _Floats:
        """The cosine of the angle between surface and light `(n,)`, 0 on far sides.

        `to_light (3,)` is the light's direction in the camera's frame.
        """
        facing = np.zeros(len(self.depth), np.float32)
        for _, pixels, normals, shown in self.shades:
            facing[pixels] = (normals @ to_light.astype(np.float32)).take(shown)
        return np.maximum(facing, np.float32(0))

    def hidden(
        self,
        pixels: _Indices,
        bodies: Sequence[_Body],
        Ts_camera_body: Array,
        corners: Array,
        to_light: Array,
    ) -> NDArray[np.bool_]:
        """Whether what pixels show is in the shadow of a body.

        Args:
            pixels: which.
            bodies: by their number.
            Ts_camera_body: where they are `(m, 4, 4)`.
            corners: of the boxes around them, in the camera's frame `(m, 8, 3)`.
            to_light: the light's direction `(3,)` in the camera's frame.
        """
        hidden = np.zeros(len(pixels), bool)
        hit = np.full(len(self.depth), -1)
        for number, at, _, _ in self.shades:
            hit[at] = number
        # Two directions across the light, and the one towards it.
        R = np.linalg.svd(to_light[None])[2][[1, 2, 0]]
        R[2] = to_light
        boxes = corners @ R.T
        low, high = (e.astype(np.float32) for e in (boxes.min(axis=1), boxes.max(axis=1)))
        points = self._rays.take(pixels, axis=1) * self.depth[pixels]
        x, y, height = R.astype(np.float32) @ points
        asked = (x >= low[:, :1]) & (x <= high[:, :1])
        asked &= (y >= low[:, 1:2]) & (y <= high[:, 1:2])
        asked &= height <= high[:, 2:]
        for number, body in enumerate(bodies):
            own = asked[number]
            if len(body.planes):
                own &= hit[pixels] != number
            at = np.flatnonzero(own)
            if len(at):
                T_camera_body = Ts_camera_body[number].astype(np.float32)
                rotation = T_camera_body[:3, :3]
                towards = to_light.astype(np.float32) @ rotation
                offset = np.float32(_OFF_SURFACE) * towards - T_camera_body[:3, 3] @ rotation
                starts = (rotation.T @ points.take(at, axis=1)).T + offset
                ends = body.scene.run(
                    starts, np.broadcast_to(towards, starts.shape), query="OCCLUDED"
                )
                hidden[at[ends >= 0]] = True
        return hidden

    def shown(
        self, facing: _Floats, palette: _Floats, light: Light, T_world_camera: Array
    ) -> CameraView:
        """The image as it is.

        Args:
            facing: the part of the light's intensity that each pixel's surface gets `(n,)`.
            palette: colours `(m, 3)` in [0, 1].
            light: the light.
            T_world_camera: where the camera is `(4, 4)`.
        """
        width, height = self._size
        bright = 255 * (np.float32(light.ambient) + np.float32(light.intensity) * facing)
        channels = palette.T.take(self.colour, axis=1, mode="wrap") * bright
        channels = np.minimum(channels + np.float32(0.5), np.float32(255)).astype(np.uint8)
        rgb = np.ascontiguousarray(channels.T)
        nothing = self.colour < 0
        rgb[nothing] = _BACKGROUND
        depth = np.where(nothing, np.float32(0), self.depth)
        return CameraView(
            rgb.reshape(height, width, 3), depth.reshape(height, width), T_world_camera
        )


@functools.lru_cache(maxsize=8)
def _rays(fov_y_deg: float, width: int, height: int) -> _Floats:
    """Directions `(3, height * width)` through the pixels' centres, 1 m along z."""
    K = CameraSpec("", "world", np.eye(4), fov_y_deg).intrinsics(width, height)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    rays = np.stack([x, y, np.ones_like(x)]).reshape(3, -1).astype(np.float32)
    rays.setflags(write=False)
    return rays
