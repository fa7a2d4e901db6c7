"""CogACT's own checkpoint: its action model read and compiled, with the actions that the original gives."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.families.checks import golden
from tests.families.weights import draw_weights
from tests.policies.saved import save_cogact, weights_of
from ttscompile.core.spec import Noise
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.scheduler import configured_loops
from ttscompile.policies import cogact
from ttscompile.policies.cogact import CogACTHead
from ttscompile.policies.loops import RESPACED

from .authors import assert_acts_as_the_original, by_one_command
from .refused import assert_not_read

LOW, HIGH = [-0.5, -1.0, 0.0, -2.0, 0.25, 0.5, 0.0], [0.5, 3.0, 0.5, -1.0, 0.25, 1.0, 1.0]
MASK = [True, True, True, True, True, True, False]
ONE = {"bridge_orig": {"action": {"q01": LOW, "q99": HIGH, "mask": MASK, "mean": LOW}, "num_trajectories": 3}}


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """A model of the size of the golden file beside the original's three, as where that was made."""
    monkeypatch.setitem(cogact.MODELS, "tiny", (24, 2, 3))


def drawn(actions: int, cognition: int, seed: int) -> dict[str, torch.Tensor]:
    """Weights of all parameters of a model, as where the golden files were made."""
    own = CogACTHead(24, 3, 2, 6, actions, cognition, guidance=1.5).state_dict()
    unread = {"history_embedder.linear.weight": (24, actions), "history_embedder.linear.bias": (24,)}
    return draw_weights({key: tuple(value.shape) for key, value in own.items()} | unread, seed)


def seven() -> dict[str, torch.Tensor]:
    """Of a model with as many numbers in an action as the original's have."""
    return drawn(actions=7, cognition=18, seed=3)


@pytest.mark.slow
def test_a_converted_checkpoint_acts_as_the_original(tmp_path: Path) -> None:
    """With the runtime of the robot: from the cognition feature to the robot's actions, clipped, the gripper 0 or 1."""
    arrays = golden("cogact_robot")
    statistics = {"own": {"action": {key: arrays[key].tolist() for key in ("q01", "q99", "mask")}}}
    weights = drawn(actions=7, cognition=4096, seed=int(arrays["seed"]))
    weights["final_layer.linear.weight"] *= 0.1
    path = save_cogact(tmp_path / "run", weights, statistics)
    rng = np.random.default_rng(int(arrays["seed"]))
    obs = {"cognition": rng.standard_normal((2, 1, 4096), dtype=np.float32)}
    actions = arrays["actions"].astype(np.float32)
    policy, _ = assert_acts_as_the_original(path, by_one_command(path), obs, arrays["noise"], actions)
    assert (np.abs(arrays["normalized"][..., :6]) < 1).mean() > 0.5
    assert policy.info.K == 10
    assert dict(policy._spec.source) == {"format": "cogact", "guidance": "1.5", "statistics": "own"}


@pytest.mark.parametrize("sampler", ["ddim", "ddpm", "dpmsolver++"])
def test_every_loop_clips_what_it_gives_and_nothing_before(sampler: str, tmp_path: Path) -> None:
    path = save_cogact(tmp_path / "run", weights_of("cogact"), {"own": {"action": {"q01": [-1] * 5, "q99": [1] * 5}}})
    module, spec = load_checkpoint_policy(path, options=LoadOptions(sampler=sampler, steps=20))
    own = spec.in_loop(f"{sampler}-20")
    assert own.sampler.bound == 1
    plain = configured_loops(RESPACED, 10, LoadOptions(sampler=sampler, steps=20)).others[f"{sampler}-20"]
    noise = Noise(golden("cogact")["noise"], np.random.default_rng(0).standard_normal((20, 2, 6, 5), dtype=np.float32))
    obs = {"cognition": torch.from_numpy(golden("cogact")["cognition"])}
    found = eager_policy(module, own)(obs, noise).numpy()
    wanted = eager_policy(module, replace(own, sampler=plain))(obs, noise).numpy()
    assert np.abs(wanted).max() > 1
    np.testing.assert_allclose(found, np.clip(wanted, -1, 1), atol=1e-4 * np.abs(wanted).max())


