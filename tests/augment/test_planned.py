"""Segments round a wall that stands in the ball: kept where straight ones must be rejected.

The scene is the one that `tools/planned_image.py` draws.
"""

from __future__ import annotations

import functools
import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.augment.executors import RestoreExecutor
from sart_toolkit.augment.planner import SegmentPlanner
from sart_toolkit.augment.validate import validate_dataset
from sart_toolkit.backends import make_backend
from sart_toolkit.backends.pybullet import PyBulletBackend
from sart_toolkit.collision.certificate import certify
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.collision.phases import BODY_STILLNESS
from sart_toolkit.data.manifest import KEPT, AttemptKey
from sart_toolkit.data.records import (
    Annotation,
    PrecisionSphere,
    apply_action,
    convergence_waypoint,
)
from sart_toolkit.data.sampling import SamplingConfig
from sart_toolkit.errors import MotionRejected
from sart_toolkit.poses import interpolate
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import SessionConfig, record_demonstration
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks.task import Placement

_PATH = Path(__file__).parents[2] / "tools" / "planned_image.py"
_SPEC = importlib.util.spec_from_file_location("planned_image", _PATH)
assert _SPEC is not None and _SPEC.loader is not None
image = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(image)

DRAWS = 30
RADIUS = 0.18
TRACKING_ERROR = PyBulletBackend.tracking_error
MARGIN = round(AugmentConfig().margin + BODY_STILLNESS + TRACKING_ERROR, 9)


@pytest.fixture(scope="module")
def task():
    return image.WalledPegInHole()


@pytest.fixture(scope="module")
def make_walled_backend(task):
    return functools.partial(make_backend, "pybullet", get_robot(task.robot), task.scene, 32)


@pytest.fixture(scope="module")
def backend(make_walled_backend):
    backend = make_walled_backend()
    yield backend
    backend.close()


@pytest.fixture(scope="module")
def demonstration(task, backend):
    model = RobotModel(backend.robot, task.scene.held)
    operator = ScriptedOperator(
        task.plan(task.initial_state(model, Placement())), np.random.default_rng(0)
    )
    config = SessionConfig(cameras=())
    return record_demonstration(backend, task, model, operator, seed=0, config=config)


@pytest.fixture(scope="module")
def annotate(demonstration):
    def annotate(kind, radius=RADIUS):
        T_key = demonstration.steps.measured_Ts_world_tool[0]
        sphere = PrecisionSphere(0, T_key, radius, kind=kind)
        return Annotation((sphere,), demonstration.content_hash())

    return annotate


def config(strategy, **others):
    sampling = SamplingConfig("area")
    return AugmentConfig(strategy=strategy, sampling=sampling, cameras=(), **others)


@pytest.fixture(scope="module")
def make_planner(task, demonstration, annotate):
    def make_planner(strategy, kind="ball"):
        robot = get_robot(task.robot)
        world = ExactWorld(demonstration, robot, task.scene)
        return SegmentPlanner(world, annotate(kind), config(strategy))

    return make_planner


def outcomes(planner, draws):
    """For each draw motion and certificate, or what it was rejected for."""
    found = {}
    for k in draws:
        try:
            found[k] = planner.plan(*planner.proposal(0, k), TRACKING_ERROR)
        except MotionRejected as error:
            found[k] = str(error)
    return found


@pytest.fixture(scope="module")
def straight(make_planner):
    return outcomes(make_planner("sart"), range(DRAWS))


@pytest.fixture(scope="module")
def planned(make_planner):
    pytest.importorskip("ompl")
    return outcomes(make_planner("sart_planned"), range(DRAWS))


def is_kept(outcome):
    return not isinstance(outcome, str)


# --- what is kept -------------------------------------------------------------------------------


def test_the_wall_stands_in_the_ball_and_straight_lines_are_rejected_for_it(
    demonstration, straight
):
    key = demonstration.steps.measured_Ts_world_tool[0, :3, 3]
    assert abs(0.09 - key[1]) < RADIUS and key[2] < 0.36
    rejected = [outcome for outcome in straight.values() if not is_kept(outcome)]
    assert 6 <= len(rejected) <= DRAWS - 6
    assert all("too close" in reason and "/ wall" in reason for reason in rejected)


def test_round_the_wall_every_draw_is_kept_but_those_that_touch_it_themselves(
    make_planner, straight, planned
):
    kept = [k for k in planned if is_kept(planned[k])]
    assert sum(not is_kept(straight[k]) for k in kept) >= 4
    placed = make_planner("sart_planned").world.placed(_t_star(make_planner))
    for k in kept:
        motion, certificate = planned[k]
        assert certificate.verdict == "free" and certificate.margin == MARGIN
        certify(placed, motion.path, certificate.margin).check_free()
    for k in set(planned) - set(kept):
        assert planned[k].startswith("sampled pose too close"), planned[k]


def _t_star(make_planner):
    return make_planner("sart").proposal(0, 0)[0].t_star


def test_a_line_that_is_clear_is_the_same_by_either_strategy(straight, planned):
    for k in straight:
        if is_kept(straight[k]):
            (line, proof), (same, certificate) = straight[k], planned[k]
            np.testing.assert_array_equal(line.path.spline.c, same.path.spline.c)
            # The last digits of a distance hang on what was computed before.
            assert (line.duration, proof.to_json()) == (same.duration, certificate.to_json())


