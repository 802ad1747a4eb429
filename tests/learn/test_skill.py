import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch

from sart_toolkit.data import storage
from sart_toolkit.data.schemas import TrainingFile
from sart_toolkit.data.writer import write_dataset
from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, MissingFile, OutputExists
from sart_toolkit.learn.policy import Policy, PolicySetup
from sart_toolkit.learn.samples import FRAMES
from sart_toolkit.learn.skill import Skill, SkillConfig, load_skill, save_skill
from sart_toolkit.learn.skillfiles import write_config
from sart_toolkit.learn.tensorfile import load_tensors, save_tensors
from sart_toolkit.learn.training import CHECKPOINT, train
from sart_toolkit.poses import up_in_tool

# The tool points down.
UP = (0.0, 0.0, -1.0)


@pytest.fixture
def trained(dataset, small_config, tmp_path):
    result = train(dataset, small_config, tmp_path / "skill")
    save_skill(tmp_path / "skill", result, dataset)
    return tmp_path / "skill", result


def _edit(path, **changes):
    value = json.loads(path.read_text())
    value.update(changes)
    value = {k: v for k, v in value.items() if v is not None}
    path.write_text(json.dumps(storage.with_seal(value)))


def test_a_skill_is_the_files_of_the_design(trained):
    path, result = trained
    assert sorted(p.name for p in path.iterdir()) == [
        "annotation.json",
        "config.json",
        "demo.h5",
        "model.safetensors",
        "training.json",
    ]
    training = storage.read_json(path / "training.json", TrainingFile)
    assert [record["epoch"] for record in training["curve"]] == [1, 2, 3]
    assert training["final_loss"] == result.final_loss
    assert training["images_per_second"] > 0 and training["seconds"] > 0
    assert training["versions"]["torch"] == torch.__version__
    assert training["config"] == result.config.to_json()
    assert (training["windows"], training["trajectories"]) == (35, 4)


def test_a_skill_of_demonstrations_alone_has_no_annotation(dataset, small_config, tmp_path):
    sources = [(dataset.sources[0].demonstration, None)]
    alone = write_dataset(tmp_path / "data", sources, [], {})
    # One with an annotation stood here before.
    save_skill(tmp_path / "skill", train(dataset, small_config, tmp_path / "skill"), dataset)
    result = train(alone, small_config, tmp_path / "skill", resume=False)
    save_skill(tmp_path / "skill", result, alone, overwrite=True)
    assert not (tmp_path / "skill" / "annotation.json").exists()
    skill = load_skill(tmp_path / "skill")
    assert skill.annotation is None
    assert skill.demonstration.content_hash() == alone.sources[0].demonstration_hash


def _images(steps, t):
    return {name: camera.rgb[t] for name, camera in steps.cameras.items()}


@pytest.mark.parametrize("cameras", [("wrist",), ("overview", "wrist")])
def test_a_skill_acts_as_the_policy_did_in_training(
    two_cameras, small_config, open_windows, tmp_path, cameras
):
    config = dataclasses.replace(small_config, cameras=cameras)
    result = train(two_cameras, config, tmp_path)
    save_skill(tmp_path, result, two_cameras)
    skill = load_skill(tmp_path)
    assert skill.cameras == cameras
    windows = open_windows(two_cameras, cameras=cameras)
    steps = two_cameras.sources[0].demonstration.steps
    for _ in range(2):
        skill.reset()
        for t in range(len(steps)):
            at = windows.history.tolist().index([max(0, t - 1), t])
            with torch.inference_mode():
                expected = result.policy.predict(windows.batch(torch.tensor([at])))[0].numpy()
            action = skill.act(
                _images(steps, t),
                float(steps.measured_gripper[t]),
                up_in_tool(steps.measured_Ts_world_tool[t]),
            )
            assert action.shape == (7,) and action.dtype == np.float64
            assert np.allclose(action[:6], expected[:6], atol=1e-7)
            # Shown only open or closed, so commanded so.
            assert action[6] == round(float(expected[6]))


@pytest.mark.parametrize("few", [True, False])
def test_the_gripper_is_commanded_as_was_shown_unless_that_was_much(trained, dataset, few):
    demonstration = dataset.sources[0].demonstration
    demo = np.linspace(0, 0.8, 3 if few else len(demonstration.steps))
    commands = np.resize(demo, len(demonstration.steps))
    steps = dataclasses.replace(demonstration.steps, commanded_gripper=commands)
    skill = load_skill(trained[0])
    other = dataclasses.replace(demonstration, steps=steps)
    skill = Skill(skill._policy, skill.config, other, skill.annotation, skill.training)
    commanded = {
        skill.act({"wrist": rgb}, gripper, UP)[6]
        for rgb, gripper in zip(
            demonstration.steps.cameras["wrist"].rgb, np.linspace(0, 1, len(steps)), strict=True
        )
    }
    assert (commanded <= set(demo)) == few


