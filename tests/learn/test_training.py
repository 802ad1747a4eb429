import dataclasses
import json
import os
import resource
import signal
import threading

import numpy as np
import pytest
import torch

from sart_toolkit import pipeline
from sart_toolkit.data.storage import OutputLock
from sart_toolkit.errors import CannotWrite, InvalidInput, Mismatch, SartError, UnknownName
from sart_toolkit.learn import training
from sart_toolkit.learn.policies import POLICIES
from sart_toolkit.learn.policies.resnet18_mlp import ResNet18
from sart_toolkit.learn.tensorfile import load_tensors, save_tensors
from sart_toolkit.learn.training import (
    CHECKPOINT,
    TrainConfig,
    learning_rate,
    resolve_bfloat16,
    resolve_device,
    train,
)


def _same_weights(a, b):
    a, b = a.policy.state_dict(), b.policy.state_dict()
    assert a.keys() == b.keys()
    return all(torch.equal(a[name], b[name]) for name in a)


def _losses(result):
    return [record.loss for record in result.curve]


def _press_ctrl_c_after(step, presses=1):
    def progress(done, total, text):
        if done == step:
            for _ in range(presses):
                os.kill(os.getpid(), signal.SIGINT)

    return progress


# --- learning -----------------------------------------------------------------------------------


def test_it_learns_where_the_blob_is_and_transfers_to_images_never_seen(
    make_dataset, open_windows, tmp_path
):
    config = TrainConfig.for_policy(
        "compact_mlp", epochs=20, batch_size=32, image_size=32, threads=1, device="cpu"
    )
    result = train(make_dataset((35,) * 8, n=40, segment=40, seed=1), config, tmp_path)
    held_out = open_windows(make_dataset((35,) * 3, n=40, segment=40, seed=2), 32)
    batch = held_out.batch(torch.arange(len(held_out.history)))
    with torch.inference_mode():
        predicted = result.policy.predict(batch)
    actions = batch["action"]
    # The last action of a trajectory holds still whatever the image shows.
    moving = actions[:, :2].abs().sum(1) > 0
    error = (predicted - actions)[moving, :2].square().mean()
    assert error < 0.05 * actions[moving, :2].var(0).mean()
    assert result.final_loss < 0.6 * result.curve[0].loss


@pytest.mark.parametrize("policy", sorted(set(POLICIES) - {"replay"}))
def test_every_policy_lowers_its_loss(policy, make_dataset, tmp_path):
    config = TrainConfig.for_policy(
        policy,
        epochs=8,
        batch_size=8,
        lr=1e-3,
        image_size=32,
        image_shift=0,
        threads=1,
        device="cpu",
    )
    result = train(make_dataset((7,), segment=8), config, tmp_path)
    assert result.final_loss < 0.8 * result.curve[0].loss
    assert not result.policy.training


def test_what_only_the_second_camera_shows_is_learned(make_dataset, with_steps, tmp_path):
    def behind_the_wrist(steps):
        seen = steps.cameras["wrist"]
        dark = dataclasses.replace(seen, rgb=np.zeros_like(seen.rgb))
        return dataclasses.replace(steps, cameras={"wrist": dark, "overview": seen})

    dataset = with_steps(make_dataset((20,) * 4, n=30, segment=30, seed=1), behind_the_wrist)
    options = {"epochs": 12, "batch_size": 32, "image_size": 32, "threads": 1, "device": "cpu"}
    final = {}
    for cameras in (("wrist",), ("wrist", "overview")):
        config = TrainConfig.for_policy("compact_mlp", cameras=cameras, **options)
        final[len(cameras)] = train(dataset, config, tmp_path / str(len(cameras))).final_loss
    assert final[2] < 0.7 * final[1]


def test_every_trajectory_is_read_once_and_reported(dataset, small_config, tmp_path):
    read = []
    train(dataset, small_config, tmp_path, reading=lambda *n: read.append(n))
    assert read == [(1, 4), (2, 4), (3, 4), (4, 4)]
    train(dataset, small_config, tmp_path, reading=lambda *n: read.append(n))
    assert len(read) == 4


