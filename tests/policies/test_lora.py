"""Adapters that LeRobot trains with PEFT: the weights of the base with the change that a few lines here compute."""

import json
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.hub import fetch_checkpoint

from ..hub.conftest import hub as hub
from ..hub.served import Hub
from ..rounding import bound
from . import lerobot_unets, vla_jepas
from .lerobot_tiny import change_json, save_policy, write_json
from .refused import assert_not_read

Tensors = dict[str, torch.Tensor]
START, BLOCK = "base_model.model.", "noise_predictor.transformer_blocks"
QKV, MLP = f"{BLOCK}.0.attn.qkv_proj", f"{BLOCK}.1.mlp.0"
SAVED: dict[str, Any] = {  # as PEFT 0.21 saves it
    "peft_type": "LORA",
    "peft_version": "0.21.2",
    "auto_mapping": {"base_model_class": "MultiTaskDiTPolicy", "parent_library": "lerobot"},
    "inference_mode": True,
    "target_modules": ["qkv_proj", "mlp.0"],
    "r": 4,
    "lora_alpha": 6,
    "lora_dropout": 0.1,
    "fan_in_fan_out": False,
    "bias": "none",
    "use_rslora": False,
    "use_dora": False,
    "modules_to_save": None,
    "init_lora_weights": True,
    "rank_pattern": {},
    "alpha_pattern": {},
    "revision": None,
    "megatron_core": "megatron.core",
    "qalora_group_size": 16,
    "loftq_config": {},
    "layer_replication": None,
    "lora_bias": False,
}


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    """Random numbers."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)) * 0.3


def pair(module: str, out: int, within: int, rank: int = 4, seed: int = 1) -> Tensors:
    """A and B of a linear layer."""
    names = f"{START}{module}.lora_A.weight", f"{START}{module}.lora_B.weight"
    return {names[0]: drawn(rank, within, seed=seed), names[1]: drawn(out, rank, seed=seed + 1)}


def save_adapter(base: Path, tensors: Tensors, **changes: Any) -> Path:
    """A directory as lerobot's training saves it, beside that of the base."""
    directory = base.parent / "adapter"
    shutil.copytree(base, directory)
    (directory / "model.safetensors").unlink()
    change_json(directory / "config.json", use_peft=True)
    write_json(directory / "adapter_config.json", SAVED | {"base_model_name_or_path": str(base)} | changes)
    save_file(tensors, directory / "adapter_model.safetensors")
    return directory


def network(directory: Path, **options: Any) -> Tensors:
    """All weights of the module that a directory is read as."""
    return load_checkpoint_policy(directory, options=LoadOptions(**options))[0].state_dict()


def by_hand(base: Path, change: Callable[[Tensors], None]) -> Path:
    """The base with weights that a test computes."""
    directory = base.parent / "by_hand"
    shutil.copytree(base, directory)
    weights = load_file(directory / "model.safetensors")
    change(weights)
    save_file(weights, directory / "model.safetensors")
    return directory


def assert_same(found: Tensors, expected: Tensors, base: Tensors, changed: int) -> None:
    """The same bits under the same names, and so many of them others than the base's."""
    assert found.keys() == expected.keys() == base.keys()
    assert [name for name in found if not torch.equal(found[name], expected[name])] == []
    assert sum(not torch.equal(found[name], base[name]) for name in found) == changed


def added(weights: Tensors, module: str, tensors: Tensors, scaling: float) -> None:
    """W + scaling B A."""
    low, high = (tensors[f"{START}{module}.lora_{part}.weight"].double() for part in "AB")
    name = f"{module}.weight"
    weights[name] = (weights[name].double() + scaling * (high @ low)).float()


@pytest.fixture
def base(tmp_path: Path) -> Path:
    """A tiny multi_task_dit."""
    return save_policy(tmp_path)


BOTH = {**pair(QKV, 48, 16), **pair(MLP, 64, 16, seed=5)}
UNLIKE = {**pair(QKV, 48, 16, rank=2), **pair(MLP, 64, 16, rank=8, seed=5)}


