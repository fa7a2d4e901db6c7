"""Streaming Diffusion Policy, call after call, to the actions that the original gave; see ``streams.py``."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.families.support import record, stored_program
from tests.rounding import PROMISED
from ttscompile.artifact import load_artifact
from ttscompile.errors import ObservationError, SpecError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy, evaluation
from ttscompile.frontends.families import LoadOptions
from ttscompile.policies.diffusion_policy.streaming import Buffer, StreamingDenoiser

from . import streams
from .authors import by_one_command
from .refused import Refusals, assert_not_read, refusals

Arrays = dict[str, np.ndarray]


def calls(
    variant: str, spec: ttscompile.PolicySpec, act: Callable[[Arrays, ttscompile.Noise], np.ndarray]
) -> Iterator[np.ndarray]:
    """Consecutive calls of ``act``, which gives ``action_pred``, with the noise in the order of the original.

    A call's last draw is for the chunks that go on, and so the next call's noise at their places.
    """
    drawn = iter(streams.draws(variant))
    executed, horizon = spec.chunk.stop - spec.chunk.start, spec.sample[0]
    kept = Buffer(horizon, spec.chunk.start + 1, executed, 1).kept
    buffer, initial = np.zeros((streams.STREAMS, *spec.sample), np.float32), next(drawn)
    for number, observed in enumerate(streams.observations(variant)):
        noise = ttscompile.Noise(initial, np.stack([next(drawn) for _ in range(spec.sampler.steps)]))
        begins = np.full((streams.STREAMS, 1), number == 0, np.float32)
        buffer = act({**observed, "buffer": buffer, "begins": begins}, noise)
        yield buffer
        assert noise.steps is not None
        new, _ = next(drawn), next(drawn)  # the original draws noise for the steps before the chunk, and drops it
        initial = np.concatenate([np.roll(noise.steps[-1], -executed, 1)[:, :kept], new[:, : horizon - kept]], 1)


def assert_same(variant: str, spec: ttscompile.PolicySpec, found: Iterator[np.ndarray]) -> None:
    """What is executed, and all that is clean, in every call."""
    numbers, (start, stop) = streams.expected(variant), (spec.chunk.start, spec.chunk.stop)
    tolerance = PROMISED * np.ptp(numbers["action"])
    count = 0
    for count, made in enumerate(found, start=1):  # how many there were
        assert np.abs(made[:, start:stop] - numbers["action"][count - 1]).max() < tolerance
        assert np.abs(made[:, :stop] - numbers["action_pred"][count - 1][:, :stop]).max() < tolerance
    assert count == streams.CALLS
    assert np.abs(numbers["action"][1] - numbers["action"][0]).max() > 1000 * tolerance


@pytest.mark.parametrize("variant", streams.VARIANTS)
def test_the_original_acts_the_same_call_after_call(variant: str, tmp_path: Path) -> None:
    """In three calls, whose buffers go on from each other."""
    module, spec = load_checkpoint_policy(streams.save(tmp_path / "policy.ckpt", variant))

    def act(observed: Arrays, noise: ttscompile.Noise) -> np.ndarray:
        seen = {key: torch.from_numpy(each.normalized(observed[key])) for key, each in spec.observations.items()}
        return spec.chunk.unnormalized(eager_policy(module, spec)(seen, noise).numpy())

    assert_same(variant, spec, calls(variant, spec, act))


@pytest.mark.parametrize("variant", streams.VARIANTS)
def test_the_network_is_told_the_timestep_of_every_position(variant: str, tmp_path: Path) -> None:
    """The same in every call; and gives what the original's gives of the first buffer."""
    made, numbers = streams.configuration(variant)["policy"], streams.expected(variant)
    buffer = Buffer(made["horizon"], made["n_obs_steps"], made["n_action_steps"], made["num_inference_steps"])
    assert (numbers["told"] == np.tile(buffer.levels(), (streams.CALLS, 1))).all()
    module, spec = load_checkpoint_policy(streams.save(tmp_path / "policy.ckpt", variant))
    seen: list[Any] = []
    denoiser = next(each for each in module.modules() if isinstance(each, StreamingDenoiser))
    denoiser.model.register_forward_hook(lambda model, args, out: seen.append(out))
    noise = streams.draws(variant)[0]
    first = streams.observations(variant)[0] | {"buffer": noise, "begins": np.ones((2, 1), np.float32)}
    given = {key: torch.from_numpy(each.normalized(first[key])) for key, each in spec.observations.items()}
    with torch.inference_mode():
        evaluation(module, spec, given)(torch.from_numpy(noise), torch.zeros(2, dtype=torch.int64))
    assert np.abs(seen[0].numpy() - numbers["first_out"]).max() < PROMISED * np.ptp(numbers["first_out"])


def test_a_buffer_by_hand() -> None:
    """Two chunks of three behind one observed step, and one step that is left over."""
    buffer = Buffer(horizon=8, observed=2, executed=3, timesteps=10)
    assert (buffer.chunks, buffer.steps, buffer.kept) == (2, 5, 4)
    assert buffer.levels()[0].tolist() == [4, 4, 4, 4, 9, 9, 9, 9]
    assert buffer.levels()[-1].tolist() == [0, 0, 0, 0, 5, 5, 5, 5]
    assert Buffer(horizon=4, observed=1, executed=4, timesteps=10).kept == 0


