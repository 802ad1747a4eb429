import numpy as np
import pytest
import torch

from sart_toolkit.learn import frames
from sart_toolkit.learn.frames import FrameLayout, Frames, input_size, resize_area


def test_area_resizing_averages_the_area_of_each_pixel():
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (12, 18, 3), dtype=np.uint8)
    exact = rgb.reshape(6, 2, 6, 3, 3).mean((1, 3))
    assert (resize_area(rgb, (6, 6)) == np.rint(exact)).all()
    assert (resize_area(rgb, (4, 9)) == np.rint(rgb.reshape(4, 3, 9, 2, 3).mean((1, 3)))).all()
    # 12 -> 8: each new pixel covers one and a half old ones.
    fine = np.repeat(np.repeat(rgb[:, :12], 2, 0), 2, 1).reshape(8, 3, 8, 3, 3)
    assert (resize_area(rgb[:, :12], (8, 8)) == np.rint(fine.mean((1, 3)))).all()
    # 12 -> 24: each old pixel becomes four.
    twice = np.repeat(np.repeat(rgb[:, :12], 2, 0), 2, 1)
    assert (resize_area(rgb[:, :12], (24, 24)) == twice).all()
    assert (resize_area(rgb, (12, 18)) == rgb).all()
    assert (resize_area(np.full((50, 31, 3), 77, np.uint8), (64, 40)) == 77).all()


@pytest.mark.parametrize(
    ("recorded", "expected"),
    [((128, 128), (64, 64)), ((120, 160), (64, 85)), ((160, 120), (64, 48)), ((900, 2), (64, 1))],
)
def test_policies_see_the_recorded_proportions(recorded, expected):
    assert input_size(recorded, 64) == expected


@pytest.fixture
def file(tmp_path):
    """A file of random frames of two cameras, and what it holds."""
    layout = FrameLayout({"a": (4, 6), "b": (3, 5)}, pad=1)
    packed = np.random.default_rng(0).integers(0, 256, (50, layout.frame_bytes), dtype=np.uint8)
    (tmp_path / "frames.bin").write_bytes(packed.tobytes())
    n = 6 * 8 * 3
    return (
        tmp_path / "frames.bin",
        layout,
        {"a": packed[:, :n].reshape(50, 6, 8, 3), "b": packed[:, n:].reshape(50, 5, 7, 3)},
    )


@pytest.mark.parametrize("at_most", [512 * 2**20, 0])
def test_gathering_gives_what_the_file_holds_however_often_it_is_let_go(file, at_most, monkeypatch):
    monkeypatch.setattr(frames, "_MAPPED_AT_MOST", at_most)
    path, layout, held = file
    found = Frames.in_file(path, layout)
    at = torch.tensor([3, 4, 49, 0, 7, 7])
    for _ in range(3):
        found.will_need(at)
        middle = found.gather(at)
        corner = found.gather(at, torch.tensor([[0, 2]] * 6))
        for camera in ("a", "b"):
            expected = held[camera][at.numpy()]
            assert (middle[camera].permute(0, 2, 3, 1).numpy()
                    == expected[:, 1:-1, 1:-1]).all()  # fmt: skip
            assert (corner[camera].permute(0, 2, 3, 1).numpy()
                    == expected[:, :-2, 2:]).all()  # fmt: skip


def test_a_copy_in_memory_gathers_the_same(file):
    path, layout, _ = file
    mapped = Frames.in_file(path, layout)
    copied = mapped.to(torch.device("cpu"))
    at = torch.tensor([3, 4, 49, 0])
    copied.will_need(at)
    for camera, images in copied.gather(at).items():
        assert torch.equal(images, mapped.gather(at)[camera])
        assert copied.images[camera].data_ptr() != mapped.images[camera].data_ptr()
