"""ScaleDP from a DexVLA's directory, as transformers 4.45.2 wrote it for DexVLA fc21a82, to the original's actions."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

import ttscompile
from tests.families.checks import golden
from tests.families.weights import draw_weights
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.policies.scaledp import ScaleDPConfig, ScaleDPHead

from .authors import assert_acts_as_the_original, by_one_command
from .refused import assert_not_read

SIZES = {"n_emb": 24, "num_heads": 3, "depth": 2, "prediction_horizon": 6, "cond_dim": 18, "state_dim": 4}
HEAD: dict[str, Any] = SIZES | {
    "input_dim": 5,
    "output_dim": 5,
    "mlp_ratio": 4.0,
    "is_tinyvla": False,
    "learn_sigma": False,
}
HEAD |= {
    "num_inference_timesteps": 10,
    "num_train_timesteps": 100,
    "model_type": "scale_dp_policy",
    "torch_dtype": None,
}
CONFIG = {
    "architectures": ["Qwen2VLForConditionalGenerationForVLA"],
    "model_type": "qwen2_vla",
    "policy_head_config": HEAD,
    "policy_head_size": "tiny",
    "policy_head_type": "scale_dp_policy",
    "rope_scaling": {"rope_type": "default", "type": "default"},
}
INDEX = "model.safetensors.index.json"
STATISTICS = "dataset_stats.pkl.*are not opened"

NONE: Mapping[str, torch.Tensor | None] = {}

Weights = dict[str, torch.Tensor]


def head_weights() -> Weights:
    """Those of the golden file, under the names of ``ScaleDP.state_dict``."""
    own = ScaleDPHead(ScaleDPConfig(24, heads=3, layers=2, horizon=6, actions=5, features=18, state=4, hidden=20))
    shapes = {name: tuple(value.shape) for name, value in own.state_dict().items()}
    return draw_weights(shapes, int(golden("scaledp")["seed"]))


def save(folder: Path, config: dict[str, Any] = CONFIG, changes: Mapping[str, torch.Tensor | None] = NONE) -> Path:
    """A whole DexVLA in two files, of which the first has nothing of the head but one weight."""
    folder.mkdir(exist_ok=True)
    weights = {name: value for name, value in {**head_weights(), **changes}.items() if value is not None}
    named = {f"policy_head.{name}": value for name, value in weights.items()}
    others = {
        name: torch.zeros(3, dtype=torch.bfloat16) for name in ("model.embed_tokens.weight", "reasoning_film.bias")
    }
    first = {"policy_head.combine.0.weight"}
    files = {
        "model-00001-of-00002.safetensors": others | {name: named[name] for name in first & named.keys()},
        "model-00002-of-00002.safetensors": {name: value for name, value in named.items() if name not in first},
    }
    for file, held in files.items():
        save_file(held, folder / file, metadata={"format": "pt"})
    names = {name: file for file, held in files.items() for name in held}
    (folder / INDEX).write_text(json.dumps({"metadata": {"total_size": 1}, "weight_map": names}))
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "dataset_stats.pkl").write_bytes(b"cos\nsystem\n(S'false'\ntR.")
    return folder


def load(path: Path, **options: Any) -> tuple[Any, ttscompile.PolicySpec]:
    with pytest.warns(UserWarning, match=STATISTICS):
        return load_checkpoint_policy(path, options=ttscompile.frontends.families.LoadOptions(**options))


@pytest.mark.slow
def test_one_command_compiles_a_head_that_acts_as_the_original(tmp_path: Path) -> None:
    path, arrays = save(tmp_path / "saved"), golden("scaledp")
    with pytest.warns(UserWarning, match=STATISTICS):
        compiled = by_one_command(path)
    conditions = {name: arrays[name] for name in ("features", "state")}
    with pytest.warns(UserWarning, match=STATISTICS):
        policy, _ = assert_acts_as_the_original(path, compiled, conditions, arrays["noise"], arrays["actions"])
    assert policy.info.K == 10


def alone(folder: Path) -> None:
    """``policy_head.save_pretrained``: its own entries and names."""
    save_file(head_weights(), folder / "model.safetensors")
    (folder / INDEX).unlink()
    (folder / "config.json").write_text(json.dumps(HEAD))


def beside_an_adapter(folder: Path) -> None:
    """What training with LoRA saved of all that is no adapter."""
    names = {f"base_model.model.policy_head.{name}": value for name, value in head_weights().items()}
    torch.save({"base_model.model.visual.bias": torch.zeros(3)} | names, folder / "non_lora_trainables.bin")
    (folder / "adapter_config.json").write_text("{}")
    (folder / INDEX).unlink()


def in_bfloat16(folder: Path) -> None:
    """As DexVLA trains; read as float32."""
    save(folder, changes={name: value.bfloat16() for name, value in head_weights().items()})


@pytest.mark.parametrize("change", [alone, beside_an_adapter, in_bfloat16])
def test_other_directories_that_hold_the_same_head(change: Callable[[Path], None], tmp_path: Path) -> None:
    module, spec = load(save(tmp_path))
    change(tmp_path)
    other, same = load(tmp_path)
    assert (same.observations, same.chunk, same.source) == (spec.observations, spec.chunk, spec.source)
    assert same.sampler.same_as(spec.sampler)
    expected = head_weights()
    if change is in_bfloat16:
        expected = {name: value.bfloat16().float() for name, value in expected.items()}
    torch.testing.assert_close(other.state_dict(), expected, rtol=0, atol=0)
    assert set(module.state_dict()) == set(expected)


def test_the_sampler_is_the_configurations_or_the_one_that_is_asked_for(tmp_path: Path) -> None:
    head = HEAD | {"num_inference_timesteps": 5, "num_train_timesteps": 50}
    module, spec = load(save(tmp_path, CONFIG | {"policy_head_config": head}), sampler="dpmsolver++", steps=3)
    assert (spec.sampler.name, spec.sampler.steps, spec.sampler.timesteps[0]) == ("ddim", 5, 40)
    assert [(each.name, each.steps) for each in spec.loops.values()] == [("dpmsolver++", 3)]
    assert module.t_embedder.waves.shape == (50, 256)


def test_sizes_follow_from_the_name_where_they_are_not_said(tmp_path: Path) -> None:
    head = {name: value for name, value in HEAD.items() if name not in ("n_emb", "num_heads", "depth")}
    path = save(tmp_path, CONFIG | {"policy_head_config": head, "policy_head_size": "ScaleDP_L"})
    assert_not_read(path, r"missing blocks\.2\..*policy_head_config in config\.json")


def test_what_is_no_such_head_is_refused(tmp_path: Path) -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"policy_head_config": None}, r"config\.json: policy_head_config is None; expected the entries of a Sc"),
        ({"policy_head_size": "ScaleDP_H"}, "policy_head_config.depth is 2; expected 32 of policy_head_size ScaleDP_H"),
        ({"policy_head_config": HEAD | {"n_emb": 10**9}}, "n_emb is 1000000000; expected a positive whole"),
        ({"policy_head_config": HEAD | {"num_heads": 5}}, "n_emb is 24; expected a multiple of num_heads, 5"),
        ({"policy_head_config": HEAD | {"is_tinyvla": True}}, "is_tinyvla is True; expected false: .*compile_denoiser"),
        ({"policy_head_config": HEAD | {"depth": 3}}, r"missing blocks\.2\."),
        ({"policy_head_config": HEAD | {"num_train_timesteps": "x"}}, "num_train_timesteps is 'x'; expected"),
    ]
    for change, message in cases:
        path = save(tmp_path, CONFIG | change)
        assert_not_read(path, message, names=path)
    assert_not_read(save(tmp_path, changes={"pos_embed": None}), r"missing pos_embed\. .* than policy_head_config in")
    assert_not_read(
        save(tmp_path, changes={"x_embedder.bias": torch.full((24,), torch.nan)}),
        r"x_embedder.bias holds 24 values that are not finite",
    )


def test_damaged_and_hostile_files_are_refused(tmp_path: Path) -> None:
    save(tmp_path)
    (tmp_path / "model-00002-of-00002.safetensors").write_bytes(b"\x08")
    assert_not_read(tmp_path, r"00002\.safetensors: not a safetensors file, a truncated one.*Copy it")
    (tmp_path / "model-00002-of-00002.safetensors").unlink()
    assert_not_read(tmp_path, r"00002\.safetensors: no such file\. Copy the directory whole")
    for names, message in (
        ({"policy_head.a": "../x.safetensors"}, "expected a file of its own"),
        ([1], "expected files"),
    ):
        (tmp_path / INDEX).write_text(json.dumps({"weight_map": names}))
        assert_not_read(tmp_path, message)
    (tmp_path / INDEX).unlink()
    assert_not_read(tmp_path, r"model\.safetensors: no such file")
    torch.save({"base_model.model.policy_head.x": print}, tmp_path / "non_lora_trainables.bin")
    assert_not_read(tmp_path, r"non_lora_trainables\.bin: refused, .*builtins\.print.*could run code")


def test_weights_in_another_place_or_format_are_named(tmp_path: Path) -> None:
    """As the training leaves them before it ends, and as transformers pickled them."""
    path = save(tmp_path / "run")
    for file in path.glob("model*"):
        file.unlink()
    (path / "pytorch_model-00001-of-00001.bin").touch()
    assert_not_read(path, r"safetensors: no such file\. It has pytorch_model-00001-of-00001\.bin; safetensors are exp")
    (path / "checkpoint-20000").mkdir()
    assert_not_read(path, r"no such file\. Give a folder in it that the training saved: checkpoint-20000\.$")
    (save(path) / "model-00002-of-00002.safetensors").unlink()
    assert_not_read(path, r"00002\.safetensors: no such file\. Copy the directory whole\.$")


def test_a_machine_without_the_memory_is_told_before_anything_is_read(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("ttscompile.frontends.saved_weights.memory_bytes", lambda: 2**12)
    path, numbers = save(tmp_path), sum(value.numel() for value in head_weights().values())
    assert 16 * numbers > 2**18
    assert_not_read(path, rf"{path}: .*million weights.*this machine has 0\.0 GiB")
