"""The U-Nets of Diffusion Policy and 3D Diffusion Policy: what the originals gave; see ``golden/make_unets.py``."""

import copy
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from ttscompile.core.spec import Noise, PolicySpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import AS_SAVED
from ttscompile.ir.program import Program
from ttscompile.policies.diffusion_policy import family as diffusion_policy
from ttscompile.policies.diffusion_policy.dp3 import POINTS

from ..families.support import record
from . import unets
from .originals import as_seen, assert_actions, assert_compiled_acts, assert_original, golden
from .refused import Refusals, refusals

GIVEN = {"local": "local condition", "inpainting": "inpainting", "hybrid_inpainting": "inpainting"}
SAVED_BY_THE_ORIGINAL = {"global": "global condition", "local": "local condition", "inpainting": "inpainting"}


def warned(variant: str) -> AbstractContextManager[object]:
    """Within it a variant is loaded, with what is said of it: older libraries give other numbers."""
    if variant == "images_shared":
        return pytest.warns(UserWarning, match=r"images of '[ab]' are made smaller, \d\d x \d\d to 34 x 36")
    if variant in unets.POINTS:
        return pytest.warns(UserWarning, match=r"DDIM's steps are those of diffusers from 0\.15 on")
    return nullcontext()


@pytest.mark.slow
@pytest.mark.parametrize("variant", unets.VARIANTS)
def test_the_original_gave_the_same(variant: str, tmp_path: Path) -> None:
    """Single evaluations, and the actions of a whole call, from the file that is saved."""
    torch.save(unets.payload(variant), tmp_path / "policy.ckpt")
    with warned(variant):
        module, spec = load_checkpoint_policy(tmp_path / "policy.ckpt")
    assert (spec.source["variant"], spec.source["weights"]) == (GIVEN.get(variant, "global condition"), "ema_model")
    noise = Noise(*unets.noise(spec.sample))
    assert_original(module, spec, unets.observation(variant), noise, golden(f"unet_{variant}"))


@pytest.mark.parametrize("name", SAVED_BY_THE_ORIGINAL)
def test_checkpoints_that_the_original_saved(name: str, shared: Path) -> None:
    """Read with the classes that are pickled in them, to the stored actions."""
    base = shared / "golden" / "diffusion_policy_unet" / name
    module, spec = load_checkpoint_policy(base.with_suffix(".ckpt"))
    assert spec.source["variant"] == SAVED_BY_THE_ORIGINAL[name]
    with np.load(base.with_suffix(".npz")) as numbers:
        noise = Noise(numbers["noise_initial"], numbers["noise_steps"])
        assert_actions(spec, eager_policy(module, spec)(as_seen(spec, {"obs": numbers["obs"]}), noise), numbers)


# Settings

Build = Callable[..., tuple[Any, PolicySpec]]
_weights = cache(unets.state_dict)


@pytest.fixture
def build() -> Build:
    """Build a policy with changes to ``cfg.policy``, to an entry of it, and to its weights, without a file."""

    def run(
        variant: str,
        model: dict[str, Any] | None = None,
        encoder: dict[str, Any] | None = None,
        weights: dict[str, torch.Tensor] | None = None,
        **policy: Any,
    ) -> tuple[Any, PolicySpec]:
        config = copy.deepcopy(unets.configuration(variant))
        config["policy"].update(policy)
        for name, changes in (("model", model), ("obs_encoder", encoder)):
            if changes:
                config["policy"][name].update(changes)
        state = _weights(variant) | (weights or {})
        return diffusion_policy.build({"cfg": config, "state_dicts": {"ema_model": state}}, AS_SAVED)

    return run


def test_the_executed_steps(build: Build) -> None:
    """They begin with the step of the last observation, or after it, and end with the horizon."""
    for given, expected in (({}, (2, 6)), ({"oa_step_convention": True}, (1, 5)), ({"n_action_steps": 8}, (2, 8))):
        chunk = build("local", **given)[1].chunk
        assert (chunk.start, chunk.stop) == expected


def test_the_observed_steps_have_their_place(build: Build) -> None:
    """Beside the sample's first steps, with zeros after; in the sample, whatever was there; or as one vector."""
    x, t = torch.randn(1, 8, 8), torch.tensor([7])
    obs = torch.randn(1, unets.OBSERVED, unets.LOW_DIM)
    with torch.inference_mode():
        network = build("local")[0].model
        placed = torch.zeros(1, 8, unets.LOW_DIM)
        placed[:, : unets.OBSERVED] = obs
        found = build("local")[0](x[..., : unets.ACTION], t, obs)
        assert torch.equal(found, network(x[..., : unets.ACTION], t, local_cond=placed))
        network = build("inpainting")[0].model
        placed = x.clone()
        placed[:, : unets.OBSERVED, unets.ACTION :] = obs
        assert torch.equal(build("inpainting")[0](x, t, obs), network(placed, t))
        network, short = build("steps_only")[0].model, x[:, :4, : unets.ACTION]
        found = build("steps_only")[0](short, t, obs)
        assert torch.equal(found, network(short, t, global_cond=obs.reshape(1, -1)))