@pytest.mark.parametrize(
    ("tensors", "changes", "scalings"),
    [
        (BOTH, {}, (1.5, 1.5)),
        (BOTH, {"use_rslora": True}, (3.0, 3.0)),
        (BOTH, {"lora_alpha": 0.5}, (0.125, 0.125)),
        (BOTH, {"alpha_pattern": {"mlp.0": 16}}, (1.5, 4.0)),
        (BOTH, {"alpha_pattern": {r".*blocks\.\d\.attn.*": 2, "qkv_proj": 16}}, (0.5, 1.5)),  # the first one counts
        (BOTH, {"alpha_pattern": {"lp.0": 16, "attn": 16, "^mlp.0": 16, "mlp": 16}}, (1.5, 1.5)),  # near misses
        (UNLIKE, {"rank_pattern": {"qkv_proj": 2, r"1\.mlp\.0": 8}}, (3.0, 0.75)),
        (
            UNLIKE,
            {"rank_pattern": {"attn.qkv_proj": 2, "mlp.0|mlp.2": 8}, "use_rslora": True},
            (6 / 2**0.5, 6 / 8**0.5),
        ),
    ],
)
def test_the_change_is_added_as_peft_scales_it(
    base: Path, tensors: Tensors, changes: dict[str, Any], scalings: tuple[float, float]
) -> None:
    def change(weights: Tensors) -> None:
        for module, scaling in zip((QKV, MLP), scalings, strict=True):
            added(weights, module, tensors, scaling)

    found = network(save_adapter(base, tensors, **changes))
    assert_same(found, network(by_hand(base, change)), network(base), 2)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:normaliser of observation.state")
def test_the_artifact_is_that_of_the_merged_policy(base: Path, tmp_path: Path) -> None:
    """Its identity is; and of the base another."""
    directory = by_hand(base, lambda weights: added(weights, QKV, BOTH, 1.5))
    adapter = save_adapter(base, pair(QKV, 48, 16), base_model_name_or_path="gone/away")
    identities = []
    for checkpoint, given in ((adapter, base), (directory, None), (base, None)):
        ttscompile.convert(checkpoint, tmp_path / "made", base=given)
        identities.append(load_artifact(tmp_path / "made").manifest.identity)
    assert identities[0] == identities[1] != identities[2]
    assert json.loads((tmp_path / "made" / "config.json").read_text())["type"] == "ttscompile"


def test_whole_modules_biases_and_the_length_of_rows(base: Path) -> None:
    """``modules_to_save``, ``bias`` (of a changed layer and of another), and DoRA, whose rows have a length each."""
    output, mlp, lengths = drawn(3, 16), drawn(64, seed=3), drawn(48, seed=4).abs() + 0.5
    own = {f"{START}noise_predictor.output_proj.weight": output, f"{START}noise_predictor.output_proj.bias": drawn(3)}
    own |= {f"{START}{MLP}.bias": mlp, f"{START}{QKV}.base_layer.bias": lengths.clone()}
    own |= {f"{START}{QKV}.lora_magnitude_vector": lengths}
    settings = {"modules_to_save": ["output_proj"], "bias": "all", "use_dora": True}
    adapter = save_adapter(base, own | pair(QKV, 48, 16), **settings)

    def change(weights: Tensors) -> None:
        low, high = (BOTH[f"{START}{QKV}.lora_{part}.weight"].double() for part in "AB")
        rows, own_lengths = weights[f"{QKV}.weight"].double() + 1.5 * high @ low, lengths.double()
        rows = torch.stack(
            [row * length / row.square().sum().sqrt() for row, length in zip(rows, own_lengths, strict=True)]
        )
        weights[f"{QKV}.weight"] = rows.float()
        weights |= {"noise_predictor.output_proj.weight": output, "noise_predictor.output_proj.bias": drawn(3)}
        weights |= {f"{MLP}.bias": mlp, f"{QKV}.bias": lengths.clone()}

    found, expected = network(adapter), network(by_hand(base, change))
    name = next(each for each in found if each.endswith("blocks.0.attn.qkv_proj.weight"))
    torch.testing.assert_close(found.pop(name), expected.pop(name), rtol=0, atol=1e-6)  # sums in another order
    before = network(base)
    before.pop(name)
    assert_same(found, expected, before, 4)


