import inspect

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, MissingFile, UnknownName
from sart_toolkit.learn.model import Policy
from sart_toolkit.learn.policies import POLICIES, get_encoder
from sart_toolkit.learn.policies.encoder import Encoder, read_state_dict
from sart_toolkit.learn.policies.resnet18_mlp import ResNet18, ResNet18Encoder
from sart_toolkit.learn.training import TrainConfig, build_policy


def _torchvision_resnet18() -> dict[str, tuple[int, ...]]:
    """Names and shapes of torchvision's resnet18().state_dict(), from its published definition."""
    shapes: dict[str, tuple[int, ...]] = {}

    def conv(name, n_in, n_out, kernel):
        shapes[f"{name}.weight"] = (n_out, n_in, kernel, kernel)

    def norm(name, n):
        for part in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{name}.{part}"] = (n,)
        shapes[f"{name}.num_batches_tracked"] = ()

    conv("conv1", 3, 64, 7)
    norm("bn1", 64)
    n_in = 64
    for layer, n in enumerate((64, 128, 256, 512), start=1):
        for block in range(2):
            at = f"layer{layer}.{block}"
            conv(f"{at}.conv1", n_in, n, 3)
            norm(f"{at}.bn1", n)
            conv(f"{at}.conv2", n, n, 3)
            norm(f"{at}.bn2", n)
            if n_in != n:
                conv(f"{at}.downsample.0", n_in, n, 1)
                norm(f"{at}.downsample.1", n)
            n_in = n
    shapes["fc.weight"] = (1000, 512)
    shapes["fc.bias"] = (1000,)
    return shapes


def test_resnet18_has_torchvisions_names_and_shapes_in_its_order():
    expected = _torchvision_resnet18()
    found = {name: tuple(tensor.shape) for name, tensor in ResNet18().state_dict().items()}
    assert len(found) == 122
    assert list(found.items()) == list(expected.items())
    assert sum(p.numel() for p in ResNet18().parameters()) == 11_689_512


def test_group_norm_has_the_same_names_without_running_statistics():
    found = set(ResNet18("group").state_dict())
    gone = ("running_mean", "running_var", "num_batches_tracked")
    assert found == {name for name in _torchvision_resnet18() if not name.endswith(gone)}


@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_a_policy_takes_pictures_and_gripper_and_nothing_else(policy):
    assert list(inspect.signature(Policy.forward).parameters) == ["self", "frames", "gripper"]
    encoder = get_encoder(policy)
    assert list(inspect.signature(encoder.forward).parameters) == ["self", "pictures"]


@pytest.mark.parametrize(
    ("policy", "norm"), [(p, n) for p in sorted(POLICIES) for n in get_encoder(p).norms]
)
def test_every_policy_maps_uint8_windows_to_actions(policy, norm):
    config = TrainConfig.for_policy(policy, norm=norm, image_size=33, image_shift=0, hidden=8)
    model = build_policy(config).eval()
    frames = torch.randint(0, 256, (2, 2, 3, 33, 33), dtype=torch.uint8)
    actions = model(frames, torch.rand(2, 2))
    assert actions.shape == (2, 7) and actions.dtype == torch.float32
    assert not torch.equal(actions[0], actions[1])
    assert set(get_encoder(policy).train_defaults) <= set(config.to_json())


@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_normalisation_is_part_of_the_state_dict(policy):
    names = set(build_policy(TrainConfig.for_policy(policy)).state_dict())
    assert {"image_mean", "image_scale", "gripper_mean", "action_mean", "action_std"} <= names


def test_the_soft_argmax_finds_a_blob_to_a_fraction_of_a_pixel():
    encoder = get_encoder("compact_mlp")(64, "none")
    with torch.no_grad():
        encoder.layers = nn.AvgPool2d(4)  # type: ignore[assignment]
        x, y = torch.meshgrid(torch.linspace(-1, 1, 64), torch.linspace(-1, 1, 64), indexing="xy")
        blob = -((x - 0.31) ** 2 + (y + 0.17) ** 2) / 0.04
        features = encoder(blob.expand(1, 3, 64, 64))
    # Pixel centres of the pooled map lie at +-(1 - 3/63) of the picture's.
    scale = 1 - 3 / 63
    assert features[0, 0].item() == pytest.approx(0.31 / scale, abs=0.01)
    assert features[0, 3].item() == pytest.approx(-0.17 / scale, abs=0.01)