def test_the_centre_is_looked_at(build: Build) -> None:
    """Of images that are resized first, where that is asked for; margins of 4.5 and 7.5 are rounded to even numbers."""
    module, _ = build("images", encoder={"crop_shape": [36, 35], "resize_shape": [45, 50]})
    found = {(each.geometry.top, each.geometry.left, *each.geometry.size) for each in module.encoder.cameras}
    assert found == {(4, 8, 36, 35)}


def test_sizes_of_each_camera(build: Build) -> None:
    """They may stand by key, as the original takes them."""
    sizes = {
        "crop_shape": {"wrist": [36, 35], "front": [20, 30]},
        "resize_shape": {"wrist": [45, 50], "front": [44, 50]},
    }
    module, _ = build("images", encoder=sizes)
    front, wrist = module.encoder.cameras
    assert (front.geometry.size, wrist.geometry.size) == ((20, 30), (36, 35))
    assert (front.geometry.top, wrist.geometry.top) == (12, 4)
    with pytest.raises(CheckpointError, match=r"obs_encoder\.crop_shape\.front is None; expected \[height, width\]"):
        build("images", encoder={"crop_shape": {"wrist": [36, 35]}})


def test_a_predicted_noise_is_the_same_in_all_versions(build: Build) -> None:
    """So nothing is said of its steps."""
    scheduler = unets.configuration("dp3")["policy"]["noise_scheduler"] | {"prediction_type": "epsilon"}
    assert build("dp3", noise_scheduler=scheduler)[1].sampler.steps == unets.STEPS


def test_points_come_as_they_are_normalised(build: Build) -> None:
    """With colours, where the shape in the configuration is that of what the network reads, as in the original's tasks.

    Nor does it look at types, of which some are misspelt there.
    """
    meta = copy.deepcopy(unets.configuration("dp3")["policy"]["shape_meta"])
    meta["obs"][POINTS]["shape"], meta["obs"]["agent_pos"]["type"] = [20, 3], "low_dimx"
    with warned("dp3"):
        module, spec = build("dp3", shape_meta=meta)
    assert spec.observations[POINTS].shape == (unets.OBSERVED, 20, 6)
    observation, noise = as_seen(spec, unets.observation("dp3")), Noise(*unets.noise(spec.sample))
    assert_actions(spec, eager_policy(module, spec)(observation, noise), golden("unet_dp3"))


_GET_RESNET = {"_target_": "a.get_resnet", "name": "resnet50"}


@pytest.mark.parametrize(
    ("key", "entry", "message"),
    [
        ("wrist", {"shape": [4, 41, 43], "type": "rgb"}, r"obs\.wrist\.shape is .*; expected 3 channels"),
        ("wrist", {"shape": [3, 9000, 43], "type": "rgb"}, r"obs\.wrist\.shape is .*; expected .* 4096 pixels at most"),
        ("pos", {"shape": [2, 2]}, r"obs\.pos\.shape is \[2, 2\]; expected one number"),
        ("pos", {"shape": [4], "type": "depth"}, r"obs\.pos\.type is 'depth'; expected low_dim or rgb"),
        ("third", {"shape": [3, 41, 43], "type": "rgb"}, r"no normalizer\.params_dict\.third\.scale"),
    ],
)
def test_observations_that_do_not_fit(build: Build, key: str, entry: dict[str, Any], message: str) -> None:
    """Each is named, with what was expected."""
    meta = copy.deepcopy(unets.configuration("images")["policy"]["shape_meta"])
    meta["obs"][key] = entry
    with pytest.raises(CheckpointError, match=message):
        build("images", encoder={"shape_meta": meta})


_NO_COLOUR = {"point_cloud": {"shape": [20, 2]}, "agent_pos": {"shape": [4]}}
_CLOUD = {"in_channels": 3, "out_channels": 24, "use_layernorm": True, "final_norm": "layernorm"}


