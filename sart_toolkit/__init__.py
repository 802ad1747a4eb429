"""Teach a robot a skill from one demonstration (SART).

The names below are what the author of a skill, robot, task, backend, strategy or policy needs; they
are imported when first used.
"""

# ruff: noqa: F401 - what is imported for type checkers is exported by `__getattr__`.
from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sart_toolkit.annotate.suggest import SuggestConfig, suggest_annotation
    from sart_toolkit.augment import STRATEGIES, get_strategy
    from sart_toolkit.augment.config import AugmentConfig
    from sart_toolkit.augment.engine import augment_demonstration, augment_sources
    from sart_toolkit.augment.executors import SegmentExecutor
    from sart_toolkit.augment.strategies import Proposal, Strategy
    from sart_toolkit.augment.validate import validate_dataset
    from sart_toolkit.backends import BACKENDS, get_backend, make_backend
    from sart_toolkit.backends.interface import (
        Backend,
        CameraView,
        CommandSent,
        Contact,
        Draws,
        KnowsBodies,
        Observation,
        Resets,
        SavesStates,
        SensesContacts,
        SensesForce,
        require,
    )
    from sart_toolkit.backends.states import pack_state, scene_digest, unpack_state
    from sart_toolkit.collision.certificate import Certificate, certify
    from sart_toolkit.collision.cloud import CloudConfig
    from sart_toolkit.collision.cloud_world import CloudWorld
    from sart_toolkit.collision.exact import ExactWorld
    from sart_toolkit.collision.model import CollisionModel
    from sart_toolkit.collision.world import CollisionWorld, make_world
    from sart_toolkit.data.assets import asset
    from sart_toolkit.data.dataset import Dataset, load_dataset
    from sart_toolkit.data.records import (
        Annotation,
        CameraRecord,
        Demonstration,
        Episode,
        PrecisionSphere,
        Provenance,
        Rates,
        Steps,
        convergence_waypoint,
    )
    from sart_toolkit.data.sampling import SamplingConfig, sample_pose
    from sart_toolkit.data.storage import (
        load_annotation,
        load_demonstration,
        load_episode,
        save_annotation,
        save_demonstration,
    )
    from sart_toolkit.errors import (
        BrokenFile,
        CannotWrite,
        DeviceLost,
        Discarded,
        InvalidInput,
        Mismatch,
        MissingCapability,
        MissingExtra,
        MissingFile,
        MotionRejected,
        NoDisplay,
        OutputExists,
        SartError,
        UnknownName,
        Unreachable,
    )
    from sart_toolkit.evaluate.rollout import EvaluateConfig, Rollout, evaluate_skill, run_rollout
    from sart_toolkit.learn.policies import POLICIES, get_policy
    from sart_toolkit.learn.policy import Policy, PolicySetup
    from sart_toolkit.learn.skill import Skill, load_skill, save_skill
    from sart_toolkit.learn.training import TrainConfig, train
    from sart_toolkit.pipeline import run, run_skill
    from sart_toolkit.poses import inverse, pose
    from sart_toolkit.record.devices import DEVICES, make_device
    from sart_toolkit.record.replay import replay_demonstration
    from sart_toolkit.record.scripted import ScriptedOperator
    from sart_toolkit.record.session import (
        Device,
        DeviceSetup,
        SessionConfig,
        TeleopCommand,
        record_demonstration,
    )
    from sart_toolkit.report.page import write_report
    from sart_toolkit.report.video import film_rollout
    from sart_toolkit.robots import ROBOTS, get_robot
    from sart_toolkit.robots.model import RobotModel
    from sart_toolkit.robots.spec import (
        Attachment,
        CameraSpec,
        GripperSpec,
        RobotSpec,
        Shape,
        check_gripper,
        check_image_size,
        look_at,
    )
    from sart_toolkit.scenes.appearance import AppearanceConfig, randomise_appearance
    from sart_toolkit.scenes.spec import Body, Detent, Joint, Light, SceneSpec, SceneState
    from sart_toolkit.tasks import TASKS, get_task
    from sart_toolkit.tasks.task import Placement, PlanStep, Task

