"""The one training loop: any policy, CPU or CUDA, resumable to the bit on a CPU."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.storage import (
    OutputLock,
    check_writable,
    remove,
    remove_temporary_files,
)
from sart_toolkit.errors import InvalidInput, Mismatch, SartError, unknown_name
from sart_toolkit.learn.policies import POLICIES, get_policy
from sart_toolkit.learn.policy import Policy, PolicySetup
from sart_toolkit.learn.samples import (
    WEIGHTINGS,
    Variation,
    WindowConfig,
    Windows,
    open_windows,
)
from sart_toolkit.learn.tensorfile import load_tensors, save_tensors
from sart_toolkit.poses import check_positive
from sart_toolkit.registry import lasting_reference
from sart_toolkit.userfiles import local_file

CHECKPOINT = "checkpoint.safetensors"
_CHECKPOINT_SECONDS = 30.0
_WARM_UP = 0.05
# So many windows that follow each other are learned from together where a policy encodes each
# picture of a batch once: 5 pictures then do for what else takes 8.
_TOGETHER = 4
_log = logging.getLogger(__name__)

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How a policy is trained; `TrainConfig.for_policy` fills in what suits a policy.

    `epochs` passes over all trajectories in batches of `batch_size` windows; AdamW with `lr` and
    `weight_decay`; `schedule` is "cosine" (5 % linear warm-up, then down to 0) or "constant".
    `history` images of each of `cameras`, resized to a height of `image_size` [pixels]; each window
    shifted by up to `image_shift` pixels at random. `hidden`: width of the head. `norm`: the
    policy's normalisation layers. `weighting`: which windows an epoch draws how often, see
    `Windows.epoch_order`. `backbone_weights`: a file of weights to start from. `bfloat16`:
    "auto", "on" or "off". `device`: "auto", "cpu" or "cuda". `threads`: torch's threads, its own
    choice if None. `seed` decides the initial weights, the order and the shifts. `policy` may be
    given as a class; its reference is kept.
    """

    policy: str | type[Policy]
    epochs: int
    batch_size: int
    lr: float
    weight_decay: float
    schedule: str
    image_size: int
    image_shift: int
    norm: str
    history: int = 2
    hidden: int = 512
    weighting: str = "balanced"
    cameras: tuple[str, ...] = ("wrist",)
    backbone_weights: str | None = None
    bfloat16: str = "auto"
    device: str = "auto"
    threads: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        norms = get_policy(self.policy).norms
        object.__setattr__(self, "policy", lasting_reference("policy", self.policy, POLICIES))
        cameras = tuple(self.cameras)
        if not cameras or len(set(cameras)) < len(cameras):
            raise InvalidInput(f"cameras: expected different names, at least one, got {cameras}")
        object.__setattr__(self, "cameras", cameras)
        for name, least in (
            ("epochs", 1),
            ("batch_size", 2),
            ("image_size", 16),
            ("image_shift", 0),
            ("history", 1),
            ("hidden", 1),
            ("seed", 0),
        ):
            _check_whole(name, getattr(self, name), least)
        if self.threads is not None:
            _check_whole("threads", self.threads, 1)
        check_positive("lr", self.lr)
        if not (math.isfinite(self.weight_decay) and self.weight_decay >= 0):
            raise InvalidInput(f"weight_decay: expected a number >= 0, got {self.weight_decay}")
        if self.image_shift > self.image_size // 4:
            raise InvalidInput(
                f"image_shift: expected at most a quarter of image_size {self.image_size}, got "
                f"{self.image_shift}; shift less"
            )
        for name, choices in (
            ("schedule", ("cosine", "constant")),
            ("bfloat16", ("auto", "on", "off")),
            ("device", ("auto", "cpu", "cuda")),
            ("norm", norms),
            ("weighting", WEIGHTINGS),
        ):
            if getattr(self, name) not in choices:
                raise InvalidInput(
                    f"{name}: expected {' or '.join(choices)} with policy {self.policy}, got "
                    f"{getattr(self, name)!r}"
                )

    @classmethod
    def for_policy(cls, policy: str | type[Policy], **overrides: Any) -> TrainConfig:
        """The options that suit a policy, some of them replaced.

        Raises:
            UnknownName: no such policy, or no such option.
            InvalidInput: a value is not acceptable.
        """
        return cls.from_json({"policy": policy, **get_policy(policy).train_defaults, **overrides})

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> TrainConfig:
        """The configuration in JSON values.

        Raises:
            UnknownName: an option that doesn't exist.
            InvalidInput: an option is missing or not acceptable.
        """
        fields = dataclasses.fields(cls)
        names = [field.name for field in fields]
        for name in value:
            if name not in names:
                raise unknown_name("training option", name, names)
        for field in fields:
            if field.name not in value and field.default is dataclasses.MISSING:
                raise InvalidInput(f"training options: {field.name!r} is missing; add it")
        return cls(**value)

    def to_json(self) -> dict[str, Any]:
        """The configuration as JSON values."""
        return {**dataclasses.asdict(self), "cameras": list(self.cameras)}

    def files_needed(self) -> list[Path]:
        """The backbone's weights, if there are any."""
        return [] if self.backbone_weights is None else [Path(self.backbone_weights)]