@pytest.mark.parametrize(
    ("steps", "first", "stride"), [(10, 90, 10), (8, 91, 13), (6, 85, 17), (16, 90, 6), (1, 50, 0)]
)
def test_ddim_visits_the_timesteps_of_the_original(steps: int, first: int, stride: int, tmp_path: Path) -> None:
    """``space_timesteps`` takes the smallest stride that gives so many; there is none for 16, where it fails."""
    path = save_cogact(tmp_path / "run", weights_of("cogact"), {"own": {"action": {"q01": [-1] * 5, "q99": [1] * 5}}})
    module, spec = load_checkpoint_policy(path, options=LoadOptions(sampler="ddim", steps=steps))
    own = spec if steps == 10 else spec.in_loop(f"ddim-{steps}")
    timesteps = own.sampler.timesteps.tolist()
    assert timesteps == [first - k * stride for k in range(steps)]
    given = torch.from_numpy(golden("cogact")["cognition"])
    x = torch.from_numpy(golden("cogact")["noise"])
    found = eager_policy(module, own)({"cognition": given}, Noise(x.numpy())).numpy()
    kept = np.cumprod([1 - min(1 - signal(t + 1) / signal(t), 0.999) for t in range(100)])
    for t, after in zip(timesteps, [*timesteps[1:], None], strict=True):
        there, then = kept[t], 1.0 if after is None else kept[after]
        out = module(x, torch.tensor([t, t]), given)
        x0 = (x - (1 - there) ** 0.5 * out) / there**0.5
        x = then**0.5 * x0 + (1 - then) ** 0.5 * out
    np.testing.assert_allclose(found, x.detach().numpy().clip(-1, 1), atol=1e-4)


def signal(t: int) -> float:
    """What is left of it before timestep t of 100, as the squared cosine has it."""
    return float(np.cos((t / 100 + 0.008) / 1.008 * np.pi / 2) ** 2)


def test_statistics_of_one_data_set_give_the_robots_actions(tmp_path: Path) -> None:
    """By the original's formula, the gripper 0 or 1 and a number that never changed at its value."""
    module, spec = load_checkpoint_policy(save_cogact(tmp_path / "run", seven(), ONE))
    assert spec.source["statistics"] == "bridge_orig"
    rng = np.random.default_rng(0)
    obs = {"cognition": torch.from_numpy(rng.standard_normal((4, 1, 18), dtype=np.float32))}
    sample = eager_policy(module, spec)(obs, Noise(rng.standard_normal((4, 6, 7), dtype=np.float32))).numpy()
    assert np.abs(sample).max() == 1
    normalized = sample.astype(np.float64)
    normalized[..., 6] = np.where(normalized[..., 6] < 0.5, 0, 1)
    low, high = np.array(LOW), np.array(HIGH)
    expected = np.where(MASK, 0.5 * (normalized + 1) * (high - low) + low, normalized)
    found = spec.chunk.unnormalized(sample)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert set(np.unique(found[..., 6])) == {0, 1}


def test_a_gripper_that_statistics_are_of_has_their_ends(tmp_path: Path) -> None:
    """``mask`` may be absent, and is then true for all."""
    only = {"own": {"action": {"q01": [*LOW[:6], -3.0], "q99": [*HIGH[:6], 5.0]}}}
    spec = load_checkpoint_policy(save_cogact(tmp_path / "run", seven(), only))[1]
    found = spec.chunk.unnormalized(np.array([[[0.0] * 6 + [0.49], [0.0] * 6 + [0.5]]], np.float32))
    np.testing.assert_allclose(found[0, :, 6], [1.0, 5.0])


def test_of_several_data_sets_none_is_chosen(tmp_path: Path) -> None:
    """The warning names them; the gripper is 0 or 1 as the original's normalised one is."""
    path = save_cogact(tmp_path / "run", seven(), ONE | {"fractal20220817_data": ONE["bridge_orig"]})
    with pytest.warns(UserWarning, match=r"holds 2 data sets \(bridge_orig, fractal20220817_data\): .* data set alone"):
        spec = load_checkpoint_policy(path)[1]
    assert spec.chunk.normalizer is None and spec.source["statistics"] == "none"
    found = spec.chunk.unnormalized(np.array([[[0.25] * 7]], np.float32))
    assert found.tolist() == [[[0.25] * 6 + [0.0]]]


