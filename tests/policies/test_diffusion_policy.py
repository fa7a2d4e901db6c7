"""Configuration to policy: variants, sizes, samplers, and every way in which configuration and weights can disagree."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler

from tests.rounding import Counted, allowed, assert_equal_but_for_rounding
from ttscompile.errors import CheckpointError, SpecError
from ttscompile.frontends import load_checkpoint_policy, recordings_of
from ttscompile.frontends.families import LoadOptions
from ttscompile.policies.diffusion_policy.parts import choose_weights
from ttscompile.samplers.table import sampler_table

from .refused import assert_not_read
from .variants import VARIANTS, Build, Save


@pytest.mark.slow
@pytest.mark.parametrize(("variant", "as_cond", "model"), VARIANTS)
def test_variants(payload: Build, save: Save, variant: str, as_cond: bool, model: dict[str, Any]) -> None:
    """Each loads, says what it is, and predicts the same for streams together and alone."""
    module, spec = load_checkpoint_policy(save(payload(as_cond, **model)))
    assert spec.source == {
        "format": "diffusion_policy",
        "policy": "DiffusionTransformerLowdimPolicy",
        "variant": variant,
        "weights": "ema_model",
    }
    assert spec.sample == (6, 3 if as_cond else 8)
    assert spec.observations["obs"].shape == (2, 5)
    assert (spec.chunk.action_dim, spec.chunk.start, spec.chunk.stop) == (3, 1, 4)
    assert not module.training
    x, obs, t = torch.randn(3, *spec.sample), torch.randn(3, 2, 5), torch.tensor([19, 7, 0])
    with torch.inference_mode(), Counted() as counted:
        together = module(x, t, obs)
        alone = torch.cat([module(x[i : i + 1], t[i : i + 1], obs[i : i + 1]) for i in range(3)])
        moved = [module(x, (t + 1) % 20, obs), module(x, t, obs + 1)]
    assert_equal_but_for_rounding(together, alone, counted.terms, counted.angle)
    assert together.shape == x.shape
    assert all((together - other).abs().max() > 1e-3 for other in moved)


def test_causal_masks_hold(payload: Build, save: Save) -> None:
    """Token t sees the sample up to t and the observations up to t; without causal_attn it sees all."""
    for causal in (True, False):
        module, _ = load_checkpoint_policy(save(payload(True, causal_attn=causal)))
        x, obs, t = torch.randn(1, 6, 3), torch.randn(1, 2, 5), torch.tensor([3])
        late_x, late_obs = x.clone(), obs.clone()
        late_x[:, 4] += 1
        late_obs[:, 1] += 1
        with torch.inference_mode():
            with Counted() as counted:
                before = module(x, t, obs)
            rounding = allowed(before, counted.terms)
            changed_x = (module(late_x, t, obs) - before).abs().amax(dim=(0, 2)) > rounding
            changed_obs = (module(x, t, late_obs) - before).abs().amax(dim=(0, 2)) > rounding
        assert changed_x.tolist() == ([False] * 4 + [True] * 2 if causal else [True] * 6)
        assert changed_obs.tolist() == ([False] + [True] * 5 if causal else [True] * 6)


def test_pred_action_steps_only(payload: Build, save: Save) -> None:
    """The sample is the executed steps alone, and all of it is executed."""
    built = payload(True, causal_attn=False)
    built["cfg"]["policy"]["pred_action_steps_only"] = True
    module, spec = load_checkpoint_policy(save(built))
    assert spec.sample == (3, 3)
    assert (spec.chunk.start, spec.chunk.stop) == (0, 3)
    assert module(torch.randn(2, 3, 3), torch.tensor([1, 2]), torch.randn(2, 2, 5)).shape == (2, 3, 3)


@pytest.mark.parametrize(
    ("data_set", "given", "recorded"),
    [
        ("pusht_dataset.PushTLowdimDataset", {"zarr_path": "???"}, ("keypoint", "state:2")),
        ("pusht_dataset.PushTLowdimDataset", {"obs_key": "points", "state_key": "pose"}, ("points", "pose:2")),
        ("blockpush_lowdim_dataset.BlockPushLowdimDataset", {"obs_eef_target": True}, ()),
        ("robomimic.RobomimicReplayLowdimDataset", {"obs_keys": "${task.obs_keys}"}, ("object", "robot0_eef_pos")),
        ("robomimic.RobomimicReplayLowdimDataset", {"obs_keys": [1]}, ()),
        ("my.OwnDataset", {}, ()),
    ],
)
def test_the_data_set_says_what_is_recorded(
    payload: Build, save: Save, data_set: str, given: dict[str, Any], recorded: tuple[str, ...]
) -> None:
    """As the classes of the original put the observation together."""
    built = payload()
    built["cfg"]["task"] = {
        "obs_keys": ["object", "robot0_eef_pos"],
        "dataset": {"_target_": f"diffusion_policy.dataset.{data_set}", **given},
    }
    assert load_checkpoint_policy(save(built))[1].observations["obs"].recorded == recorded


@pytest.mark.parametrize("key", ["zarr_path", "dataset_path"])
def test_the_data_set_of_the_training_is_taken_where_it_lay(
    payload: Build, save: Save, key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = payload()
    with pytest.raises(CheckpointError, match="does not say which data set it was trained on"):
        recordings_of(save(built))
    built["cfg"]["task"] = {"dataset": {key: "data/pusht.zarr"}}
    saved = save(built)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        CheckpointError, match="trained on data/pusht.zarr, and there is no such file here. Run this in"
    ):
        recordings_of(saved)
    (tmp_path / "data" / "pusht.zarr").mkdir(parents=True)
    assert recordings_of(saved) == "data/pusht.zarr"


def test_chunk_ends_with_the_horizon(payload: Build, save: Save) -> None:
    """More action steps than are left after the observations: the original's slice is cut, and so is ours."""
    built = payload()
    built["cfg"]["policy"]["n_action_steps"] = 8
    assert load_checkpoint_policy(save(built))[1].chunk.stop == 6