@dataclass(frozen=True)
class EpochRecord:
    """One epoch: its number from 1, mean training loss, and seconds it took."""

    epoch: int
    loss: float
    seconds: float


@dataclass(frozen=True)
class TrainResult:
    """A trained policy (on the CPU, in evaluation mode) and how its training went.

    `images_per_second` counts every image of every window, those of all its cameras. `bfloat16`
    and `device` are what "auto" came to.
    """

    policy: Policy
    config: TrainConfig
    curve: tuple[EpochRecord, ...]
    images_per_second: float
    n_windows: int
    n_trajectories: int
    device: str
    bfloat16: bool

    @property
    def final_loss(self) -> float:
        """Mean training loss of the last epoch (normalised actions)."""
        return self.curve[-1].loss

    @property
    def seconds(self) -> float:
        """Seconds spent in the loop, resumed parts included."""
        return sum(record.seconds for record in self.curve)


def build_policy(config: TrainConfig, image_sizes: Mapping[str, tuple[int, int]]) -> Policy:
    """An untrained policy with the initial weights that `config.seed` decides, on the CPU.

    Args:
        config: which policy.
        image_sizes: `(height, width)` [pixels] of the images that it sees, by camera.
    """
    setup = PolicySetup(image_sizes, config.history, config.hidden, config.norm)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        policy = get_policy(config.policy)(setup)
    # torch's type stubs leave this argument out. Convolutions on a CPU are several times faster so.
    return policy.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def resolve_device(name: str) -> torch.device:
    """The device that "auto", "cpu" or "cuda" means on this machine.

    Raises:
        InvalidInput: CUDA was asked for and torch finds none.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise InvalidInput("device 'cuda': torch finds no CUDA device here; use --device cpu")
    return torch.device(name)


def resolve_bfloat16(setting: str, device: torch.device) -> bool:
    """Whether to compute convolutions in bfloat16 on a device.

    "auto" says yes where the processor multiplies bfloat16 natively. Measured with both policies
    on AVX-512-BF16/AMX that is 1.6 to 2.5 times as fast; without it, torch emulates it slowly.
    """
    if setting != "auto":
        return setting == "on"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities()
    return any(bool(capabilities.get(name)) for name in ("avx512_bf16", "amx_bf16"))


def learning_rate(config: TrainConfig, step: int, n_steps: int) -> float:
    """The learning rate of a step, counted from 0, of `n_steps`."""
    if config.schedule == "constant":
        return config.lr
    warm_up = max(1, round(_WARM_UP * n_steps))
    if step < warm_up:
        return config.lr * (step + 1) / warm_up
    return config.lr * 0.5 * (1.0 + math.cos(math.pi * (step - warm_up) / (n_steps - warm_up)))


def epoch_batches(
    windows: Windows, config: TrainConfig, epoch: int, n_batches: int
) -> list[tuple[Tensor, Variation]]:
    """The windows of each batch of an epoch, and how they are varied.

    Args:
        windows: all of them.
        config: how is trained.
        epoch: counted from 0.
        n_batches: how many; they differ by at most one window.
    """
    rng = np.random.default_rng([config.seed, epoch])
    together = _TOGETHER if get_policy(config.policy).shares_pictures else 1
    order, runs = windows.epoch_order(rng, config.weighting, together)
    offsets = torch.from_numpy(
        rng.integers(0, 2 * config.image_shift + 1, (int(runs.max()) + 1, 2))
    ).to(windows.device)
    return [
        (
            torch.from_numpy(some).to(windows.device),
            Variation(offsets, torch.from_numpy(of).to(windows.device)),
        )
        # Of nearly equal size: a small last batch would disturb BatchNorm.
        for some, of in zip(
            np.array_split(order, n_batches), np.array_split(runs, n_batches), strict=True
        )
    ]


def make_optimizer(policy: Policy, config: TrainConfig) -> torch.optim.AdamW:
    """AdamW over all of a policy's weights, its update fused into one pass."""
    return torch.optim.AdamW(
        policy.parameters(), lr=config.lr, weight_decay=config.weight_decay, fused=True
    )