# --- same bits ----------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(
    dataset, small_config, tmp_path
):
    first = train(dataset, small_config, tmp_path / "a")
    again = train(dataset, small_config, tmp_path / "b")
    other = train(dataset, dataclasses.replace(small_config, seed=1), tmp_path / "c")
    assert _same_weights(first, again) and _losses(first) == _losses(again)
    assert not _same_weights(first, other)


@pytest.mark.parametrize(
    ("policy", "step"),  # five batches an epoch
    [*(("compact_mlp", step) for step in (1, 5, 6, 10)), ("resnet18_mlp", 6)],
)
def test_an_interrupted_training_ends_with_the_same_bits(
    policy, step, dataset, small_config, tmp_path
):
    if policy != small_config.policy:
        small_config = TrainConfig.for_policy(
            policy, epochs=2, batch_size=8, image_size=32, lr=1e-3, device="cpu", threads=1
        )
    whole = train(dataset, small_config, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        train(dataset, small_config, tmp_path / "cut", progress=_press_ctrl_c_after(step))
    assert (tmp_path / "cut" / CHECKPOINT).exists()
    seen = []
    resumed = train(
        dataset,
        small_config,
        tmp_path / "cut",
        progress=lambda done, total, text: seen.append(done),
    )
    assert seen[0] == step + 1
    assert _same_weights(whole, resumed) and _losses(whole) == _losses(resumed)


def test_a_training_that_was_killed_resumes_from_its_last_checkpoint(
    dataset, small_config, tmp_path, monkeypatch
):
    monkeypatch.setattr(training, "_CHECKPOINT_SECONDS", 0.0)
    whole = train(dataset, small_config, tmp_path / "whole")

    def die(done, total, text):
        if done == 8:
            raise MemoryError

    with pytest.raises(MemoryError):
        train(dataset, small_config, tmp_path / "cut", progress=die)
    assert _same_weights(whole, train(dataset, small_config, tmp_path / "cut"))


def test_a_finished_training_is_not_repeated_unless_asked(dataset, small_config, tmp_path):
    first = train(dataset, small_config, tmp_path)
    steps = []
    again = train(dataset, small_config, tmp_path, progress=lambda *args: steps.append(args))
    assert not steps and _same_weights(first, again) and first.curve == again.curve
    over = train(
        dataset, small_config, tmp_path, progress=lambda *args: steps.append(args), resume=False
    )
    assert len(steps) == 15 and steps[-1][:2] == (15, 15) and "epoch 3/3" in steps[-1][2]
    assert _same_weights(first, over)


def test_settings_of_the_process_are_put_back(dataset, small_config, tmp_path):
    threads, random_state = torch.get_num_threads(), torch.get_rng_state()
    handler = signal.getsignal(signal.SIGINT)
    config = dataclasses.replace(small_config, threads=threads + 1)
    with pytest.raises(KeyboardInterrupt):
        train(dataset, config, tmp_path, progress=_press_ctrl_c_after(2))
    assert torch.get_num_threads() == threads
    assert torch.equal(torch.get_rng_state(), random_state)
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_second_ctrl_c_interrupts_at_once(dataset, small_config, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        train(dataset, small_config, tmp_path, progress=_press_ctrl_c_after(2, presses=2))
    assert not (tmp_path / CHECKPOINT).exists()


def test_other_signals_that_python_handles_also_let_the_step_finish(
    dataset, small_config, tmp_path
):
    class Ended(BaseException):
        pass

    def end(number, frame):
        raise Ended

    def send(done, total, text):
        if done == 7:
            os.kill(os.getpid(), signal.SIGTERM)

    before = signal.signal(signal.SIGTERM, end)
    try:
        with pytest.raises(Ended):
            train(dataset, small_config, tmp_path / "cut", progress=send)
        assert signal.getsignal(signal.SIGTERM) is end
    finally:
        signal.signal(signal.SIGTERM, before)
    seen = []
    resumed = train(
        dataset, small_config, tmp_path / "cut", progress=lambda done, *_: seen.append(done)
    )
    assert seen[0] == 8
    assert _same_weights(train(dataset, small_config, tmp_path / "whole"), resumed)


OPTIONS = {
    "epochs": 3, "batch_size": 8, "image_size": 16, "image_shift": 1, "hidden": 16,
    "device": "cpu", "threads": 1,
}  # fmt: skip


@pytest.mark.parametrize("finished", [True, False])
def test_training_is_overwritten_after_an_interruption_and_resumed_after_another(
    finished, dataset, tmp_path, monkeypatch
):
    # So short a recording is refused otherwise.
    monkeypatch.setattr(pipeline, "_check", lambda *_: None)
    monkeypatch.setattr("sart_toolkit.record.checks.check_recording", lambda *_, **__: None)

    def cut(stage, done, total, text=""):
        if stage == "train" and done == 7:
            raise KeyboardInterrupt

    def train_policy(out, **changed):
        pipeline.train_policy(dataset.path, tmp_path / out, **{**OPTIONS, **changed})
        return load_tensors(tmp_path / out / "model.safetensors")[0]

    out = tmp_path / "cut"
    if finished:
        train_policy("cut", lr=0.1)
    else:
        with pytest.raises(KeyboardInterrupt):
            pipeline.train_policy(
                dataset.path, out, **OPTIONS, lr=0.1, progress=lambda *args: _press(args, 7)
            )
        assert (out / CHECKPOINT).exists()
    # Interrupted before its first checkpoint.
    with pytest.raises(KeyboardInterrupt):
        pipeline.train_policy(dataset.path, out, **OPTIONS, overwrite=True, progress=cut)
    resumed = train_policy("cut")
    whole = train_policy("whole")
    assert all(torch.equal(resumed[name], whole[name]) for name in whole)
    assert sorted(p.name for p in out.iterdir()) == sorted(
        p.name for p in (tmp_path / "whole").iterdir()
    )


def _press(progress, step):
    if progress[:2] == ("train", step):
        os.kill(os.getpid(), signal.SIGINT)


def test_two_processes_do_not_train_in_one_directory(dataset, small_config, tmp_path):
    steps = []
    with OutputLock(tmp_path / "skill"), pytest.raises(CannotWrite, match="another process"):
        pipeline.train_policy(dataset.path, tmp_path / "skill", **OPTIONS, overwrite=True)
    with pytest.raises(CannotWrite, match="another process"):

        def meanwhile(done, total, text):
            steps.append(done)
            OutputLock(tmp_path / "skill")

        train(dataset, small_config, tmp_path / "skill", progress=meanwhile)
    assert steps == [1]


def test_what_a_killed_training_was_writing_is_removed(dataset, small_config, tmp_path):
    left = tmp_path / ".frames.abcd1234.bin"
    left.write_bytes(b"half")
    train(dataset, small_config, tmp_path)
    assert not left.exists()


def test_it_trains_in_a_thread_that_can_not_take_signals(dataset, small_config, tmp_path):
    results = []
    thread = threading.Thread(
        target=lambda: results.append(train(dataset, small_config, tmp_path / "thread"))
    )
    thread.start()
    thread.join()
    assert _same_weights(results[0], train(dataset, small_config, tmp_path / "main"))


# --- options ------------------------------------------------------------------------------------


def test_options_survive_json():
    config = TrainConfig.for_policy(
        "resnet18_mlp", norm="group", seed=3, threads=2, cameras=("wrist", "overview")
    )
    assert TrainConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


def test_resnet18_starts_from_the_papers_table():
    config = TrainConfig.for_policy("resnet18_mlp")
    assert (config.lr, config.weight_decay, config.batch_size) == (1e-5, 1e-4, 32)
    assert (config.epochs, config.history, config.hidden) == (40, 2, 512)
    assert config.schedule == "constant"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("epochs", 0, "epochs: expected a whole number >= 1, got 0"),
        ("batch_size", 1, "batch_size: expected a whole number >= 2, got 1"),
        ("image_size", 8, "image_size: expected a whole number >= 16, got 8"),
        ("image_shift", -1, "image_shift: expected a whole number >= 0"),
        ("image_shift", 17, "image_shift: expected at most a quarter of image_size 64, got 17"),
        ("history", 0, "history: expected a whole number >= 1"),
        ("hidden", 2.5, "hidden: expected a whole number >= 1, got 2.5"),
        ("seed", True, "seed: expected a whole number >= 0, got True"),
        ("threads", 0, "threads: expected a whole number >= 1"),
        ("lr", float("nan"), "lr: expected a finite number > 0, got nan"),
        ("weight_decay", -1e-4, "weight_decay: expected a number >= 0, got -0.0001"),
        ("schedule", "linear", "schedule: expected cosine or constant .* got 'linear'"),
        ("bfloat16", "yes", "bfloat16: expected auto or on or off"),
        ("device", "tpu", "device: expected auto or cpu or cuda"),
        ("cameras", (), r"cameras: expected different names, at least one, got \(\)"),
        ("cameras", ["a", "a"], r"cameras: expected different names, .* got \('a', 'a'\)"),
        ("norm", "batch", "norm: expected none with policy compact_mlp, got 'batch'"),
    ],
)
def test_an_option_out_of_range_is_refused(name, value, message):
    with pytest.raises(InvalidInput, match=message):
        TrainConfig.for_policy("compact_mlp", **{name: value})