def test_interpolated_configuration_is_the_same_policy(payload: Build, save: Save) -> None:
    """As a fork may save it: unresolved, with the original's own expressions."""
    built = payload()
    expected = load_checkpoint_policy(save(built))[0].state_dict()
    config = built["cfg"]
    config |= {"obs_dim": 5, "action_dim": 3, "obs_as_cond": True, "horizon": 6, "run": "${now:%Y}"}
    config["policy"] |= {"obs_dim": "${obs_dim}", "horizon": "${horizon}", "obs_as_cond": "${obs_as_cond}"}
    config["policy"]["model"] |= {
        "input_dim": "${eval:'${action_dim} if ${obs_as_cond} else ${obs_dim} + ${action_dim}'}",
        "output_dim": "${policy.model.input_dim}",
        "cond_dim": "${eval:'${obs_dim} if ${obs_as_cond} else 0'}",
    }
    found = load_checkpoint_policy(save(built))[0].state_dict()
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[key], expected[key]) for key in found)
    config["policy"]["model"]["n_emb"] = "${oc.env:WIDTH}"
    assert_not_read(save(built), r"cfg\.policy\.model\.n_emb is '\$\{oc\.env:WIDTH\}'")


# Weights


def test_wanted_weights_are_missing(payload: Build, save: Save) -> None:
    """The other ones are taken, and it is said; nothing is said where the configuration does not choose."""
    built = payload()
    del built["state_dicts"]["ema_model"]
    with pytest.warns(UserWarning, match=r"asks for the weights 'ema_model'.*using 'model'"):
        assert load_checkpoint_policy(save(built))[1].source["weights"] == "model"
    del built["cfg"]["training"]["use_ema"]
    assert load_checkpoint_policy(save(built))[1].source["weights"] == "model"
    built["state_dicts"] = {"optimizer": {}}
    assert_not_read(save(built), r"state_dicts holds \['optimizer'\]")


