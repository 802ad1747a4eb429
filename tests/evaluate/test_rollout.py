from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image as PillowImage

from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.data.schemas import EvaluationFile
from sart_toolkit.data.storage import read_json
from sart_toolkit.errors import (
    CannotWrite,
    InvalidInput,
    Mismatch,
    MissingFile,
    OutputExists,
    SartError,
)
from sart_toolkit.evaluate import rollout as module
from sart_toolkit.evaluate.rollout import (
    EvaluateConfig,
    episode_placement,
    evaluate_skill,
    run_rollout,
)
from sart_toolkit.evaluate.statistics import wilson_interval
from sart_toolkit.learn.skill import save_skill
from sart_toolkit.learn.training import TrainConfig, train
from sart_toolkit.scenes.appearance import AppearanceConfig
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement

STILL = np.append(np.zeros(6), 0.67)


class Player:
    """A made-up skill: plays actions whatever it sees, then holds still."""

    def __init__(self, actions=()):
        self.actions = [np.array(action) for action in actions]
        self.config = SimpleNamespace(robot="ur5e_2f85", training=SimpleNamespace(policy="player"))
        self.cameras = ("wrist",)
        steps = SimpleNamespace(measured_Ts_world_tool=np.eye(4)[None], measured_gripper=np.ones(1))
        self.demonstration = SimpleNamespace(rates=DEFAULT_RATES, task_parameters={}, steps=steps)
        self.seen = []

    def reset(self):
        self.seen = []

    def act(self, images, gripper, up):
        self.seen.append((images["wrist"], gripper))
        at = len(self.seen) - 1
        return self.actions[at] if at < len(self.actions) else STILL


@pytest.fixture(scope="module")
def replay(peg_demonstration):
    """The demonstration's own actions, as good as they are where it was shown."""
    return Player(peg_demonstration.actions)


@pytest.fixture
def roll_out(peg_backend, peg_model, peg_task):
    def roll_out(skill, placement=None, task=None, **options):
        return run_rollout(
            skill, task or peg_task, peg_backend, peg_model, placement or Placement(), **options
        )

    return roll_out


# --- one rollout --------------------------------------------------------------------------------


def test_replaying_the_demonstration_where_it_was_shown_succeeds(
    roll_out, replay, peg_task, peg_demonstration
):
    result = roll_out(replay, seed=(5, 3))
    assert result.success and result.success_any and result.reason is None
    assert (result.episode, result.seed) == (3, (5, 3))
    first = int(np.argmax(peg_demonstration.success))
    assert result.steps == pytest.approx(first + peg_task.hold * DEFAULT_RATES.record_hz - 1, abs=2)


def test_a_rollout_ends_as_soon_as_success_has_lasted(roll_out, replay):
    watched = []
    result = roll_out(replay, watch=lambda *seen: watched.append(seen))
    held = [success for _, step, success in watched if step > 0]
    first = held.index(True)
    assert held == [False] * first + [True] * 10
    assert [step for _, step, _ in watched][-result.steps :] == list(range(1, result.steps + 1))


def test_how_long_success_must_last_is_the_task_s(roll_out, replay):
    task = get_task("peg_in_hole")
    task.hold = 0.3
    assert roll_out(replay, task=task).steps == roll_out(replay).steps - 7


def test_replaying_the_demonstration_elsewhere_fails_and_says_by_how_much(roll_out, replay):
    result = roll_out(replay, Placement(0.045, -0.045))
    assert not result.success and not result.success_any
    assert re.match(r"peg 4\d mm beside the hole's axis, tip", result.reason)


def test_a_rollout_ends_at_the_horizon_with_the_failure_reason(roll_out):
    task = get_task("peg_in_hole")
    task.horizon = 1.2
    result = roll_out(Player(), task=task)
    assert result.steps == 12 and not result.success
    assert "125 mm" in result.reason


def test_success_that_does_not_last_is_counted_apart(roll_out, peg_demonstration):
    first = int(np.argmax(peg_demonstration.success)) + 2
    up = np.append([0, 0, -0.01, 0, 0, 0], 0.67)
    task = get_task("peg_in_hole")
    task.horizon = first / DEFAULT_RATES.record_hz + 1.5
    result = roll_out(Player([*peg_demonstration.actions[:first], *[up] * 30]), task=task)
    assert result.success_any and not result.success
    assert "peg" in result.reason
    assert result.to_json("block")["outcome"] == "failure"
    assert result.to_json("block")["success_any"] is True


