"""DPPO's policies on states: what its evaluation gave; see ``golden/make_dppo.py``."""

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from ttscompile.core.spec import Noise
from ttscompile.errors import CheckpointError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import find_family

from ..families.support import record
from . import dppos
from .originals import as_seen, assert_actions, assert_compiled_acts, golden
from .refused import Refusals, assert_not_read, refusals

BOUNDED = r"randn_clip_value: the original bounds the noise of its steps at 3, beyond which 0\.27% of the numbers are"


def warned(variant: str) -> AbstractContextManager[object]:
    """Within it a variant is loaded, with what is said of it."""
    return pytest.warns(UserWarning, match=BOUNDED) if variant == "mlp_tuned" else nullcontext()


@pytest.mark.parametrize("variant", dppos.VARIANTS)
def test_the_original_gave_the_same(variant: str, tmp_path: Path) -> None:
    """The actions of its evaluation, from raw states."""
    path = dppos.save(tmp_path / "run", variant)
    assert find_family(path, "auto").name == "dppo"
    with warned(variant):
        module, spec = load_checkpoint_policy(path)
    numbers = golden(f"dppo_{variant}")
    assert spec.sampler.steps == numbers["steps"]
    noise = Noise(*dppos.noise(spec.sampler.steps))
    assert_actions(spec, eager_policy(module, spec)(as_seen(spec, dppos.observation()), noise), numbers)
    assert (spec.chunk.start, spec.chunk.stop) == (0, 3)


def test_the_schedule_is_rounded_as_the_original_rounds_it(tmp_path: Path) -> None:
    """diffusers' own columns are seven times further off than this, and with other weights beyond what is promised."""
    module, spec = load_checkpoint_policy(dppos.save(tmp_path / "run", "mlp_long"))
    out = eager_policy(module, spec)(as_seen(spec, dppos.observation()), Noise(*dppos.noise(100))).numpy()
    expected = golden("dppo_mlp_long")["action_pred"]
    assert np.abs(spec.chunk.unnormalized(out) - expected).max() < 1e-6 * np.ptp(expected)


def test_the_last_steps_are_those_that_were_tuned(tmp_path: Path) -> None:
    """By their timestep, whatever the sampler: below 3 of 8; of DDIM's 15, 10, 5 and 0 the last two."""
    for variant, first in (("mlp_tuned", 2), ("unet_tuned", 5)):
        with warned(variant):
            module: Any = load_checkpoint_policy(dppos.save(tmp_path / variant, variant))[0]
        sample, state = torch.randn(2, dppos.HORIZON, dppos.ACTION), torch.randn(2, dppos.STEPS, dppos.WIDTH)
        observed, timesteps = state.flatten(1), torch.tensor([first, first + 1])
        with torch.inference_mode():
            found = module(sample, timesteps, state)
            tuned, before = (each(sample, timesteps, observed) for each in (module.after, module.before))
        assert torch.equal(found[0], tuned[0])
        assert torch.equal(found[1], before[1])
        assert not torch.equal(tuned, before)


def test_one_network_is_enough_where_all_steps_or_none_are_tuned(tmp_path: Path) -> None:
    """The averaged weights of a training are those that fine-tuning begins with; the evaluation takes the others."""
    model = dppos.configuration("mlp_tuned")["model"]
    with warned("mlp_tuned"):
        none: Any = load_checkpoint_policy(
            dppos.save(tmp_path / "0", "mlp_tuned", model=model | {"ft_denoising_steps": 0})
        )[0]
    with warned("mlp_tuned"):
        every: Any = load_checkpoint_policy(
            dppos.save(tmp_path / "8", "mlp_tuned", model=model | {"ft_denoising_steps": 8})
        )[0]
    trained: Any = load_checkpoint_policy(dppos.save(tmp_path / "mlp", "mlp"))[0]
    saved = {variant: dppos.payload(variant)["model"] for variant in ("mlp", "mlp_tuned")}
    for module, name, variant in (
        (none, "actor", "mlp_tuned"),
        (every, "actor_ft", "mlp_tuned"),
        (trained, "network", "mlp"),
    ):
        assert module.before is None
        for key, value in module.after.state_dict().items():
            assert torch.equal(value, saved[variant][f"{name}.{key}"])


@pytest.mark.slow
def test_noise_has_the_deviation_of_the_evaluation(tmp_path: Path) -> None:
    """Not that with which training explores; and never the least one, 0.001, with as many timesteps as there may be."""
    model = dppos.configuration("mlp")["model"] | {"denoising_steps": 1000}
    table = load_checkpoint_policy(dppos.save(tmp_path / "run", "mlp", model=model))[1].sampler
    assert table.noise_to_next[-1] == 0
    assert 0.001 < table.noise_to_next[:-1].min() < dppos.configuration("mlp")["model"]["min_sampling_denoising_std"]


def test_without_statistics_the_policy_speaks_as_the_wrapper_does(tmp_path: Path) -> None:
    """And says so."""
    with pytest.warns(
        UserWarning, match=r"run/normalization\.npz: no such file, so the policy takes observations, and"
    ):
        spec = load_checkpoint_policy(dppos.save(tmp_path / "run", "mlp", normalized=False))[1]
    assert spec.observations["state"].normalizer is None
    assert spec.chunk.normalizer is None


