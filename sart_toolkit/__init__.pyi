"""What `import sart_toolkit as sart` offers, by the module that it comes from."""

from .annotate.suggest import (
    SuggestConfig as SuggestConfig,
)
from .annotate.suggest import (
    suggest_annotation as suggest_annotation,
)
from .augment import STRATEGIES as STRATEGIES
from .augment import get_strategy as get_strategy
from .augment.config import AugmentConfig as AugmentConfig
from .augment.engine import (
    augment_demonstration as augment_demonstration,
)
from .augment.engine import (
    augment_sources as augment_sources,
)
from .augment.executors import SegmentExecutor as SegmentExecutor
from .augment.preview import Preview as Preview
from .augment.preview import preview_sources as preview_sources
from .augment.strategies import Proposal as Proposal
from .augment.strategies import Strategy as Strategy
from .augment.validate import validate_dataset as validate_dataset
from .backends import (
    BACKENDS as BACKENDS,
)
from .backends import (
    get_backend as get_backend,
)
from .backends import (
    make_backend as make_backend,
)
from .backends.hardware import (
    HardwareBackend as HardwareBackend,
)
from .backends.hardware import (
    cell_backend as cell_backend,
)
from .backends.interface import (
    Attended as Attended,
)
from .backends.interface import (
    Backend as Backend,
)
from .backends.interface import (
    CameraView as CameraView,
)
from .backends.interface import (
    CommandSent as CommandSent,
)
from .backends.interface import (
    Contact as Contact,
)
from .backends.interface import (
    Draws as Draws,
)
from .backends.interface import (
    Guides as Guides,
)
from .backends.interface import (
    KnowsBodies as KnowsBodies,
)
from .backends.interface import (
    Observation as Observation,
)
from .backends.interface import (
    Resets as Resets,
)
from .backends.interface import (
    SavesStates as SavesStates,
)
from .backends.interface import (
    SensesContacts as SensesContacts,
)
from .backends.interface import (
    SensesForce as SensesForce,
)
from .backends.interface import (
    Simulator as Simulator,
)
from .backends.interface import (
    require as require,
)
from .backends.raycast import RayCaster as RayCaster
from .backends.states import (
    pack_state as pack_state,
)
from .backends.states import (
    scene_digest as scene_digest,
)
from .backends.states import (
    unpack_state as unpack_state,
)
from .calibrate.board import Board as Board
from .calibrate.board import save_board as save_board
from .calibrate.calibration import (
    Calibration as Calibration,
)
from .calibrate.calibration import (
    declared_errors as declared_errors,
)
from .calibrate.calibration import (
    load_calibration as load_calibration,
)
from .calibrate.calibration import (
    save_calibration as save_calibration,
)
from .calibrate.hand_eye import BoardView as BoardView
from .calibrate.hand_eye import CalibrateConfig as CalibrateConfig
from .calibrate.hand_eye import calibrate_camera as calibrate_camera
from .collision import make_world as make_world
from .collision.certificate import Certificate as Certificate
from .collision.certificate import certify as certify
from .collision.cloud import CloudConfig as CloudConfig
from .collision.cloud_world import CloudWorld as CloudWorld
from .collision.exact import ExactWorld as ExactWorld
from .collision.model import CollisionModel as CollisionModel
from .collision.world import CollisionWorld as CollisionWorld
from .data.assets import asset as asset
from .data.combine import (
    merge_datasets as merge_datasets,
)
from .data.combine import (
    shorten_dataset as shorten_dataset,
)
from .data.combine import (
    split_dataset as split_dataset,
)
from .data.combine import (
    split_sources as split_sources,
)
from .data.dataset import Dataset as Dataset
from .data.dataset import load_dataset as load_dataset
from .data.formats import FORMATS as FORMATS
from .data.formats import get_format as get_format
from .data.formats.format import About as About
from .data.formats.format import Arm as Arm
from .data.formats.format import Format as Format
from .data.formats.format import Given as Given
from .data.formats.format import Reads as Reads
from .data.formats.format import Trajectory as Trajectory
from .data.records import (
    Annotation as Annotation,
)
from .data.records import (
    CameraRecord as CameraRecord,
)
from .data.records import (
    Demonstration as Demonstration,
)
from .data.records import (
    Episode as Episode,
)
from .data.records import (
    PrecisionSphere as PrecisionSphere,
)
from .data.records import (
    Provenance as Provenance,
)
from .data.records import (
    Rates as Rates,
)
from .data.records import (
    Steps as Steps,
)
from .data.records import (
    convergence_waypoint as convergence_waypoint,
)
from .data.sampling import SamplingConfig as SamplingConfig
from .data.sampling import sample_pose as sample_pose
from .data.storage import (
    load_annotation as load_annotation,
)
from .data.storage import (
    load_demonstration as load_demonstration,
)
from .data.storage import (
    load_episode as load_episode,
)
from .data.storage import (
    save_annotation as save_annotation,
)
from .data.storage import (
    save_demonstration as save_demonstration,
)
from .errors import (
    BrokenFile as BrokenFile,
)
from .errors import (
    CannotWrite as CannotWrite,
)
from .errors import (
    DeviceLost as DeviceLost,
)
from .errors import (
    Discarded as Discarded,
)
from .errors import (
    InvalidInput as InvalidInput,
)
from .errors import (
    Mismatch as Mismatch,
)
from .errors import (
    MissingCapability as MissingCapability,
)
from .errors import (
    MissingExtra as MissingExtra,
)
from .errors import (
    MissingFile as MissingFile,
)
from .errors import (
    MotionRejected as MotionRejected,
)
from .errors import (
    NoDisplay as NoDisplay,
)
from .errors import (
    OutputExists as OutputExists,
)
from .errors import (
    RobotStopped as RobotStopped,
)
from .errors import (
    SartError as SartError,
)
from .errors import (
    UnknownName as UnknownName,
)
from .errors import (
    Unreachable as Unreachable,
)
from .evaluate.compare import compare_rollouts as compare_rollouts
from .evaluate.deploy import Deployment as Deployment
from .evaluate.deploy import Judge as Judge
from .evaluate.deploy import deploy_skill as deploy_skill
from .evaluate.deploy import judge_skill as judge_skill
from .evaluate.rollout import (
    EvaluateConfig as EvaluateConfig,
)
from .evaluate.rollout import (
    Rollout as Rollout,
)
from .evaluate.rollout import (
    evaluate_skill as evaluate_skill,
)
from .evaluate.rollout import (
    run_rollout as run_rollout,
)
from .hardware.cell import Cell as Cell
from .hardware.cell import load_cell as load_cell
from .hardware.drivers import ArmState as ArmState
from .hardware.drivers import CameraImage as CameraImage
from .learn.policies import POLICIES as POLICIES
from .learn.policies import get_policy as get_policy
from .learn.policies.encoder import Encoder as Encoder
from .learn.policies.mlp import MLPPolicy as MLPPolicy
from .learn.policy import Policy as Policy
from .learn.policy import PolicySetup as PolicySetup
from .learn.skill import Skill as Skill
from .learn.skill import load_skill as load_skill
from .learn.skill import save_skill as save_skill
from .learn.training import TrainConfig as TrainConfig
from .learn.training import train as train
from .pipeline import check_export as check_export
from .pipeline import export as export
from .pipeline import import_recordings as import_recordings
from .pipeline import run as run
from .pipeline import run_benchmark as run_benchmark
from .pipeline import run_skill as run_skill
from .pipeline import train_seeds as train_seeds
from .poses import inverse as inverse
from .poses import pose as pose
from .record.devices import DEVICES as DEVICES
from .record.devices import make_device as make_device
from .record.replay import replay_demonstration as replay_demonstration
from .record.scripted import ScriptedOperator as ScriptedOperator
from .record.session import (
    Device as Device,
)
from .record.session import (
    DeviceSetup as DeviceSetup,
)
from .record.session import (
    SessionConfig as SessionConfig,
)
from .record.session import (
    TeleopCommand as TeleopCommand,
)
from .record.session import (
    record_demonstration as record_demonstration,
)
from .report.page import write_report as write_report
from .report.video import film_rollout as film_rollout
from .robots import ROBOTS as ROBOTS
from .robots import get_robot as get_robot
from .robots.model import RobotModel as RobotModel
from .robots.spec import (
    Attachment as Attachment,
)
from .robots.spec import (
    CameraSpec as CameraSpec,
)
from .robots.spec import (
    GripperSpec as GripperSpec,
)
from .robots.spec import (
    MeshShape as MeshShape,
)
from .robots.spec import (
    RobotSpec as RobotSpec,
)
from .robots.spec import (
    Shape as Shape,
)
from .robots.spec import (
    check_gripper as check_gripper,
)
from .robots.spec import (
    check_image_size as check_image_size,
)
from .robots.spec import (
    look_at as look_at,
)
from .robots.spec import (
    mass_from_density as mass_from_density,
)
from .robots.visuals import RobotVisuals as RobotVisuals
from .scenes.appearance import (
    AppearanceConfig as AppearanceConfig,
)
from .scenes.appearance import (
    randomise_appearance as randomise_appearance,
)
from .scenes.spec import (
    Body as Body,
)
from .scenes.spec import (
    Detent as Detent,
)
from .scenes.spec import (
    Joint as Joint,
)
from .scenes.spec import (
    Light as Light,
)
from .scenes.spec import (
    SceneSpec as SceneSpec,
)
from .scenes.spec import (
    SceneState as SceneState,
)
from .tasks import TASKS as TASKS
from .tasks import get_task as get_task
from .tasks.task import Placement as Placement
from .tasks.task import PlanStep as PlanStep
from .tasks.task import Task as Task
from .workers import Workers as Workers
