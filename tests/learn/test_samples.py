import dataclasses
from collections import Counter

import numpy as np
import pytest
import torch

from sart_toolkit.data.records import Dataset
from sart_toolkit.errors import InvalidInput, Mismatch, UnknownName
from sart_toolkit.learn.samples import build_windows, resize_area
from sart_toolkit.poses import pose


def _expected_windows(dataset, history):
    """Every window of every trajectory, one by one: frames, gripper and action as bytes."""
    demonstration = dataset.demonstration
    trajectories = [(demonstration.steps, len(demonstration), demonstration.actions)]
    trajectories += [
        (e.steps, e.provenance.t_star, e.actions(demonstration)) for e in dataset.episodes
    ]
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


@pytest.mark.parametrize("history", [1, 2, 3])
@pytest.mark.parametrize("t_stars", [(), (0,), (3, 5, 5), (8, 1, 8, 2)])
def test_windows_are_exactly_the_steps_of_all_trajectories(make_dataset, history, t_stars):
    dataset = make_dataset(t_stars)
    windows = build_windows(dataset, "wrist", 32, history)
    frames, gripper, actions = windows.batch(torch.arange(len(windows.history)))
    found = {
        (f.permute(0, 2, 3, 1).numpy().tobytes(), tuple(g.numpy()), tuple(a.numpy())): int(m)
        for f, g, a, m in zip(frames, gripper, actions, windows.multiplicity, strict=True)
    }
    assert found == dict(_expected_windows(dataset, history))
    assert len(found) == len(windows.history)


def test_each_picture_is_stored_once(make_dataset):
    dataset = make_dataset((2,) * 20)
    windows = build_windows(dataset, "wrist", 16, 2)
    assert len(windows.frames) == len(dataset.demonstration) + 20 * 4


def test_the_first_window_repeats_the_first_frame(dataset):
    windows = build_windows(dataset, "wrist", 16, 3)
    assert [0, 0, 0] in windows.history.tolist()
    assert [0, 0, 1] in windows.history.tolist()


def test_the_window_at_the_join_holds_the_segments_last_frame(dataset):
    windows = build_windows(dataset, "wrist", 16, 2)
    # Demonstration 0..8, first episode's segment 9..12, then the demonstration from t* = 3.
    assert [12, 3] in windows.history.tolist()


def test_the_shared_suffix_counts_once_for_every_trajectory(dataset):
    windows = build_windows(dataset, "wrist", 16, 2)
    count = {tuple(h): int(m) for h, m in zip(windows.history, windows.multiplicity, strict=True)}
    count = {tuple(int(i) for i in h): m for h, m in count.items()}
    # t* = 3, 5, 5: the step after t* is the first whose history lies in the demonstration.
    assert [count[t - 1, t] for t in range(1, 9)] == [1, 1, 1, 2, 2, 4, 4, 4]


def test_an_epoch_passes_every_step_of_every_trajectory_once(dataset):
    windows = build_windows(dataset, "wrist", 16, 2)
    order = windows.epoch_order(np.random.default_rng(0))
    assert (np.bincount(order) == windows.multiplicity.numpy()).all()
    assert len(order) == 9 + (4 + 6) + 2 * (4 + 4)
    assert (order != windows.epoch_order(np.random.default_rng(1))).any()
    assert (order == windows.epoch_order(np.random.default_rng(0))).all()


def test_joints_forces_and_measured_poses_never_enter(dataset, perturbed, with_steps):
    plain = build_windows(dataset, "wrist", 16, 2)
    other = build_windows(with_steps(dataset, perturbed), "wrist", 16, 2)
    assert plain.content_hash() == other.content_hash()


def test_where_in_the_world_it_happened_never_enters(dataset, with_steps):
    def moved(steps):
        T = pose((1.0, -2.0, 0.5), (0.3, 0.2, -1.0))
        return dataclasses.replace(steps, commanded_Ts_world_tool=T @ steps.commanded_Ts_world_tool)

    plain = build_windows(dataset, "wrist", 16, 2)
    other = build_windows(with_steps(dataset, moved), "wrist", 16, 2)
    assert torch.allclose(plain.actions, other.actions, atol=1e-7)
    assert torch.equal(plain.frames, other.frames)


def test_area_resizing_averages_the_area_of_each_pixel():
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (12, 18, 3), dtype=np.uint8)
    exact = rgb.reshape(6, 2, 6, 3, 3).mean((1, 3))
    assert (resize_area(rgb, 6) == np.rint(exact)).all()
    # 12 -> 8: each new pixel covers one and a half old ones.
    fine = np.repeat(np.repeat(rgb[:, :12], 2, 0), 2, 1).reshape(8, 3, 8, 3, 3)
    assert (resize_area(rgb[:, :12], 8) == np.rint(fine.mean((1, 3)))).all()
    # 12 -> 24: each old pixel becomes four.
    assert (resize_area(rgb[:, :12], 24) == np.repeat(np.repeat(rgb[:, :12], 2, 0), 2, 1)).all()
    assert (resize_area(rgb[:12, :12], 12) == rgb[:12, :12]).all()
    assert (resize_area(np.full((50, 31, 3), 77, np.uint8), 64) == 77).all()