_MODEL: Any = {variant: dppos.configuration(variant)["model"] for variant in dppos.VARIANTS}


def _network(variant: str, **changes: Any) -> dict[str, Any]:
    name = "network" if variant == "mlp" else "actor"
    return {"model": {name: _MODEL[variant][name] | changes}}


REFUSED: Refusals = {
    "mlp": [
        (
            {"model": {"_target_": "model.rl.gaussian_ppo.PPO_Gaussian"}},
            r"_target_ is .*; expected DiffusionModel or PPO",
        ),
        ({"model": None}, r"config\.yaml: model is a NoneType; expected settings by name"),
        ({"obs_dim": 6}, r"mlp_mean\.layers\.0\.weight has shape \(24, 30\); expected \(24, 32\)"),
        ({"obs_dim": 10**9}, r"model\.obs_dim is 1000000000; expected a positive whole number, 16384 at most"),
        ({"cond_steps": None}, r"cond_steps is None; expected a positive whole number|cond_steps"),
        ({"model": {"denoised_clip_value": 0}}, r"denoised_clip_value is 0; expected a positive number or null"),
        (
            {"model": {"final_action_clip_value": 0.5}},
            r"final_action_clip_value is 0\.5; expected denoised_clip_value, 1",
        ),
        ({"model": {"denoising_steps": "${oc.env:STEPS}"}}, r"which only the training code can resolve"),
        (_network("mlp", _target_="model.diffusion.mlp_diffusion.VisionDiffusionMLP"), "those that see images are not"),
        (_network("mlp", mlp_dims=[24, 24]), "an odd number of them with residual_style"),
        (_network("mlp", mlp_dims=[10**9]), "expected widths up to 16384, 64 of them at most"),
        (_network("mlp", activation_type="Swish"), r"activation_type is 'Swish'; expected Mish or ReLU"),
        (_network("mlp", horizon_steps=8), r"horizon_steps is 8; expected 4, as the rest of the configuration says"),
        ({"env": {"wrappers": {"robomimic_lowdim": {"clamp_obs": True}}}}, "clamp_obs of the wrapper is not false"),
    ],
    "unet_tuned": [
        ({"model": {"ft_denoising_steps": 5}}, r"ft_denoising_steps is 5; expected 4 at most"),
        (
            {"model": {"ft_denoising_steps_d": 1}},
            r"ft_denoising_steps_d is 1; expected 0: what is annealed is not saved",
        ),
        ({"model": {"eps_clip_value": 1.0}}, r"eps_clip_value is 1\.0; expected null"),
        ({"model": {"predict_epsilon": False}}, r"predict_epsilon is false with use_ddim"),
        ({"horizon_steps": 5}, r"a U-Net of 2 levels halves the chunk's 5 steps"),
        (
            _network("unet_tuned", n_groups=3),
            r"dim is 8 with dim_mults = \[1, 2\]; expected widths that n_groups divides",
        ),
        (_network("unet_tuned", groupnorm_eps=2), "groupnorm_eps is 2; expected a small number"),
        (_network("unet_tuned", kernel_size=4), "Mish or ReLU, odd"),
        (_network("unet_tuned", smaller_encoder=True), "unexpected .*cond_encoder|missing .*cond_encoder"),
        (_network("unet_tuned", cond_mlp_dims=[8]), "cond_mlp_dims is .*; expected an even number of widths"),
    ],
}


@pytest.mark.parametrize(("variant", "changes", "message"), refusals(REFUSED))
def test_settings_that_do_not_fit(tmp_path: Path, variant: str, changes: dict[str, Any], message: str) -> None:
    path = dppos.save(tmp_path / "run", variant, **changes)
    assert_not_read(path, message, names=tmp_path / "run")


def test_statistics_that_do_not_fit(tmp_path: Path) -> None:
    """Of another robot, or of a channel that never moved."""
    path = dppos.save(tmp_path / "run", "mlp")
    rows = dppos.normalization()
    for changes, message in (
        (
            {"obs_min": np.zeros(3)},
            r"normalization\.npz: obs_min has the shape \(3,\); expected a number of each channel",
        ),
        ({"action_max": rows["action_min"]}, r"normalization\.npz: .*[Cc]opy the file again"),
    ):
        np.savez(tmp_path / "run" / "normalization.npz", **rows | changes)
        with pytest.raises(CheckpointError, match=message):
            load_checkpoint_policy(path)


COMPILED = {"mlp": "DPPO, MLP", "unet_tuned": "DPPO, U-Net, fine-tuned"}
"""Variant, and the row of the support table."""


@pytest.mark.slow
@pytest.mark.parametrize("variant", COMPILED)
def test_one_command_compiles_a_policy_that_acts_as_the_original(variant: str, tmp_path: Path) -> None:
    program = ttscompile.convert(dppos.save(tmp_path / "run", variant), tmp_path / "compiled")
    steps = program.spec.sampler.steps
    noise = Noise(*dppos.noise(steps))
    assert_compiled_acts(tmp_path / "compiled", dppos.observation(), noise, golden(f"dppo_{variant}"))
    of = "dppo cc7234a `DiffusionEval`, deterministic, raw state to action, 1e-5 of the range"
    record(COMPILED[variant], of, f"{program.spec.sampler.name} {steps}", program)
