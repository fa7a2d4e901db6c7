"""Parity with LeRobot's pi05 that was trained to go on from a prefix, at tiny size: no release has it yet."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from torch import Tensor, nn

import ttscompile
from tests.once import Once
from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.artifact import load_artifact
from ttscompile.core.spec import Noise
from ttscompile.errors import ObservationError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.ir.program import Binding
from ttscompile.policies.networks.pi import Expert, Pi
from ttscompile.samplers.flow import flow_matching_table

from . import originals, pis
from .lerobot_tiny import change_json
from .refused import assert_not_read
from .vlas import Array

DELAY = "rtc_training_max_delay"


def trained(directory: Path) -> Path:
    """A policy with the weights of all others of ``pis``."""
    pis.save("pi05", directory)
    change_json(directory / "config.json", **{DELAY: pis.TRAINED})
    return directory


def compiled(once: Once, tmp_path: Path) -> Path:
    return once.compiled("trained pi05", lambda to: ttscompile.convert(trained(tmp_path / "policy"), to))[0]


def chunk(policy: ttscompile.CompiledPolicy, prefix: Array | None) -> Array:
    given, specs = pis.observation(0), policy.info.observation
    windows = {key: given[key] if one.frames is None else given[key][:, None] for key, one in specs.items()}
    out: Array = policy.predict_action(windows, Noise(pis.noise()), "dense", prefix)["action_pred"]
    return out


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "torch", "reference"])
def test_lerobots_actions_without_a_prefix_and_with_all_lengths_of_it(once: Once, tmp_path: Path, runtime: str) -> None:
    """LeRobot gives the committed actions back as they are, and so do we: of all others it is the network's own."""
    golden = originals.golden("lerobot_pi_trained")
    policy = ttscompile.load(compiled(once, tmp_path), runtime=runtime)
    assert (policy.info.prefix_refusal, policy.info.trained_prefix) == (None, pis.TRAINED)
    committed = policy.info.action.unnormalized(pis.left_over())
    assert np.abs(chunk(policy, None) - golden["without"]).max() < 1e-4
    for delay in range(pis.TRAINED + 1):
        expected = golden[str(delay)]
        assert np.abs(chunk(policy, committed[:, :delay]) - expected).max() < 1e-4
        assert np.abs(expected[:, :delay] - committed[:, :delay]).max(initial=0) < 1e-6
        assert np.array_equal(expected, golden["without"]) == (delay == 0)
    apart = [np.abs(golden["1"] - golden[each])[:, pis.TRAINED :].max() for each in "23"]
    assert min(apart) > 1e-3  # what is free goes on from what is committed
    with pytest.raises(ObservationError, match="was trained to go on from at most 3"):
        chunk(policy, committed)


@pytest.mark.slow
def test_without_a_prefix_it_is_the_policy_that_knows_of_none(once: Once, tmp_path: Path) -> None:
    """And with one it is not what inpainting would make of it."""
    plain, _ = once.compiled("whole pi05", lambda to: ttscompile.convert(pis.save("pi05", tmp_path / "plain"), to))
    policies = [ttscompile.load(path) for path in (compiled(once, tmp_path), plain)]
    assert [policy.info.trained_prefix for policy in policies] == [pis.TRAINED, 0]
    committed = policies[0].info.action.unnormalized(pis.left_over()[:, :2])
    without, inpainted = (np.subtract(*(chunk(each, prefix) for each in policies)) for prefix in (None, committed))
    assert np.abs(without).max() < 1e-6
    assert np.abs(inpainted).max() > 1e-2


@pytest.mark.slow
def test_the_norms_have_a_row_a_step_in_memory_and_none_an_action(once: Once, tmp_path: Path) -> None:
    contexts = load_artifact(compiled(once, tmp_path)).manifest.contexts.values()
    rows = [one.type.at(1) for one in contexts if one.binding is not Binding.CONDITION]
    norms = 2 * pis.EXPERT.layers + 1
    assert rows == [(1, 1, pis.EXPERT.width)] * (2 * (3 * norms - 1))  # of the last one nobody reads the gate
    assert not any(one.binding is Binding.STEP for one in contexts)


def test_what_cannot_be_is_refused(tmp_path: Path) -> None:
    config = trained(tmp_path / "policy") / "config.json"
    for delay in (pis.HORIZON, -1, 2.0, True):
        change_json(config, **{DELAY: delay})
        assert_not_read(config.parent, rf"{DELAY} is {delay}; expected a whole number, 5 at most")
    change_json(config, **{DELAY: 5})
    assert load_checkpoint_policy(config.parent)[1].trained_prefix == 5
    change_json(config, use_visual_memory=True)
    assert_not_read(config.parent, "use_visual_memory or use_proprioceptive_memory is set")
    config = pis.save("pi0", tmp_path / "other") / "config.json"
    change_json(config, **{DELAY: 3})
    assert_not_read(config.parent, rf"{DELAY} is set: .* of pi05 alone; with 0 it is compiled")


class Head(nn.Module):
    """The expert on keys and values of a prefix of three tokens."""

    def __init__(self, trained: int) -> None:
        super().__init__()
        wide = replace(pis.EXPERT, width=512, hidden=2048, layers=3, channels=64)
        narrow = replace(pis.TEXT, layers=3, channels=64)
        config = replace(pis.config("pi05"), expert=wide, text=narrow, actions=32, trained_prefix=trained)
        self.expert = Expert(Pi(config))

    def forward(
        self, sample: Tensor, timestep: Tensor, valid: Tensor, cache: Tensor, committed: Tensor | None = None
    ) -> Tensor:
        told = () if committed is None else (committed,)
        made: Tensor = self.expert(sample, timestep, (*told, valid, *cache.unbind(1)))
        return made


@pytest.mark.soak
def test_what_a_trained_prefix_costs(tmp_path: Path) -> None:
    """On one thread, at half of the published width. With ``-s`` it prints times, and ratios to the plain policy's.

    All take turns; a ratio is the median of those of each round. Times are of the processor, whatever else it does.
    """
    observed = {"valid": ObservationSpec((3,), dtype="bool", window=False, bounds=(1, 1))}
    observed["cache"] = ObservationSpec((6, 1, 3, 64), window=False)
    spec = PolicySpec((50, 32), observed, flow_matching_table(10, start=1.0, end=0.0), ChunkSpec(32, 0, 50))
    policies = []
    for trained in (0, 10):
        folder = tmp_path / str(trained)
        ttscompile.compile_denoiser(Head(trained), replace(spec, trained_prefix=trained), folder)
        policies.append(ttscompile.load(folder, threads=1, seed=0))
    rng = np.random.default_rng(0)
    obs = {"valid": np.ones((1, 3), np.bool_), "cache": rng.standard_normal((1, 6, 1, 3, 64), dtype=np.float32)}
    prefix, rounds = rng.uniform(-1, 1, (1, 8, 32)).astype(np.float32), list[list[float]]()
    for _ in range(14):
        rounds.append([])
        for policy in policies:
            for known in (None, prefix):
                start = time.process_time()
                policy.predict_action(obs, prefix=known)
                rounds[-1].append(1e3 * (time.process_time() - start))
    taken = np.array(rounds[2:])
    ratios = np.median(taken / taken[:, :1], axis=0)
    for what, ms, ratio in zip(
        ("plain", "inpainted prefix", "trained, no prefix", "trained prefix"), np.median(taken, 0), ratios, strict=True
    ):
        print(f"{what}: {ms:.1f} ms, {ratio:.3f} of the plain policy's")
    assert ratios.max() < 1.5