def test_a_bent_segment_leads_from_the_commanded_pose_of_t_star_to_the_sampled_pose(
    demonstration, make_planner, straight, planned
):
    planner, t = make_planner("sart_planned"), _t_star(make_planner)
    for k in planned:
        if is_kept(planned[k]) and not is_kept(straight[k]):
            motion, _ = planned[k]
            start = demonstration.steps.commanded_joint_positions[t]
            np.testing.assert_array_equal(motion.path.positions(np.zeros(1))[0], start)
            sampled = planner.proposal(0, k)[0].T_world_sampled
            arrived = motion.T_world_tool(motion.duration)
            np.testing.assert_allclose(arrived, sampled, rtol=0, atol=2e-6)
            middle = interpolate(motion.T_world_tool(0.0), arrived, 0.5)[:3, 3]
            ways = [motion.T_at(s)[:3, 3] for s in np.linspace(0.2, 0.8, 30)]
            assert min(np.linalg.norm(way - middle) for way in ways) > 1e-4


def test_the_order_of_the_draws_changes_nothing(make_planner, straight, planned):
    bent = [k for k in planned if is_kept(planned[k]) and not is_kept(straight[k])][:3]
    again = outcomes(make_planner("sart_planned"), reversed(bent))
    for k in bent:
        np.testing.assert_array_equal(again[k][0].path.spline.c, planned[k][0].path.spline.c)
        assert again[k][1] == planned[k][1]


def test_by_the_paper_s_strategy_a_free_space_region_is_a_ball(make_planner, straight):
    region = make_planner("sart", "free_space")
    assert {k: is_kept(o) for k, o in outcomes(region, range(8)).items()} == {
        k: is_kept(straight[k]) for k in range(8)
    }


def test_a_free_space_region_is_filled_though_a_wall_stands_in_it(demonstration, make_planner):
    pytest.importorskip("ompl")
    planner = make_planner("sart_planned", "free_space")
    key = demonstration.steps.measured_Ts_world_tool[0, :3, 3]
    beyond, distances = 0, []
    for k, outcome in outcomes(planner, range(DRAWS)).items():
        p = planner.proposal(0, k)[0].T_world_sampled[:3, 3]
        distances.append(np.linalg.norm(p - key))
        beyond += is_kept(outcome) and p[1] > 0.1
        assert is_kept(outcome) or outcome.startswith("sampled pose too close"), outcome
    assert beyond >= 1, "some pose on the wall's far side"
    assert max(distances) < RADIUS and min(distances) < 0.6 * RADIUS


# --- carried out --------------------------------------------------------------------------------


def test_a_bent_segment_is_executed_proved_as_measured_and_joined(
    backend, demonstration, annotate, straight, planned
):
    k = next(k for k in planned if is_kept(planned[k]) and not is_kept(straight[k]))
    make = RestoreExecutor(
        backend, [(demonstration, annotate("ball"))], config("sart_planned")
    ).attempt
    attempt = make(AttemptKey(0, 0, k))
    assert attempt.outcome == KEPT
    proof = attempt.episode.provenance.certificate
    assert proof["commanded"]["verdict"] == proof["measured"]["verdict"] == "free"
    assert len(attempt.episode) == round(10 * proof["duration"])
    Ts, gripper = attempt.episode.commands(demonstration)
    for t, action in enumerate(attempt.episode.actions(demonstration)[:-1]):
        T, g = apply_action(Ts[t], action)
        np.testing.assert_allclose(T, Ts[t + 1], rtol=0, atol=1e-9)
        assert g == gripper[t + 1]


def test_two_processes_generate_the_same_as_one_and_it_holds_when_checked_again(
    task, demonstration, annotate, make_walled_backend, tmp_path
):
    pytest.importorskip("ompl")
    annotation = annotate("ball")
    datasets = [
        augment_demonstration(
            demonstration,
            annotation,
            make_walled_backend,
            tmp_path / str(workers),
            config("sart_planned", n=13),
            workers=workers,
        )
        for workers in (1, 2)
    ]
    assert datasets[0].content_hash == datasets[1].content_hash
    t_star = convergence_waypoint(demonstration, annotation.spheres[0])
    bent = 0
    for episode in datasets[0]:
        assert episode.provenance.t_star == t_star
        way = episode.steps.commanded_Ts_world_tool[:, :3, 3]
        chord = (way[-1] - way[0]) / np.linalg.norm(way[-1] - way[0])
        bent += np.linalg.norm(np.cross(way - way[0], chord), axis=1).max() > 0.01
    assert bent >= 1
    found = validate_dataset(tmp_path / "2", get_robot(task.robot), task.scene)
    assert not found.problems and found.episodes == 12


# --- the image --------------------------------------------------------------------------------


def test_the_image_is_drawn_and_its_counts_are_reported(tmp_path, capsys):
    pytest.importorskip("ompl")
    out = tmp_path / "images" / "planned.png"
    assert image.main(["--out", str(out), "--draws", "6"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["draws"] == 6 and "ompl" in report["versions"]
    for name in ("sart", "sart_planned"):
        assert report["kept"][name] + sum(report["rejected"][name].values()) == 6
    with Image.open(out) as drawn:
        assert drawn.width > 1000


def test_the_image_without_ompl_says_how_to_install_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ompl", None)
    assert image.main(["--out", str(tmp_path / "planned.png")]) == 2
    assert "pip install 'sart_toolkit[planning]'" in capsys.readouterr().err
    assert not (tmp_path / "planned.png").exists()