# For each module of ours the names that are exported from it, the same as above.
_HOMES = {
    "annotate.suggest": (
        "SuggestConfig",
        "suggest_annotation",
    ),
    "augment": (
        "STRATEGIES",
        "get_strategy",
    ),
    "augment.config": ("AugmentConfig",),
    "augment.engine": (
        "augment_demonstration",
        "augment_sources",
    ),
    "augment.executors": ("SegmentExecutor",),
    "augment.strategies": (
        "Proposal",
        "Strategy",
    ),
    "augment.validate": ("validate_dataset",),
    "backends": (
        "BACKENDS",
        "get_backend",
        "make_backend",
    ),
    "backends.interface": (
        "Backend",
        "CameraView",
        "CommandSent",
        "Contact",
        "Draws",
        "KnowsBodies",
        "Observation",
        "Resets",
        "SavesStates",
        "SensesContacts",
        "SensesForce",
        "require",
    ),
    "backends.states": (
        "pack_state",
        "scene_digest",
        "unpack_state",
    ),
    "collision.certificate": (
        "Certificate",
        "certify",
    ),
    "collision.cloud": ("CloudConfig",),
    "collision.cloud_world": ("CloudWorld",),
    "collision.exact": ("ExactWorld",),
    "collision.model": ("CollisionModel",),
    "collision.world": (
        "CollisionWorld",
        "make_world",
    ),
    "data.assets": ("asset",),
    "data.dataset": (
        "Dataset",
        "load_dataset",
    ),
    "data.records": (
        "Annotation",
        "CameraRecord",
        "Demonstration",
        "Episode",
        "PrecisionSphere",
        "Provenance",
        "Rates",
        "Steps",
        "convergence_waypoint",
    ),
    "data.sampling": (
        "SamplingConfig",
        "sample_pose",
    ),
    "data.storage": (
        "load_annotation",
        "load_demonstration",
        "load_episode",
        "save_annotation",
        "save_demonstration",
    ),
    "errors": (
        "BrokenFile",
        "CannotWrite",
        "DeviceLost",
        "Discarded",
        "InvalidInput",
        "Mismatch",
        "MissingCapability",
        "MissingExtra",
        "MissingFile",
        "MotionRejected",
        "NoDisplay",
        "OutputExists",
        "SartError",
        "UnknownName",
        "Unreachable",
    ),
    "evaluate.rollout": (
        "EvaluateConfig",
        "Rollout",
        "evaluate_skill",
        "run_rollout",
    ),
    "learn.policies": (
        "POLICIES",
        "get_policy",
    ),
    "learn.policy": (
        "Policy",
        "PolicySetup",
    ),
    "learn.skill": (
        "Skill",
        "load_skill",
        "save_skill",
    ),
    "learn.training": (
        "TrainConfig",
        "train",
    ),
    "pipeline": (
        "run",
        "run_skill",
    ),
    "poses": (
        "inverse",
        "pose",
    ),
    "record.devices": (
        "DEVICES",
        "make_device",
    ),
    "record.replay": ("replay_demonstration",),
    "record.scripted": ("ScriptedOperator",),
    "record.session": (
        "Device",
        "DeviceSetup",
        "SessionConfig",
        "TeleopCommand",
        "record_demonstration",
    ),
    "report.page": ("write_report",),
    "report.video": ("film_rollout",),
    "robots": (
        "ROBOTS",
        "get_robot",
    ),
    "robots.model": ("RobotModel",),
    "robots.spec": (
        "Attachment",
        "CameraSpec",
        "GripperSpec",
        "RobotSpec",
        "Shape",
        "check_gripper",
        "check_image_size",
        "look_at",
    ),
    "scenes.appearance": (
        "AppearanceConfig",
        "randomise_appearance",
    ),
    "scenes.spec": (
        "Body",
        "Detent",
        "Joint",
        "Light",
        "SceneSpec",
        "SceneState",
    ),
    "tasks": (
        "TASKS",
        "get_task",
    ),
    "tasks.task": (
        "Placement",
        "PlanStep",
        "Task",
    ),
}
_MODULES = {name: module for module, names in _HOMES.items() for name in names}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