def test_half_precision_is_loaded_as_float32(payload: Build, save: Save) -> None:
    """Masks included, whose -inf survives."""
    built = payload()
    built["state_dicts"]["ema_model"] = {k: v.half() for k, v in built["state_dicts"]["ema_model"].items()}
    module, _ = load_checkpoint_policy(save(built))
    assert {value.dtype for value in module.state_dict().values()} == {torch.float32}
    assert module.get_buffer("model.mask")[0, 1] == -math.inf


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("model.", "model._orig_mod."),
        ("model.", "model.module."),
        ("", "_orig_mod."),
        ("", "module."),
        ("", "_orig_mod.module."),
    ],
)
def test_wrappers_of_torch_are_taken_off(payload: Build, old: str, new: str) -> None:
    """As torch.compile and DistributedDataParallel name the weights, of the network or of the whole policy."""
    states = {"ema_model": payload()["state_dicts"]["ema_model"]}
    expected, _ = choose_weights(states, True)
    states["ema_model"] = {
        new + key.removeprefix(old) if key.startswith(old) else key: value for key, value in expected.items()
    }
    found, _ = choose_weights(states, True)
    assert list(found) == list(expected) and list(states["ema_model"]) != list(expected)


def test_many_missing_weights_are_counted(payload: Build, save: Save) -> None:
    """The message stays readable."""
    built = payload()
    built["cfg"]["policy"]["model"]["n_layer"] = 3
    assert_not_read(save(built), r"missing model\.decoder\.layers\.1\.\S+,.* and 30 more\.")


MISSING = ("model.head.bias", "model.decoder.layers.0.norm3.weight", "model.mask", "model.cond_obs_emb.weight")
UNKNOWN = ("model.extra.weight", "obs_encoder.weight", "normalizer.other", "model.decoder.layers.1.norm3.weight")
"""A network with more in it is another network."""


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        *((key, None, rf"missing {key}\.") for key in MISSING),
        *((key, torch.zeros(8), rf"unexpected {key}\.") for key in UNKNOWN),
        ("model.head.bias", torch.zeros(4), r"model\.head\.bias has shape \(4,\); expected \(3,\)"),
        ("model.head.bias", torch.tensor([0.0, math.nan, math.inf]), r"model\.head\.bias holds 2 values that are not"),
        ("model.head.bias", torch.zeros(3, dtype=torch.int64), r"model\.head\.bias is a torch\.int64 tensor"),
        ("model.head.bias", [0.0, 0.0, 0.0], r"model\.head\.bias is a list"),
        ("model.mask", torch.zeros(6, 6), r"model\.mask is not the causal mask"),
        ("normalizer.params_dict.obs.scale", torch.tensor([1.0, 1, 0, 1, 1]), r"obs\.scale is .* no zero"),
        ("normalizer.params_dict.action.scale", torch.tensor([0.0, 1, 1]), r"action\.scale is \[0\.0, .* no zero in a"),
        ("normalizer.params_dict.obs.offset", torch.zeros(10), r"obs\.offset has shape \(10,\).* 5 channels"),
    ],
)
def test_wrong_weights_are_refused(payload: Build, save: Save, key: str, value: Any, message: str) -> None:
    """Names, shape, type, and values that are not finite; masks hold -inf and are compared instead."""
    built = payload()
    weights = built["state_dicts"]["ema_model"]
    built["state_dicts"]["ema_model"] = {k: v for k, v in (weights | {key: value}).items() if v is not None}
    assert_not_read(save(built), message)


def test_normalizer(payload: Build, save: Save) -> None:
    """Scale and offset reach observation and action; a single entry stands for all channels; none is an error."""
    built = payload()
    weights = built["state_dicts"]["ema_model"]
    _, spec = load_checkpoint_policy(save(built))
    for affine, key in ((spec.observations["obs"].normalizer, "obs"), (spec.chunk.normalizer, "action")):
        assert affine is not None
        np.testing.assert_array_equal(affine.scale, weights[f"normalizer.params_dict.{key}.scale"].numpy())
        np.testing.assert_array_equal(affine.offset, weights[f"normalizer.params_dict.{key}.offset"].numpy())
    weights["normalizer.params_dict.obs.scale"] = torch.tensor([2.0])
    affine = load_checkpoint_policy(save(built))[1].observations["obs"].normalizer
    assert affine is not None
    assert affine.scale.tolist() == [2.0] * 5
    del weights["normalizer.params_dict.action.scale"]
    assert_not_read(save(built), r"no normalizer\.params_dict\.action\.scale")


# Configuration


