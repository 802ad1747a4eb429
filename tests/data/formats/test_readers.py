"""What others' tools make of our exports: each in an environment of its own, from its package."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sart_toolkit.cli import main
from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.formats.format import trajectories_of
from sart_toolkit.data.formats.lerobot import depth_levels, depth_of_levels
from sart_toolkit.data.formats.video import read_video
from sart_toolkit.tasks import TASKS

pytestmark = pytest.mark.slow

# A Python that has lerobot >= 0.6; it needs Python 3.12 or later and another torch than ours.
LEROBOT_PYTHON = "SART_LEROBOT_PYTHON"
# A Python that has robomimic.
ROBOMIMIC_PYTHON = "SART_ROBOMIMIC_PYTHON"
# What lerobot-doctor says that is so, of few and short episodes of one task.
FACTS = (
    r"zero variance \(constant value",
    r"dimension\(s\) have zero std",
    r"constant across ALL episodes",
    r"extreme outlier\(s\)",
    r"of values at (minimum|maximum)",
    r"stuck/static in ",
    r"episodes shorter than chunk_size=",
    r"is too short for delta_timestamps",
)


@pytest.fixture(scope="session")
def tools(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of an environment with lerobot-doctor and zarr 2."""
    path = tmp_path_factory.mktemp("tools") / "env"
    subprocess.run([sys.executable, "-m", "venv", path], check=True)
    wanted = ["lerobot-doctor==0.2.0", "zarr<3", "numcodecs<0.16"]
    pip = [path / "bin" / "python", "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    done = subprocess.run([*pip, *wanted], capture_output=True, text=True, env=outside())
    if done.returncode:
        pytest.skip(f"{', '.join(wanted)} can't be installed here: {done.stderr[-300:]}")
    return path / "bin"


def outside() -> dict[str, str]:
    """The environment variables, without those that lead to our own packages."""
    return {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}


@pytest.fixture(scope="module")
def dataset_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A dataset of a task, each made once."""
    made: dict[str, Path] = {}

    def dataset_of(task: str) -> Path:
        if task not in made:
            out = made[task] = tmp_path_factory.mktemp(task)
            main(["record", task, "--out", f"{out}/demo.h5", "--image-size", "64"])
            main(["suggest", f"{out}/demo.h5", "--out", f"{out}/demo.json"])
            main(["augment", f"{out}/demo.h5", f"{out}/demo.json", "--out", f"{out}/dataset",
                  "--n", "8"])  # fmt: skip
            main(["export", f"{out}/dataset", "--format", "lerobot", "--out", f"{out}/lerobot"])
        return made[task]

    return dataset_of


@pytest.mark.parametrize("task", TASKS)
def test_lerobot_doctor_finds_no_fault(task, tools, dataset_of):
    folder = dataset_of(task)
    main(["validate", f"{folder}/lerobot", "--format", "lerobot"])
    done = subprocess.run(
        [tools / "lerobot-doctor", "check", folder / "lerobot", "--json"],
        capture_output=True, text=True, env=outside(),
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads(done.stdout)
    said = [m for result in report["checks"] for m in result["messages"]]
    assert len(said) > 10 and not [m for m in said if m["severity"] == "FAIL"]
    warned = [m["message"] for m in said if m["severity"] == "WARN"]
    assert [text for text in warned if not re.search("|".join(FACTS), text)] == []


READ = """
    import json, sys
    import numpy as np
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    dataset = LeRobotDataset("sart/peg", root=sys.argv[1], video_backend="pyav")
    expected = np.load(sys.argv[2])
    worst = {}
    for i, item in enumerate(dataset):
        image = 255 * item["observation.images.wrist"].permute(1, 2, 0).numpy()
        depth = item["observation.images.wrist_depth"][0].numpy()
        found = {"image": image, "depth": depth, "action": item["action"].numpy()}
        for name, value in found.items():
            far = float(np.abs(value - expected[name][i]).max())
            worst[name] = max(worst.get(name, 0.0), far)
        assert item["index"] == i and item["task"] == str(expected["task"])
    print(json.dumps({"n": len(dataset), "episodes": dataset.num_episodes, **worst}))
"""


def test_a_lerobot_reader_draws_every_frame_exactly(dataset_of, tmp_path):
    """Each is the frame that the video has at its place, and depth the one recorded."""
    python = os.environ.get(LEROBOT_PYTHON)
    if python is None:
        pytest.skip(f"{LEROBOT_PYTHON} names no Python that has lerobot >= 0.6")
    folder = dataset_of("peg_in_hole")
    trajectories = list(trajectories_of(load_dataset(folder / "dataset")))
    depth = np.concatenate([t.steps.cameras["wrist"].depth for t in trajectories])
    (video,) = (folder / "lerobot").glob("videos/observation.images.wrist/*/*.mp4")
    info = json.loads((folder / "lerobot/meta/info.json").read_text())
    np.savez(
        tmp_path / "expected.npz",
        image=np.stack(list(read_video(video, "rgb24"))).astype(np.float64),
        depth=np.rint(1e3 * depth_of_levels(depth_levels(depth))),
        action=np.concatenate([t.actions for t in trajectories]),
        task="Lower a 3 cm square peg, fixed to the gripper, into a 5 cm square hole, 4 cm deep",
    )
    found = in_python(python, READ, folder / "lerobot", tmp_path / "expected.npz")
    assert (found["n"], found["episodes"]) == (info["total_frames"], 8)
    assert found["depth"] <= 1 and found["action"] < 1e-6
    # Another version of FFmpeg may round a colour otherwise.
    assert found["image"] <= 2


ROBOMIMIC = """
    import json, sys
    import numpy as np
    import robomimic.utils.file_utils as files
    import robomimic.utils.obs_utils as observations
    from robomimic.utils.dataset import SequenceDataset
    keys = ["robot0_gripper_qpos", "wrist_image"]
    specs = {"low_dim": keys[:1], "rgb": keys[1:]}
    observations.initialize_obs_utils_with_obs_specs([{"obs": specs}])
    env = files.get_env_metadata_from_dataset(sys.argv[1])
    datasets = [
        SequenceDataset(
            hdf5_path=sys.argv[1], obs_keys=keys, dataset_keys=["actions", "rewards", "dones"],
            frame_stack=2, seq_length=10, load_next_obs=False, hdf5_cache_mode="low_dim",
            filter_by_attribute=name,
        )
        for name in (None, "generated")
    ]
    every = (datasets[0][i] for i in range(len(datasets[0])))
    most = max(float(np.abs(item["actions"]).max()) for item in every)
    shape = datasets[0][3]["obs"]["wrist_image"].shape
    print(json.dumps({"env": env["env_name"], "n": [len(d) for d in datasets], "most": most,
                      "shape": shape}))
"""


def test_robomimic_reads_its_file_for_training(dataset_of, tmp_path):
    python = os.environ.get(ROBOMIMIC_PYTHON)
    if python is None:
        pytest.skip(f"{ROBOMIMIC_PYTHON} names no Python that has robomimic")
    folder = dataset_of("peg_in_hole")
    main(["export", f"{folder}/dataset", "--format", "robomimic", "--out", f"{tmp_path}/a.hdf5"])
    lengths = [len(t) for t in trajectories_of(load_dataset(folder / "dataset"))]
    found = in_python(python, ROBOMIMIC, tmp_path / "a.hdf5")
    assert found["env"] == "sart/PegInHole-v0" and found["most"] <= 1
    assert found["n"] == [sum(lengths), sum(lengths[1:])]
    assert found["shape"] == [11, 64, 64, 3]


ZARR = """
    import json, sys
    import numpy as np, zarr
    root = zarr.open(sys.argv[1], "r")
    expected = np.load(sys.argv[2])
    ends = root["meta"]["episode_ends"][:]
    assert all(value.shape[0] == ends[-1] for _, value in root["data"].items())
    same = {name: bool(np.array_equal(root["data"][name][:], expected[name])) for name in expected}
    print(json.dumps({"ends": ends.tolist(), "version": zarr.__version__, **same}))
"""


def test_zarr_reads_the_replay_buffer(tools, dataset_of, tmp_path):
    folder = dataset_of("peg_in_hole")
    main(["export", f"{folder}/dataset", "--format", "zarr", "--out", f"{tmp_path}/a.zarr"])
    trajectories = list(trajectories_of(load_dataset(folder / "dataset")))
    np.savez(
        tmp_path / "expected.npz",
        action=np.concatenate([t.actions for t in trajectories]).astype(np.float32),
        wrist_rgb=np.concatenate([t.steps.cameras["wrist"].rgb for t in trajectories]),
        wrist_depth=np.concatenate([t.steps.cameras["wrist"].depth for t in trajectories]),
    )
    found = in_python(tools / "python", ZARR, tmp_path / "a.zarr", tmp_path / "expected.npz")
    assert found.pop("version").startswith("2.")
    assert found.pop("ends") == np.cumsum([len(t) for t in trajectories]).tolist()
    assert found == {"action": True, "wrist_rgb": True, "wrist_depth": True}


def in_python(python: Path | str, code: str, *arguments: Path) -> Any:
    """The JSON that a program prints in another Python."""
    done = subprocess.run(
        [python, "-c", textwrap.dedent(code), *arguments],
        capture_output=True, text=True, env=outside(),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.strip().splitlines()[-1])