def test_all_biases_of_a_module_that_is_saved_whole(base: Path) -> None:
    """PEFT 0.21 saves them three times with ``bias="all"``: as the module's, and with a level of its own between."""
    output = f"{START}noise_predictor.output_proj"
    own = {f"{output}.weight": drawn(3, 16), f"{output}.bias": drawn(3), **pair(QKV, 48, 16)}
    copies = {f"{output}.modules_to_save.bias": drawn(3), f"{output}.original_module.bias": drawn(3, seed=9)}
    settings: dict[str, Any] = {"modules_to_save": ["output_proj"], "bias": "all"}
    expected = network(save_adapter(base, own, **settings))
    shutil.rmtree(base.parent / "adapter")
    assert_same(network(save_adapter(base, own | copies, **settings)), expected, network(base), 3)


def test_a_whole_module_that_the_policy_does_not_compute(tmp_path: Path) -> None:
    """A predictor of videos is for training alone: its weights are there, and are not read."""
    base = vla_jepas.save(vla_jepas.KINDS[0], tmp_path)
    weights = load_file(base / "model.safetensors")
    predictor = [name for name in weights if ".video_predictor." in name]
    changed = next(name for name in weights if name.endswith("language_model.layers.0.mlp.up_proj.weight"))
    tensors = {f"{START}{name}": weights[name] for name in predictor}
    tensors |= pair(changed.removesuffix(".weight"), *weights[changed].shape)
    adapter = save_adapter(base, tensors, modules_to_save=["video_predictor"])
    before, found = network(base), network(adapter)
    assert predictor and found.keys() == before.keys()
    assert sum(not torch.equal(value, before[name]) for name, value in found.items()) == 1


def test_convolutions(tmp_path: Path) -> None:
    """B of a convolution sees one place: the change of ``W[o, i, k]`` is the sum over r of ``B[o, r] A[r, i, k]``."""
    base = lerobot_unets.save("states", tmp_path / "policy")
    module = "diffusion.unet.down_modules.0.1.conv1.block.0"
    low, high = drawn(4, 16, 5), drawn(16, 4, 1, seed=1)
    adapter = save_adapter(
        base, {f"{START}{module}.lora_A.weight": low, f"{START}{module}.lora_B.weight": high}, target_modules="conv1"
    )

    def change(weights: Tensors) -> None:
        both = torch.einsum("or,rik->oik", high[:, :, 0].double(), low.double())
        weights[f"{module}.weight"] = (weights[f"{module}.weight"].double() + 1.5 * both).float()

    found, expected, before = network(adapter), network(by_hand(base, change)), network(base)
    different = [name for name in found if not torch.equal(found[name], before[name])]
    assert len(different) == 1
    for name in found:
        torch.testing.assert_close(found[name], expected[name], rtol=0, atol=1e-6 if name in different else 0)


def test_a_base_of_another_version_of_transformers(base: Path) -> None:
    """The base's text encoder has a level that the adapter's, which transformers 5 named, has not."""
    new = "observation_encoder.text_encoder.text_encoder.encoder.layers.0.mlp.fc1"
    old = new.replace(".encoder.layers", ".text_model.encoder.layers")
    tensors = pair(new, 12, 8)
    renamed = {name.replace(new, old): value for name, value in tensors.items()}
    expected = network(by_hand(base, lambda weights: added(weights, old, renamed, 1.5)))
    assert_same(network(save_adapter(base, tensors)), expected, network(base), 1)


def test_the_base_is_what_is_given_before_what_is_named(base: Path, tmp_path: Path) -> None:
    """Also where the one that is named is there; and ``base`` is nothing for a whole policy."""
    other = by_hand(base, lambda weights: weights.update({f"{MLP}.bias": drawn(64)}))
    adapter = save_adapter(base, pair(QKV, 48, 16))
    expected, found = network(adapter), network(adapter, base=other)
    assert [name for name in found if not torch.equal(found[name], expected[name])] == [
        next(name for name in found if name.endswith("blocks.1.mlp.0.bias"))
    ]
    message = "the option base is for an adapter; found a whole policy. Leave it out"
    assert_not_read(base, message, options=LoadOptions(base=other))
    # lerobot's rule for a directory with both: its use_peft says which.
    shutil.copy(other / "model.safetensors", adapter)
    assert_same(network(adapter), expected, expected, 0)
    change_json(adapter / "config.json", use_peft=False)
    assert_same(network(adapter), network(other), expected, 2)