def test_shifts_move_all_of_a_windows_pictures_alike_and_repeat_the_edge(dataset):
    windows = build_windows(dataset, "wrist", 16, 2)
    padded = windows.padded(3)
    chosen = torch.tensor([4, 7, 2])
    plain, gripper, actions = windows.batch(chosen)
    offsets = torch.tensor([[0, 0], [3, 3], [5, 1]])
    shifted, same_gripper, same_actions = padded.batch(chosen, offsets)
    for picture, result, (row, column) in zip(plain, shifted, offsets.tolist(), strict=True):
        rows = np.clip(np.arange(16) + row - 3, 0, 15)
        columns = np.clip(np.arange(16) + column - 3, 0, 15)
        assert torch.equal(picture[:, :, rows][:, :, :, columns], result)
    assert torch.equal(gripper, same_gripper) and torch.equal(actions, same_actions)
    assert torch.equal(padded.batch(chosen)[0], plain)
    assert torch.equal(padded.padded(1).batch(chosen)[0], plain)
    assert padded.image_size == windows.image_size == 16


def test_batches_are_channels_last(dataset):
    windows = build_windows(dataset, "wrist", 16, 2)
    for frames in (
        windows.batch(torch.arange(4))[0],
        windows.padded(2).batch(torch.arange(4), torch.ones(4, 2, dtype=torch.int64))[0],
    ):
        assert frames.shape == (4, 2, 3, 16, 16) and frames.dtype == torch.uint8
        assert frames.flatten(0, 1).is_contiguous(memory_format=torch.channels_last)


def test_normalisation_weighs_trajectories_and_floors_what_hardly_moves(dataset):
    windows = build_windows(dataset, "wrist", 16, 2)
    repeated = windows.actions.double().repeat_interleave(windows.multiplicity, 0).numpy()
    normalisation = windows.normalisation()
    assert np.allclose(normalisation.action_mean, repeated.mean(0))
    assert np.allclose(normalisation.action_std[:2], repeated[:, :2].std(0))
    # z and the rotations are constant in this dataset.
    assert normalisation.action_std[2] == pytest.approx(0.1 * repeated[:, :2].std(0).max())
    assert (normalisation.action_std[3:6] == 1e-3).all()


@pytest.mark.parametrize("name", ["image_size", "history"])
def test_a_size_below_one_is_refused(dataset, name):
    with pytest.raises(InvalidInput, match=f"{name}: expected at least 1, got 0"):
        build_windows(dataset, "wrist", **{"image_size": 16, "history": 2, name: 0})


def test_an_unknown_camera_is_refused_with_the_nearest(dataset):
    with pytest.raises(UnknownName, match="did you mean 'wrist'"):
        build_windows(dataset, "wirst", 16, 2)


def _with_last(dataset, steps=None, **provenance):
    last = dataset.episodes[-1]
    changed = dataclasses.replace(
        last,
        steps=steps or last.steps,
        provenance=dataclasses.replace(last.provenance, **provenance),
    )
    return Dataset(dataset.demonstration, dataset.annotation, (*dataset.episodes[:-1], changed))


def test_an_episode_of_another_demonstration_is_refused(dataset):
    with pytest.raises(Mismatch, match="episode 2 was generated from another demonstration"):
        build_windows(_with_last(dataset, demonstration_hash="0"), "wrist", 16, 2)


@pytest.mark.parametrize("t_star", [-1, 9])
def test_an_episode_that_rejoins_nowhere_is_refused(dataset, t_star):
    with pytest.raises(Mismatch, match=f"episode 2 rejoins at step {t_star} of a demonstration"):
        build_windows(_with_last(dataset, t_star=t_star), "wrist", 16, 2)


def test_an_episode_without_the_camera_is_refused(dataset):
    steps = dataclasses.replace(dataset.episodes[-1].steps, cameras={})
    with pytest.raises(Mismatch, match="episode 2 has no pictures of camera 'wrist'"):
        build_windows(_with_last(dataset, steps), "wrist", 16, 2)


@pytest.mark.parametrize("field", ["intrinsics", "T_frame_camera", "size"])
def test_an_episode_seen_by_another_camera_is_refused(dataset, field):
    steps = dataset.episodes[-1].steps
    camera = steps.cameras["wrist"]
    if field == "size":
        camera = dataclasses.replace(camera, rgb=camera.rgb[:, 2:], depth=camera.depth[:, 2:])
    else:
        value = np.array(getattr(camera, field))
        value[0, -1] += 0.1
        camera = dataclasses.replace(camera, **{field: value})
    steps = dataclasses.replace(steps, cameras={"wrist": camera})
    with pytest.raises(Mismatch, match="episode 2: camera 'wrist' has another size, intrinsics or"):
        build_windows(_with_last(dataset, steps), "wrist", 16, 2)
