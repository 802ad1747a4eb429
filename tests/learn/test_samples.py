import dataclasses
import resource
import shutil
from collections import Counter

import numpy as np
import pytest
import torch

from sart_toolkit.data.combine import merge_datasets
from sart_toolkit.data.writer import write_dataset
from sart_toolkit.errors import CannotWrite, InvalidInput, Mismatch, UnknownName
from sart_toolkit.learn.samples import (
    FRAMES,
    SAMPLES,
    WEIGHTINGS,
    Variation,
    WindowConfig,
    open_windows,
    remove_windows,
)
from sart_toolkit.poses import pose


def _expected_windows(dataset, history):
    """Every window of every trajectory, one by one: frames, gripper and action as bytes."""
    demonstration = dataset.sources[0].demonstration
    trajectories = [(demonstration.steps, len(demonstration), demonstration.actions)]
    trajectories += [(e.steps, e.provenance.t_star, e.actions(demonstration)) for e in dataset]
    windows = Counter()
    for steps, t_star, actions in trajectories:
        frames = list(steps.cameras["wrist"].rgb)
        frames += list(demonstration.steps.cameras["wrist"].rgb[t_star:])
        gripper = [*steps.measured_gripper, *demonstration.steps.measured_gripper[t_star:]]
        assert len(frames) == len(actions)
        for t, action in enumerate(actions):
            at = [max(0, t - back) for back in reversed(range(history))]
            windows[
                b"".join(frames[i].tobytes() for i in at),
                tuple(np.float32(gripper[i]) for i in at),
                tuple(action.astype(np.float32)),
            ] += 1
    return windows


def _varied(offsets, runs=None):
    return Variation(offsets, torch.arange(len(offsets)) if runs is None else runs)


@pytest.mark.parametrize("history", [1, 2, 3])
@pytest.mark.parametrize("t_stars", [(), (0,), (3, 5, 5), (8, 1, 8, 2)])
def test_windows_are_exactly_the_steps_of_all_trajectories(
    make_dataset, history, t_stars, open_windows
):
    dataset = make_dataset(t_stars)
    windows = open_windows(dataset, 32, history)
    batch = windows.batch(torch.arange(len(windows.history)))
    images, gripper, actions = batch["images/wrist"], batch["gripper"], batch["action"]
    found = {
        (f.permute(0, 2, 3, 1).numpy().tobytes(), tuple(g.numpy()), tuple(a.numpy())): int(m)
        for f, g, a, m in zip(images, gripper, actions, windows.multiplicity, strict=True)
    }
    assert found == dict(_expected_windows(dataset, history))
    assert len(found) == len(windows.history)


def test_each_image_is_stored_once(make_dataset, open_windows):
    dataset = make_dataset((2,) * 20)
    windows = open_windows(dataset)
    assert len(windows.frames.images["wrist"]) == len(dataset.sources[0].demonstration) + 20 * 4


def test_the_first_window_repeats_the_first_frame(dataset, open_windows):
    windows = open_windows(dataset, 16, 3)
    assert [0, 0, 0] in windows.history.tolist()
    assert [0, 0, 1] in windows.history.tolist()


def test_the_window_at_the_join_holds_the_segments_last_frame(dataset, open_windows):
    windows = open_windows(dataset)
    # Demonstration 0..8, first episode's segment 9..12, then the demonstration from t* = 3.
    assert [12, 3] in windows.history.tolist()


def test_the_shared_suffix_counts_once_for_every_trajectory(dataset, open_windows):
    windows = open_windows(dataset)
    count = {tuple(h): int(m) for h, m in zip(windows.history, windows.multiplicity, strict=True)}
    count = {tuple(int(i) for i in h): m for h, m in count.items()}
    # t* = 3, 5, 5: the step after t* is the first whose history lies in the demonstration.
    assert [count[t - 1, t] for t in range(1, 9)] == [1, 1, 1, 2, 2, 4, 4, 4]