def test_the_rest_of_the_model_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some 30 GB of it: tensors are mapped, and what is kept are copies."""
    seen, plain = list[bool](), torch.load

    def watched(*args: Any, **more: Any) -> Any:
        seen.append(more["mmap"])
        return plain(*args, **more)

    monkeypatch.setattr(torch, "load", watched)
    path = save_cogact(tmp_path / "run", weights_of("cogact"), {"a": {"action": {"q01": [-1] * 5, "q99": [1] * 5}}})
    module, _ = load_checkpoint_policy(path)
    path.write_bytes(bytes(path.stat().st_size))  # who overwrites the file does not change the network
    assert seen == [True]
    expected = weights_of("cogact")
    assert all(torch.equal(value, expected[name]) for name, value in module.state_dict().items())


def changed(**changes: Any) -> dict[str, Any]:
    return {key: value for key, value in (weights_of("cogact") | changes).items() if value is not None}


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (changed(positional_embedding=None), "positional_embedding must be a matrix; found none. Give what CogACT's"),
        (changed(positional_embedding=torch.zeros(3)), r"positional_embedding must be a matrix; found shape \[3\]"),
        (changed(positional_embedding=torch.zeros(7, 32)), "has 2 layers 32 wide; expected DiT-S of 6 layers 384 wide"),
        (changed(**{"blocks.7.attn.qkv.weight": torch.zeros(2)}), "has 3 layers 24 wide; expected DiT-S"),
        (changed(**{"blocks.0.attn.qkv.weight": None}), r"missing blocks\.0\.attn\.qkv\.weight"),
        (changed(**{"x_embedder.linear.bias": torch.full((24,), np.nan)}), "24 values that are not finite"),
        (changed(**{"x_embedder.linear.bias": torch.zeros(24, dtype=torch.int8)}), "is a torch.int8 tensor"),
        (changed(more=torch.zeros(2)), "unexpected more"),
        (changed(more=print), "could run code while loading. Nothing of the file was executed"),
    ],
)
def test_a_file_that_is_no_such_policy_is_refused(weights: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = save_cogact(tmp_path / "run", weights)
    assert_not_read(path, message, names=path)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"action": {"q01": LOW, "q99": HIGH[:6]}}, r"q99 is \[.*; expected 7 finite numbers"),
        ({"action": {"q01": [*LOW[:6], "0"], "q99": HIGH}}, "q01 is .*; expected 7 finite numbers"),
        ({"action": {"q01": LOW, "q99": HIGH, "mask": [1] * 7}}, "mask is .*; expected 7 times true or false"),
        ({"proprio": {}}, "bridge.action.q01 is None; expected 7 finite numbers. Copy the file again"),
        (3, "bridge.action.q01 is None"),
    ],
)
def test_statistics_that_are_none_are_refused(entry: Any, message: str, tmp_path: Path) -> None:
    path = save_cogact(tmp_path / "run", seven(), {"bridge": entry})
    assert_not_read(path, message, names=tmp_path / "run" / "dataset_statistics.json")


def test_other_files_are_told_from_it(tmp_path: Path) -> None:
    """A file without the name, and one without the weights."""
    path = save_cogact(tmp_path / "run", weights_of("cogact"))
    other = path.rename(path.with_suffix(".bin"))
    assert_not_read(other, r"this is a checkpoint of CogACT .*Give it a name that ends with \.pt")
    torch.save({"model": {"action_model_of_others": {}}}, path)
    assert_not_read(path, r"action_model: weights.*found \['action_model_of_others'\]. Give")
    torch.save({"action_model": torch.zeros(2)}, path)
    assert_not_read(path, r"as CogACT's training saves it; found no entry model")
    assert_not_read(tmp_path / "run", r"this is a directory of checkpoints .*Give one of the files in it\.$")