REFUSED: Refusals = {
    "local": [
        ({"horizon": 7}, r"cfg\.policy\.horizon is 7; expected a multiple of 2, because a U-Net of 2 levels"),
        ({"horizon": 10**9}, r"cfg\.policy\.horizon is 1000000000; expected .* 4096 at most"),
        ({"horizon": None}, r"cfg\.policy\.horizon is None; expected a positive whole number"),
        ({"horizon": 2}, r"n_obs_steps = 2 leaves nothing of horizon = 2"),
        ({"obs_as_global_cond": True}, "both true; the original refuses this, too"),
        ({"pred_action_steps_only": True}, "pred_action_steps_only needs obs_as_global_cond"),
        ({"oa_step_convention": "yes"}, r"oa_step_convention is 'yes'; expected true or false"),
        ({"obs_as_local_cond": False}, r"model\.input_dim is 3; expected 8 with the observation as inpainting"),
        ({"obs_dim": 6}, r"model\.local_cond_dim is 5; expected 6 with the observation as local condition"),
        ({"guidance": 2.0}, r"cfg\.policy has settings that are not known: guidance"),
        ({"weights": {"model.extra": torch.zeros(2)}}, r"unexpected model\.extra"),
    ],
    "steps_only": [
        ({"n_action_steps": 6}, r"cfg\.policy\.n_action_steps is 6; expected a multiple of 4"),
        ({"n_obs_steps": 3}, r"model\.global_cond_dim is 10; expected 15 with"),
    ],
    "inpainting": [({"horizon": 2, "n_obs_steps": 4, "oa_step_convention": True}, r"n_obs_steps = 4 leaves nothing")],
    "local/model": [
        ({"input_dim": None}, r"model\.input_dim is missing"),
        ({"input_dim": "3"}, r"input_dim of the U-Net is '3'"),
        ({"down_dims": [8 * 10**6, 8 * 10**6]}, r"asks for at least \d+ weights; the checkpoint holds"),
        ({"down_dims": [16, 20]}, r"model\.\S+ has shape \(24,.*; expected \(20,"),
        ({"kernel_size": 4}, r"kernel_size of the U-Net is 4; expected an odd number"),
        ({"cond_predict_scale": False}, r"cond_encoder\S+ has shape \(32, 16\); expected \(16, 16\)"),
        ({"attention": True}, "settings that ConditionalUnet1D does not know: attention"),
        ({"_target_": "fork.Unet"}, "network is Unet; expected ConditionalUnet1D"),
    ],
    "images/encoder": [
        ({"_target_": "umi.TimmObsEncoder"}, r"obs_encoder is TimmObsEncoder; expected MultiImageObsEncoder"),
        ({"dropout": 0.1}, r"settings that MultiImageObsEncoder does not know: dropout"),
        ({"rgb_model": _GET_RESNET}, r"rgb_model\.name is 'resnet50'; expected resnet18 or resnet34"),
        (
            {"rgb_model": _GET_RESNET | {"name": ["resnet18"]}},
            r"rgb_model\.name is \['resnet18'\]; expected resnet18 or",
        ),
        ({"rgb_model": {"_target_": "torchvision.models.vit"}}, r"rgb_model is made by vit; expected get_resnet"),
        ({"rgb_model": _GET_RESNET | {"name": "resnet34"}}, r"torchvision's ResNets: missing \S+layer1\.2\.conv1"),
        ({"crop_shape": [41, 30]}, r"crop_shape is \[41, 30\], and the images of 'front' are 41 x 43"),
        ({"crop_shape": 36}, r"crop_shape is 36; expected \[height, width\]"),
        ({"resize_shape": [10**6, 10**6]}, r"resize_shape is .* of 4096 pixels at most"),
        ({"use_group_norm": False}, r"missing obs_encoder\.key_model_map\.front\.bn1\.running_mean"),
        ({"share_rgb_model": True}, r"missing obs_encoder\.key_model_map\.rgb\.conv1\.weight"),
        ({"imagenet_norm": "yes"}, r"obs_encoder\.imagenet_norm is 'yes'; expected true or false"),
    ],
    "images": [
        ({"horizon": 7}, r"cfg\.policy\.horizon is 7; expected a multiple of 2"),
        ({"n_obs_steps": 3}, r"cond_encoder\.1\.weight has shape \(32, 2074\); expected \(32, 3103\)"),
        ({"kernel_size": 4}, r"kernel_size of the U-Net is 4"),
        ({"obs_as_global_cond": "no"}, r"obs_as_global_cond is 'no'; expected true or false"),
        ({"obs_encoder": None}, r"obs_encoder is None; expected MultiImageObsEncoder"),
        ({"oa_step_convention": True}, r"settings that are not known: oa_step_convention"),
        ({"weights": {"obs_encoder.extra": torch.zeros(1)}}, r"unexpected obs_encoder\.extra"),
        (
            {"weights": {f"normalizer.params_dict.front.{name}": torch.ones(3) for name in ("scale", "offset")}},
            r"params_dict\.front has 3 entries; expected one for the whole image",
        ),
    ],
    "dp3": [
        ({"condition_type": "cross_attention_film"}, r"is 'cross_attention_film'; expected film or add or mlp_film"),
        ({"condition_type": "film"}, r"missing model\S+cond_encoder|unexpected model\S+cond_encoder"),
        ({"condition_type": ["film"]}, r"condition_type is \['film'\]; expected film or add"),
        ({"obs_as_global_cond": False}, r"obs_as_global_cond is false; expected true"),
        ({"eta": 0.5}, r"cfg\.policy has settings that 3D Diffusion Policy does not know: eta"),
        ({"use_up_condition": 1}, r"cfg\.policy\.use_up_condition is 1; expected true or false"),
        ({"pointnet_type": "transformer"}, r"pointnet_type is 'transformer'; expected pointnet"),
        ({"pointcloud_encoder_cfg": None}, r"pointcloud_encoder_cfg is None; expected settings by name"),
        ({"pointcloud_encoder_cfg": _CLOUD | {"final_norm": "batch"}}, r"final_norm is 'batch'; expected none or"),
        ({"pointcloud_encoder_cfg": _CLOUD | {"use_layernorm": False}}, r"unexpected obs_encoder\S+mlp\.1\."),
        ({"pointcloud_encoder_cfg": _CLOUD | {"out_channels": 10**9}}, r"out_channels asks for at least"),
        ({"encoder_output_dim": 32}, r"encoder_output_dim is 32; expected 24, which its PointNet gives"),
        ({"use_pc_color": True, "horizon": 8}, r"extractor\.mlp\.9\.weight|mlp\.0\.weight has shape"),
        (
            {"shape_meta": {"obs": _NO_COLOUR, "action": {"shape": [3]}}, "weights": unets.normalizer({POINTS: 2})},
            r"\[20, 2\]; expected .*\[points, 3\]",
        ),
        (
            {"shape_meta": {"obs": _NO_COLOUR | {"point_cloud": {"shape": [10**9, 3]}}, "action": {"shape": [3]}}},
            "expected the shape .*, 65536 points at most",
        ),
        ({"shape_meta": {"obs": {"agent_pos": {"shape": [4]}}, "action": {"shape": [3]}}}, "point_cloud is missing"),
    ],
    "dp3_add": [({"use_pc_color": True}, r"obs\.point_cloud is \[20, 3\]; expected the shape \[points, 6\]")],
    "simple_dp3": [
        ({"horizon": 6}, r"horizon is 6; expected a multiple of 4"),
        ({"_target_": "a.DP3"}, r"missing model\.down_modules"),
    ],
}