class _Spy(Policy):
    """Remembers what it observes; predicts chunks of three actions."""

    def __init__(self, setup):
        super().__init__(setup)
        self.seen, self.n_resets = [], 0
        self.predicted = torch.arange(21.0).reshape(1, 3, 7)

    def loss(self, batch):
        raise NotImplementedError

    def predict(self, observation):
        self.seen.append(observation)
        return self.predicted

    def reset(self):
        self.n_resets += 1


@pytest.fixture
def spied(trained):
    skill = load_skill(trained[0])
    spy = _Spy(PolicySetup(skill.config.image_sizes, 2, 8, "none"))
    return Skill(spy, skill.config, skill.demonstration, skill.annotation, skill.training), spy


def test_a_policy_sees_images_gripper_and_tilt_and_nothing_else(spied):
    skill, spy = spied
    skill.act({"wrist": np.zeros((32, 32, 3), np.uint8)}, 0.25, UP)
    (seen,) = spy.seen
    assert {name: tuple(tensor.shape) for name, tensor in seen.items()} == {
        "images/wrist": (1, 2, 3, 16, 16),
        "gripper": (1, 2),
        "up": (1, 3),
    }
    assert seen["gripper"].tolist() == [[0.25, 0.25]]


@pytest.mark.parametrize("threads", [1, 3])
def test_a_policy_acts_with_one_thread_and_leaves_torch_s_alone(spied, monkeypatch, threads):
    skill, spy = spied
    seen = []
    predict = spy.predict

    def counting(observation):
        seen.append(torch.get_num_threads())
        return predict(observation)

    monkeypatch.setattr(spy, "predict", counting)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        skill.act({"wrist": np.zeros((32, 32, 3), np.uint8)}, 0.25, UP)
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert seen == [1]


def test_a_chunk_is_executed_before_the_policy_is_asked_again(spied):
    skill, spy = spied
    for step in range(4):
        image = np.full((32, 32, 3), step, np.uint8)
        action = skill.act({"wrist": image}, step / 10, UP)
        assert action[:6].tolist() == [7.0 * (step % 3) + i for i in range(6)]
    assert len(spy.seen) == 2
    # What was seen meanwhile is part of the history.
    assert spy.seen[1]["gripper"].tolist() == [[pytest.approx(0.2), pytest.approx(0.3)]]
    assert spy.seen[1]["images/wrist"][0, :, 0, 0, 0].tolist() == [2, 3]


def test_a_reset_ends_the_chunk_and_reaches_the_policy(spied):
    skill, spy = spied
    image = np.zeros((32, 32, 3), np.uint8)
    skill.act({"wrist": image}, 0.0, UP)
    skill.reset()
    skill.act({"wrist": image}, 1.0, UP)
    assert len(spy.seen) == 2 and spy.n_resets == 1
    assert spy.seen[1]["gripper"].tolist() == [[1.0, 1.0]]


@pytest.mark.parametrize(
    ("predicted", "message"),
    [
        (torch.zeros(1, 6), r"predicted actions: expected shape \('n', 7\), got \(1, 6\)"),
        (torch.zeros(7), r"predicted actions: expected shape \('n', 7\), got \(1, 1\)"),
        (torch.zeros(1, 0, 7), "predicted actions: expected at least one, got none"),
        (torch.full((1, 7), torch.nan), "predicted actions: has NaN"),
    ],
)
def test_a_policy_that_predicts_no_actions_is_refused(spied, predicted, message):
    skill, spy = spied
    spy.predicted = predicted
    with pytest.raises(InvalidInput, match=message):
        skill.act({"wrist": np.zeros((32, 32, 3), np.uint8)}, 0.0, UP)


def test_a_skill_takes_images_of_any_size(trained):
    skill = load_skill(trained[0])
    rgb = np.full((32, 32, 3), 90, np.uint8)
    first = skill.act({"wrist": rgb}, 0.5, UP)
    skill.reset()
    assert np.allclose(skill.act({"wrist": np.full((48, 20, 3), 90, np.uint8)}, 0.5, UP), first)


