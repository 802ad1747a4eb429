import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, MissingFile, UnknownName
from sart_toolkit.learn.policies import POLICIES, get_policy
from sart_toolkit.learn.policies.compact_mlp import CompactEncoder
from sart_toolkit.learn.policies.encoder import read_state_dict
from sart_toolkit.learn.policies.resnet18_mlp import ResNet18
from sart_toolkit.learn.policy import Policy
from sart_toolkit.learn.skill import load_skill, save_skill
from sart_toolkit.learn.training import TrainConfig, build_policy, train


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


# The tool points down.
UP = (0.0, 0.0, -1.0)
LEARNED = sorted(set(POLICIES) - {"replay"})


class _Recorded(dict[str, torch.Tensor]):
    """Named tensors that remember which of them were asked for."""

    def __init__(self, tensors):
        super().__init__(tensors)
        self.asked = set()

    def __getitem__(self, name):
        self.asked.add(name)
        return super().__getitem__(name)


def _observation(n, **sizes):
    images = {
        f"images/{camera}": torch.randint(0, 256, (n, 2, 3, *size), dtype=torch.uint8)
        for camera, size in sizes.items()
    }
    return _Recorded({**images, "gripper": torch.rand(n, 2), "up": torch.rand(n, 3)})


@pytest.mark.parametrize("policy", LEARNED)
def test_a_policy_takes_images_gripper_and_tilt_and_nothing_else(policy):
    sizes = {"wrist": (32, 32), "overview": (32, 48)}
    config = TrainConfig.for_policy(policy, cameras=tuple(sizes), hidden=8)
    model = build_policy(config, sizes).eval()
    observation = _observation(2, **sizes)
    observation["joint_positions"] = torch.rand(2, 6)
    model.predict(observation)
    assert observation.asked == {"images/wrist", "images/overview", "gripper", "up"}
    observation["action"] = torch.rand(2, 7)
    model.loss(observation)
    assert observation.asked == {"images/wrist", "images/overview", "gripper", "up", "action"}


@pytest.mark.parametrize(("policy", "norm"), [(p, n) for p in LEARNED for n in get_policy(p).norms])
@pytest.mark.parametrize("sizes", [{"wrist": (33, 33)}, {"wrist": (33, 20), "top": (18, 33)}])
def test_every_policy_maps_uint8_windows_to_actions(policy, norm, sizes):
    config = TrainConfig.for_policy(policy, norm=norm, hidden=8, cameras=tuple(sizes))
    model = build_policy(config, sizes).eval()
    actions = model.predict(_observation(2, **sizes))
    assert actions.shape == (2, 7) and actions.dtype == torch.float32
    assert not torch.equal(actions[0], actions[1])
    assert set(get_policy(policy).train_defaults) <= set(config.to_json())


def test_cameras_share_the_encoders_class_and_not_its_weights():
    sizes = {"wrist": (32, 32), "overview": (32, 48)}
    config = TrainConfig.for_policy("compact_mlp", cameras=tuple(sizes))
    wrist, overview = build_policy(config, sizes).encoders
    assert type(wrist) is type(overview)
    assert not torch.equal(wrist.layers[0].weight, overview.layers[0].weight)


@pytest.mark.parametrize("policy", LEARNED)
def test_normalisation_is_part_of_the_state_dict(policy):
    model = build_policy(TrainConfig.for_policy(policy), {"wrist": (32, 32)})
    names = set(model.state_dict())
    assert {"image_mean", "image_scale", "gripper_mean", "action_mean", "action_std"} <= names