def test_a_base_on_the_hub(base: Path, hub: Hub, tmp_path: Path) -> None:
    """Named as lerobot names it, at the revision that is said; and the adapter may be there as well."""
    commit = hub.commit("org/base", {each.name: each.read_bytes() for each in base.iterdir()})
    hub.commit("org/base", {"config.json": b"{}", "model.safetensors": b"another"})
    adapter = save_adapter(base, BOTH, base_model_name_or_path="org/base", revision=commit)
    expected = network(adapter, base=base)
    assert_same(network(adapter), expected, expected, 0)
    files = {each.name: each.read_bytes() for each in adapter.iterdir()}
    hub.commit("org/adapter", {**files, "training_state/rng_state.safetensors": b"", "adapter_model.bin": b"pickle"})
    fetched = fetch_checkpoint("hf://org/adapter")
    assert {each.name for each in fetched.path.iterdir()} == set(files)
    encoders = base.parent / "clip-small"
    assert_same(network(fetched.path, encoders=encoders), expected, expected, 0)
    assert_same(network(fetched.path, base=f"hf://org/base@{commit}", encoders=encoders), expected, expected, 0)
    change_json(adapter / "adapter_config.json", base_model_name_or_path="org/nothing", revision=None)
    assert_not_read(adapter, r"the base is 'org/nothing': hf://org/nothing: .*with --base \(base=")


@pytest.mark.parametrize("named", ["/gone/away/policy", "outputs/train/policy", "x" * 300, "", None, "a\0b", "."])
def test_a_base_that_is_not_there(base: Path, named: str | None) -> None:
    adapter = save_adapter(base, BOTH, base_model_name_or_path=named)
    what = re.escape(f"{adapter / 'adapter_config.json'}: the base is ")
    assert_not_read(adapter, rf"^{what}.*Give the base policy, .* with --base \(base= in Python\)\.$")


A, B = (f"{START}{QKV}.lora_{part}.weight" for part in "AB")