def test_an_unknown_option_is_refused_with_the_nearest():
    with pytest.raises(UnknownName, match="unknown training option 'epoch': did you mean 'epochs'"):
        TrainConfig.for_policy("compact_mlp", epoch=3)


def test_a_missing_option_is_refused():
    with pytest.raises(InvalidInput, match="training options: 'epochs' is missing"):
        TrainConfig.from_json({"policy": "compact_mlp"})


def test_the_cosine_schedule_warms_up_and_ends_near_zero(small_config):
    rates = [learning_rate(small_config, step, 1000) for step in range(1000)]
    assert rates[0] == pytest.approx(small_config.lr / 50)
    assert max(rates) == rates[49] == pytest.approx(small_config.lr)
    assert rates[525] == pytest.approx(small_config.lr / 2, rel=1e-3)
    assert 0 < rates[-1] < 1e-5 * small_config.lr + 1e-8
    assert learning_rate(small_config, 0, 1) == small_config.lr


def test_the_constant_schedule_is_constant(small_config):
    config = dataclasses.replace(small_config, schedule="constant")
    assert {learning_rate(config, step, 10) for step in range(10)} == {config.lr}


@pytest.mark.parametrize(
    ("capabilities", "expected"),
    [({}, False), ({"avx512_bf16": True}, True), ({"amx_bf16": True}, True), ({"avx2": 1}, False)],
)
def test_bfloat16_is_chosen_where_the_processor_has_it(monkeypatch, capabilities, expected):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities)
    assert resolve_bfloat16("auto", torch.device("cpu")) is expected
    assert resolve_bfloat16("on", torch.device("cpu")) is True
    assert resolve_bfloat16("off", torch.device("cpu")) is False