@pytest.mark.slow
@pytest.mark.parametrize(("variant", "what"), [("two_chunks", "low-dimensional"), ("images", "robomimic's encoder")])
def test_one_command_compiles_a_policy_that_goes_on_from_call_to_call(variant: str, what: str, tmp_path: Path) -> None:
    """In both runtimes; its row of the support table."""
    compiled = by_one_command(streams.save(tmp_path / "policy.ckpt", variant))
    spec = load_artifact(compiled).manifest.spec
    for runtime in ("onnxruntime", "reference"):
        policy = ttscompile.load(compiled, runtime=runtime)

        def act(observed: Arrays, noise: ttscompile.Noise, policy: Any = policy) -> np.ndarray:
            made: np.ndarray = policy.predict_action(observed, noise=noise)["action_pred"]
            return made

        assert_same(variant, spec, calls(variant, spec, act))
    assert policy.info.prefix_refusal is not None
    with pytest.raises(ObservationError, match="buffer"):
        policy.predict_action(streams.observations(variant)[0])
    record(
        f"Streaming Diffusion Policy, {what}",
        "actions that the original gave, call after call, 1e-5 of the range",
        "streaming 5",
        stored_program(load_artifact(compiled)),
    )


def test_it_has_one_loop(tmp_path: Path) -> None:
    path = streams.save(tmp_path / "policy.ckpt", "two_chunks")
    for options in (LoadOptions(sampler="ddim"), LoadOptions(steps=4), LoadOptions(spacing="trailing")):
        assert_not_read(
            path, "has one loop: its buffer is cleaner by 5 steps after each call", error=SpecError, options=options
        )
    assert not load_checkpoint_policy(path, options=LoadOptions(loops=[("ddim", 3)]))[1].loops


REFUSED: Refusals = {
    "two_chunks/noise_scheduler": [
        ({"_target_": "a.DDIMTEDiScheduler"}, "_target_ is DDIMTEDiScheduler; expected DDPMTEDi"),
        ({"num_train_timesteps": 20}, "num_inference_steps is 10; expected 20, the timesteps of the"),
        ({"num_train_timesteps": 10**6}, "num_train_timesteps is 1000000; expected a positive whole"),
        ({"variance_type": "learned"}, "variance_type is 'learned'; expected fixed_small or"),
        ({"beta_schedule": "x"}, r"noise_scheduler: diffusers refuses the settings"),
        ({"clip_sample": 1}, "clip_sample is 1; expected true or false"),
    ],
    "two_chunks": [
        ({"obs_as_global_cond": False}, "obs_as_global_cond is false; expected true: its inpainting is not rebuilt"),
        ({"obs_as_local_cond": True}, "obs_as_local_cond is True; expected false: another is not rebuilt here"),
        ({"oa_step_convention": False}, "oa_step_convention is False; expected true"),
        ({"buffer_init": "denoise"}, "buffer_init is 'denoise'; expected zero or constant: the first call"),
        ({"n_action_steps": 2}, r"horizon = 8 holds 3 chunks of n_action_steps = 2, and 10 timesteps; expected"),
        ({"n_action_steps": 8}, "horizon = 8 holds 0 chunks of n_action_steps = 8"),
        ({"horizon": 12, "n_action_steps": 5}, r"model\.horizon is 8; expected 12, the policy's"),
        (
            {"horizon": 10**6, "model": {"horizon": 10**6}},
            "policy.horizon is 1000000; expected a positive whole number, 4096 at most",
        ),
        ({"eta": 0.1}, r"cfg\.policy has settings that are not known: eta\. The policy was changed"),
    ],
    "two_chunks/model": [
        ({"input_dim": 4}, r"model\.input_dim is 4; expected 3 with action_dim = 3"),
        ({"input_dim": None}, r"model\.input_dim is missing"),
        ({"more": 1}, r"cfg\.policy\.model has settings that ConditionalUnet1D does not know: more"),
        ({"diffusion_step_embed_dim": 10**6}, "diffusion_step_embed_dim or horizon asks for at least"),
        ({"down_dims": [16, 24, 32]}, r"missing model\.down_modules\.1\.2\."),
        ({"down_dims": [16] * 5}, "horizon is 8; expected a multiple of 16"),
    ],
    "images": [
        ({"obs_as_global_cond": False}, "obs_as_global_cond is false"),
        (
            {"shape_meta": {"obs": {"buffer": {"shape": [4]}}, "action": {"shape": [3]}}},
            "shape_meta.obs names buffer, which stands",
        ),
        ({"down_dims": [16, 24, 32]}, r"missing model\.down_modules\.1\.2"),
        ({"more": 1}, "has settings that are not known: more"),
    ],
}


@pytest.mark.parametrize(("place", "changes", "message"), refusals(REFUSED))
def test_what_is_no_such_policy_is_refused(place: str, changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    variant, _, entry = place.partition("/")
    path = streams.save(tmp_path / "policy.ckpt", variant, **({entry: changes} if entry else changes))
    assert_not_read(path, message, names=path)
