"""Segments proved clear of what the wrist camera saw: nothing of the scene is used."""

import dataclasses

import pytest

from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.augment.planner import SegmentPlanner, world_of
from sart_toolkit.augment.validate import validate_dataset
from sart_toolkit.collision.model import CLOUD
from sart_toolkit.errors import MotionRejected

CONFIG = AugmentConfig(n=5, obstacles="cloud")


@pytest.fixture(scope="module")
def world(peg_demonstration, peg_model, peg_task):
    return world_of(peg_demonstration, peg_model.spec, peg_task.scene, CONFIG)


@pytest.fixture(scope="module")
def annotation(peg_demonstration, world):
    return suggest_annotation(peg_demonstration, world)


@pytest.fixture(scope="module")
def dataset(peg_demonstration, annotation, make_peg_backend, tmp_path_factory):
    out = tmp_path_factory.mktemp("cloud") / "dataset"
    return augment_demonstration(peg_demonstration, annotation, make_peg_backend, out, CONFIG), out


def test_a_dataset_is_generated_against_the_cloud_and_validated_against_it(
    dataset, peg_model, peg_task
):
    generated, out = dataset
    assert len(generated) == CONFIG.n - 1
    proofs = [episode.provenance.certificate for episode in generated]
    pairs = [proof[which]["pair"] for proof in proofs for which in ("commanded", "measured")]
    assert any(CLOUD in pair for pair in pairs)
    bodies = {body.name for body in peg_task.scene.bodies}
    assert bodies.isdisjoint(name for pair in pairs for name in pair)
    found = validate_dataset(out, peg_model.spec, peg_task.scene)
    assert not found.problems
    # Without the bodies' shapes it is as well.
    bare = dataclasses.replace(peg_task.scene, bodies=())
    assert validate_dataset(out, peg_model.spec, bare) == found


def test_a_proof_against_the_cloud_is_no_proof_against_the_scene(dataset, peg_model, peg_task):
    """What is asked for is checked: of the same draws the other world proves other clearances."""
    generated, _ = dataset
    scene = SegmentPlanner(
        world_of(
            generated.sources[0].demonstration, peg_model.spec, peg_task.scene, AugmentConfig()
        ),
        generated.sources[0].annotation,
        AugmentConfig(),
    )
    episode = generated.episode(0)
    _, exact = scene.plan(*scene.proposal(episode.provenance.sphere, episode.provenance.k), 0.0)
    assert episode.provenance.certificate["commanded"]["pair"] != list(exact.pair)


def test_a_segment_that_starts_too_close_to_what_was_seen_is_rejected(annotation, world):
    wide = dataclasses.replace(annotation.spheres[-1], radius=0.15)
    planner = SegmentPlanner(world, dataclasses.replace(annotation, spheres=(wide,)), CONFIG)
    with pytest.raises(MotionRejected, match=f"start too close peg / {CLOUD}"):
        planner.plan(*planner.proposal(0, 0), 0.0)