@pytest.mark.parametrize(("place", "given", "message"), refusals(REFUSED))
def test_settings_that_do_not_fit(build: Build, place: str, given: dict[str, Any], message: str) -> None:
    """Of a variant, or of an entry of its configuration: each is named, with what was expected."""
    variant, _, entry = place.partition("/")
    with pytest.raises(CheckpointError, match=message):
        build(variant, **({entry: given} if entry else given))


# Compiled

COMPILED = {
    "local": "Diffusion Policy, U-Net on low-dimensional observations",
    "images": "Diffusion Policy, U-Net on images",
    "dp3": "3D Diffusion Policy",
}
"""Variant, and the row of the support table.

The three ways of giving the observation are in them, but for inpainting, which the transformers are compiled with.
"""


@pytest.fixture(scope="module", params=COMPILED)
def compiled(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Program, Path]:
    """Variant, program and artifact of a policy, converted once."""
    folder = tmp_path_factory.mktemp(request.param)
    torch.save(unets.payload(request.param), folder / "policy.ckpt")
    with warned(request.param):
        program = ttscompile.convert(folder / "policy.ckpt", folder / "compiled")
    return request.param, program, folder / "compiled"


@pytest.mark.slow
def test_compiled_is_the_original(compiled: tuple[str, Program, Path]) -> None:
    variant, program, directory = compiled
    noise = Noise(*unets.noise(program.spec.sample))
    assert_compiled_acts(directory, unets.observation(variant), noise, golden(f"unet_{variant}"))
    record(
        COMPILED[variant],
        "predictions at three timesteps and actions that the original gave, 1e-5 of the range",
        f"{program.spec.sampler.name} {unets.STEPS}",
        program,
    )
