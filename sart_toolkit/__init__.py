"""Teach a robot a skill from one demonstration (SART).

The names below are what a skill author needs; they are imported when first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sart_toolkit.annotate.suggest import SuggestConfig, suggest_annotation
    from sart_toolkit.augment.config import AugmentConfig
    from sart_toolkit.augment.engine import augment_demonstration, augment_sources
    from sart_toolkit.augment.strategies import Proposal, Strategy
    from sart_toolkit.augment.validate import validate_dataset
    from sart_toolkit.backends import make_backend
    from sart_toolkit.collision.certificate import certify
    from sart_toolkit.collision.cloud_world import CloudWorld
    from sart_toolkit.collision.exact import ExactWorld
    from sart_toolkit.collision.model import CollisionModel
    from sart_toolkit.collision.world import CollisionWorld, make_world
    from sart_toolkit.data.assets import asset
    from sart_toolkit.data.dataset import load_dataset
    from sart_toolkit.data.sampling import SamplingConfig
    from sart_toolkit.data.storage import (
        load_annotation,
        load_demonstration,
        save_annotation,
        save_demonstration,
    )
    from sart_toolkit.evaluate.rollout import EvaluateConfig, evaluate_skill
    from sart_toolkit.learn.skill import load_skill, save_skill
    from sart_toolkit.learn.training import TrainConfig, train
    from sart_toolkit.record.replay import replay_demonstration
    from sart_toolkit.record.scripted import ScriptedOperator
    from sart_toolkit.record.session import record_demonstration
    from sart_toolkit.report.page import write_report
    from sart_toolkit.report.video import film_rollout
    from sart_toolkit.robots import get_robot
    from sart_toolkit.robots.model import RobotModel
    from sart_toolkit.scenes.appearance import vary_appearance
    from sart_toolkit.tasks import get_task
    from sart_toolkit.tasks.task import Placement

_HOMES = {
    "AugmentConfig": "augment.config",
    "CloudWorld": "collision.cloud_world",
    "CollisionModel": "collision.model",
    "CollisionWorld": "collision.world",
    "EvaluateConfig": "evaluate.rollout",
    "ExactWorld": "collision.exact",
    "Placement": "tasks.task",
    "Proposal": "augment.strategies",
    "RobotModel": "robots.model",
    "SamplingConfig": "data.sampling",
    "ScriptedOperator": "record.scripted",
    "Strategy": "augment.strategies",
    "SuggestConfig": "annotate.suggest",
    "TrainConfig": "learn.training",
    "asset": "data.assets",
    "augment_demonstration": "augment.engine",
    "augment_sources": "augment.engine",
    "certify": "collision.certificate",
    "evaluate_skill": "evaluate.rollout",
    "film_rollout": "report.video",
    "get_robot": "robots",
    "get_task": "tasks",
    "load_annotation": "data.storage",
    "load_dataset": "data.dataset",
    "load_demonstration": "data.storage",
    "load_skill": "learn.skill",
    "make_backend": "backends",
    "make_world": "collision.world",
    "record_demonstration": "record.session",
    "replay_demonstration": "record.replay",
    "save_annotation": "data.storage",
    "save_demonstration": "data.storage",
    "save_skill": "learn.skill",
    "suggest_annotation": "annotate.suggest",
    "train": "learn.training",
    "validate_dataset": "augment.validate",
    "vary_appearance": "scenes.appearance",
    "write_report": "report.page",
}
__all__ = [
    "AugmentConfig",
    "CloudWorld",
    "CollisionModel",
    "CollisionWorld",
    "EvaluateConfig",
    "ExactWorld",
    "Placement",
    "Proposal",
    "RobotModel",
    "SamplingConfig",
    "ScriptedOperator",
    "Strategy",
    "SuggestConfig",
    "TrainConfig",
    "asset",
    "augment_demonstration",
    "augment_sources",
    "certify",
    "evaluate_skill",
    "film_rollout",
    "get_robot",
    "get_task",
    "load_annotation",
    "load_dataset",
    "load_demonstration",
    "load_skill",
    "make_backend",
    "make_world",
    "record_demonstration",
    "replay_demonstration",
    "save_annotation",
    "save_demonstration",
    "save_skill",
    "suggest_annotation",
    "train",
    "validate_dataset",
    "vary_appearance",
    "write_report",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