def test_an_epoch_passes_every_step_of_every_trajectory_once(dataset, open_windows):
    windows = open_windows(dataset)
    order, _ = windows.epoch_order(np.random.default_rng(0), "trajectories")
    assert (np.bincount(order) == windows.multiplicity.numpy()).all()
    assert len(order) == 9 + (4 + 6) + 2 * (4 + 4)


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_an_epoch_s_order_is_decided_by_its_random_numbers(dataset, open_windows, weighting):
    windows = open_windows(dataset)
    order, runs = windows.epoch_order(np.random.default_rng(0), weighting, 3)
    assert (order != windows.epoch_order(np.random.default_rng(1), weighting, 3)[0]).any()
    again, runs_again = windows.epoch_order(np.random.default_rng(0), weighting, 3)
    assert (order == again).all() and (runs == runs_again).all()


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_windows_of_a_run_follow_each_other_and_runs_come_in_any_order(
    dataset, open_windows, weighting
):
    windows = open_windows(dataset)
    rng, starts = np.random.default_rng(0), set()
    for _ in range(20):
        order, runs = windows.epoch_order(rng, weighting, 4)
        alone, _ = windows.epoch_order(np.random.default_rng(0), weighting)
        assert np.abs(np.bincount(order, minlength=len(windows.history))
                      - np.bincount(alone, minlength=len(windows.history))).max() <= 1  # fmt: skip
        assert (np.diff(runs) >= 0).all() and (np.bincount(runs) <= 4).all()
        for run in np.unique(runs):
            of = order[runs == run]
            assert (np.diff(of) >= 0).all()
        starts.add(int(order[0]))
    assert len(starts) > 5


def test_a_balanced_epoch_draws_by_the_root_of_multiplicity_and_by_activity(dataset, open_windows):
    windows = open_windows(dataset)
    windows = dataclasses.replace(windows, activity=torch.linspace(0.1, 4.0, len(windows.activity)))
    n = int(windows.multiplicity.sum())
    weights = np.sqrt(windows.multiplicity.numpy()) * windows.activity.numpy()
    expected = n * weights / weights.sum()
    total = np.zeros(len(expected))
    for seed in range(200):
        order, _ = windows.epoch_order(np.random.default_rng(seed), "balanced")
        counts = np.bincount(order, minlength=len(expected))
        assert len(order) == n and (np.abs(counts - expected) < 1).all()
        total += counts
    np.testing.assert_allclose(total / 200, expected, atol=0.15)


def test_what_stands_still_counts_less_and_gripper_events_more(
    make_dataset, with_steps, open_windows
):
    """It moves 10 mm a step, trembles from step 8 on, closes its gripper at 17, moves from 26."""

    def acted(steps):
        n = len(steps)
        strides = np.zeros(n)
        strides[1:9] = strides[27:] = 0.01
        strides[9:27] = 0.003 * (-1.0) ** np.arange(18)
        commanded = np.where(np.arange(n) >= 18, 1.0, 0.0)
        measured = np.clip((np.arange(n) - 17) / 2, 0.0, 1.0)
        return dataclasses.replace(
            steps,
            commanded_Ts_world_tool=np.stack([pose([x, 0, 0]) for x in np.cumsum(strides)]),
            commanded_gripper=commanded,
            measured_gripper=measured,
        )

    windows = open_windows(with_steps(make_dataset((), n=34), acted))
    activity = windows.activity[np.argsort(windows.history[:, -1].numpy())].numpy()
    assert (activity[:8] == 1).all() and (activity[26:33] == 1).all()
    # The tremor gets nowhere in four steps; what comes or was within four counts.
    assert activity[12:17] == pytest.approx(0.1)
    assert activity[17] == 4 and activity[18] == 1
    assert activity[19:22] == pytest.approx(0.1)
    assert (np.diff(activity[22:26]) > 0).any() and activity[24] == 1


@pytest.mark.parametrize(("shade", "told"), [(61, 0.02), (68, 0.16), (80, 1.0), (200, 1.0)])
def test_a_segment_whose_pictures_do_not_tell_where_it_begins_hardly_counts(
    make_dataset, with_steps, open_windows, shade, told
):
    """The demonstration moves 10 mm a step and its pictures change by 20; t* = 3, at shade 60."""

    def acted(steps):
        n = len(steps)
        shades = 20 * np.arange(n) if n == 9 else np.full(n, shade)
        rgb = np.broadcast_to(shades[:, None, None, None], (n, 32, 32, 3)).astype(np.uint8)
        # A segment of 20 mm in 4 steps.
        along = 0.01 * np.arange(n) if n == 9 else 0.03 - 0.005 * np.arange(n, 0, -1)
        camera = dataclasses.replace(steps.cameras["wrist"], rgb=rgb)
        return dataclasses.replace(
            steps,
            cameras={"wrist": camera},
            commanded_Ts_world_tool=np.stack([pose([x, 0, 0]) for x in along]),
            commanded_gripper=np.zeros(n),
            measured_gripper=np.zeros(n),
        )

    windows = open_windows(with_steps(make_dataset((3,)), acted))
    segment = windows.activity[(windows.history[:, -1] >= 9)].tolist()
    assert segment == pytest.approx([told] * 4)