def test_success_at_the_last_steps_alone_is_a_failure_that_says_so(roll_out, replay, peg_task):
    """The horizon ends while the goal has been reached for less than the task's hold."""
    watched = []
    whole = roll_out(replay, watch=lambda *seen: watched.append(seen))
    for n_held in (1, 9, 10):
        task = get_task("peg_in_hole")
        task.horizon = (whole.steps - 10 + n_held) / DEFAULT_RATES.record_hz
        result = roll_out(replay, task=task)
        assert result.success_any and result.success is (n_held == 10)
        expected = f"goal reached only for the last {n_held / 10:g} s, not for 1 s"
        assert result.reason == (None if result.success else expected)


@pytest.mark.parametrize("n_held", [1, 9])
def test_a_sequence_shorter_than_the_hold_is_no_success(peg_task, n_held):
    assert not peg_task.achieved(np.ones(n_held, bool))
    assert not peg_task.achieved(np.zeros(0, bool))
    assert peg_task.achieved(np.ones(10, bool))


def test_steering_out_of_reach_ends_the_rollout_with_that_reason(roll_out, peg_model):
    away = peg_model.fk(peg_model.spec.home)[:3, :3].T @ [0.019, 0.0, 0.0]
    result = roll_out(Player([np.append([*away, 0, 0, 0], 0.67)] * 100))
    assert not result.success and result.steps < 60
    assert result.reason.startswith("steered out of reach: tool pose at (")


def test_a_skill_sees_the_wrist_image_and_the_gripper_at_every_step(
    roll_out, replay, peg_demonstration
):
    result = roll_out(replay)
    assert len(replay.seen) == result.steps
    recorded = peg_demonstration.steps
    np.testing.assert_array_equal(replay.seen[0][0], recorded.cameras["wrist"].rgb[0])
    assert replay.seen[0][1] == recorded.measured_gripper[0]
    assert replay.seen[-1][1] == pytest.approx(0.67, abs=1e-3)


def test_the_same_rollout_twice_is_the_same(roll_out, replay):
    task = get_task("peg_in_hole")
    task.horizon = 3.0
    images = []
    for _ in range(2):
        images.append([])
        roll_out(
            replay,
            Placement(0.01, 0.02),
            task,
            watch=lambda seen, *_: images[-1].append(seen.cameras["wrist"].rgb),
        )
    np.testing.assert_array_equal(*images)
    assert len(images[0]) >= 30


# --- many rollouts ------------------------------------------------------------------------------


@pytest.fixture
def short_task():
    task = get_task("peg_in_hole")
    task.horizon = 0.6
    return task


@pytest.fixture
def evaluate(monkeypatch, make_peg_backend, tmp_path_factory):
    """Evaluates a made-up skill in place of a trained one."""
    directory = tmp_path_factory.mktemp("skill")
    for name in ("config.json", "model.safetensors"):
        (directory / name).write_text(name)

    def evaluate(skill, task, config=None, **options):
        monkeypatch.setattr(module, "load_skill", lambda *_, **__: skill)
        return evaluate_skill(directory, task, make_peg_backend, config, **options)

    return evaluate


def test_placements_follow_from_the_evaluation_seed_and_the_episode_alone(peg_task):
    drawn = [episode_placement(peg_task, 7, i) for i in range(50)]
    assert drawn == [episode_placement(peg_task, 7, i) for i in range(50)]
    assert len({(p.x, p.y) for p in drawn}) == 50
    assert drawn != [episode_placement(peg_task, 8, i) for i in range(50)]


def test_objects_are_turned_and_the_appearance_varies_where_asked_for(evaluate, short_task):
    class Watching(Player):
        def reset(self):
            super().reset()
            self.rollouts.append(self.seen)

    placements, tables = {}, {}
    for name, options in (
        ("plain", {}),
        ("turned", {"yaw_deg": 15.0}),
        ("appearance", {"appearance": AppearanceConfig()}),
    ):
        player = Watching()
        player.rollouts = []
        rows = evaluate(player, short_task, EvaluateConfig(3, 0, **options))["episodes"]
        placements[name] = [row["placement"]["block"] for row in rows]
        # The table's colour in the corner of each rollout's first image.
        tables[name] = {tuple(seen[0][0][-1, 0]) for seen in player.rollouts}
    assert placements["plain"] == placements["appearance"]
    assert {p["yaw_deg"] for p in placements["plain"]} == {0.0}
    assert len({p["yaw_deg"] for p in placements["turned"]}) == 3
    assert len(tables["plain"]) == 1 and len(tables["appearance"]) == 3