def test_a_skill_says_where_it_came_from(trained, dataset):
    skill = load_skill(trained[0])
    assert skill.demonstration.content_hash() == dataset.sources[0].demonstration.content_hash()
    assert skill.annotation.demonstration_hash == dataset.sources[0].annotation.demonstration_hash
    config = skill.config
    assert (config.task, config.robot, config.backend) == ("blob", "none", "synthetic")
    assert list(config.cameras) == ["wrist"] and config.cameras["wrist"].size == (32, 32)
    assert np.allclose(config.cameras["wrist"].T_frame_camera[:3, 3], [0.05, 0, -0.1])
    assert dict(config.task_parameters) == {"gain": 0.01}
    assert SkillConfig.from_json(config.to_json()).to_json() == config.to_json()


@pytest.mark.parametrize(
    "rgb",
    [
        np.zeros((8, 8, 3)),
        np.zeros((8, 8), np.uint8),
        np.zeros((8, 8, 4), np.uint8),
        np.zeros((0, 8, 3), np.uint8),
    ],
)
def test_anything_but_an_image_is_refused(trained, rgb):
    with pytest.raises(InvalidInput, match=r"image of camera 'wrist': expected uint8 of shape \("):
        load_skill(trained[0]).act({"wrist": rgb}, 0.0, UP)


def test_a_missing_cameras_image_is_refused(trained):
    with pytest.raises(InvalidInput, match="expected one of camera 'wrist', got overview"):
        load_skill(trained[0]).act({"overview": np.zeros((8, 8, 3), np.uint8)}, 0.0, UP)


def test_a_gripper_that_is_not_a_number_is_refused(trained):
    with pytest.raises(InvalidInput, match=r"gripper: expected a number in \[0, 1\], got nan"):
        load_skill(trained[0]).act({"wrist": np.zeros((8, 8, 3), np.uint8)}, float("nan"), UP)
    with pytest.raises(InvalidInput, match="up: expected a unit vector in the tool frame"):
        load_skill(trained[0]).act({"wrist": np.zeros((8, 8, 3), np.uint8)}, 0.0, (0.0, 0.0, 0.0))


def test_a_skill_is_not_overwritten_unless_asked(trained, dataset):
    path, result = trained
    with pytest.raises(OutputExists, match="config.json: already exists"):
        save_skill(path, result, dataset)
    save_skill(path, result, dataset, overwrite=True)
    load_skill(path)


def test_saving_a_skill_ends_its_checkpoint_and_frames(dataset, small_config, tmp_path):
    result = train(dataset, small_config, tmp_path)
    assert (tmp_path / CHECKPOINT).exists() and (tmp_path / FRAMES).exists()
    save_skill(tmp_path, result, dataset)
    assert not (tmp_path / CHECKPOINT).exists() and not (tmp_path / FRAMES).exists()


def test_a_missing_directory_is_refused(tmp_path):
    with pytest.raises(MissingFile, match="no such skill directory; make it with `sart train`"):
        load_skill(tmp_path / "none")


@pytest.mark.parametrize(
    "name", ["config.json", "training.json", "demo.h5", "annotation.json", "model.safetensors"]
)
def test_a_skill_that_lacks_a_file_is_refused(trained, name):
    (trained[0] / name).unlink()
    with pytest.raises(MissingFile, match=name):
        load_skill(trained[0])


@pytest.mark.parametrize(
    "name", ["config.json", "training.json", "demo.h5", "annotation.json", "model.safetensors"]
)
def test_a_truncated_file_is_refused(trained, name):
    path = trained[0] / name
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(BrokenFile, match=name):
        load_skill(trained[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": None}, "skill configuration: 'robot' is missing"),
        ({"colour": "red"}, "skill configuration: 'colour' is unknown"),
        ({"cameras": {}}, "cameras: expected wrist as in training, got none"),
        ({"cameras": {"wrist": {"size": [4, 5]}}}, "camera 'wrist' .* 'T_frame_camera' is missing"),
        ({"cameras": 3}, "config.json: .*Expected `object`, got `int` - at `\\$.cameras`"),
        ({"cameras": {"wrist": 3}}, "camera 'wrist' .*: expected values by name, got 3"),
        ({"training": {"policy": "compact_mpl"}}, "training options: 'epochs' is missing"),
        ({"training": 3}, "config.json"),
    ],
)
def test_a_configuration_that_makes_no_sense_is_refused(trained, change, message):
    _edit(trained[0] / "config.json", **change)
    with pytest.raises(BrokenFile, match=message):
        load_skill(trained[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": (32,)}, r"size: expected \(height, width\) \[pixels\], got \(32,\)"),
        ({"size": (0, 5)}, r"size: expected \(height, width\) \[pixels\], got \(0, 5\)"),
        ({"intrinsics": [[1]]}, "intrinsics: expected shape"),
        ({"T_frame_camera": 2 * np.eye(4)}, "T_frame_camera: not a rigid transform"),
    ],
)
def test_a_camera_is_checked_when_made(trained, change, message):
    camera = load_skill(trained[0]).config.cameras["wrist"]
    with pytest.raises(InvalidInput, match=message):
        dataclasses.replace(camera, **change)


