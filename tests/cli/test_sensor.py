"""Flags about the depth camera say what they mean, or are refused."""

import dataclasses

import numpy as np
import pytest

from sart_toolkit import pipeline
from sart_toolkit.annotate.suggest import SuggestConfig, suggestion_settings
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.cli.arguments import Augment, Suggest
from sart_toolkit.cli.sensor import declared_sensor
from sart_toolkit.cli.verbs import Verb
from sart_toolkit.collision import make_world
from sart_toolkit.collision.sensor import CloudConfig, SensorErrors, sensor_errors
from sart_toolkit.data.records import Annotation, PrecisionSphere
from sart_toolkit.errors import InvalidInput


def parsed(words, of=Suggest):
    start = "demo.h5 --out a.json" if of is Suggest else "demo.h5 a.json --out data"
    return declared_sensor(Verb(of, "").parse("verb", (start + " " + words).split()), [])


@pytest.mark.parametrize("of", [Suggest, Augment])
def test_a_sensor_and_its_calibration_are_read_in_millimetres_degrees_and_percent(of):
    words = "--source cloud --sensor d405 --hand-eye-error 2,0.3 --depth-scale-error 1"
    assert parsed(words, of) == sensor_errors("d405", (0.002, 0.3), 0.01)
    assert parsed("--source cloud --hand-eye-error 1,0", of) == SensorErrors(hand_eye=0.001)
    assert parsed("--source cloud", of) is None


def test_a_sensor_for_obstacles_of_the_scene_is_refused():
    with pytest.raises(InvalidInput, match="--sensor: is about the recorded RGB-D; add --source"):
        parsed("--sensor d405")


@pytest.mark.parametrize("text", ["2", "2,0.3,1", "2mm,0.3"])
def test_an_error_that_is_no_pair_of_numbers_is_refused(text):
    with pytest.raises(InvalidInput, match="expected millimetres and degrees as in 2,0.3, got"):
        parsed(f"--source cloud --hand-eye-error {text}")


def test_an_error_that_is_negative_is_refused():
    with pytest.raises(InvalidInput, match="hand_eye: expected a number from 0 to"):
        parsed("--source cloud --hand-eye-error=-2,0.3")


def test_in_python_a_sensor_for_obstacles_of_the_scene_is_refused_as_well(peg_demonstration):
    with pytest.raises(InvalidInput, match="sensor: is about the recorded RGB-D, not the scene"):
        pipeline.world_of(peg_demonstration, "scene", sensor=SensorErrors())


def annotation(settings):
    return Annotation((PrecisionSphere(0, np.eye(4), 0.1),), "hash", settings=settings)


def test_an_annotation_keeps_how_its_cloud_was_made_and_augmentation_finds_it(
    peg_demonstration, peg_model, peg_task
):
    cloud = CloudConfig(unknown="free", sensor=sensor_errors("d435", (0.002, 0.3)))
    about = peg_demonstration, peg_model.spec, peg_task.scene
    settings = suggestion_settings(make_world("cloud", *about, cloud=cloud), SuggestConfig())
    assert pipeline._cloud_of(annotation(settings), None) == cloud
    other = SensorErrors(hand_eye=0.001)
    assert pipeline._cloud_of(annotation(settings), other) == dataclasses.replace(
        cloud, sensor=other
    )
    scene = suggestion_settings(make_world("scene", *about), SuggestConfig())
    assert pipeline._cloud_of(annotation(scene), None) == CloudConfig()


def test_a_dataset_says_how_its_cloud_was_made_and_an_older_one_reads():
    config = AugmentConfig(obstacles="cloud", cloud=CloudConfig(sensor=sensor_errors("d405")))
    values = config.to_json()
    assert AugmentConfig.from_json(values) == config
    del values["cloud"]
    assert AugmentConfig.from_json(values).cloud == CloudConfig()