@pytest.mark.parametrize("part", ["cfg", "state_dicts"])
def test_checkpoint_of_something_else(payload: Build, save: Save, part: str) -> None:
    """What is missing and what is there instead."""
    built = payload()
    built["weights"] = built.pop(part)
    assert_not_read(save(built), rf"policy\.ckpt: no entry '{part}'; found .*'weights'")


@pytest.mark.parametrize(
    ("place", "changes", "message"),
    [
        ("model", {"n_head": 3}, "n_emb = 8 with n_head = 3"),
        ("model", {"n_layer": 0}, "n_layer is 0; expected at least 1"),
        ("model", {"n_layer": "8"}, "n_layer is '8'; expected int"),
        ("model", {"causal_attn": 1}, "causal_attn is 1; expected bool"),
        ("model", {"time_as_cond": False}, "cond_dim > 0 needs time_as_cond"),
        ("model", {"cond_dim": 4}, "cond_dim is 4; expected 5"),
        ("model", {"input_dim": 8}, "input_dim is 8; expected 3"),
        ("model", {"horizon": None}, "model.horizon is missing"),
        ("model", {"flash": True}, "settings that TransformerForDiffusion does not know: flash"),
        ("model", {"_target_": "fork.BetterTransformer"}, "network is BetterTransformer; expected"),
        ("model", {"n_obs_steps": 3}, "n_obs_steps is 3, but the policy gives the network 2 tokens.*causal"),
        ("policy", {"horizon": 7}, "horizon is 6, but the policy gives the network 7"),
        ("policy", {"obs_as_cond": False}, "expected 8 with obs_as_cond = False"),
        ("policy", {"pred_action_steps_only": True}, "gives the network 3 tokens.*causal"),
        ("policy", {"pred_action_steps_only": True, "obs_as_cond": False}, "needs obs_as_cond"),
        ("policy", {"n_action_steps": 0}, "n_action_steps is 0; expected a positive"),
        ("policy", {"obs_as_cond": "yes"}, "obs_as_cond is 'yes'; expected true or false"),
        ("policy", {"noise_scheduler": None}, "noise_scheduler is missing"),
        ("policy", {"guidance": 2.0}, r"not known: guidance\. Where only the training .* save"),
        ("policy", {"predict_epsilon": False}, "contradicts noise_scheduler.prediction_type = 'epsilon'"),
        (
            "noise_scheduler",
            {"_target_": "diffusers.PNDMScheduler"},
            "noise_scheduler is PNDMScheduler.* convert --sampler ddpm or ddim or dpm.*; then calibrate --learn loops",
        ),
        ("noise_scheduler", {"karras": True}, "does not know: karras"),
        ("noise_scheduler", {"predict_epsilon": False}, "predict_epsilon contradicts prediction_type = 'epsilon'"),
        ("noise_scheduler", {"beta_schedule": "none"}, "diffusers refuses the settings"),
        ("training", {"use_ema": "maybe"}, "use_ema is 'maybe'"),
    ],
)
def test_contradictions_are_refused(
    payload: Build, save: Save, place: str, changes: dict[str, Any], message: str
) -> None:
    """Each one names the key, what is expected and what was found."""
    built = payload()
    policy = built["cfg"]["policy"]
    {"policy": policy, "training": built["cfg"]["training"], **policy}[place].update(changes)
    assert_not_read(save(built), message)


# Samplers


def test_the_checkpoints_own_sampler(payload: Build, save: Save) -> None:
    """Steps of the policy, or of training where it gives none; the class and settings of the scheduler."""
    built = payload()
    assert load_checkpoint_policy(save(built))[1].sampler.timesteps.tolist() == list(range(19, -1, -1))
    built["cfg"]["policy"] |= {"num_inference_steps": None, "predict_epsilon": True}
    assert load_checkpoint_policy(save(built))[1].sampler.steps == 20
    scheduler = built["cfg"]["policy"]["noise_scheduler"]
    scheduler |= {"_target_": "diffusers.schedulers.scheduling_ddim.DDIMScheduler", "set_alpha_to_one": True}
    del scheduler["variance_type"]
    built["cfg"]["policy"]["num_inference_steps"] = 4
    plain = load_checkpoint_policy(save(built))[1].sampler
    assert (plain.name, plain.timesteps.tolist(), plain.stochastic) == ("ddim", [15, 10, 5, 0], False)
    scheduler["timestep_spacing"] = "trailing"
    assert load_checkpoint_policy(save(built))[1].sampler.timesteps.tolist() == [19, 14, 9, 4]
    built["cfg"]["policy"]["eta"] = 0.5
    assert load_checkpoint_policy(save(built))[1].sampler.stochastic
    loops = load_checkpoint_policy(save(built), options=LoadOptions(sampler="ddpm"))[1].loops
    assert not loops["ddpm-4"].out_to_next.any()