def test_cuda_is_refused_where_there_is_none(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert resolve_device("auto") == torch.device("cpu")
    with pytest.raises(InvalidInput, match="device 'cuda': torch finds no CUDA device"):
        resolve_device("cuda")


@pytest.mark.parametrize(
    ("device", "free", "expected"),
    [("cuda", 2.1, True), ("cuda", 1.9, False), ("cpu", 100, False)],
)
def test_a_gpu_holds_the_images_if_half_of_it_does(
    dataset, open_windows, monkeypatch, device, free, expected
):
    windows = open_windows(dataset)
    n_bytes = windows.frames.images["wrist"].nbytes
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (free * n_bytes, 1e12))
    assert training._has_room(torch.device(device), windows) is expected


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_it_trains_and_resumes_on_cuda(policy, dataset, tmp_path):
    config = TrainConfig.for_policy(policy, epochs=3, batch_size=8, lr=1e-3, device="cuda")
    with pytest.raises(KeyboardInterrupt):
        train(dataset, config, tmp_path, progress=_press_ctrl_c_after(7))
    result = train(dataset, config, tmp_path)
    assert result.device == "cuda" and result.final_loss < result.curve[0].loss


# --- what goes wrong ----------------------------------------------------------------------------


def test_a_loss_that_is_not_finite_is_reported(dataset, small_config, tmp_path):
    config = dataclasses.replace(small_config, lr=1e30, schedule="constant")
    with pytest.raises(SartError, match=r"training loss became (nan|inf) in epoch \d; lower lr"):
        train(dataset, config, tmp_path)
    assert not (tmp_path / CHECKPOINT).exists()