def test_the_soft_argmax_finds_a_blob_to_a_fraction_of_a_pixel():
    encoder = CompactEncoder((64, 96), "none")
    with torch.no_grad():
        encoder.layers = nn.AvgPool2d(4)  # type: ignore[assignment]
        x, y = torch.meshgrid(torch.linspace(-1, 1, 96), torch.linspace(-1, 1, 64), indexing="xy")
        blob = -((x - 0.31) ** 2 + (y + 0.17) ** 2) / 0.04
        features = encoder(blob.expand(1, 3, 64, 96))
    # Pixel centres of the pooled map lie at +-(1 - 3/(n - 1)) of the image's.
    assert features[0, 0].item() == pytest.approx(0.31 / (1 - 3 / 95), abs=0.01)
    assert features[0, 3].item() == pytest.approx(-0.17 / (1 - 3 / 63), abs=0.01)


def _resnet18_mlp(norm="batch", cameras=("wrist",)):
    config = TrainConfig.for_policy("resnet18_mlp", norm=norm, cameras=cameras)
    return build_policy(config, dict.fromkeys(cameras, (64, 64)))


@pytest.mark.parametrize("suffix", [".pth", ".pt", ".safetensors"])
def test_backbone_weights_are_loaded_with_or_without_fc(tmp_path, suffix):
    state = {k: torch.full_like(v, 0.5) for k, v in ResNet18().state_dict().items()}
    if suffix == ".pt":
        del state["fc.weight"], state["fc.bias"]
    path = tmp_path / f"weights{suffix}"
    save_file(state, path) if suffix == ".safetensors" else torch.save(state, path)
    policy = _resnet18_mlp(cameras=("wrist", "overview"))
    policy.load_backbone(path)
    loaded = {k: v for k, v in policy.encoders.state_dict().items() if "num" not in k}
    assert len(loaded) == 200 and all((tensor == 0.5).all() for tensor in loaded.values())


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
        _resnet18_mlp().load_backbone(tmp_path / "weights.safetensors")


def test_batch_norm_weights_are_refused_by_group_norm_with_the_remedy(tmp_path):
    save_file(ResNet18().state_dict(), tmp_path / "weights.safetensors")
    with pytest.raises(Mismatch, match="also holds .* --norm batch"):
        _resnet18_mlp("group").load_backbone(tmp_path / "weights.safetensors")


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


def test_a_policy_without_published_weights_says_so(tmp_path):
    policy = build_policy(TrainConfig.for_policy("compact_mlp"), {"wrist": (64, 64)})
    with pytest.raises(InvalidInput, match="CompactMLP takes no --backbone-weights"):
        policy.load_backbone(tmp_path / "weights.pth")


def test_an_unknown_policy_is_refused_with_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'compact_mlp'"):
        get_policy("compact_mpl")


def test_every_entry_of_the_table_is_a_policy():
    for name in POLICIES:
        assert issubclass(get_policy(name), Policy)


def test_what_is_no_policy_is_refused(monkeypatch):
    monkeypatch.setitem(POLICIES, "resnet", "sart_toolkit.learn.policies.resnet18_mlp:ResNet18")
    with pytest.raises(UnknownName, match="policy 'resnet': expected a subclass of Policy, got"):
        get_policy("resnet")


# --- replay -------------------------------------------------------------------------------------


def test_replay_gives_the_demonstrations_actions_whatever_is_seen_and_then_holds_still(
    dataset, tmp_path
):
    config = TrainConfig.for_policy("replay", image_size=32, device="cpu")
    result = train(dataset, config, tmp_path / "skill")
    save_skill(tmp_path / "skill", result, dataset)
    assert result.final_loss == 0.0
    demonstration = dataset.sources[0].demonstration
    skill = load_skill(tmp_path / "skill")
    rng = np.random.default_rng(0)
    for _ in range(2):
        skill.reset()
        for t in range(len(demonstration) + 3):
            image = rng.integers(0, 256, (32, 32, 3), dtype=np.uint8)
            action = skill.act({"wrist": image}, rng.uniform(), UP)
            if t < len(demonstration):
                np.testing.assert_allclose(action, demonstration.actions[t], atol=1e-6)
            else:
                np.testing.assert_allclose(action[:6], 0.0)
                assert action[6] == demonstration.actions[-1, 6]