def train(
    dataset: Dataset,
    config: TrainConfig,
    out: Path,
    progress: Progress | None = None,
    resume: bool = True,
    reading: Callable[[int, int], None] | None = None,
) -> TrainResult:
    """A policy trained on a dataset.

    The dataset is read once, into files in `out` (see `open_windows`) from which batches are
    gathered. Checkpoints go to `out` every 30 seconds, at the end, and when interrupted (Ctrl-C
    lets the step finish, a second one does not; so does any signal that Python handles, as `sart`
    has it handle SIGTERM and SIGHUP). A later call with the same dataset and options
    resumes from there, and ends with the weights of an uninterrupted run, bit for bit on the same
    CPU with the same number of threads.

    Args:
        dataset: the demonstration and its episodes.
        config: how to train.
        out: directory of the checkpoint and the windows; made if needed.
        progress: called after every step with steps done, steps in all, and a line of text.
        resume: resume from a checkpoint in `out` if there is one; otherwise it is removed.
        reading: called after each trajectory of the dataset that was read, with how many of how
            many.

    Raises:
        UnknownName: the dataset has no such camera.
        InvalidInput: CUDA was asked for and isn't there, or the policy takes no backbone weights.
        Mismatch: the dataset's parts don't belong together, the checkpoint is of other options or
            another dataset, or the backbone weights don't fit.
        MissingFile: no such backbone weights.
        BrokenFile: damaged checkpoint or backbone weights.
        CannotWrite: another process is at work on `out`, or the disk refuses the checkpoint, or
            has no room for the images.
        SartError: the loss is not finite any more.
    """
    device, out = resolve_device(config.device), Path(out)
    with OutputLock(out, nested=True):
        check_writable(out / CHECKPOINT, overwrite=True)
        remove_temporary_files(out)
        if not resume:
            # Interrupted before its first checkpoint, it must not resume from an older one.
            remove(out / CHECKPOINT)
        windows = open_windows(dataset, _window_config(config), out, reading)
        with torch_threads(config.threads), _deferred_interrupt() as interrupt:
            training = _Training(windows, config, out, device)
            actions = dataset.sources[0].demonstration.actions
            training.policy.set_demonstration(torch.from_numpy(actions))
            return training.run(progress, interrupt)


def _window_config(config: TrainConfig) -> WindowConfig:
    return WindowConfig(
        config.cameras,
        config.image_size,
        config.history,
        config.image_shift,
        get_policy(config.policy).chunk,
    )


