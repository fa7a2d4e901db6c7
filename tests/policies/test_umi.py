"""UMI's policies, to the actions that the original gave with the middle of all that it draws; see ``umis.py``."""

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.families.support import record, stored_program
from tests.rounding import PROMISED
from ttscompile.artifact import load_artifact
from ttscompile.errors import ObservationError
from ttscompile.frontends import load_checkpoint_policy, recordings_of
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.settings import Settings
from ttscompile.policies.diffusion_policy.timm_pictures import Pictures

from . import umis
from .authors import by_one_command
from .originals import assert_agreement_on_random_plans
from .refused import Refusals, assert_not_read, refusals

WARNED = {
    "clip": r"transforms: the original draws ColorJitter, RandomCrop anew at every call, on the robot, too",
    "dino": "the original draws RandomRotation anew",
    "spatial_embedding": "the original draws ColorJitter, RandomCrop anew",
    "tokens": "the original draws RandomCrop, RandomRotation anew",
    "blind": r"feature_aggregation is transformer: .* the same whatever a camera shows",
}


def warned(variant: str) -> AbstractContextManager[object]:
    """Within it a variant is loaded, with what is said of it."""
    return pytest.warns(UserWarning, match=WARNED[variant]) if variant in WARNED else nullcontext()


def assert_near(found: np.ndarray, expected: np.ndarray) -> None:
    """Within what is promised."""
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() < PROMISED * np.ptp(expected)


@pytest.mark.slow
@pytest.mark.parametrize("variant", umis.VARIANTS)
def test_the_original_acts_the_same(variant: str, tmp_path: Path) -> None:
    """And so it does not where another picture is seen, but for the policy that sees none."""
    with warned(variant):
        module, spec = load_checkpoint_policy(umis.save(tmp_path / "policy.ckpt", variant))
    assert (spec.chunk.start, spec.chunk.stop, spec.sampler.name, spec.sampler.steps) == (0, umis.HORIZON, "ddim", 16)
    observed, expected = umis.observation(variant), umis.expected(variant)["action"]
    assert {key: each.shape for key, each in spec.observations.items()} == {k: v.shape[1:] for k, v in observed.items()}
    act = eager_policy(module, spec)

    def actions(**changed: np.ndarray) -> np.ndarray:
        seen = {k: torch.from_numpy(each.normalized((observed | changed)[k])) for k, each in spec.observations.items()}
        return spec.chunk.unnormalized(act(seen, ttscompile.Noise(umis.noise())).numpy())

    assert_near(actions(), expected)
    other = np.abs(actions(camera0_rgb=1 - observed["camera0_rgb"]) - expected).max() / np.ptp(expected)
    assert other < PROMISED if variant == "blind" else other > 100 * PROMISED


# Compiled

COMPILED = {"clip": "UMI, U-Net (timm's networks)", "tokens": "UMI, transformer (timm's networks)"}
"""Variant, and the row of the support table."""


