"""Parity with the original implementation, on checkpoints that it saved."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch import nn

from tests.rounding import PROMISED, Counted, assert_equal_but_for_rounding
from ttscompile.core.spec import Noise, PolicySpec
from ttscompile.errors import ObservationError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.checkpoint import plain_config, read_checkpoint
from ttscompile.frontends.eager import eager_policy
from ttscompile.ir.evaluate import evaluate

from ..golden import compiled_golden
from ..once import Once
from .originals import as_seen, assert_actions

GOLDEN = {
    "mlp_encoder_causal": "token-wise condition encoder",
    "ddim8": "token-wise condition encoder",
    "transformer_encoder_causal": "transformer condition encoder",
    "inpainting": "inpainting",
    "bert": "encoder-only",
}

Loaded = tuple[nn.Module, PolicySpec, dict[str, npt.NDArray[Any]]]


@pytest.fixture(scope="module", params=GOLDEN)
def name(request: pytest.FixtureRequest) -> str:
    """Of one golden checkpoint."""
    return str(request.param)


@pytest.fixture(scope="module")
def golden(name: str, shared: Path) -> Loaded:
    """Module, specification and the original's numbers."""
    base = shared / "golden" / "diffusion_policy" / name
    module, spec = load_checkpoint_policy(base.with_suffix(".ckpt"))
    assert spec.source["variant"] == GOLDEN[name]
    assert spec.observations["obs"].normalizer is not None
    with np.load(base.with_suffix(".npz")) as numbers:
        return module, spec, dict(numbers)


@pytest.mark.slow
def test_single_evaluations(golden: Loaded) -> None:
    """The network alone, at three timesteps."""
    module, spec, numbers = golden
    network: Any = module.model
    cond = as_seen(spec, numbers)["obs"] if network.config.cond_dim else None
    for timestep, expected in zip(numbers["probe_t"], numbers["probe_eps"], strict=True):
        with torch.inference_mode(), Counted() as counted:
            found = network(torch.from_numpy(numbers["probe_x"]), torch.full((2,), int(timestep)), cond)
        assert_equal_but_for_rounding(found, expected, counted.terms, counted.angle)


@pytest.mark.slow
def test_module_is_the_network_with_the_observation_in_place(golden: Loaded) -> None:
    """Inpainting overwrites exactly the first To rows of the observation channels, whatever was there."""
    module, spec, numbers = golden
    network: Any = module.model
    obs, x, t = as_seen(spec, numbers)["obs"], torch.from_numpy(numbers["probe_x"]), torch.full((2,), 7)
    with torch.inference_mode():
        found = module(x, t, obs)
        if network.config.cond_dim:
            expected = network(x, t, obs)
        else:
            placed = x.clone()
            placed[:, : obs.shape[1], spec.chunk.action_dim :] = obs
            expected = network(placed, t)
            assert not torch.equal(expected, network(x, t))
    assert torch.equal(found, expected)


def test_whole_call(golden: Loaded) -> None:
    """The denoising loop from the stored noise gives the stored actions within what is promised."""
    module, spec, numbers = golden
    assert spec.sampler.timesteps.tolist() == numbers["timesteps"].tolist()
    assert spec.sample == numbers["noise_initial"].shape[1:]
    noise = Noise(numbers["noise_initial"], numbers["noise_steps"])
    assert spec.chunk.normalizer is not None
    assert_actions(spec, eager_policy(module, spec)(as_seen(spec, numbers), noise), numbers)


@pytest.mark.slow
def test_captured_once_for_any_batch(golden: Loaded, name: str, once: Once, shared: Path) -> None:
    """The graph that is compiled, after capture, decompositions and passes, is the module for every batch size."""
    module, _, numbers = golden
    program = compiled_golden(once, shared, name)[1]
    weights = {key: torch.from_numpy(program.weights[key]) for key in program.denoiser.constants}
    for streams in (1, 5):
        generator = torch.Generator().manual_seed(streams)
        inputs = (
            torch.randn(streams, *numbers["probe_x"].shape[1:], generator=generator),
            torch.arange(streams),
            torch.randn(streams, *numbers["obs"].shape[1:], generator=generator),
        )
        values = dict(zip(("sample", "timestep", "obs"), inputs, strict=True))
        (found,) = evaluate(program.denoiser, weights, values)
        with torch.no_grad(), Counted() as counted:
            expected = module(*inputs)
        assert_equal_but_for_rounding(found, expected, counted.terms, counted.angle)