def test_the_result_has_a_row_for_each_episode_and_what_they_come_to(
    evaluate, short_task, tmp_path
):
    progress = []
    out = tmp_path / "evaluation.json"
    config = EvaluateConfig(episodes=3, eval_seed=11)
    result = evaluate(
        Player(), short_task, config, out=out, progress=lambda *counts: progress.append(counts)
    )
    assert read_json(out, dict) == json.loads(json.dumps(result))
    assert result["task"] == "peg_in_hole" and result["backend"] == "pybullet"
    assert result["robot"] == "ur5e_2f85" and result["policy"] == "player"
    assert (result["n_episodes"], result["n_success"], result["success_rate"]) == (3, 0, 0.0)
    assert (result["n_success_any"], result["success_rate_any"]) == (0, 0.0)
    assert result["ci95"] == result["ci95_any"] == list(wilson_interval(0, 3))
    assert result["seeds"] == {"eval_seed": 11, "episodes": [[11, 0], [11, 1], [11, 2]]}
    assert result["seconds"] > 0 and result["videos"] == [] and "python" in result["versions"]
    assert result["config"] == dataclasses.asdict(config)
    for i, row in enumerate(result["episodes"]):
        assert row["episode"] == i and row["seed"] == [11, i] and row["steps"] == 6
        assert row["placement"] == {"block": episode_placement(short_task, 11, i).to_json()}
        assert row["outcome"] == "failure" and row["success_any"] is False and row["reason"]
    assert progress == [(1, 3, 0), (2, 3, 0), (3, 3, 0)]


def test_successes_are_counted_and_carry_no_reason(evaluate, replay, peg_demonstration):
    task = get_task("peg_in_hole")
    task.placement_range = 0.002
    task.hold = 0.1
    result = evaluate(replay, task, EvaluateConfig(episodes=2))
    assert result["n_success"] == result["n_success_any"] == 2
    assert result["ci95"] == list(wilson_interval(2, 2))
    assert [row["reason"] for row in result["episodes"]] == [None, None]
    assert [row["outcome"] for row in result["episodes"]] == ["success", "success"]


def test_the_same_seed_gives_the_same_rows_and_another_seed_other_placements(evaluate, short_task):
    def rows(seed):
        config = EvaluateConfig(episodes=2, eval_seed=seed)
        return evaluate(Player(), short_task, config)["episodes"]

    assert rows(1) == rows(1)
    assert rows(1)[0]["placement"] != rows(2)[0]["placement"]


def test_the_first_failures_are_handed_to_the_film_maker(evaluate, short_task, tmp_path):
    filmed = []
    config = EvaluateConfig(episodes=3, videos=2)
    out = tmp_path / "e" / "evaluation.json"
    result = evaluate(
        Player(), short_task, config, out=out, film=lambda *asked: filmed.append(asked)
    )
    assert result["videos"] == [
        {"path": f"videos/failure_{k:03d}.mp4", "episode": k, "outcome": "failure"} for k in (0, 1)
    ]
    assert read_json(out, dict)["videos"] == result["videos"]
    paths = [tmp_path / "e" / row["path"] for row in result["videos"]]
    assert [(path, k, outcome) for path, _, _, k, outcome in filmed] == [
        (paths[0], 0, "failure"),
        (paths[1], 1, "failure"),
    ]
    for _, moments, hz, _, _ in filmed:
        assert hz == 10
        assert [moment.seconds for moment in moments] == [step / 10 for step in range(7)]
        assert not any(moment.success for moment in moments)
        assert len({moment.overview.shape for moment in moments}) == 1
        assert moments[0].overview.shape != moments[0].wrist.shape


