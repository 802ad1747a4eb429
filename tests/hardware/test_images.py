"""Real images as a `CameraSpec` describes them."""

from __future__ import annotations

import numpy as np
import pytest

from sart_toolkit.errors import InvalidInput
from sart_toolkit.hardware.drivers import CameraImage
from sart_toolkit.hardware.images import as_described
from sart_toolkit.robots.spec import CameraSpec


def image_of(f, size, centre=None):
    """An image whose red is the ray's x / z and whose depth is its y / z, both from -0.5 to 0.5."""
    width, height = size
    cx, cy = centre or ((width - 1) / 2, (height - 1) / 2)
    x = (np.arange(width) - cx) / f
    y = (np.arange(height) - cy) / f
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[..., 0] = np.round(255 * (x + 0.5))[None].clip(0, 255)
    depth = np.broadcast_to(y[:, None] + 1.0, (height, width)).astype(np.float32)
    return CameraImage(rgb, depth, np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]]), 0.0)


@pytest.mark.parametrize("given", [(600.0, (640, 480), None), (450.0, (640, 480), (330.0, 230.0))])
@pytest.mark.parametrize("size", [(64, 64), (40, 30), (97, 61)])
def test_each_pixel_shows_what_its_ray_shows(given, size):
    camera = CameraSpec("wrist", "tool", np.eye(4), fov_y_deg=35.0)
    rgb, depth = as_described(image_of(*given), camera, size)
    assert rgb.shape == (size[1], size[0], 3) and depth.shape == (size[1], size[0])
    k = camera.intrinsics(*size)
    x = (np.arange(size[0]) - k[0, 2]) / k[0, 0]
    y = (np.arange(size[1]) - k[1, 2]) / k[1, 1]
    pixel = 1 / given[0]
    assert np.abs(rgb[0, :, 0] / 255 - 0.5 - x).max() < pixel + 1 / 255
    assert np.abs(depth[:, 0] - 1 - y).max() < pixel


def test_depth_is_never_a_mean_of_two_surfaces():
    image = image_of(600.0, (640, 480))
    two = np.where(np.arange(640) % 2, 0.5, 2.0).astype(np.float32)
    image = CameraImage(image.rgb, np.broadcast_to(two, (480, 640)), image.intrinsics, 0.0)
    camera = CameraSpec("wrist", "tool", np.eye(4), fov_y_deg=40.0)
    assert set(np.unique(as_described(image, camera, (50, 50))[1])) <= {0.5, 2.0}


def test_a_field_of_view_wider_than_the_camera_s_is_refused_with_what_it_has():
    camera = CameraSpec("wrist", "tool", np.eye(4), fov_y_deg=60.0)
    with pytest.raises(InvalidInput, match=r"fov_y_deg 60; set fov_y_deg .* to 43 or less"):
        as_described(image_of(600.0, (640, 480)), camera, (64, 64))
