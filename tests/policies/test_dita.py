"""Dita's head from a checkpoint and the configuration of its training, to the actions of Dita 66350e7."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from tests.families.checks import golden
from tests.families.weights import draw_weights
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.policies.dita import DitaHead

from .authors import assert_acts_as_the_original, assert_loops, by_one_command
from .refused import assert_not_read

CONFIG: dict[str, Any] = {
    "task_name": "calvin_exp",
    "batch_size": 32,
    "prediction_type": "epsilon",
    "num_pred_action": 5,
    "trajectory_dim": 7,
    "use_action_head_diff": 0,
    "num_inference_steps": 10,
    "scheduler_type": 0,
    "dataset": {"traj_length": 6, "num_given_observation": 2, "stride": 4},
    "model": {"name": "llama_dp", "num_layers": 12, "dim_align_type": 2},
    "hydra": {"run": {"dir": "./outputs/${task_name}"}},
}
QUERIES = {"image_tokenizer.qformer.queries": torch.zeros(1, 4, 128)}

Weights = dict[str, Any]


def weights() -> Weights:
    """Those of the golden file, under the names of ``RobotTransformerNet.state_dict``, and one of the image's."""
    own = DitaHead(128, heads=2, hidden=80, layers=2, actions=7).state_dict()
    shapes = {name: tuple(value.shape) for name, value in own.items()}
    return draw_weights(shapes, int(golden("dita_words")["seed"])) | QUERIES


def save(folder: Path, parameter: Weights, **changes: Any) -> Path:
    """As the training writes it: ``checkpoints`` in the folder where hydra has put ``.hydra``."""
    for name in (".hydra", "checkpoints"):
        (folder / name).mkdir(exist_ok=True)
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump(CONFIG | changes))
    path = folder / "checkpoints" / "ckpt_1000.pth"
    optimizer = {"state": {0: {"step": torch.tensor(1.0)}}, "param_groups": [{"lr": 1e-4, "params": [0]}]}
    torch.save({"parameter": parameter, "optimizer": optimizer, "epoch": 1, "loss": torch.tensor(0.1)}, path)
    return path


@pytest.mark.slow
def test_one_command_compiles_a_head_that_acts_as_the_original(tmp_path: Path) -> None:
    path = save(tmp_path, weights())
    arrays, drawn = golden("dita_words"), np.random.default_rng(205)  # as golden/make_dita.py draws them
    words, frames = (drawn.standard_normal(shape, dtype=np.float32) for shape in ((2, 77, 128), (2, 2, 4, 128)))
    observed = {"prefix": np.concatenate([words, frames.reshape(2, 8, 128)], 1)}
    compiled = by_one_command(path)
    policy, _ = assert_acts_as_the_original(path, compiled, observed, arrays["noise"], arrays["actions"])
    assert policy.info.K == 10


def test_the_lengths_and_the_sampler_are_the_configurations(tmp_path: Path) -> None:
    path = save(tmp_path, weights(), scheduler_type=1, num_inference_steps=20, num_pred_action=4)
    spec = assert_loops(path, ("ddim", 20, 950), ("dpmsolver++", 3), "dita")
    assert spec.observations["prefix"].shape == (77 + 3 * 4, 128)
    assert (spec.chunk.start, spec.chunk.stop, spec.sample) == (2, 6, (6, 7))
    for wrapped, length in ((1, 5), (2, 6)):
        spec = load_checkpoint_policy(save(tmp_path, weights(), wrap_grmg_data=wrapped, dataset={"traj_length": 9}))[1]
        assert (spec.sample[0], spec.chunk.stop - spec.chunk.start) == (length, 5)


def test_other_files_that_hold_the_same_head(tmp_path: Path) -> None:
    expected = {name: value for name, value in weights().items() if name not in QUERIES}
    path = save(tmp_path, {f"module._orig_mod.{name}": value.half() for name, value in weights().items()})
    module = load_checkpoint_policy(path)[0]
    halved = {name: value.half().float() for name, value in expected.items()}
    torch.testing.assert_close(dict(module.state_dict()), halved, rtol=0, atol=0)
    old = {"transformer.model.layers.0.self_attn.rotary_emb.inv_freq": torch.zeros(32)}
    torch.save(weights() | old, path)
    torch.testing.assert_close(dict(load_checkpoint_policy(path)[0].state_dict()), expected, rtol=0, atol=0)


LAYER = "transformer.model.layers.0.mlp."
REFUSED: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    ({"use_action_head_diff": 2}, {}, "use_action_head_diff is 2; expected 0: another is not rebuilt here"),
    ({"dim_align_type": 1}, {}, "dim_align_type is 1; expected 0"),
    ({"cfg": 1.5}, {}, "cfg is 1.5; expected 0: another is not rebuilt here"),
    ({"abs_sup": 3}, {}, "abs_sup is 3; expected 0: another is not rebuilt here"),
    (
        {"dataset": None},
        {},
        r"config\.yaml: dataset is None; expected settings by name\. Give the \.hydra/config\.yaml",
    ),
    ({"dataset": {}}, {}, "dataset.traj_length is None; expected a positive whole number, 4096 at most"),
    ({"num_pred_action": 7}, {}, "num_pred_action is 7; expected 6 at most, of dataset.traj_length"),
    ({"prediction_type": "flow"}, {}, "prediction_type is 'flow'; expected epsilon or sample or v_prediction"),
    ({"scheduler_type": "x"}, {}, "scheduler_type is 'x'; expected a whole number"),
    (
        {},
        {f"{LAYER}gate_proj.weight": None},
        r"ckpt_1000\.pth: no weight transformer\.model\.layers\.0\.mlp\.gate_proj",
    ),
    ({}, {f"{LAYER}gate_proj.weight": torch.zeros(80, 100)}, "is 100 wide; expected a multiple of 64"),
    ({}, {f"{LAYER}up_proj.weight": None}, r"missing transformer\.model\.layers\.0\.mlp\.up_proj\.weight"),
    ({}, {f"{LAYER}up_proj.weight": torch.zeros(2, 2)}, r"up_proj\.weight has shape \(2, 2\); expected \(80, 128\)"),
    ({}, {f"{LAYER}up_proj.weight": torch.full((80, 128), torch.inf)}, "10240 values that are not finite"),
    ({}, {f"{LAYER}up_proj.lora_A.default.weight": torch.zeros(2)}, r"holds an adapter \(LoRA: .*merge_and_unload"),
    ({}, {"image_tokenizer.qformer.queries": None}, "whose rows are the tokens of a frame; expected a Dita with"),
]


@pytest.mark.parametrize(("changes", "replaced", "message"), REFUSED)
def test_what_is_no_such_head_is_refused(
    changes: dict[str, Any], replaced: dict[str, Any], message: str, tmp_path: Path
) -> None:
    held = {name: value for name, value in (weights() | replaced).items() if value is not None}
    assert_not_read(save(tmp_path, held, **changes), message, names=tmp_path)


def test_hostile_and_damaged_files_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path, {"a": print})
    assert_not_read(path, r"ckpt_1000\.pth: refused, .*could run code")
    torch.save({"parameter": [1]}, path)
    assert_not_read(path, "its entry 'parameter' is a list; expected weights by name")
    (tmp_path / ".hydra" / "config.yaml").write_text("a: [1\n")
    assert_not_read(path, r"config\.yaml: cannot be read as plain YAML")
