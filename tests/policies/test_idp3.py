"""Improved 3D Diffusion Policy: what the original gave; see ``golden/make_idp3.py``."""

import copy
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch

import ttscompile
from ttscompile.core.spec import Noise, PolicySpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import AS_SAVED
from ttscompile.policies.diffusion_policy import family as diffusion_policy

from ..families.support import record
from . import idp3s
from .originals import assert_compiled_acts, assert_original, golden
from .refused import Refusals, refusals

WARNED = {
    "points_of_more": r"takes 20 of 33 points at random, others in every call\. Compiled it takes evenly spaced ones",
    "images": "draws ColorJitter, RandomCrop, RandomRotation anew at every call, on the robot, too",
}
OF_OLDER = r"DDIM's steps are those of diffusers from 0\.15 on"


def warned(variant: str) -> AbstractContextManager[object]:
    """Within it a variant is loaded, with what is said of it."""
    said = WARNED.get(variant, OF_OLDER if "predicts" not in idp3s.VARIANTS[variant] else "")
    return pytest.warns(UserWarning, match=said) if said else nullcontext()


@pytest.mark.slow
@pytest.mark.parametrize("variant", idp3s.VARIANTS)
def test_the_original_gave_the_same(variant: str, tmp_path: Path) -> None:
    """Single evaluations, and the actions of a whole call, from the file that is saved."""
    torch.save(idp3s.payload(variant), tmp_path / "policy.ckpt")
    with warned(variant):
        module, spec = load_checkpoint_policy(tmp_path / "policy.ckpt")
    assert (spec.source["variant"], spec.source["weights"]) == ("global condition", "ema_model")
    noise = Noise(*idp3s.noise(spec.sample))
    assert_original(module, spec, idp3s.observation(variant), noise, golden(f"idp3_{variant}"))


# Settings

Build = Callable[..., tuple[Any, PolicySpec]]
_weights = cache(idp3s.state_dict)


@pytest.fixture
def build() -> Build:
    """Build a policy with changes to ``cfg.policy``, to an entry of it, and to its weights, without a file."""

    def run(
        variant: str,
        entries: dict[str, dict[str, Any]] | None = None,
        weights: dict[str, torch.Tensor] | None = None,
        data_set: str = "",
        **policy: Any,
    ) -> tuple[Any, PolicySpec]:
        config = copy.deepcopy(idp3s.configuration(variant))
        config["policy"].update(policy)
        config["task"] = {"dataset": {"_target_": f"diffusion_policy_3d.dataset.gr1.{data_set}"}}
        for name, changes in (entries or {}).items():
            config["policy"][name].update(changes)
        state = _weights(variant) | (weights or {})
        return diffusion_policy.build({"cfg": config, "state_dicts": {"ema_model": state}}, AS_SAVED)

    return run


def test_the_executed_steps_end_with_the_horizon(build: Build) -> None:
    """They begin with the step of the last observation: of 16 steps its authors ask for 15."""
    for count, expected in ((7, (1, 8)), (8, (1, 8)), (3, (1, 4))):
        chunk = build("points_of_fewer", n_action_steps=count)[1].chunk
        assert (chunk.start, chunk.stop) == expected


