"""Teach a robot a skill from one demonstration (SART).

The names below are what a skill author needs; they are imported when first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sart_toolkit.augment.config import AugmentConfig
    from sart_toolkit.augment.engine import augment_demonstration
    from sart_toolkit.augment.validate import validate_dataset
    from sart_toolkit.backends import make_backend
    from sart_toolkit.evaluate.report import write_report
    from sart_toolkit.evaluate.rollout import EvaluateConfig, evaluate_skill
    from sart_toolkit.learn.skill import load_skill, save_skill
    from sart_toolkit.learn.training import TrainConfig, train
    from sart_toolkit.robots import get_robot
    from sart_toolkit.robots.model import RobotModel
    from sart_toolkit.sampling import SamplingConfig
    from sart_toolkit.scene.appearance import vary_appearance
    from sart_toolkit.scene.certificate import certify
    from sart_toolkit.scene.collision import CollisionModel
    from sart_toolkit.scene.demonstrated import DemonstratedScene
    from sart_toolkit.storage import (
        load_annotation,
        load_dataset,
        load_demonstration,
        save_annotation,
        save_demonstration,
    )
    from sart_toolkit.tasks import get_task
    from sart_toolkit.tasks.task import Placement
    from sart_toolkit.teach.replay import replay_demonstration
    from sart_toolkit.teach.scripted import ScriptedOperator
    from sart_toolkit.teach.session import record_demonstration
    from sart_toolkit.teach.suggest import ExactSurroundings, SuggestConfig, suggest_annotation

_HOMES = {
    "AugmentConfig": "augment.config",
    "CollisionModel": "scene.collision",
    "DemonstratedScene": "scene.demonstrated",
    "EvaluateConfig": "evaluate.rollout",
    "ExactSurroundings": "teach.suggest",
    "Placement": "tasks.task",
    "RobotModel": "robots.model",
    "SamplingConfig": "sampling",
    "ScriptedOperator": "teach.scripted",
    "SuggestConfig": "teach.suggest",
    "TrainConfig": "learn.training",
    "augment_demonstration": "augment.engine",
    "certify": "scene.certificate",
    "evaluate_skill": "evaluate.rollout",
    "get_robot": "robots",
    "get_task": "tasks",
    "load_annotation": "storage",
    "load_dataset": "storage",
    "load_demonstration": "storage",
    "load_skill": "learn.skill",
    "make_backend": "backends",
    "record_demonstration": "teach.session",
    "replay_demonstration": "teach.replay",
    "save_annotation": "storage",
    "save_demonstration": "storage",
    "save_skill": "learn.skill",
    "suggest_annotation": "teach.suggest",
    "train": "learn.training",
    "validate_dataset": "augment.validate",
    "vary_appearance": "scene.appearance",
    "write_report": "evaluate.report",
}
__all__ = [
    "AugmentConfig",
    "CollisionModel",
    "DemonstratedScene",
    "EvaluateConfig",
    "ExactSurroundings",
    "Placement",
    "RobotModel",
    "SamplingConfig",
    "ScriptedOperator",
    "SuggestConfig",
    "TrainConfig",
    "augment_demonstration",
    "certify",
    "evaluate_skill",
    "get_robot",
    "get_task",
    "load_annotation",
    "load_dataset",
    "load_demonstration",
    "load_skill",
    "make_backend",
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
