"""The table of backends; what each of them promises is tested by `sart_toolkit.testing`."""

from __future__ import annotations

import numpy as np
import pytest

from sart_toolkit.backends import BACKENDS, get_backend, make_backend
from sart_toolkit.backends.interface import (
    Draws,
    Observation,
    Resets,
    SavesStates,
    missing_abilities,
    require,
)
from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.errors import MissingCapability, MissingExtra, UnknownName
from sart_toolkit.robots import get_robot
from sart_toolkit.scenes.spec import SceneSpec
from sart_toolkit.testing.bench import make_bench


def test_an_unknown_backend_is_refused_with_the_nearest_name():
    with pytest.raises(UnknownName, match="did you mean 'pybullet'"):
        make_backend("pybulet", get_robot("ur5e_2f85"), SceneSpec(()))


@pytest.mark.parametrize("name", BACKENDS)
def test_a_backend_has_the_name_that_it_has_in_the_table(name):
    try:
        assert get_backend(name).name == name
    except MissingExtra as error:
        pytest.skip(str(error))


def test_an_observation_without_a_joint_path_has_one_of_no_rows():
    seen = Observation(np.zeros(6), np.zeros(6), 0.0, np.eye(4), 0.0)
    assert seen.joint_path.shape == (0, 6)


@pytest.mark.parametrize("name", BACKENDS)
def test_the_joint_path_is_measured_at_each_physics_step(name):
    """Where the motors can't keep up with the commands, too."""
    try:
        bench = make_bench(name, "ur5e_hande")
    except MissingExtra as error:
        pytest.skip(str(error))
    bench.command(bench.ready + 0.5)
    seen = bench.see()
    assert len(seen.joint_path) == DEFAULT_RATES.physics_per_control
    speeds = np.diff(seen.joint_path, axis=0) * DEFAULT_RATES.physics_hz
    assert (np.diff(speeds[:, 0]) > 0.5).all()
    np.testing.assert_allclose(speeds[-1], seen.dq, rtol=0, atol=1e-3)
    bench.backend.close()


@pytest.fixture(scope="module", params=BACKENDS)
def view(request):
    """A floor and two balls before our backends' cameras."""
    try:
        bench = make_bench(request.param, "ur5e_hande", "view")
    except MissingExtra as error:
        pytest.skip(str(error))
    yield bench
    bench.backend.close()


def _ray_cast(bench, camera, size):
    """Depth `(size, size)` [m] of floor, ball and bead alone; infinite where a ray meets none."""
    spec, Ts = bench.backend.cameras[camera], bench.see().Ts_world_body
    rows, columns = np.mgrid[:size, :size]
    rays = np.stack([columns, rows, np.ones((size, size))], -1)
    T = spec.T_frame_camera
    rays, eye = rays @ np.linalg.inv(spec.intrinsics(size, size)).T @ T[:3, :3].T, T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (Ts["floor"][2, 3] + 0.05 - eye[2]) / rays[..., 2]
        on_floor = np.abs((eye + s[..., None] * rays)[..., :2]).max(-1) < 1.5
        depth = np.where((s > 0) & on_floor, s, np.inf)
        for name, radius in (("ball", 0.015), ("bead", 0.01)):
            to_ball = Ts[name][:3, 3] - eye
            a, b = (rays**2).sum(-1), rays @ to_ball
            root = b**2 - a * (to_ball @ to_ball - radius**2)
            hit = np.where(root > 0, (b - np.sqrt(root)) / a, np.inf)
            depth = np.minimum(depth, hit)
    return depth


@pytest.mark.parametrize("size", [33, 64, 128])
@pytest.mark.parametrize("camera", ["left", "right"])
def test_depth_is_that_of_a_ray_cast_to_a_fifth_of_a_millimetre(view, camera, size):
    view.needs_images()
    depth = view.see((camera,), size).cameras[camera].depth
    expected = _ray_cast(view, camera, size)
    # The robot hides some, and the balls are made of facets; at an edge a pixel may show either.
    seen = (depth > 0) & (depth < view.backend.cameras[camera].far * 0.99) & np.isfinite(expected)
    difference = (depth - expected)[seen]
    assert (np.abs(difference) < 2e-4).mean() > 0.7
    assert (difference > 2e-4).mean() < 0.02


def test_an_ability_is_had_or_its_lack_is_reported_with_the_purpose(limited):
    backend = make_backend("pybullet", get_robot("ur5e_hande"), SceneSpec(()), 8)
    assert require(backend, Resets, "tests reset it") is backend
    core = limited(backend, Resets)
    assert missing_abilities(core, [Resets, Draws, SavesStates]) == ["Draws", "SavesStates"]
    message = "backend 'limited' lacks the ability Draws, but films are drawn; use another backend"
    with pytest.raises(MissingCapability, match=message):
        require(core, Draws, "films are drawn")
    backend.close()


def test_a_backend_without_images_still_tells_a_camera_that_is_not_there(limited):
    backend = limited(make_backend("pybullet", get_robot("ur5e_hande"), SceneSpec(()), 8))
    backend.no_images = "its lens is broken"
    backend.check_cameras(())
    with pytest.raises(UnknownName, match="unknown camera 'wirst': did you mean 'wrist'"):
        backend.check_cameras(("wirst",))
    with pytest.raises(MissingCapability, match="takes no images: its lens is broken; use an"):
        backend.check_cameras(("wrist",))
    backend.close()