def test_joints_forces_and_measured_poses_never_enter(dataset, perturbed, with_steps, open_windows):
    plain = open_windows(dataset)
    other = open_windows(with_steps(dataset, perturbed))
    assert plain.data_hash == other.data_hash


def _moved(T):
    """Steps as they would have been recorded in another place."""

    def moved(steps):
        return dataclasses.replace(
            steps,
            commanded_Ts_world_tool=T @ steps.commanded_Ts_world_tool,
            measured_Ts_world_tool=T @ steps.measured_Ts_world_tool,
        )

    return moved


def test_where_in_the_world_it_happened_never_enters(dataset, with_steps, open_windows):
    plain = open_windows(dataset)
    other = open_windows(with_steps(dataset, _moved(pose((1.0, -2.0, 0.5), (0.0, 0.0, -1.0)))))
    assert torch.allclose(plain.actions, other.actions, atol=1e-7)
    assert torch.allclose(plain.up, other.up, atol=1e-7)
    assert torch.equal(plain.frames.images["wrist"], other.frames.images["wrist"])


def test_how_the_tool_is_tilted_enters(dataset, with_steps, open_windows):
    plain = open_windows(dataset)
    T = pose((1.0, -2.0, 0.5), (0.3, 0.0, 0.0))
    tilted = open_windows(with_steps(dataset, _moved(T)))
    assert torch.allclose(plain.actions, tilted.actions, atol=1e-7)
    # The tools of these steps stand upright in the world.
    assert torch.allclose(plain.up, torch.tensor([0.0, 0.0, 1.0]))
    expected = torch.tensor([0.0, np.sin(0.3), np.cos(0.3)], dtype=torch.float32)
    assert torch.allclose(tilted.up, expected)
    assert torch.allclose(tilted.batch(torch.arange(3))["up"], expected)
    assert tilted.normalisation().up_mean == pytest.approx(expected.tolist())


def test_shifts_move_all_of_a_windows_images_alike_and_repeat_the_edge(dataset, open_windows):
    padded = open_windows(dataset, image_shift=3)
    chosen = torch.tensor([4, 7, 2])
    plain = open_windows(dataset).batch(chosen)
    offsets = torch.tensor([[0, 0], [3, 3], [5, 1]])
    shifted = padded.batch(chosen, _varied(offsets))
    for image, result, (row, column) in zip(
        plain["images/wrist"], shifted["images/wrist"], offsets.tolist(), strict=True
    ):
        rows = np.clip(np.arange(16) + row - 3, 0, 15)
        columns = np.clip(np.arange(16) + column - 3, 0, 15)
        assert torch.equal(image[:, :, rows][:, :, :, columns], result)
    assert torch.equal(plain["gripper"], shifted["gripper"])
    assert torch.equal(plain["action"], shifted["action"])
    assert torch.equal(padded.batch(chosen)["images/wrist"], plain["images/wrist"])


def test_a_batch_is_images_gripper_tilt_and_action_and_nothing_else(two_cameras, open_windows):
    windows = open_windows(two_cameras, cameras=("wrist", "overview"))
    batch = windows.batch(torch.arange(4))
    assert {name: (tuple(v.shape), v.dtype) for name, v in batch.items()} == {
        "images/wrist": ((4, 2, 3, 16, 16), torch.uint8),
        "images/overview": ((4, 2, 3, 16, 24), torch.uint8),
        "gripper": ((4, 2), torch.float32),
        "up": ((4, 3), torch.float32),
        "action": ((4, 7), torch.float32),
    }