def test_eager_policy_needs_noise_for_a_stochastic_sampler(golden: Loaded) -> None:
    """A missing draw is an error, not a deterministic sampler; DDIM needs none."""
    module, spec, numbers = golden
    run, obs = eager_policy(module, spec), as_seen(spec, numbers)
    if spec.sampler.stochastic:
        with pytest.raises(ObservationError, match=r"noise\.steps is None"):
            run(obs, Noise(numbers["noise_initial"]))
    else:
        assert torch.isfinite(run(obs, Noise(numbers["noise_initial"]))).all()


def test_use_ema_decides_which_weights(shared: Path, tmp_path: Path) -> None:
    """The same file with use_ema = false gives the other weights."""
    path = shared / "golden" / "diffusion_policy" / "mlp_encoder_causal.ckpt"
    payload = read_checkpoint(path)
    config = plain_config(payload["cfg"])
    assert config["training"]["use_ema"] is True
    config["training"]["use_ema"] = False
    torch.save({**payload, "cfg": config}, tmp_path / "plain.ckpt")
    stored = {name: weights["model.head.weight"] for name, weights in payload["state_dicts"].items()}
    assert not torch.equal(stored["model"], stored["ema_model"])
    for file, name in ((path, "ema_model"), (tmp_path / "plain.ckpt", "model")):
        module, spec = load_checkpoint_policy(file)
        assert spec.source["weights"] == name
        assert torch.equal(module.get_parameter("model.head.weight"), stored[name])


@pytest.fixture(scope="module")
def pusht(shared: Path) -> tuple[nn.Module, PolicySpec]:
    """The policy at its real size."""
    return load_checkpoint_policy(shared / "policies" / "pusht_dpt.ckpt")


@pytest.mark.slow
def test_dense_call_of_the_real_policy(shared: Path, pusht: tuple[nn.Module, PolicySpec]) -> None:
    """The first call of a TTS episode is dense: the authors' implementation and ours agree on it."""
    module, spec = pusht
    with np.load(shared / "golden" / "tts" / "timestep_95.npz") as numbers:
        assert not numbers["plans"][0].any()
        noise = Noise(numbers["noise_initial"][0], numbers["noise_steps"][0])
        sample = eager_policy(module, spec)(as_seen(spec, {"obs": numbers["obs"][0]}), noise).numpy()
        assert spec.chunk.normalizer is not None
        actions = spec.chunk.normalizer.unnormalize(sample)
        assert np.abs(actions - numbers["action_pred"][0]).max() < PROMISED * np.ptp(numbers["action_pred"])


def test_half_precision_policy_is_the_same_policy(shared: Path, pusht: tuple[nn.Module, PolicySpec]) -> None:
    """EMA weights only, in half precision: loaded as float32, and equal to the original up to rounding."""
    full, spec = pusht
    half, half_spec = load_checkpoint_policy(shared / "policies" / "pusht_dpt_ema_fp16.ckpt")
    assert half_spec.source == spec.source
    assert half_spec.source["weights"] == "ema_model"
    expected = full.state_dict()
    for key, value in half.state_dict().items():
        assert value.dtype == torch.float32, key
        assert torch.equal(value, expected[key].half().float()), key
    generator = torch.Generator().manual_seed(0)
    x, obs = torch.randn(4, 16, 2, generator=generator), torch.randn(4, 2, 20, generator=generator)
    with torch.inference_mode():
        outputs = [module(x, torch.full((4,), 50), obs) for module in (full, half)]
    error = float((outputs[0] - outputs[1]).abs().max())
    assert 0 < error < 1e-2
