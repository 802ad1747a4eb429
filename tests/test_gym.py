"""Every task as a Gymnasium environment."""

from __future__ import annotations

import gc
import subprocess
import sys
import weakref
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sart_toolkit import gym
from sart_toolkit.backends import BACKENDS, get_backend
from sart_toolkit.backends.interface import Resets
from sart_toolkit.errors import InvalidInput, MissingCapability, UnknownName
from sart_toolkit.learn.skill import load_skill, save_skill
from sart_toolkit.learn.training import TrainConfig, train
from sart_toolkit.tasks import TASKS
from sart_toolkit.tasks.task import Placement

MIDDLE = {"placement": Placement()}
CELLS = [
    pytest.param(task, backend, marks=[] if backend == "pybullet" else [pytest.mark.slow])
    for backend in BACKENDS
    for task in TASKS
]


@pytest.fixture(autouse=True)
def _nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows open on a display that isn't there."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.fixture
def env() -> Iterator[gym.SartEnv]:
    made = gym.SartEnv("peg_in_hole", image_size=48)
    yield made
    made.close()


def same(a: Any, b: Any) -> bool:
    """Whether two observations are equal to the bit."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return bool(np.array_equal(a, b))


def test_every_task_has_an_id():
    assert [gym.env_id(task) for task in TASKS][:2] == ["sart/PegInHole-v0", "sart/DoorOpening-v0"]
    assert all(gym.env_id(task) in gymnasium.registry for task in TASKS)


@pytest.mark.parametrize(("task", "backend"), CELLS)
def test_gymnasium_s_own_check_finds_nothing(task, backend):
    """A warning of it would be an error here."""
    env = gymnasium.make(gym.env_id(task), backend=backend, image_size=48, render_mode="rgb_array")
    check_env(env.unwrapped)


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("task", TASKS)
def test_a_thousand_random_steps_stay_within_the_spaces(task, backend):
    env = gymnasium.make(gym.env_id(task), backend=backend, image_size=48)
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    episodes = 0
    for _ in range(1000):
        assert observation in env.observation_space
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert (reward == 1.0) == info["is_success"]
        if terminated or truncated:
            assert info["is_success"] or info["reason"]
            observation, _ = env.reset()
            episodes += 1
    assert episodes > 0
    env.close()


def test_the_demonstration_s_actions_lead_to_success(env, peg_demonstration):
    observation, info = env.reset(options=MIDDLE)
    assert not info["is_success"] and info["placement"] == {"x": 0, "y": 0, "yaw_deg": 0}
    camera = peg_demonstration.steps.cameras["wrist"].rgb[0]
    assert np.array_equal(observation["pixels"]["wrist"], camera)
    rewards = []
    for action in peg_demonstration.actions:
        observation, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
        if terminated:
            break
    assert terminated and not truncated and info["is_success"] and info["goal_reached"]
    assert rewards == [0.0] * (len(rewards) - 1) + [1.0]
    assert len(rewards) > 0.8 * len(peg_demonstration)


def test_the_same_seed_gives_the_same_episode_whatever_was_before(env):
    def episode(seed: int, n: int) -> list[Any]:
        first, info = env.reset(seed=seed)
        env.action_space.seed(seed)
        rows = [(first, info["placement"])]
        for _ in range(n):
            seen, reward, *_, info = env.step(0.2 * env.action_space.sample())
            rows.append((seen, reward))
        return rows

    once = episode(3, 12)
    other = episode(4, 7)
    again = episode(3, 12)
    assert all(same(a[0], b[0]) and a[1] == b[1] for a, b in zip(once, again, strict=True))
    assert once[0][1] != other[0][1]
    # Without a seed the next placement is another one.
    assert env.reset()[1]["placement"] != once[0][1]


def test_a_skill_is_a_policy(peg_dataset, tmp_path, env):
    config = TrainConfig.for_policy(
        "compact_mlp", epochs=1, image_size=32, batch_size=16, hidden=16, threads=1, device="cpu"
    )
    save_skill(tmp_path, train(peg_dataset, config, tmp_path), peg_dataset)
    skill = load_skill(tmp_path)
    observation, _ = env.reset(seed=0)
    skill.reset()
    acted = skill(observation)
    skill.reset()
    gripper, _, *up = observation["agent_pos"]
    direct = skill.act(observation["pixels"], float(gripper), up)
    assert np.array_equal(acted, direct) and acted.shape == (7,)
    assert len(env.step(acted)) == 5


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_several_run_side_by_side(mode):
    envs = gymnasium.make_vec(
        "sart/PegInHole-v0", num_envs=2, vectorization_mode=mode, image_size=48
    )
    observation, _ = envs.reset(seed=5)
    assert observation["pixels"]["wrist"].shape == (2, 48, 48, 3)
    assert observation["agent_pos"].shape == (2, 5)
    *_, info = envs.step(np.zeros((2, 7), np.float32))
    assert info["is_success"].tolist() == [False, False]
    envs.close()


def test_it_is_cut_off_at_the_horizon_and_says_why(env):
    env.reset(seed=0)
    still = np.array([0, 0, 0, 0, 0, 0, 0.67], np.float32)
    ends = []
    while not any(ends[-1:]):
        *_, terminated, truncated, info = env.step(still)
        assert not terminated
        ends.append(truncated)
    assert len(ends) == 150
    assert "mm" in info["reason"]


def test_steered_out_of_reach_it_ends(env):
    env.reset(options=MIDDLE)
    away = np.array([0, 0, -0.06, 0, 0, 0, 0.67], np.float32)
    for _ in range(150):
        observation, reward, terminated, *_, info = env.step(away)
        if terminated:
            break
    assert terminated and not info["is_success"] and reward == 0.0
    assert info["reason"].startswith("steered out of reach")
    assert observation in env.observation_space


def test_images_of_several_cameras_and_from_outside():
    env = gym.SartEnv(
        "peg_in_hole", cameras=["wrist", "overview"], image_size=(64, 48), render_mode="rgb_array"
    )
    observation, _ = env.reset(seed=0)
    assert {name: image.shape for name, image in observation["pixels"].items()} == {
        "wrist": (48, 64, 3),
        "overview": (48, 64, 3),
    }
    picture = env.render()
    assert picture is not None and picture.shape == (384, 384, 3) and picture.std() > 10
    env.close()


def test_a_person_sees_it_in_a_window(monkeypatch):
    env = gym.SartEnv("peg_in_hole", image_size=48, render_mode="human")
    env.reset(seed=0)
    env.step(np.array([0, 0, 0.01, 0, 0, 0, 0.67]))
    assert env.render() is None
    from sart_toolkit.record.screen import start_sdl

    window = start_sdl().display.get_surface()
    assert window is not None
    width, height = window.get_size()
    scene, nothing = (
        window.get_at((width // 4, height // 2)),
        window.get_at((width - 2, height - 2)),
    )
    assert scene[:3] != nothing[:3]
    env.close()
    assert start_sdl().display.get_surface() is None


def test_varied_appearance_differs_from_episode_to_episode():
    env = gym.SartEnv("peg_in_hole", image_size=48, vary_appearance=True)
    first, _ = env.reset(seed=1, options=MIDDLE)
    second, _ = env.reset(options=MIDDLE)
    again, _ = env.reset(seed=1, options=MIDDLE)
    assert not same(first, second) and same(first, again)
    env.close()


def test_closing_frees_the_simulator():
    env = gym.SartEnv("peg_in_hole", image_size=48)
    env.reset(seed=0)
    backend = weakref.ref(env._backend)
    env.close()
    env.close()
    gc.collect()
    assert backend() is None
    for use in (env.reset, lambda: env.step(np.zeros(7)), lambda: env._drawn()):
        with pytest.raises(InvalidInput, match="was closed; make another"):
            use()


def test_what_can_not_be_is_refused(env):
    with pytest.raises(InvalidInput, match="wasn't reset; call reset first"):
        env.step(np.zeros(7))
    with pytest.raises(InvalidInput, match="wasn't reset; call reset first"):
        env._drawn()
    with pytest.raises(InvalidInput, match=r"options: expected placement alone, got \['where'\]"):
        env.reset(options={"where": 1})
    with pytest.raises(InvalidInput, match="placement: expected x, y, yaw_deg"):
        env.reset(options={"placement": {"z": 1}})
    env.reset(options={"placement": {"x": 0.01}})
    with pytest.raises(InvalidInput, match="action"):
        env.step(np.full(7, np.nan))
    with pytest.raises(InvalidInput, match="render_mode: expected one of"):
        gym.SartEnv("peg_in_hole", render_mode="ansi")
    with pytest.raises(InvalidInput, match="yaw_deg"):
        gym.SartEnv("peg_in_hole", yaw_deg=90.0)
    with pytest.raises(UnknownName, match="camera"):
        gym.SartEnv("peg_in_hole", cameras=["wirst"])


def test_a_backend_that_knows_no_bodies_is_refused(limited):
    base = type(limited(get_backend("pybullet")(*_peg(), 48), Resets))

    class Alone(base):  # type: ignore[misc, valid-type]
        def __init__(self, *args: Any) -> None:
            super().__init__(get_backend("pybullet")(*args))

    with pytest.raises(MissingCapability, match="lacks the ability KnowsBodies, but the success"):
        gym.SartEnv("peg_in_hole", backend=Alone)


def _peg() -> tuple[Any, Any]:
    from sart_toolkit.robots import get_robot
    from sart_toolkit.tasks import get_task

    task = get_task("peg_in_hole")
    return get_robot(task.robot), task.scene


def test_without_gymnasium_it_says_what_to_install():
    code = "import sys; sys.modules['gymnasium'] = None; import sart_toolkit.gym"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "pip install 'sart_toolkit[gym]'" in said.stderr.strip().splitlines()[-1]