def test_points_are_those_that_the_original_would_look_at(build: Build) -> None:
    """All where it draws none, as by default; evenly spaced ones where it draws; fewer beside one at 0."""
    points = torch.randn(2, 33, 3)
    with torch.inference_mode():
        drawn, every = (_extractor(build, "points_of_more", downsample) for downsample in (True, False))
        assert torch.equal(drawn(points), every(points[:, torch.arange(20) * 33 // 20]))
        assert not torch.equal(drawn(points), every(points))
        padded, bare = (_extractor(build, "points_of_fewer", downsample) for downsample in (True, False))
        few = points[:, :12] + 9  # far from 0, so that a point there changes what is the largest
        assert torch.equal(padded(few), bare(torch.cat((few, torch.zeros(2, 1, 3)), 1)))
        assert not torch.equal(padded(few), bare(few))
    assert "point_downsample" in idp3s.configuration("points")["policy"]


def _extractor(build: Build, variant: str, downsample: bool) -> Any:
    with warned(variant) if downsample or variant == "points" else nullcontext():
        return build(variant, point_downsample=downsample)[0].encoder.extractor


def test_what_a_recording_has_is_known(build: Build) -> None:
    """By the class of the data set in the configuration."""
    observed = build("points_of_fewer", data_set="GR1DexDataset3D")[1].observations
    assert observed["agent_pos"].recorded == ("state",)
    with warned("images"):
        observed = build("images", data_set="GR1DexDatasetImage")[1].observations
    assert {key: each.recorded for key, each in observed.items()} == {
        "image": ("img",),
        "agent_pos": ("state",),
        "grip": (),
    }


def test_what_the_policy_ignores_is_not_asked_for(build: Build) -> None:
    """A state that is recorded, and that its encoder does not read."""
    meta = copy.deepcopy(idp3s.configuration("images")["policy"]["shape_meta"])
    meta["obs"]["time"] = {"shape": [1], "type": "low_dim", "ignore_by_policy": True, "horizon": 1}
    with warned("images"):
        assert set(build("images", {"obs_encoder": {"shape_meta": meta}})[1].observations) == {
            *idp3s.VARIANTS["images"]["obs"]
        }


_CLOUD = {"out_channels": 24, "num_points": 20}
_SHAPES = {"point_cloud": {"shape": [12, 6]}, "agent_pos": {"shape": [4]}}


def _meta(**obs: Any) -> dict[str, Any]:
    return {"obs": obs, "action": {"shape": [3]}}


def _images(**obs: Any) -> dict[str, Any]:
    return {"obs_encoder": {"shape_meta": _meta(**idp3s.VARIANTS["images"]["obs"] | obs)}}


REFUSED: Refusals = {
    "points_of_fewer": [
        ({"condition_type": "cross_attention_add"}, r"is 'cross_attention_add'; expected film or add or mlp_film"),
        ({"obs_as_global_cond": False}, r"obs_as_global_cond is false; expected true"),
        ({"pointnet_type": "pointnet"}, r"pointnet_type is 'pointnet'; expected multi_stage_pointnet, the only one"),
        ({"use_pc_color": True}, r"use_pc_color is true, and points have 6 numbers; expected false"),
        ({"point_downsample": 1}, r"cfg\.policy\.point_downsample is 1; expected true or false"),
        ({"crop_shape": [80, 80]}, r"settings that Improved 3D Diffusion Policy does not know: crop_shape"),
        ({"pointcloud_encoder_cfg": _CLOUD | {"num_points": 10**9}}, r"num_points is .*; expected .* 65536 at most"),
        ({"pointcloud_encoder_cfg": _CLOUD | {"out_channels": 10**9}}, r"out_channels asks for at least"),
        ({"pointcloud_encoder_cfg": _CLOUD | {"out_channels": 32}}, r"conv_out\.weight has shape \(24, 512, 1\)"),
        ({"shape_meta": _meta(agent_pos={"shape": [4]})}, r"point_cloud is missing; expected the shape \[points, 3\]"),
        ({"shape_meta": _meta(**_SHAPES | {"point_cloud": {"shape": [10**9, 6]}})}, "65536 points at most"),
        ({"weights": {"obs_encoder.extra": torch.zeros(1)}}, r"unexpected obs_encoder\.extra"),
    ],
    "images": [
        ({"use_depth": True}, r"use_depth is true; expected false: R3M takes colours alone"),
        ({"use_down_condition": True}, r"Improved 3D Diffusion Policy does not know: use_down_condition"),
        ({"entries": {"obs_encoder": {"model_name": "resnet18"}}}, r"model_name is 'resnet18'; expected r3m"),
        ({"entries": {"obs_encoder": {"_target_": "a.Other"}}}, r"obs_encoder is Other; expected TimmObsEncoder"),
        ({"entries": {"obs_encoder": {"dropout": 0.1}}}, r"does not know: dropout"),
        ({"entries": {"obs_encoder": {"pretrained": False}}}, r"unexpected \S+convnet\.bn1\.running_mean"),
        ({"entries": _images(image={"shape": [3, 40, 40]})}, r"obs\.image\.horizon is None; expected 2"),
        (
            {"entries": _images(wrist=idp3s.VARIANTS["images"]["obs"]["image"])},
            r"obs\.wrist\.type is rgb; expected rgb of",
        ),
        (
            {"entries": _images(image={"shape": [4], "horizon": 2})},
            r"obs\.image\.type is low_dim; expected rgb of image",
        ),
        (
            {"entries": _images(grip={"shape": [2, 2], "horizon": 2})},
            r"obs\.grip\.shape is \[2, 2\]; expected one number",
        ),
        ({"entries": _images(image={"ignore_by_policy": True, "shape": [4]})}, r"shape_meta\.obs has no image"),
        (
            {"entries": _images(image={"shape": [1, 40, 40], "type": "rgb", "horizon": 2})},
            r"obs\.image\.shape is \[1, 40, 40\]; expected 3 channels",
        ),
    ],
}


@pytest.mark.parametrize(("variant", "given", "message"), refusals(REFUSED))
def test_settings_that_do_not_fit(build: Build, variant: str, given: dict[str, Any], message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        build(variant, **given)


# Compiled

COMPILED = {"points": "Improved 3D Diffusion Policy (iDP3)", "images": "Improved 3D Diffusion Policy, on images (R3M)"}
"""Variant, and the row of the support table."""


@pytest.mark.slow
@pytest.mark.parametrize("variant", COMPILED)
def test_compiled_is_the_original(variant: str, tmp_path: Path) -> None:
    torch.save(idp3s.payload(variant), tmp_path / "policy.ckpt")
    with warned(variant):
        program = ttscompile.convert(tmp_path / "policy.ckpt", tmp_path / "compiled")
    noise = Noise(*idp3s.noise(program.spec.sample))
    assert_compiled_acts(tmp_path / "compiled", idp3s.observation(variant), noise, golden(f"idp3_{variant}"))
    record(
        COMPILED[variant],
        "predictions at three timesteps and actions that the original gave, 1e-5 of the range",
        f"{program.spec.sampler.name} {program.spec.sampler.steps}",
        program,
    )


def test_build_takes_the_data_set_of_the_training(tmp_path: Path) -> None:
    """Where its path is that of a zarr buffer on this machine."""
    payload = idp3s.payload("points")
    payload["cfg"]["task"] = {"dataset": {"zarr_path": str(tmp_path)}}
    torch.save(payload, tmp_path / "policy.ckpt")
    assert diffusion_policy.recordings(tmp_path / "policy.ckpt") == str(tmp_path)