class _Training:
    """What a run changes as it goes: weights, optimizer, and the place in the epoch."""

    def __init__(
        self, windows: Windows, config: TrainConfig, out: Path, device: torch.device
    ) -> None:
        self.config = config
        self.device = device
        self.bfloat16 = resolve_bfloat16(config.bfloat16, device)
        self.checkpoint = out / CHECKPOINT
        # Where it ran decides rounding, not what is learned: those options may change.
        self.options = {k: v for k, v in config.to_json().items() if k not in ("device", "threads")}
        self.n_windows = int(windows.multiplicity.sum())
        self.n_batches = math.ceil(self.n_windows / config.batch_size)

        resumes = self.checkpoint.exists()
        self.policy = build_policy(config, windows.frames.layout.sizes)
        self.policy.set_normalisation(windows.normalisation())
        if config.backbone_weights is not None and not resumes:
            self.policy.load_backbone(local_file(config.backbone_weights))
        self.policy.to(device)
        self.optimizer = make_optimizer(self.policy, config)
        self.windows = windows.to(device) if _has_room(device, windows) else windows

        self.curve: list[EpochRecord] = []
        self.batch = 0
        self.loss_sum = torch.zeros((), dtype=torch.float64, device=device)
        self.seconds = 0.0
        if resumes:
            self._restore()

    def run(self, progress: Progress | None, interrupt: _DeferredInterrupt) -> TrainResult:
        config, n_steps = self.config, self.config.epochs * self.n_batches
        self.policy.train()
        saved = time.perf_counter()
        for epoch in range(len(self.curve), config.epochs):
            began = time.perf_counter() - self.seconds
            batches = epoch_batches(self.windows, config, epoch, self.n_batches)
            for batch in range(self.batch, self.n_batches):
                step = epoch * self.n_batches + batch
                for group in self.optimizer.param_groups:
                    group["lr"] = learning_rate(config, step, n_steps)
                if batch + 1 < self.n_batches:
                    self.windows.will_need(batches[batch + 1][0])
                self._step(*batches[batch])
                self.batch = batch + 1
                if progress is not None:
                    progress(step + 1, n_steps, self._status())
                self.seconds = time.perf_counter() - began
                if interrupt.waiting or time.perf_counter() - saved > _CHECKPOINT_SECONDS:
                    self._save()
                    saved = time.perf_counter()
                if interrupt.waiting:
                    _log.warning("interrupted after step %d; train again to resume", step + 1)
                    interrupt.carry_out()
            loss = self._finite_loss() / self.n_windows
            self.curve.append(EpochRecord(epoch + 1, loss, time.perf_counter() - began))
            self.batch, self.seconds = 0, 0.0
            self.loss_sum.zero_()
        self._save()
        return self._result()

    def _step(self, windows: Tensor, variation: Variation) -> None:
        batch = self.windows.batch(windows, variation, self.policy.shares_pictures)
        batch = {k: v.to(self.device) for k, v in batch.items()}
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
            loss = self.policy.loss(batch)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        # Kept on the device: reading it each step would make a GPU wait.
        self.loss_sum += loss.detach() * len(windows)

    def _finite_loss(self) -> float:
        total = float(self.loss_sum)
        if not math.isfinite(total):
            raise SartError(
                f"training loss became {total} in epoch {len(self.curve) + 1}; lower lr (now "
                f"{self.config.lr:g}) or set bfloat16 off"
            )
        return total

    def _status(self) -> str:
        epochs = f"epoch {len(self.curve) + 1}/{self.config.epochs}"
        return f"{epochs}, loss {self.curve[-1].loss:.4g}" if self.curve else epochs

    def _result(self) -> TrainResult:
        seconds = sum(record.seconds for record in self.curve)
        n_images = self.n_windows * self.config.history * len(self.config.cameras) * len(self.curve)
        return TrainResult(
            policy=self.policy.cpu().eval(),
            config=self.config,
            curve=tuple(self.curve),
            images_per_second=n_images / seconds,
            n_windows=self.n_windows,
            n_trajectories=self.windows.n_trajectories,
            device=self.device.type,
            bfloat16=self.bfloat16,
        )

    def _save(self) -> None:
        tensors = {f"policy/{k}": v for k, v in self.policy.state_dict().items()}
        for i, parameter in enumerate(self.policy.parameters()):
            for name, value in self.optimizer.state[parameter].items():
                tensors[f"optimizer/{i}/{name}"] = value
        about = {
            "options": self.options,
            "data_hash": self.windows.data_hash,
            "batch": self.batch,
            "loss_sum": self._finite_loss(),
            "seconds": self.seconds,
            "curve": [dataclasses.asdict(record) for record in self.curve],
        }
        save_tensors(self.checkpoint, tensors, about)

    def _restore(self) -> None:
        tensors, about = load_tensors(self.checkpoint)
        changed = [k for k, v in self.options.items() if about["options"].get(k) != v]
        if about["data_hash"] != self.windows.data_hash:
            changed.append("training data")
        if changed:
            raise Mismatch(
                f"{self.checkpoint}: was made with other {', '.join(changed)}; restore them, "
                "choose another --out, or start again with --overwrite"
            )
        try:
            self.policy.load_state_dict(
                {
                    k.removeprefix("policy/"): v
                    for k, v in tensors.items()
                    if k.startswith("policy/")
                }
            )
            for i, parameter in enumerate(self.policy.parameters()):
                if f"optimizer/{i}/step" not in tensors:
                    continue  # a weight that isn't trained
                moments = {
                    # The moments must lie in memory as the weights do.
                    name: torch.empty_like(parameter).copy_(tensors[f"optimizer/{i}/{name}"])
                    for name in ("exp_avg", "exp_avg_sq")
                }
                step = tensors[f"optimizer/{i}/step"].to(self.device)
                self.optimizer.state[parameter] = {"step": step, **moments}
        except (KeyError, RuntimeError) as error:
            raise Mismatch(
                f"{self.checkpoint}: does not fit this version's {self.config.policy}; start again "
                "with --overwrite"
            ) from error
        self.batch, self.seconds = about["batch"], about["seconds"]
        self.loss_sum.fill_(about["loss_sum"])
        self.curve = [EpochRecord(**record) for record in about["curve"]]