@pytest.mark.parametrize("shift", [0, 2])
def test_each_cameras_images_are_those_it_has_alone(two_cameras, open_windows, shift):
    chosen, offsets = (
        torch.tensor([3, 8, 1]),
        torch.tensor([[0, 1], [2, 2], [1, 0]]).clamp(max=shift * 2),
    )
    both = open_windows(two_cameras, cameras=("overview", "wrist"), image_shift=shift)
    for camera in ("wrist", "overview"):
        alone = open_windows(two_cameras, cameras=(camera,), image_shift=shift)
        name = f"images/{camera}"
        expected = alone.batch(chosen, _varied(offsets))[name]
        assert torch.equal(both.batch(chosen, _varied(offsets))[name], expected)


def test_a_shared_batch_has_each_picture_of_a_run_once(two_cameras, open_windows):
    windows = open_windows(two_cameras, cameras=("wrist", "overview"), image_shift=2)
    chosen = torch.tensor([0, 1, 2, 2, 9, 10, 11, 1])
    runs = torch.tensor([1, 1, 1, 1, 0, 0, 0, 3])
    offsets = torch.tensor([[4, 2], [0, 1], [2, 2], [3, 3]])
    apart = windows.batch(chosen, _varied(offsets, runs=runs))
    shared = windows.batch(chosen, _varied(offsets, runs=runs), shared=True)
    assert torch.equal(apart["gripper"], shared["gripper"])
    assert torch.equal(apart["action"], shared["action"])
    for camera in ("wrist", "overview"):
        pictures = shared[f"pictures/{camera}"]
        assert torch.equal(pictures[shared["pictures"]], apart[f"images/{camera}"])
        different = {(int(r), int(f)) for r, h in zip(runs, windows.history[chosen], strict=True)
                     for f in h}  # fmt: skip
        assert len(pictures) == len(different) < apart[f"images/{camera}"].flatten(0, 1).shape[0]


@pytest.mark.parametrize("shift", [0, 2])
def test_batches_are_channels_last(two_cameras, open_windows, shift):
    windows = open_windows(two_cameras, cameras=("wrist", "overview"), image_shift=shift)
    batch = windows.batch(torch.arange(4), _varied(torch.full((4, 2), shift)))
    for camera in ("wrist", "overview"):
        images = batch[f"images/{camera}"].flatten(0, 1)
        assert images.is_contiguous(memory_format=torch.channels_last)


def test_a_chunk_holds_the_actions_that_follow_and_then_holds_still(dataset, open_windows):
    windows = open_windows(dataset, chunk=4)
    single = open_windows(dataset)
    assert torch.equal(windows.history, single.history)
    assert torch.equal(windows.actions[:, 0], single.actions)
    at = {tuple(h): i for i, h in enumerate(single.history.tolist())}
    # The first episode: its segment is 9..12, then the demonstration from t* = 3.
    following = [at[11, 12], at[12, 3], at[3, 4], at[4, 5]]
    assert torch.equal(windows.actions[at[11, 12]], single.actions[following])
    last = at[7, 8]
    assert torch.equal(windows.actions[last], single.actions[[last] * 4])
    assert windows.normalisation().action_mean == pytest.approx(single.normalisation().action_mean)


def test_the_files_are_used_again_for_the_same_dataset_and_windows(make_dataset, tmp_path):
    read = []

    def opened(dataset=None, **options):
        config = WindowConfig(**{"cameras": ("wrist",), "image_size": 16, "history": 2, **options})
        before = len(read)
        windows = open_windows(
            dataset or make_dataset(), config, tmp_path, lambda *n: read.append(n)
        )
        return windows, len(read) - before

    first, n = opened()
    assert n == 4 and read[-1] == (4, 4)
    again, n = opened()
    assert n == 0 and again.data_hash == first.data_hash
    assert torch.equal(again.batch(torch.arange(9))["images/wrist"],
                       first.batch(torch.arange(9))["images/wrist"])  # fmt: skip
    for other in ({"image_shift": 1}, {"history": 3}, {"chunk": 2}, {"image_size": 20}):
        assert opened(**other)[1] == 4
    other, n = opened(make_dataset(seed=1))
    assert n == 4 and other.data_hash != first.data_hash