def test_an_interrupted_evaluation_keeps_its_rollouts_and_ends_with_the_same_result(
    evaluate, short_task, tmp_path
):
    config, played = EvaluateConfig(episodes=4, eval_seed=3), []

    class Counted(Player):
        def reset(self):
            super().reset()
            played.append(1)

    def cut(done, wanted, successes):
        if done == 3:
            raise KeyboardInterrupt

    out = tmp_path / "e.json"
    whole = evaluate(Player(), short_task, config, out=tmp_path / "whole.json")
    with pytest.raises(KeyboardInterrupt):
        evaluate(Counted(), short_task, config, out=out, progress=cut)
    assert not out.exists() and len(played) == 3
    with pytest.raises(Mismatch, match=r"e.json.journal: holds results of .* add --overwrite"):
        evaluate(Counted(), short_task, dataclasses.replace(config, eval_seed=4), out=out)
    resumed = evaluate(Counted(), short_task, config, out=out)
    assert len(played) == 4
    assert {**resumed, "seconds": 0} == {**whole, "seconds": 0}
    written = read_json(out, EvaluationFile)
    assert resumed["seconds"] > 0 and written == json.loads(json.dumps(resumed))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["e.json", "whole.json"]


def test_a_finished_evaluation_is_replaced_only_if_asked(evaluate, short_task, tmp_path):
    out, config = tmp_path / "e.json", EvaluateConfig(episodes=1)
    evaluate(Player(), short_task, config, out=out)
    before = out.read_bytes()
    with pytest.raises(OutputExists, match="already exists; add --overwrite"):
        evaluate(Player(), short_task, config, out=out)
    assert out.read_bytes() == before
    evaluate(Player(), short_task, EvaluateConfig(1, 7), out=out, overwrite=True)
    assert read_json(out, EvaluationFile)["config"]["eval_seed"] == 7


def test_two_evaluations_of_one_result_at_once_are_refused(evaluate, short_task, tmp_path):
    def meanwhile(*counts):
        for overwrite in (False, True):
            with pytest.raises(CannotWrite, match="another process is using it"):
                evaluate(Player(), short_task, out=tmp_path / "e.json", overwrite=overwrite)

    evaluate(Player(), short_task, EvaluateConfig(2), out=tmp_path / "e.json", progress=meanwhile)
    assert read_json(tmp_path / "e.json", EvaluationFile)["n_episodes"] == 2


def test_a_video_carries_the_outcome_of_the_run_that_it_shows(evaluate, replay, tmp_path, caplog):
    """The policy fails when it is evaluated, and succeeds when it is run again."""

    class Improving(Player):
        rollouts = 0

        def reset(self):
            super().reset()
            self.rollouts += 1
            self.actions = replay.actions if self.rollouts == 2 else []

    task = get_task("peg_in_hole")
    task.placement_range, task.horizon = 0.002, 13.0
    filmed = []
    result = evaluate(
        Improving(),
        task,
        EvaluateConfig(episodes=1, videos=1),
        out=tmp_path / "e" / "evaluation.json",
        film=lambda *asked: filmed.append(asked),
    )
    assert result["episodes"][0]["outcome"] == "failure" and result["n_success"] == 0
    assert result["videos"] == [
        {
            "path": "videos/success_000.mp4",
            "episode": 0,
            "outcome": "success",
            "evaluated_outcome": "failure",
        }
    ]
    ((path, moments, _, _, outcome),) = filmed
    assert path.name == "success_000.mp4" and outcome == "success" and moments[-1].success
    assert "it was a failure when it was evaluated, and a success when" in caplog.text


def test_without_a_camera_outside_there_are_no_videos_and_that_is_said(
    evaluate, short_task, tmp_path, monkeypatch, caplog
):
    monkeypatch.setattr(module, "_OVERVIEW", "none")
    config = EvaluateConfig(episodes=1, videos=1)
    result = evaluate(Player(), short_task, config, out=tmp_path / "e.json", film=print)
    assert result["videos"] == [] and "no camera named 'none'" in caplog.text