@pytest.mark.parametrize(
    ("change", "message"), [({"lr": 0.1, "seed": 5}, "other lr, seed;"), ({"hidden": 8}, "hidden")]
)
def test_a_checkpoint_of_other_options_is_refused(dataset, small_config, tmp_path, change, message):
    train(dataset, small_config, tmp_path)
    with pytest.raises(Mismatch, match=message):
        train(dataset, dataclasses.replace(small_config, **change), tmp_path)


def test_a_checkpoint_may_resume_with_other_threads(dataset, small_config, tmp_path):
    before = train(dataset, small_config, tmp_path)
    after = train(dataset, dataclasses.replace(small_config, threads=2), tmp_path)
    assert after.curve == before.curve


def test_a_checkpoint_of_another_dataset_is_refused(make_dataset, small_config, tmp_path):
    train(make_dataset(seed=0), small_config, tmp_path)
    with pytest.raises(Mismatch, match="was made with other training data"):
        train(make_dataset(seed=1), small_config, tmp_path)


def test_a_checkpoint_of_another_version_is_refused(dataset, small_config, tmp_path):
    train(dataset, small_config, tmp_path)
    tensors, about = load_tensors(tmp_path / CHECKPOINT)
    del tensors["optimizer/0/exp_avg"]
    save_tensors(tmp_path / CHECKPOINT, tensors, about)
    with pytest.raises(Mismatch, match="does not fit this version's compact_mlp"):
        train(dataset, small_config, tmp_path)


def test_a_disk_that_refuses_is_reported_before_training(dataset, small_config, tmp_path):
    (tmp_path / "file").write_text("kept")
    steps = []
    with pytest.raises(CannotWrite, match="is not a directory"):
        train(
            dataset,
            small_config,
            tmp_path / "file" / "skill",
            progress=lambda *args: steps.append(args),
        )
    assert not steps


def test_a_disk_that_fills_up_leaves_the_last_checkpoint_to_resume_from(
    dataset, small_config, tmp_path
):
    with pytest.raises(KeyboardInterrupt):
        train(dataset, small_config, tmp_path / "cut", progress=_press_ctrl_c_after(6))
    before = (tmp_path / "cut" / CHECKPOINT).read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, hard))
    try:
        with pytest.raises(CannotWrite, match="nothing was replaced, make room or choose another"):
            train(dataset, small_config, tmp_path / "cut")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / "cut" / CHECKPOINT).read_bytes() == before
    whole = train(dataset, small_config, tmp_path / "whole")
    assert _same_weights(whole, train(dataset, small_config, tmp_path / "cut"))


def test_training_starts_from_backbone_weights(dataset, tmp_path):
    state = ResNet18().state_dict()
    state["bn1.weight"] = torch.full((64,), 3.0)
    torch.save(state, tmp_path / "weights.pth")
    config = TrainConfig.for_policy(
        "resnet18_mlp",
        epochs=1,
        image_size=32,
        threads=1,
        backbone_weights=str(tmp_path / "weights.pth"),
        device="cpu",
    )
    result = train(dataset, config, tmp_path / "out")
    assert torch.allclose(
        result.policy.state_dict()["encoders.0.resnet.bn1.weight"], state["bn1.weight"], atol=1e-3
    )