@pytest.mark.parametrize(
    "name", ["demo.h5", "annotation.json", "training.json", "model.safetensors"]
)
def test_files_of_different_skills_are_refused(trained, make_dataset, small_config, tmp_path, name):
    other = make_dataset(seed=7)
    save_skill(tmp_path / "other", train(other, small_config, tmp_path / "other"), other)
    shutil.copy(tmp_path / "other" / name, trained[0] / name)
    with pytest.raises(Mismatch, match=f"{name}: (belongs to another demo|isn't the one that)"):
        load_skill(trained[0])


def test_weights_of_another_training_are_refused(trained, dataset, small_config, tmp_path):
    wide = dataclasses.replace(small_config, hidden=24)
    save_skill(tmp_path / "wide", train(dataset, wide, tmp_path / "wide"), dataset)
    shutil.copy(tmp_path / "wide" / "model.safetensors", trained[0] / "model.safetensors")
    with pytest.raises(Mismatch, match="model.safetensors: isn't the one that config.json was"):
        load_skill(trained[0])


def _write_weights(path, tensors):
    """Weights in a skill, with hashes that fit."""
    save_tensors(path / "model.safetensors", tensors, {})
    config = storage.read_json(path / "config.json", dict)
    del config["files"]
    write_config(path, config)


def test_weights_that_do_not_fit_the_policy_are_refused(trained):
    _write_weights(trained[0], {"weight": torch.zeros(3)})
    with pytest.raises(Mismatch, match="does not fit the policy in config.json"):
        load_skill(trained[0])


def test_weights_that_are_no_finite_numbers_are_neither_saved_nor_loaded(
    trained, dataset, tmp_path
):
    path, result = trained
    tensors, _ = load_tensors(path / "model.safetensors")
    name = next(name for name, tensor in tensors.items() if tensor.is_floating_point())
    for value in (torch.nan, torch.inf):
        tensors[name].reshape(-1)[0] = value
        _write_weights(path, tensors)
        with pytest.raises(BrokenFile, match=f"weight '{name}' has NaN or infinite values"):
            load_skill(path)
        with torch.no_grad():
            next(result.policy.parameters()).fill_(value)
        with pytest.raises(InvalidInput, match="has NaN or infinite values, so it can't be saved"):
            save_skill(tmp_path / "new", result, dataset)
    assert not (tmp_path / "new" / "config.json").exists()


def test_one_flipped_bit_of_a_weight_is_refused(trained):
    path = trained[0] / "model.safetensors"
    whole = path.read_bytes()
    start = 8 + int.from_bytes(whole[:8], "little")
    for at in np.linspace(start, len(whole) - 1, 40).astype(int):
        flipped = bytearray(whole)
        flipped[at] ^= 0x40
        path.write_bytes(flipped)
        with pytest.raises(BrokenFile, match="model.safetensors: content differs from its hash"):
            load_skill(trained[0])


@pytest.mark.parametrize("name", ["config.json", "training.json"])
def test_a_changed_number_in_a_skill_s_json_is_refused(trained, name):
    value = json.loads((trained[0] / name).read_text())
    inside, key = (value, "seconds") if name == "training.json" else (value["training"], "epochs")
    inside[key] += 1
    (trained[0] / name).write_text(json.dumps(value))
    with pytest.raises(BrokenFile, match=f"{name}: content differs from its hash"):
        load_skill(trained[0])


def test_an_annotation_that_was_edited_after_training_is_refused(trained):
    path = trained[0] / "annotation.json"
    value = json.loads(path.read_text())
    value["spheres"][0]["radius_m"] *= 2
    path.write_text(json.dumps(value))
    with pytest.raises(Mismatch, match="annotation.json: isn't the one that config.json was"):
        load_skill(trained[0])