def test_settings_of_old_schedulers(payload: Build, save: Save) -> None:
    """diffusers before 0.11 said ``predict_epsilon``; entries of hydra and diffusers say nothing of it."""
    built = payload()
    policy = built["cfg"]["policy"]
    policy["noise_scheduler"] |= {"predict_epsilon": True, "_convert_": "all", "_diffusers_version": "0.11.1"}
    policy["model"] |= {"_recursive_": False}
    assert load_checkpoint_policy(save(built))[1].sampler.sample_to_x0.any()
    del policy["noise_scheduler"]["prediction_type"]
    policy["noise_scheduler"]["predict_epsilon"] = False
    assert not load_checkpoint_policy(save(built))[1].sampler.sample_to_x0.any()


def test_sample_prediction(payload: Build, save: Save) -> None:
    """The network's output is the clean sample."""
    built = payload()
    built["cfg"]["policy"]["noise_scheduler"]["prediction_type"] = "sample"
    table = load_checkpoint_policy(save(built))[1].sampler
    assert not table.sample_to_x0.any()
    assert (table.out_to_x0 == 1).all()


def test_another_sampler_keeps_the_betas(payload: Build, save: Save) -> None:
    """DDIM on the checkpoint's own betas, with both spacings; the original's table is what it is without it."""
    path = save(payload())
    original = load_checkpoint_policy(path)[1].sampler
    betas = {"num_train_timesteps": 20, "beta_schedule": "squaredcos_cap_v2"}
    for spacing, name, timesteps in ((None, "ddim-4", [15, 10, 5, 0]), ("trailing", "ddim-4-trailing", [19, 14, 9, 4])):
        spec = load_checkpoint_policy(path, options=LoadOptions(sampler="ddim", steps=4, spacing=spacing))[1]
        assert list(spec.loops) == [name] and spec.sampler.same_as(original)
        found = spec.loops[name]
        expected = sampler_table(DDIMScheduler(**betas, timestep_spacing=spacing or "leading"), 4)
        assert found.timesteps.tolist() == timesteps
        for column in found.COLUMNS:
            np.testing.assert_array_equal(getattr(found, column), getattr(expected, column))
    assert load_checkpoint_policy(path, options=LoadOptions(steps=5))[1].loops["ddpm-5"].stochastic


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sampler": "euler"}, r"'euler' is none of .* diffusion; expected one of ddpm, ddim, dpmsolver\+\+\."),
        ({"steps": 21}, "21 denoising steps are not possible"),
        ({"steps": 0}, "steps must be an integer of at least 1; found 0"),
        ({"steps": -1}, "steps must be an integer of at least 1; found -1"),
        ({"spacing": "even"}, "'even' is not known; expected one of leading"),
    ],
)
def test_impossible_samplers(payload: Build, save: Save, arguments: dict[str, Any], message: str) -> None:
    """What was asked for, and what can be asked for."""
    with pytest.raises(SpecError, match=message):
        load_checkpoint_policy(save(payload()), options=LoadOptions(**arguments))


def test_another_schedulers_betas(payload: Build, save: Save) -> None:
    """A policy trained with another sampler runs on its betas in the one that is asked for, and in its own."""
    built = payload()
    built["cfg"]["policy"]["noise_scheduler"] |= {
        "_target_": "diffusers.DPMSolverMultistepScheduler",
        "solver_order": 2,
    }
    built["cfg"]["policy"]["num_inference_steps"] = 10
    spec = load_checkpoint_policy(save(built), options=LoadOptions(sampler="ddim", steps=5))[1]
    found = {name: (table.name, table.steps) for name, table in spec.all_loops.items()}
    assert found == {"original": ("dpmsolver++", 10), "ddim-5": ("ddim", 5)}