def test_a_rollout_that_ends_before_its_first_step_does_not_stop_the_evaluation(
    evaluate, short_task, peg_model, tmp_path
):
    stretched = np.array([0.0, -0.6, 0.02, -1.0, -np.pi / 2, 0.0])
    start = short_task.initial_state

    def initial_state(model, placement):
        return dataclasses.replace(start(model, placement), q=stretched)

    short_task.initial_state = initial_state
    away = peg_model.fk(stretched)[:3, :3].T @ [0.019, 0.0, -0.01]
    skill = Player([np.append([*away, 0, 0, 0], 0.67)] * 9)
    filmed = []
    result = evaluate(
        skill,
        short_task,
        EvaluateConfig(episodes=1, videos=1),
        out=tmp_path / "e" / "evaluation.json",
        film=lambda path, moments, *_: filmed.append(len(moments)),
    )
    assert filmed == [1]
    assert result["episodes"][0]["steps"] == 0
    assert result["episodes"][0]["reason"].startswith("steered out of reach")


def test_nothing_is_written_unless_asked(evaluate, short_task, tmp_path):
    result = evaluate(Player(), short_task, EvaluateConfig(episodes=1))
    assert result["videos"] == [] and list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def skill_directory(peg_dataset, tmp_path_factory):
    """A skill that has learned next to nothing."""
    out = tmp_path_factory.mktemp("skill")
    config = TrainConfig.for_policy(
        "compact_mlp", epochs=1, image_size=32, batch_size=16, hidden=16, threads=1, device="cpu"
    )
    save_skill(out, train(peg_dataset, config, out), peg_dataset)
    return out


def test_two_processes_give_the_rows_of_one_and_leave_torch_s_threads_alone(
    skill_directory, short_task, make_peg_backend
):
    config = EvaluateConfig(episodes=2)
    before = torch.get_num_threads()
    try:
        results = [
            evaluate_skill(skill_directory, short_task, make_peg_backend, config, workers=workers)
            for workers in (1, 2)
        ]
        assert results[0]["episodes"] == results[1]["episodes"]
        assert results[0]["policy"] == "compact_mlp"
        assert torch.get_num_threads() == before
    finally:
        torch.set_num_threads(before)


# --- refusals -----------------------------------------------------------------------------------


@pytest.mark.parametrize("workers", [0, -1])
def test_at_least_one_process_is_needed(evaluate, short_task, workers):
    with pytest.raises(InvalidInput, match=f"workers: expected at least 1, got {workers}"):
        evaluate(Player(), short_task, workers=workers)


@pytest.mark.parametrize("options", [{"film": print}, {"out": Path("evaluation.json")}])
def test_videos_need_a_film_maker_and_a_place(evaluate, short_task, options):
    with pytest.raises(InvalidInput, match="videos: expected 0 without `film` and `out`, got 1"):
        evaluate(Player(), short_task, EvaluateConfig(episodes=1, videos=1), **options)


def test_a_missing_skill_is_refused(peg_task, make_peg_backend, tmp_path):
    with pytest.raises(MissingFile, match="no such skill directory"):
        evaluate_skill(tmp_path / "none", peg_task, make_peg_backend)


def test_a_result_that_cannot_be_written_is_an_error(evaluate, short_task, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite, match="is not a directory; choose another --out"):
        evaluate(
            Player(),
            short_task,
            EvaluateConfig(episodes=1),
            out=tmp_path / "file" / "evaluation.json",
        )


def test_a_skill_that_gives_nonsense_is_an_error_not_a_crash(roll_out):
    with pytest.raises(SartError, match="NaN"):
        roll_out(Player([np.full(7, np.nan)]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes": 0}, "episodes: expected at least 1, got 0"),
        ({"eval_seed": -1}, "eval_seed: expected a whole number >= 0, got -1"),
        ({"videos": -1}, "videos: expected at least 0, got -1"),
    ],
)
def test_a_bad_setting_is_refused(changes, message):
    with pytest.raises(InvalidInput, match=message):
        EvaluateConfig(**changes)


# --- variations ---------------------------------------------------------------------------------


@pytest.mark.parametrize("ticks", [1, 3, 4, 6])
def test_with_latency_a_skill_sees_what_was_seen_so_much_earlier(
    peg_backend, peg_model, peg_task, peg_demonstration, ticks
):
    """Its wrist images are those of a rollout of the same actions, some control steps before."""
    actions = peg_demonstration.actions[:14]
    peg_task = get_task("peg_in_hole")
    peg_task.horizon = 1.4
    seen = []

    observe = peg_backend.observe
    step, at = peg_backend.step, [0]

    def count():
        at[0] += 1
        step()

    def look(*cameras):
        found = observe(*cameras)
        seen.append((at[0], found))
        return found

    peg_backend.step, peg_backend.observe = count, look
    try:
        player = Player(actions)
        run_rollout(player, peg_task, peg_backend, peg_model, Placement(), latency=ticks / 30)
        shown = [images for images, _ in player.seen]
        by_tick = {tick: found.cameras["wrist"].rgb for tick, found in seen}
        start = min(by_tick)
        for k, image in enumerate(shown):
            np.testing.assert_array_equal(image, by_tick[start + max(0, 3 * k - ticks)])
    finally:
        del peg_backend.step, peg_backend.observe
    assert len(shown) == 14