@pytest.mark.parametrize("name", [FRAMES, SAMPLES])
@pytest.mark.parametrize("damage", ["cut", "gone"])
def test_damaged_files_are_written_again(dataset, tmp_path, name, damage):
    config = WindowConfig(("wrist",), 16, 2)
    first = open_windows(dataset, config, tmp_path)
    images = first.frames.images["wrist"].clone()
    if damage == "cut":
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).unlink()  # what is mapped must not shrink
        (tmp_path / name).write_bytes(content[:-50])
    else:
        (tmp_path / name).unlink()
    again = open_windows(dataset, config, tmp_path)
    assert torch.equal(again.frames.images["wrist"], images)
    assert torch.equal(again.history, first.history)


def test_reading_that_was_interrupted_leaves_nothing_that_would_be_used(dataset, tmp_path):
    def interrupt(done, total):
        if done == 2:
            raise KeyboardInterrupt

    config = WindowConfig(("wrist",), 16, 2)
    with pytest.raises(KeyboardInterrupt):
        open_windows(dataset, config, tmp_path, interrupt)
    assert list(tmp_path.iterdir()) == []
    assert len(open_windows(dataset, config, tmp_path).history) > 0


def test_windows_are_removed(dataset, tmp_path):
    open_windows(dataset, WindowConfig(("wrist",), 16, 2), tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [FRAMES, SAMPLES]
    remove_windows(tmp_path)
    remove_windows(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_without_room_is_refused_before_anything_is_read(dataset, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    read = []
    with pytest.raises(CannotWrite, match=r"frames.bin: needs 0.0 GB and 0.0 GB are free; make"):
        open_windows(dataset, WindowConfig(("wrist",), 16, 2), tmp_path, lambda *n: read.append(n))
    assert not read


def test_a_disk_that_fills_up_is_reported_and_leaves_nothing(dataset, tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    try:
        with pytest.raises(CannotWrite, match=r"frames.bin: File too large; nothing was replaced"):
            open_windows(dataset, WindowConfig(("wrist",), 32, 2), tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_normalisation_weighs_trajectories_and_floors_what_hardly_moves(dataset, open_windows):
    windows = open_windows(dataset)
    repeated = windows.actions.double().repeat_interleave(windows.multiplicity, 0).numpy()
    normalisation = windows.normalisation()
    assert np.allclose(normalisation.action_mean, repeated.mean(0))
    assert np.allclose(normalisation.action_std[:2], repeated[:, :2].std(0))
    # z and the rotations are constant in this dataset.
    assert normalisation.action_std[2] == pytest.approx(0.1 * repeated[:, :2].std(0).max())
    assert (normalisation.action_std[3:6] == 1e-3).all()


@pytest.mark.parametrize(
    ("name", "least"), [("image_size", 1), ("history", 1), ("image_shift", 0), ("chunk", 1)]
)
def test_a_size_out_of_range_is_refused(name, least):
    options = {"cameras": ("wrist",), "image_size": 16, "history": 2, name: least - 1}
    with pytest.raises(InvalidInput, match=f"{name}: expected at least {least}, got {least - 1}"):
        WindowConfig(**options)


def test_an_unknown_camera_is_refused_with_the_nearest(dataset, open_windows):
    with pytest.raises(UnknownName, match="did you mean 'wrist'"):
        open_windows(dataset, cameras=("wirst",))


@pytest.fixture
def two_sources(make_dataset, tmp_path_factory):
    """Two demonstrations and an episode of each; the second's images may have another size."""

    def two_sources(size=32):
        episodes, sources = [], []
        for i, t_star in enumerate((3, 5)):
            dataset = make_dataset((t_star,), seed=i, size=(32, size)[i])
            sources += [(source.demonstration, source.annotation) for source in dataset.sources]
            (episode,) = dataset
            provenance = dataclasses.replace(episode.provenance, source=i)
            episodes.append(dataclasses.replace(episode, provenance=provenance))
        return write_dataset(tmp_path_factory.mktemp("two"), sources, episodes, {})

    return two_sources


def test_each_episode_is_followed_by_its_own_demonstration(two_sources, open_windows):
    windows = open_windows(two_sources())
    # Demonstrations 0..8 and 9..17, their episodes' segments 18..21 and 22..25.
    assert windows.n_trajectories == 4 and len(windows.gripper) == 26
    histories = windows.history.tolist()
    assert [21, 3] in histories and [25, 9 + 5] in histories and [9, 9] in histories
    assert [8, 9] not in histories


def test_a_demonstration_that_sources_share_is_learned_from_once(
    make_dataset, open_windows, tmp_path
):
    datasets = [make_dataset((3, 5)), make_dataset((4,))]
    request = {"config": {"seed": 1}}
    # Told apart by their settings, as parts of a merged dataset are.
    rows = [d.sources[0] for d in datasets]
    rows[1].request = request
    whole = open_windows(merge_datasets(datasets, tmp_path / "both"), 32, 2)
    alone = [open_windows(dataset, 32, 2) for dataset in datasets]
    assert whole.n_trajectories == 4 == sum(each.n_trajectories for each in alone) - 1
    n_demonstration = len(datasets[0].sources[0].demonstration)
    n_steps = sum(int(each.multiplicity.sum()) for each in alone)
    assert int(whole.multiplicity.sum()) == n_steps - n_demonstration
    assert len(whole.gripper) == sum(len(each.gripper) for each in alone) - n_demonstration


def test_demonstrations_seen_by_different_cameras_are_refused(two_sources, open_windows):
    with pytest.raises(Mismatch, match="demo01: camera 'wrist' has another size, intrinsics or"):
        open_windows(two_sources(size=24))


@pytest.fixture
def with_last(tmp_path_factory):
    """The dataset with its last episode changed."""

    def with_last(dataset, steps=None, **provenance):
        *others, last = dataset
        changed = dataclasses.replace(
            last,
            steps=steps or last.steps,
            provenance=dataclasses.replace(last.provenance, **provenance),
        )
        (source,) = dataset.sources
        sources = [(source.demonstration, source.annotation)]
        return write_dataset(tmp_path_factory.mktemp("other"), sources, [*others, changed], {})

    return with_last


def test_an_episode_of_another_demonstration_is_refused(dataset, with_last, open_windows):
    with pytest.raises(
        Mismatch, match="sphere00_k00002.h5 was generated from another demonstration"
    ):
        open_windows(with_last(dataset, demonstration_hash="0"))


def test_of_an_episode_that_is_not_merged_only_its_segment_is_learned(
    dataset, with_last, open_windows
):
    whole, cut = open_windows(dataset), open_windows(with_last(dataset, merged=False))
    episode = dataset.episode(2)
    n, t_star = len(dataset.sources[0].demonstration), episode.provenance.t_star
    assert whole.multiplicity.sum() - cut.multiplicity.sum() == n - t_star
    # Its last step still leads to where it would join.
    last = n + 3 * len(episode) - 1
    for windows in (whole, cut):
        (at,) = torch.nonzero(windows.history[:, -1] == last)[:, 0]
        expected = episode.actions(dataset.sources[0].demonstration)[len(episode) - 1]
        np.testing.assert_allclose(windows.actions[at], expected, atol=1e-6)
    joins = (cut.history[:, -1] == t_star) & (cut.history[:, -2] == last)
    assert not joins.any()


@pytest.mark.parametrize("t_star", [-1, 9])
def test_an_episode_that_rejoins_nowhere_is_refused(dataset, t_star, with_last, open_windows):
    with pytest.raises(Mismatch, match=f"episode 2 rejoins at step {t_star} of a demonstration"):
        open_windows(with_last(dataset, t_star=t_star))


def test_an_episode_without_the_camera_is_refused(dataset, with_last, open_windows):
    steps = dataclasses.replace(dataset.episode(2).steps, cameras={})
    with pytest.raises(Mismatch, match="episode 2 has no images of camera 'wrist'"):
        open_windows(with_last(dataset, steps))


@pytest.mark.parametrize("field", ["intrinsics", "T_frame_camera", "size"])
def test_an_episode_seen_by_another_camera_is_refused(dataset, field, with_last, open_windows):
    steps = dataset.episode(2).steps
    camera = steps.cameras["wrist"]
    if field == "size":
        camera = dataclasses.replace(camera, rgb=camera.rgb[:, 2:], depth=camera.depth[:, 2:])
    else:
        value = np.array(getattr(camera, field))
        value[0, -1] += 0.1
        camera = dataclasses.replace(camera, **{field: value})
    steps = dataclasses.replace(steps, cameras={"wrist": camera})
    with pytest.raises(Mismatch, match="episode 2: camera 'wrist' has another size, intrinsics or"):
        open_windows(with_last(dataset, steps))
