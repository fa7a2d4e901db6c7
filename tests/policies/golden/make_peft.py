"""What PEFT itself saves of adapters and merges into their base, for small LeRobot policies.

    python -m tests.policies.golden.make_peft

Runs where PEFT 0.21.2 is installed beside this project, from the root of the repository; writes ``peft.npz`` beside
this file, or what ``-o`` names. The base's modules have the names and the weights of a policy that ``lerobot_tiny`` or
``lerobot_unets`` saves: PEFT looks at nothing else. Keys of an array: the case, then ``base``, ``saved`` or ``merged``,
then the weight's name as it is saved. ``base`` and ``merged`` hold the weights that merging changes.
"""

from __future__ import annotations

import argparse
import importlib
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from torch import nn

from tests.policies import lerobot_unets
from tests.policies.lerobot_tiny import save_policy

LINEAR = {"target_modules": ["qkv_proj", "mlp.0"]}
CASES: dict[str, dict[str, Any]] = {
    "plain": LINEAR,
    "scaled": LINEAR
    | {
        "use_rslora": True,
        "rank_pattern": {"qkv_proj": 2},
        "alpha_pattern": {r"transformer_blocks\.0\.mlp\.0": 32, "mlp.0": 5},
    },
    "lengths": LINEAR | {"use_dora": True, "bias": "lora_only", "modules_to_save": ["output_proj"]},
    "biases": LINEAR | {"bias": "all", "modules_to_save": ["output_proj", "input_proj"]},
    "convolutions": {"target_modules": r".*down_modules\.0\.\d\.conv1\.block\.0"},
}


def tree(weights: Mapping[str, torch.Tensor]) -> nn.Module:
    """Modules with these names and weights: linear layers, convolutions of one axis, and others."""
    made = nn.Module()
    for name, value in weights.items():
        *path, last = name.split(".")
        within = made
        for i, part in enumerate(path):
            if part not in within._modules:
                within.add_module(part, leaf(weights, ".".join(path[: i + 1])))
            within = within.get_submodule(part)
        within.register_parameter(last, nn.Parameter(value.clone(), requires_grad=False))
    return made


def leaf(weights: Mapping[str, torch.Tensor], name: str) -> nn.Module:
    """A layer of the kind that a weight of this name has, whose parameters are set later."""
    weight, bias = weights.get(f"{name}.weight"), f"{name}.bias" in weights
    if weight is None or weight.dim() not in (2, 3) or not weight.is_floating_point():
        return nn.Module()
    out, within, *kernel = weight.shape
    return nn.Conv1d(within, out, kernel[0], bias=bias) if kernel else nn.Linear(within, out, bias)


def adapted(case: str, folder: Path) -> dict[str, np.ndarray]:
    """One case: what is saved, and what is merged."""
    peft: Any = importlib.import_module("peft")
    base = lerobot_unets.save("states", folder / "policy") if case == "convolutions" else save_policy(folder)
    weights = {
        name: value for name, value in load_file(base / "model.safetensors").items() if value.is_floating_point()
    }
    settings = peft.LoraConfig(r=4, lora_alpha=6, init_lora_weights=False, **CASES[case])
    model, generator = peft.get_peft_model(tree(weights), settings), torch.Generator().manual_seed(8)
    with torch.no_grad():
        for value in model.parameters():
            if value.requires_grad:
                value.add_(torch.rand(value.shape, generator=generator) * 0.1)
    model.save_pretrained(folder / "saved")
    # What is saved is read again, as a user does: PEFT sorts the patterns as it saves them, and the first counts.
    model = peft.PeftModel.from_pretrained(tree(weights), folder / "saved")
    merged = model.merge_and_unload().state_dict()
    changed = [name for name in weights if not torch.equal(weights[name], merged[name])]
    saved = load_file(folder / "saved" / "adapter_model.safetensors")
    config = (folder / "saved" / "adapter_config.json").read_text(encoding="utf-8")
    return {
        f"{case}/config": np.array(config),
        **{f"{case}/base/{name}": weights[name].numpy() for name in changed},
        **{f"{case}/saved/{name}": value.numpy() for name, value in saved.items()},
        **{f"{case}/merged/{name}": merged[name].numpy() for name in changed},
    }


def main() -> None:
    """Write ``peft.npz``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).with_name("peft.npz"))
    output, arrays = parser.parse_args().output, dict[str, Any]()
    for case in CASES:
        torch.manual_seed(9)
        with tempfile.TemporaryDirectory() as folder:
            arrays |= adapted(case, Path(folder))
    np.savez_compressed(output, **arrays)


if __name__ == "__main__":
    main()