def _has_room(device: torch.device, windows: Windows) -> bool:
    """Whether a GPU can hold all images and as much again for the policy."""
    if device.type != "cuda":
        return False
    free, _ = torch.cuda.mem_get_info(device)
    return 2 * sum(images.nbytes for images in windows.frames.images.values()) < free


@contextlib.contextmanager
def torch_threads(threads: int | None) -> Iterator[None]:
    """Within it torch computes with so many threads, its own choice if None."""
    before = torch.get_num_threads()
    try:
        if threads is not None:
            torch.set_num_threads(threads)
        yield
    finally:
        torch.set_num_threads(before)


class _DeferredInterrupt:
    """A signal that would have interrupted, kept until a step has finished.

    Only then do weights, optimizer and counters belong together.
    """

    def __init__(self) -> None:
        self.handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}
        self._signal: int | None = None

    @property
    def waiting(self) -> bool:
        """Whether a signal came."""
        return self._signal is not None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self.waiting:
            self.handlers[number](number, frame)
        self._signal = number

    def carry_out(self) -> None:
        """Interrupt, as the signal would have done at once."""
        number, self._signal = self._signal, None
        if number is not None:
            self.handlers[number](number, None)
        raise KeyboardInterrupt


@contextlib.contextmanager
def _deferred_interrupt() -> Iterator[_DeferredInterrupt]:
    """What Ctrl-C and the signals that ask a process to end are kept in; a second one isn't."""
    interrupt = _DeferredInterrupt()
    if threading.current_thread() is threading.main_thread():
        for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            handler = signal.getsignal(each)
            # Neither what is ignored, nor what ends the process without asking Python.
            if callable(handler):
                interrupt.handlers[each] = handler
    try:
        for number in interrupt.handlers:
            signal.signal(number, interrupt)
        yield interrupt
    finally:
        for number, handler in interrupt.handlers.items():
            signal.signal(number, handler)


def _check_whole(name: str, value: Any, least: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise InvalidInput(f"{name}: expected a whole number >= {least}, got {value!r}")
