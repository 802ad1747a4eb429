"""The noise model does what is declared, and the noise table counts honestly."""

import dataclasses
import functools

import numpy as np
import pytest

from sart_toolkit.backends import make_backend
from sart_toolkit.benchmark import clouds
from sart_toolkit.benchmark.cells import Cell
from sart_toolkit.benchmark.clouds import Recording, _allowed, _noise_totals, benchmark_noise
from sart_toolkit.benchmark.noise import as_measured
from sart_toolkit.collision.sensor import SensorErrors, sensor_errors
from sart_toolkit.data.records import PrecisionSphere
from sart_toolkit.errors import Mismatch
from sart_toolkit.poses import distance
from sart_toolkit.robots import get_robot


@pytest.fixture
def measured(peg_demonstration):
    """Depth before and after, and the camera's pose before and after."""

    def measured(errors, holes=0.0):
        noisy = as_measured(peg_demonstration, errors, holes, np.random.default_rng(0))
        a, b = (d.steps.cameras["wrist"] for d in (peg_demonstration, noisy))
        return a.depth.astype(float), b.depth.astype(float), a.T_frame_camera, b.T_frame_camera

    return measured


def test_without_errors_images_stay_as_they_are(measured):
    before, after, T, T_noisy = measured(SensorErrors())
    np.testing.assert_array_equal(before, after)
    np.testing.assert_allclose(T, T_noisy, atol=1e-12)


def test_a_camera_is_off_by_what_is_declared(measured):
    _, _, T, T_noisy = measured(sensor_errors("exact", (0.002, 0.3)))
    far, turn = distance(T, T_noisy)
    assert far == pytest.approx(0.002) and np.rad2deg(turn) == pytest.approx(0.3)


def test_noise_scale_and_grid_are_what_is_declared(measured):
    errors = SensorErrors(depth_scale=0.01, noise=0.001, noise_quadratic=0.002, step=0.0005)
    before, after, _, _ = measured(errors)
    seen = before > 0
    off = (after - 1.01 * before)[seen] / errors.deviation(before[seen])
    assert abs(off.mean()) < 0.05 and off.std() == pytest.approx(1.0, abs=0.05)
    steps = after[seen] / 0.0005
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)


def test_as_many_pixels_fly_or_have_no_depth_as_is_declared(measured):
    before, after, _, _ = measured(SensorErrors(flying=0.02), holes=0.05)
    seen = before > 0
    assert (after[seen] == 0).mean() == pytest.approx(0.05, abs=0.01)
    changed = seen & (after > 0) & (np.abs(after - before) > 1e-6)
    assert changed.sum() / seen.sum() == pytest.approx(0.02, abs=0.005)
    assert not after[~seen].any()


def test_radii_that_are_too_large_and_spheres_that_are_lost_are_counted():
    draws = [
        {"exact": [0.1, 0.01], "allowed": [0.1, 0.01], "cloud": [0.08, 0.0], "seconds": 1.0},
        {"exact": [0.1, 0.01], "allowed": [0.104, 0.01], "cloud": [0.104, 0.012], "seconds": 3.0},
    ]
    found = _noise_totals(draws)
    assert (found["n_radii"], found["n_larger"], found["n_lost"]) == (4, 1, 1)
    assert found["n_larger_but_passing"] == 1 and found["seconds"] == 2.0
    assert found["largest_excess_mm"] == pytest.approx(2.0)
    assert found["median_share"] == pytest.approx(np.median([0.8, 0.0, 1.04, 1.2]))
    assert found["median_share_kept"] == pytest.approx(1.04)


def test_a_radius_between_two_probed_ones_is_right_if_it_passes_itself(monkeypatch):
    """What is asked of the true scene is the other radius, at its waypoint."""
    sphere = PrecisionSphere(3, np.eye(4), 0.1)

    def suggest(world, demonstration, waypoint, config):
        assert waypoint == 3
        return dataclasses.make_dataclass("Found", ["radius"])(min(config.max_radius, 0.105))

    monkeypatch.setattr(clouds, "suggest_radius", suggest)
    world = dataclasses.make_dataclass("World", ["demonstration"])(None)
    for other, allowed in ((0.09, 0.1), (0.104, 0.104), (0.12, 0.105)):
        assert _allowed(world, [sphere], [0.1], [other]) == [allowed]


def test_a_cell_s_radii_from_noisy_images_stand_beside_the_exact_ones(peg_task, tmp_path):
    make = functools.partial(
        make_backend, "pybullet", get_robot(peg_task.robot), peg_task.scene, 48
    )
    recordings = {"off": Recording.honest("exact")}
    seen = []
    found = benchmark_noise(
        [Cell(peg_task, "pybullet", make)], 1, tmp_path / "n.json", recordings=recordings,
        progress=lambda done, wanted: seen.append((done, wanted)),
    )  # fmt: skip
    assert seen == [(1, 1)] and found["image_size"] == {"peg_in_hole/pybullet": [48, 48]}
    row = found["cells"]["peg_in_hole/pybullet"]["off"]
    (draw,) = row["draws"]
    assert row["n_radii"] == len(draw["exact"]) == len(draw["cloud"]) >= 2
    assert row["n_larger"] == 0 and found["total"]["off"]["n_radii"] == row["n_radii"]


def test_an_interrupted_noise_table_keeps_the_cells_that_were_finished(
    peg_task, tmp_path, monkeypatch
):
    done = []

    class Cells:
        def __init__(self, *_):
            pass

        def __call__(self, name):
            done.append(name)
            row = {"exact": [0.01], "allowed": [0.01], "cloud": [0.008], "seconds": 1.0}
            return [48, 48], {"off": [row]}

        def close(self):
            pass

    def cut(finished, wanted):
        raise KeyboardInterrupt

    monkeypatch.setattr(clouds, "_NoiseCell", Cells)
    cells = [Cell(peg_task, backend, None) for backend in ("one", "two")]
    out, recordings = tmp_path / "n.json", {"off": Recording.honest("exact")}
    with pytest.raises(KeyboardInterrupt):
        benchmark_noise(cells, 1, out, recordings=recordings, progress=cut)
    with pytest.raises(Mismatch, match="add --overwrite"):
        benchmark_noise(cells, 2, out, recordings=recordings)
    found = benchmark_noise(cells, 1, out, recordings=recordings)
    assert done == ["peg_in_hole/one", "peg_in_hole/two"] == list(found["cells"])
    assert found["total"]["off"]["n_radii"] == 2 and out.exists()