def test_latency_that_is_no_whole_number_of_control_steps_is_refused(roll_out):
    with pytest.raises(InvalidInput, match="latency: expected whole control steps of 1/30 s"):
        roll_out(Player(), latency=0.05)


def test_objects_are_placed_in_another_square_and_turned_farther_where_asked_for(
    evaluate, short_task
):
    usual = evaluate(Player(), short_task, EvaluateConfig(4, 3))["episodes"]
    config = EvaluateConfig(4, 3, placement_range=0.10, yaw_deg=30.0)
    wide = evaluate(Player(), short_task, config)["episodes"]
    for a, b in zip(usual, wide, strict=True):
        assert b["placement"]["block"]["x"] == pytest.approx(2 * a["placement"]["block"]["x"])
    turns = [row["placement"]["block"]["yaw_deg"] for row in wide]
    assert max(map(abs, turns)) > short_task.yaw_range_deg


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"yaw_deg": -1}, "yaw_deg: expected 0 to 180"),
        ({"placement_range": -0.1}, "placement_range: expected 0 to 1 m"),
        ({"latency": -0.1}, "latency: expected 0 to 10 s"),
    ],
)
def test_variations_that_can_not_be_are_refused(options, complaint):
    with pytest.raises(InvalidInput, match=complaint):
        EvaluateConfig(**options)


def test_what_was_seen_at_the_end_of_a_failure_is_kept_if_asked(evaluate, short_task, tmp_path):
    out = tmp_path / "e.json"
    result = evaluate(Player(), short_task, EvaluateConfig(2, final_images=True), out=out)
    for row in result["episodes"]:
        assert row["final_image"] == f"e_failures/{row['episode']:03d}.png"
        with PillowImage.open(tmp_path / row["final_image"]) as image:
            # The overview and the square wrist image beside each other.
            assert image.size == (384, 192)
            assert np.ptp(np.asarray(image)[:, :192]) > 50 < np.ptp(np.asarray(image)[:, 192:])
    assert read_json(out, EvaluationFile)["episodes"][1]["final_image"] == "e_failures/001.png"
    with pytest.raises(InvalidInput, match="final_images: expected False without `out`"):
        evaluate(Player(), short_task, EvaluateConfig(1, final_images=True))


def test_of_a_success_no_final_image_is_kept_and_it_went_all_the_way(
    evaluate, replay, peg_demonstration, tmp_path
):
    task = get_task("peg_in_hole")
    task.placement_range = 0.002
    player = Player(peg_demonstration.actions)
    player.demonstration = peg_demonstration
    config = EvaluateConfig(1, final_images=True)
    (row,) = evaluate(player, task, config, out=tmp_path / "e.json")["episodes"]
    assert row["outcome"] == "success" and "final_image" not in row
    assert row["progress"]["of"] == len(peg_demonstration)
    assert row["progress"]["waypoint"] > 0.7 * len(peg_demonstration)


def test_a_failure_tells_how_far_along_the_demonstration_it_came(roll_out, peg_demonstration):
    task = get_task("peg_in_hole")
    task.horizon = 4.0
    player = Player(peg_demonstration.actions[:20])
    player.demonstration = peg_demonstration
    result = roll_out(player, task=task)
    assert not result.success and 17 <= result.progress.waypoint <= 22
    assert 1.5 < result.to_json("block")["progress"]["seconds"] < 2.6
    # Beside the hole it is nowhere near.
    player = Player(peg_demonstration.actions[:20])
    player.demonstration = peg_demonstration
    assert roll_out(player, Placement(0.045, 0.045), task).progress is None


def test_few_rollouts_are_warned_of(evaluate, short_task, caplog):
    evaluate(Player(), short_task, EvaluateConfig(1))
    assert "only 1 rollout: " in caplog.text
