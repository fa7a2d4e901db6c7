"""HybridVLA from a checkpoint of its training, to the actions of HybridVLA 64ed480; see ``hybrid_vlas.py``."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ttscompile
from tests.families.checks import golden, in_loop
from tests.families.support import record, stored_program
from tests.rounding import PROMISED
from ttscompile.artifact import load_artifact
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions, find_family

from . import hybrid_vlas as tiny
from .authors import by_one_command
from .refused import assert_not_read

RANGE = np.ptp([tiny.LOW, tiny.HIGH])


def as_seen(spec: ttscompile.PolicySpec, **changes: np.ndarray) -> dict[str, torch.Tensor]:
    """The observation as the module takes it."""
    return {name: torch.from_numpy(value) for name, value in (tiny.observation() | changes).items()}


def test_the_original_predicts_the_same(tmp_path: Path) -> None:
    """Three actions at two timesteps: what each token sees, and what is padding."""
    module, spec = load_checkpoint_policy(tiny.save(tmp_path, tiny.CONFIG | {"future_action_window_size": 2}))
    assert spec.sample == (3, 7)
    numbers, timesteps = golden("hybrid_vla"), torch.tensor([90, 30])
    with torch.inference_mode():
        found = module(torch.from_numpy(numbers["several"]), timesteps, **as_seen(spec)).numpy()
        short = module(
            torch.from_numpy(numbers["several"]),
            timesteps,
            **{name: torch.from_numpy(value) for name, value in tiny.observation(11).items()},
        ).numpy()
    for each in (found, short):
        assert np.abs(each - numbers["prediction"]).max() < PROMISED * np.ptp(numbers["prediction"])


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """By one command."""
    return by_one_command(tiny.save(tmp_path_factory.mktemp("hybrid_vla")))


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnxruntime", "reference"])
def test_the_compiled_policy_acts_as_the_original(compiled: Path, runtime: str) -> None:
    """From the robot's state to its actions, the gripper's included."""
    policy, numbers = ttscompile.load(compiled, runtime=runtime), golden("hybrid_vla")
    out = policy.predict_action(tiny.observation(), noise=ttscompile.Noise(numbers["noise"]), plan="dense")
    assert np.abs(out["action"] - numbers["actions"]).max() < PROMISED * RANGE
    within = (numbers["actions"] > tiny.LOW) & (numbers["actions"] < tiny.HIGH)
    assert within[..., :4].mean() > 0.5
    assert policy.info.K == 4


@pytest.mark.slow
def test_the_language_model_reads_the_prefix_once(compiled: Path) -> None:
    """Its layers are the blocks, and of all arithmetic less than an eighth is left in the loop."""
    program = stored_program(load_artifact(compiled))
    assert in_loop(program) < 1 / 8
    record(
        "HybridVLA, its diffusion, read from its file",
        "Hybrid-VLA 64ed480 `predict_action`, `PrismaticVLM.forward`, 1e-5 of the range",
        "ddim 4",
        program,
    )
    assert program.spec.observations["prefix"].shape == (12, 256)


def test_what_the_network_is_told_of_the_state(tmp_path: Path) -> None:
    """Its quantiles become -1 and 1, and nothing is beyond; the gripper stays as it is."""
    module: Any = load_checkpoint_policy(tiny.save(tmp_path))[0]
    seen: list[np.ndarray] = []
    hook = module.proprio_embedder.register_forward_pre_hook(lambda _, given: seen.append(given[0].numpy()))
    with torch.inference_mode():
        module(torch.zeros(2, 1, 7), torch.tensor([9, 9]), **as_seen(load_checkpoint_policy(tiny.save(tmp_path))[1]))
    hook.remove()
    np.testing.assert_allclose(seen[0], tiny.scaled(tiny.states()), rtol=0, atol=1e-6)
    assert seen[0][0, 2] == 1


def test_the_sampler_and_the_lengths_are_what_is_asked_for(tmp_path: Path) -> None:
    path = tiny.save(tmp_path, tiny.CONFIG | {"prefix_tokens": 600})
    spec = load_checkpoint_policy(path, options=LoadOptions(sampler="ddpm", steps=100))[1]
    assert spec.sampler.timesteps.tolist() == [75, 50, 25, 0]
    assert [(each.name, each.steps) for each in spec.loops.values()] == [("ddpm", 100)]
    assert spec.observations["prefix_mask"].shape == (600,)
    spec = load_checkpoint_policy(path, options=LoadOptions(sampler="ddim", steps=6))[1]
    assert spec.in_loop("ddim-6").sampler.timesteps.tolist() == [85, 68, 51, 34, 17, 0]  # the original's --ddim-steps 6
    config = {name: value for name, value in tiny.CONFIG.items() if name != "future_action_window_size"}
    assert load_checkpoint_policy(tiny.save(tmp_path, config))[1].sample == (16, 7)
    assert find_family(path, "auto").name == find_family(path, "hybrid_vla").name == "hybrid_vla"


def test_without_statistics_actions_stay_as_the_network_makes_them(tmp_path: Path) -> None:
    two = tiny.STATISTICS | {"bridge": {}}
    for statistics, what in ((None, "is not there"), (two, "holds 2 data sets")):
        with pytest.warns(UserWarning, match=rf"dataset_statistics\.json {what}.*state has to be given as the network"):
            module, spec = load_checkpoint_policy(tiny.save(tmp_path, statistics=statistics))
        assert spec.chunk.normalizer is None
        assert spec.source["statistics"] == "none"
        assert not dict(module.named_buffers())["mask"].any()


def test_a_policy_of_two_arms_has_two_grippers(tmp_path: Path) -> None:
    double = {name: 2 * value for name, value in tiny.STATISTICS["rlbench"]["action"].items()}
    both = {"rlbench": {"action": double, "proprio": double}}
    changes = {
        "x_embedder": {"mlp.fc1.weight": torch.zeros(256, 14)},
        "proprio_embedder": {"mlp.fc1.weight": torch.zeros(256, 14)},
        "final_layer": {"mlp.fc2.weight": torch.zeros(14, 256), "mlp.fc2.bias": torch.zeros(14)},
    }
    spec = load_checkpoint_policy(tiny.save(tmp_path, statistics=both, **changes))[1]
    assert [one.channel for one in spec.chunk.switches] == [6, 13]


def statistics(part: str, **changes: Any) -> dict[str, Any]:
    """Those of the data set with changes to one part."""
    own = tiny.STATISTICS["rlbench"]
    return {"statistics": {"rlbench": own | {part: own[part] | changes}}}


GATE = "llm.model.layers.0.mlp.gate_proj.weight"
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"config": None}, r"no .*config\.json\. Put beside the folder checkpoints"),
    ({"config": {}}, "prefix_tokens is None; expected a positive whole number, 4096 at most.*256 for each camera"),
    ({"config": tiny.CONFIG | {"prefix_tokens": 10**9}}, "prefix_tokens is 1000000000; expected"),
    ({"config": tiny.CONFIG | {"future_action_window_size": -1}}, "future_action_window_size is -1; expected a whole"),
    ({"x_embedder": None}, r"no entry model\.x_embedder; expected.*trained with use_diff.*nothing denoises"),
    ({"llm_backbone": None}, r"no entry model\.llm_backbone"),
    ({"llm_backbone": {GATE: None}}, rf"{GATE} must be a matrix; found none\. Expected.*Llama 2; one on Phi-2 is not"),
    ({"llm_backbone": {GATE: torch.zeros(40, 200)}}, "Llama is 200 wide, and its keys 256; expected multiples of 128"),
    ({"t_embedder": {"mlp.0.bias": None}}, r"missing t_embedder\.mlp\.0\.bias"),
    ({"t_embedder": {"mlp.0.bias": torch.zeros(3)}}, r"t_embedder\.mlp\.0\.bias has shape \(3,\); expected \(256,\)"),
    ({"final_layer": {"mlp.fc2.bias": torch.full((7,), torch.nan)}}, "7 values that are not finite"),
    ({"final_layer": {"more": torch.zeros(1)}}, r"unexpected final_layer\.more"),
    (statistics("action", q01=[1, 2]), r"rlbench\.action\.q01 is \[1, 2\]; expected 7 finite numbers"),
    (statistics("proprio", q99=None), r"rlbench\.proprio\.q99 is None; expected 7 finite numbers"),
    (statistics("proprio", mask=[1] * 7), "mask is .*expected 7 times true or false"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_what_is_no_such_policy_is_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = tiny.save(tmp_path, **changes)
    assert_not_read(path, message, names=tmp_path, format="hybrid_vla")


def test_hostile_and_damaged_files_are_refused(tmp_path: Path) -> None:
    path = tiny.save(tmp_path, x_embedder={"hook": print})
    assert_not_read(path, r"refused, .*could run code")
    path = tiny.save(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps([1]))
    assert_not_read(path, r"config\.json: holds a list; expected an object")
    tiny.save(tmp_path).write_bytes(path.read_bytes()[:4000])
    assert_not_read(path, "not a torch checkpoint, or a truncated one", format="hybrid_vla")


def test_a_machine_without_the_memory_is_told_before_anything_is_copied(tmp_path: Path, monkeypatch: Any) -> None:
    """Seven thousand million weights are more than most have memory for."""
    monkeypatch.setattr("ttscompile.frontends.saved_weights.memory_bytes", lambda: 2**18)
    path = tiny.save(tmp_path)
    assert_not_read(path, rf"{path}: .*million weights.*this machine has 0\.0 GiB")