@pytest.mark.parametrize("suffix", [".pth", ".pt", ".safetensors"])
def test_backbone_weights_are_loaded_with_or_without_fc(tmp_path, suffix):
    state = {k: torch.full_like(v, 0.5) for k, v in ResNet18().state_dict().items()}
    if suffix == ".pt":
        del state["fc.weight"], state["fc.bias"]
    path = tmp_path / f"weights{suffix}"
    save_file(state, path) if suffix == ".safetensors" else torch.save(state, path)
    encoder = ResNet18Encoder(64, "batch")
    encoder.load_backbone(path)
    assert all(
        (tensor == 0.5).all() for k, tensor in encoder.state_dict().items() if "num" not in k
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("layer1.0.conv1.weight"), "lacks 'layer1.0.conv1.weight';"),
        (lambda s: [s.pop("bn1.bias"), s.pop("conv1.weight")], "lacks 'bn1.bias' and 1 more"),
        (lambda s: s.update(extra=torch.zeros(1)), "also holds 'extra'"),
        (
            lambda s: s.update({"conv1.weight": torch.zeros(64, 1, 7, 7)}),
            r"'conv1.weight' has shape \(64, 1, 7, 7\), ResNet18 needs \(64, 3, 7, 7\)",
        ),
    ],
)
def test_backbone_weights_that_do_not_fit_are_refused(tmp_path, change, message):
    state = ResNet18().state_dict()
    change(state)
    save_file(state, tmp_path / "weights.safetensors")
    with pytest.raises(Mismatch, match=message):
        ResNet18Encoder(64, "batch").load_backbone(tmp_path / "weights.safetensors")


def test_batch_norm_weights_are_refused_by_group_norm_with_the_remedy(tmp_path):
    save_file(ResNet18().state_dict(), tmp_path / "weights.safetensors")
    with pytest.raises(Mismatch, match="also holds .* --norm batch"):
        ResNet18Encoder(64, "group").load_backbone(tmp_path / "weights.safetensors")


def test_missing_backbone_weights_are_refused(tmp_path):
    with pytest.raises(MissingFile, match="no such file of backbone weights"):
        read_state_dict(tmp_path / "weights.pth")


def test_another_kind_of_weights_file_is_refused(tmp_path):
    (tmp_path / "weights.onnx").write_bytes(b"x")
    with pytest.raises(InvalidInput, match="expected a .pth, .pt or .safetensors file"):
        read_state_dict(tmp_path / "weights.onnx")


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_damaged_weights_are_refused(tmp_path, suffix):
    path = tmp_path / f"weights{suffix}"
    state = {"a": torch.zeros(1000)}
    save_file(state, path) if suffix == ".safetensors" else torch.save(state, path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(BrokenFile, match="not readable as plain weights"):
        read_state_dict(path)


def test_weights_that_would_run_code_are_refused(tmp_path):
    torch.save(nn.Linear(1, 1), tmp_path / "weights.pth")
    with pytest.raises(BrokenFile, match="not readable as plain weights"):
        read_state_dict(tmp_path / "weights.pth")


def test_a_file_of_anything_but_tensors_is_refused(tmp_path):
    torch.save({"state_dict": {"a": torch.zeros(1)}}, tmp_path / "weights.pth")
    with pytest.raises(BrokenFile, match="expected tensors by name"):
        read_state_dict(tmp_path / "weights.pth")


def test_an_encoder_without_published_weights_says_so(tmp_path):
    with pytest.raises(InvalidInput, match="CompactEncoder takes no --backbone-weights"):
        get_encoder("compact_mlp")(64, "none").load_backbone(tmp_path / "weights.pth")


def test_an_unknown_policy_is_refused_with_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'compact_mlp'"):
        get_encoder("compact_mpl")


def test_every_entry_of_the_table_is_an_encoder():
    for name in POLICIES:
        assert issubclass(get_encoder(name), Encoder)