@pytest.fixture(scope="module", params=COMPILED)
def compiled(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Variant and artifact of a policy, converted once."""
    path = umis.save(tmp_path_factory.mktemp(request.param) / "policy.ckpt", request.param)
    with warned(request.param):
        return request.param, by_one_command(path)


@pytest.mark.slow
def test_one_command_compiles_it(compiled: tuple[str, Path]) -> None:
    """In both runtimes; its row of the support table."""
    variant, folder = compiled
    for runtime in ("onnxruntime", "reference"):
        policy = ttscompile.load(folder, runtime=runtime)
        made = policy.predict_action(umis.observation(variant), noise=ttscompile.Noise(umis.noise()), plan="dense")
        for part in ("action", "action_pred"):
            assert_near(made[part], umis.expected(variant)["action"])
    assert_agreement_on_random_plans(folder)
    artifact = load_artifact(folder)
    record(
        COMPILED[variant],
        "actions that the original gave with the middle of what it draws, 1e-5 of the range",
        "ddim 16",
        stored_program(artifact),
    )


@pytest.mark.slow
def test_what_is_committed_replaces_the_sample(compiled: tuple[str, Path]) -> None:
    """As in the original, where it was asked for; and elsewhere as in any policy, with noise."""
    variant, folder = compiled
    policy, noise = ttscompile.load(folder), ttscompile.Noise(umis.noise())
    made = policy.predict_action(umis.observation(variant), noise=noise, prefix=umis.committed())["action"]
    np.testing.assert_allclose(made[:, : umis.COMMITTED], umis.committed(), atol=1e-5)
    assert np.abs(made[:, umis.COMMITTED :] - umis.expected(variant)["action"][:, umis.COMMITTED :]).max() > 0.01
    if variant == "clip":
        assert_near(made, umis.expected(variant)["prefixed"])
        with pytest.raises(ObservationError, match="prefix holds 8 actions; .* at most 7"):
            policy.predict_action(umis.observation(variant), prefix=np.zeros((2, 8, 10), np.float32))


@pytest.mark.slow
def test_a_frame_that_is_known_is_not_seen_again(compiled: tuple[str, Path]) -> None:
    variant, folder = compiled
    policy = ttscompile.load(folder)
    observed = {key: value[:1] for key, value in umis.observation(variant).items()}
    for expected in ((2, 0), (0, 2), (1, 1)):
        if expected == (1, 1):
            new = np.zeros_like(observed["camera0_rgb"][:, :1])
            observed["camera0_rgb"] = np.concatenate([observed["camera0_rgb"][:, 1:], new], 1)
        policy.predict_action(observed)
        assert policy.last_report is not None
        frames = policy.last_report.frames
        assert (frames.computed, frames.remembered) == expected


# Pictures


def pictures(size: tuple[int, int], *transforms: dict[str, Any], normalizer: tuple[float, float] = (1.0, 0.0)) -> Any:
    """The steps of some transforms."""
    return Pictures(Settings({"transforms": list(transforms)}, "cfg."), size, normalizer)


def test_the_middle_of_what_is_drawn() -> None:
    """A crop whose margins are 1 and 2, and nothing else; then colours of mean 0.5 and deviation 0.25."""
    crop = {"_target_": "torchvision.transforms.RandomCrop", "size": [2, 4]}
    jitter = {"_target_": "torchvision.transforms.ColorJitter", "brightness": [0.5, 1.5]}
    colours = {"_target_": "torchvision.transforms.Normalize", "mean": [0.5] * 3, "std": [0.25] * 3}
    others = [{"_target_": f"torchvision.transforms.{name}"} for name in ("RandomPerspective", "ElasticTransform")]
    made = pictures((4, 8), crop, jitter, *others, colours)
    image = torch.rand(1, 3, 4, 8)
    assert (made.size, made.drawn) == ((2, 4), ["RandomCrop", "ColorJitter", "RandomPerspective", "ElasticTransform"])
    torch.testing.assert_close(torch.nn.Sequential(*made.steps)(image), 4 * image[:, :, 1:3, 2:6] - 2)
    assert not pictures((4, 8), crop | {"size": [4, 8]}).drawn


def test_colours_that_were_moved_are_kept_within_bounds() -> None:
    """As the original's jitter keeps them, whatever it draws."""
    jitter = {"_target_": "torchvision.transforms.ColorJitter", "hue": 0.1}
    made = pictures((1, 1), jitter, normalizer=(2.0, -1.0))
    image = torch.tensor([0.1, 0.6, 0.9])[None, :, None, None]
    expected = torch.tensor([0.0, 0.2, 0.8])[None, :, None, None]
    torch.testing.assert_close(torch.nn.Sequential(*made.steps)(image), expected)


def test_the_shorter_side_is_resized() -> None:
    resize = {"_target_": "torchvision.transforms.Resize", "size": 10, "antialias": True}
    assert (pictures((20, 30), resize).size, pictures((30, 20), resize).size) == ((10, 15), (15, 10))
    assert pictures((20, 30), resize | {"size": [7, 8]}).size == (7, 8)


# Refused

_TURN = {"_target_": "torchvision.transforms.RandomRotation"}
_JITTER = {"_target_": "torchvision.transforms.ColorJitter"}
_CAMERA = {"shape": [3, 48, 48], "horizon": 2, "type": "rgb"}

REFUSED: Refusals = {
    "clip/obs_encoder": [
        ({"_target_": "a.TransformerObsEncoder"}, r"obs_encoder is TransformerObsEncoder; expected TimmObsEncoder"),
        ({"more": 1}, "obs_encoder has settings that TimmObsEncoder does not know: more"),
        (
            {"model_name": "vit_base_patch16_siglip_224"},
            "model_name is 'vit_base_patch16_siglip_224'; expected a plain",
        ),
        ({"model_name": "efficientnet_b0"}, "expected a plain .* other networks of timm are"),
        ({"model_name": "resnet50d"}, "model_name is 'resnet50d'; expected"),
        ({"model_name": ["vit"]}, r"model_name is \['vit'\]; expected a name"),
        ({"model_name": "vit_base_patch16_224"}, r"unexpected networks\.0\.norm_pre\.bias"),
        ({"model_name": "vit_base_patch14_dinov2"}, r"missing networks\.0\.patch_embed\.proj\.bias, .*lambda_1"),
        ({"model_name": "vit_base_patch14_reg4_dinov2"}, "10 positions; expected a plain transformer"),
        ({"model_name": "resnet18", "feature_aggregation": "max"}, r"missing networks\.0\.0\.weight"),
        ({"model_name": "convnext_base"}, r"key_model_map\.\*\.1\.0\.blocks\.0\.gamma: expected a weight of 1 axes"),
        ({"feature_aggregation": "all_tokens"}, "feature_aggregation is 'all_tokens'; expected null"),
        ({"global_pool": "avg"}, "global_pool is 'avg'; expected"),
        ({"share_rgb_model": 1}, "share_rgb_model is 1; expected true or false"),
        ({"transforms": []}, r"transforms is \[\]; expected transforms by name or null"),
        ({"transforms": [{"type": "Resize"}]}, r"transforms\[0\]\.type is 'Resize'; expected RandomCrop"),
        ({"transforms": [{"type": "RandomCrop", "ratio": 1.5}]}, "ratio is 1.5; expected a share of the picture"),
        ({"transforms": [{"type": "RandomCrop", "ratio": 1e-9}]}, "ratio is 1e-09; expected a share"),
        ({"transforms": [{"_target_": "torchvision.transforms.RandomErasing"}]}, "_target_ is 'RandomErasing'"),
        ({"transforms": [_TURN | {"degrees": [5, 9]}]}, r"degrees is \[5, 9\]; expected a number, or a range around 0"),
        ({"transforms": [_TURN | {"degrees": "9"}]}, "degrees is '9'; expected a number"),
        ({"transforms": [_TURN | {"degrees": 5, "expand": True}]}, "expand is true; expected false"),
        ({"transforms": [_TURN | {"degrees": 5, "center": [1, 1]}]}, "RandomRotation has settings .*: center"),
        ({"transforms": [_JITTER | {"contrast": [0.2, 0.8]}]}, r"contrast is \[0\.2, 0\.8\]; .* around 1"),
        (
            {"transforms": [{"_target_": "torchvision.transforms.CenterCrop", "size": 49}]},
            "a crop of 49 x 49 from pictures of 48 x 48; expected one that is no larger",
        ),
        (
            {"transforms": [{"_target_": "torchvision.transforms.CenterCrop", "size": 40}]},
            "takes pictures of 48 x 48; after its transforms they are 40 x 40",
        ),
        ({"transforms": [{"_target_": "a.Resize", "size": 10**6}]}, "size is .*; expected .* of 4096 pixels at most"),
        ({"transforms": [{"_target_": "a.Normalize", "mean": [0, 0, 0], "std": [1, 1, 0]}]}, "std is .*; expected"),
    ],
    "clip/obs": [
        ({"camera0_rgb": {**_CAMERA, "shape": [1, 48, 48]}}, r"shape is \[1, 48, 48\]; expected one"),
        ({"camera0_rgb": {**_CAMERA, "horizon": 10**9}}, "horizon is 1000000000; expected"),
        ({"camera0_rgb": {**_CAMERA, "shape": [3, 10**6, 48]}}, r"\[C, H, W\], 4096 pixels at most"),
        ({"camera0_rgb": {"shape": [3], "horizon": 2}}, r"expected cameras \(type: rgb\) of one size; found \{\}"),
        ({"camera1_rgb": {**_CAMERA, "shape": [3, 48, 32]}}, r"of one size; found .*\[3, 48, 32\]"),
        ({"robot0_eef_pos": {"shape": [3, 2], "horizon": 2}}, r"shape is \[3, 2\]; expected one number"),
        ({"robot0_eef_pos": {"shape": [3]}}, "horizon is None; expected a positive whole number"),
        ({"robot0_eef_pos": {"shape": [4], "horizon": 2}}, r"eef_pos\.scale has shape \(3,\); expected one entry for"),
        ({"robot0_gripper_width": {"shape": [1], "horizon": 3}}, r"weight model\.\S+ has shape"),
        ({"more": {"shape": [1], "horizon": 1}}, r"the weights hold no normalizer\.params_dict\.more\.scale"),
    ],
    "clip/action": [
        ({"horizon": 10**9}, r"action\.horizon is 1000000000; expected a positive whole number, 4096 at most"),
        ({"horizon": 7}, r"shape_meta\.action\.horizon is 7; expected a multiple of 2"),
        ({"shape": [9]}, r"model\.\S+ has shape"),
    ],
    "clip": [
        ({"obs_as_global_cond": False}, "obs_as_global_cond is False; expected true; the original refuses this, too"),
        ({"down_dims": [10**6, 10**6]}, "input_dim asks for at least 10000000 weights"),
        ({"diffusion_step_embed_dim": 10**6}, "diffusion_step_embed_dim asks for at least"),
        ({"inpaint_fixed_action_prefix": "yes"}, "inpaint_fixed_action_prefix is 'yes'; expected true or false"),
        ({"shape_meta": None}, r"cfg\.policy\.shape_meta is missing or malformed"),
    ],
    "deeper/obs_encoder": [
        ({"feature_aggregation": "soft_attention"}, "feature_aggregation is 'soft_attention'; expected avg or max"),
        ({"downsample_ratio": 8}, "downsample_ratio is 8; expected 32, or 16 of a resnet"),
        ({"downsample_ratio": 16}, r"unexpected networks\.0\.7\.0"),
        ({"use_group_norm": False}, r"missing networks\.0\.1\.running_mean"),
    ],
    "attention_pool/obs_encoder": [
        ({"feature_aggregation": None}, "feature_aggregation is None; expected avg or max or soft"),
        ({"feature_aggregation": ["avg"]}, r"feature_aggregation is \['avg'\]; expected avg"),
        ({"share_rgb_model": True}, r"camera1_rgb\.\S+ is not obs_encoder\S+, though share"),
    ],
    "average/obs_encoder": [
        ({"downsample_ratio": 16}, "downsample_ratio is 16; expected 32, or 16 of a resnet"),
        (
            {"transforms": [{"_target_": "a.CenterCrop", "size": 31}]},
            r"convnext_base\S+ takes pictures from 32 x 32 on",
        ),
    ],
    "tokens": [
        ({"n_emb": 64}, "n_emb is 64, and that of its obs_encoder 32; expected the same"),
        ({"n_emb": 10**6, "obs_encoder": {"n_emb": 10**6}}, "n_emb is 1000000; expected .* 65536"),
        ({"n_head": 5}, r"cfg\.policy: n_emb = 32 with n_head = 5"),
        ({"n_layer": 10**9}, "n_layer asks for at least"),
        ({"n_layer": 3}, r"missing model\.decoder\.layers\.2"),
        ({"action": {"horizon": 9}}, r"model\.pos_emb has shape \(1, 8, 32\); expected \(1, 9, 32\)"),
        (
            {"obs": {"camera0_rgb": {"shape": [3, 64, 64], "horizon": 3, "type": "rgb"}}},
            r"model\.cond_pos_emb has shape",
        ),
    ],
    "tokens/obs_encoder": [({"imagenet_norm": True}, "TransformerObsEncoder does not know: imagenet_norm")],
    "places/obs_encoder": [
        ({"feature_aggregation": "spatial_embedding"}, "expected null or avg or max or soft_attention")
    ],
}


@pytest.mark.filterwarnings("ignore:cfg.policy.obs_encoder.transforms")
@pytest.mark.parametrize(("place", "changes", "message"), refusals(REFUSED))
def test_what_is_no_such_policy_is_refused(place: str, changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    variant, _, entry = place.partition("/")
    path = umis.save(tmp_path / "policy.ckpt", variant, **({entry: changes} if entry else changes))
    assert_not_read(path, message, names=path)


def test_its_recordings_are_those_of_the_policy(tmp_path: Path) -> None:
    """Its data set has other poses than it observes."""
    with pytest.raises(Exception, match=r"trained on session/dataset\.zarr\.zip, whose poses are the robot's, .*\.npz"):
        recordings_of(umis.save(tmp_path / "policy.ckpt", "plain"))


def test_other_loops(tmp_path: Path) -> None:
    options = LoadOptions(sampler="ddpm", steps=4)
    spec = load_checkpoint_policy(umis.save(tmp_path / "policy.ckpt", "plain"), options=options)[1]
    assert [(each.name, each.steps) for each in spec.all_loops.values()] == [("ddim", 16), ("ddpm", 4)]