@pytest.mark.parametrize(
    ("tensors", "changes", "told"),
    [
        (BOTH, {"peft_type": "LOHA"}, "peft_type is 'LOHA'; expected LORA"),
        (BOTH, {"init_lora_weights": "pissa"}, "init_lora_weights is 'pissa'; expected true, gaussian"),
        (BOTH, {"fan_in_fan_out": True}, "fan_in_fan_out is True; expected none"),
        (BOTH, {"layer_replication": [[0, 2]]}, r"layer_replication is \[\[0, 2\]\]; expected none"),
        (BOTH, {"next_years_option": "on"}, "next_years_option is 'on'; expected none"),
        (BOTH, {"modules_to_save": "output_proj"}, "modules_to_save is 'output_proj'; expected a list of names"),
        (BOTH, {"modules_to_save": ["output_proj"]}, "found 2 changes and of modules_to_save {'output_proj': False}"),
        (BOTH, {"bias": "some"}, "bias is 'some'; expected none or all or lora_only"),
        (BOTH, {"rank_pattern": [2]}, r"rank_pattern is \[2\]; expected a dict of names"),
        (BOTH, {"alpha_pattern": {"(a+)+b": 2}}, "alpha_pattern is .*expected a dict of names"),
        (BOTH, {"alpha_pattern": {".*a.*b.*": 2}}, "in which .* may stand twice"),
        (BOTH, {"alpha_pattern": {"qkv_proj": "2"}}, "lora_alpha of .*qkv_proj is '2'; expected a positive number"),
        (BOTH, {"r": 0}, "r of .*qkv_proj is 0; expected a positive number"),
        (BOTH, {"r": 4.0}, r"r of .*qkv_proj is 4\.0; expected"),
        (BOTH, {"r": 8}, r"qkv_proj of adapter_model.safetensors has .*\[4, 16\].*; expected .*\[8, 16\]"),
        (BOTH, {"use_dora": True}, r"has {.*}; expected {.*'lora_magnitude_vector': \[48\]}"),
        (BOTH | {f"{START}{QKV}.lora_magnitude_vector": drawn(48)}, {}, r"has .*lora_magnitude_vector.*; expected {"),
        ({A: BOTH[A]}, {}, r"has {'lora_A.weight': \[4, 16\]}; expected .*'lora_B.weight'"),
        ({A: BOTH[A], B: drawn(47, 4)}, {}, r"\[47, 4\]}; expected .*\[48, 4\]"),
        ({A: BOTH[A], B: drawn(48, 4, 1)}, {}, r"\[48, 4, 1\]}; expected .*\[48, 4\]"),
        (pair(f"{BLOCK}.2.mlp.0", 64, 16), {}, r"transformer_blocks\.2\.mlp\.0\.weight is no weight of the base"),
        ({A: BOTH[A], B: BOTH[B] * math.nan}, {}, "holds 768 values that are not finite"),
        ({A: BOTH[A].int(), B: BOTH[B]}, {}, r"adapter_model\.safetensors: weight .* is a torch.int32 tensor"),
        (
            {f"{START}{QKV}.lora_A.other.weight": drawn(4, 16), **BOTH},
            {},
            r"found .*lora_A\.other\.weight; expected lora_A",
        ),
        (
            {f"{START}{QKV}.lora_embedding_A": drawn(4, 16), **BOTH},
            {},
            r"found .*lora_embedding_A; expected lora_A and",
        ),
        ({f"{START}{QKV}.bias": drawn(48), **BOTH}, {}, r"found .*qkv_proj\.bias; expected"),
        ({f"{START}{QKV}.weight": drawn(48, 16), **BOTH}, {"modules_to_save": ["qkv_proj"]}, "has {'': .*; expected"),
        ({f"{START}{MLP}.bias": drawn(63)}, {"bias": "all"}, r"has shape \(63,\); expected \(64,\)"),
        ({A.removeprefix(START): BOTH[A]}, {}, r"found noise.*lora_A\.weight; expected lora_A"),
        ({}, {}, "found 0 changes"),
    ],
)
def test_whatever_is_not_merged_is_refused(base: Path, tensors: Tensors, changes: dict[str, Any], told: str) -> None:
    adapter = save_adapter(base, tensors, **changes)
    assert_not_read(adapter, told, names=adapter)


def test_nothing_but_safetensors_is_read(base: Path) -> None:
    adapter = save_adapter(base, BOTH)
    (adapter / "adapter_model.safetensors").rename(adapter / "adapter_model.bin")
    assert_not_read(adapter, r"adapter_model\.safetensors: no such file")


@pytest.mark.parametrize("case", ["plain", "scaled", "lengths", "biases", "convolutions"])
def test_peft_merges_the_same(tmp_path: Path, case: str) -> None:
    """Adapters that PEFT saved, against what its ``merge_and_unload`` made of them (``golden/make_peft.py``)."""
    with np.load(Path(__file__).with_name("golden") / "peft.npz") as arrays:
        held = {name.removeprefix(f"{case}/"): arrays[name] for name in arrays if name.startswith(f"{case}/")}

    def part(name: str) -> Tensors:
        start = f"{name}/"
        return {key.removeprefix(start): torch.from_numpy(held[key]) for key in held if key.startswith(start)}

    base = lerobot_unets.save("states", tmp_path / "policy") if case == "convolutions" else save_policy(tmp_path)
    weights = load_file(base / "model.safetensors")
    save_file(weights | part("base"), base / "model.safetensors")
    adapter = save_adapter(base, part("saved"))
    (adapter / "adapter_config.json").write_text(str(held["config"]), encoding="utf-8")
    merged = part("merged")
    expected = network(by_hand(base, lambda own: own.update(merged)))
    found, before = network(adapter, base=base), network(base)
    assert len(merged) == {"lengths": 10, "biases": 30, "convolutions": 2}.get(case, 4)
    assert found.keys() == expected.keys()
    for name, value in found.items():
        torch.testing.assert_close(value, expected[name], rtol=0, atol=bound(32) * float(value.abs().max()))
    assert sum(not torch.equal(expected[name], before[name]) for name in found) == len(merged)
