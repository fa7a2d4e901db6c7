"""Policies of ``large.py``: what is written of one is what its frontend reads; at small sizes here."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import large
import large_dita
import large_eo1
import large_octo
import large_pi0
import large_qwen3_vl
import large_smolvla
import large_wall_x
import pytest
import torch
from safetensors.torch import load_file

from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.families import LoadOptions
from ttscompile.policies.networks.t5 import Words


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Towers and language models of two layers."""
    text = {"hidden_size": 24, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
    text |= {"num_key_value_heads": 1, "head_dim": 12, "vocab_size": 151936}
    turns = {"mrope_section": [2, 2, 2], "rope_type": "default", "mrope_interleaved": True}
    vision = {"depth": 2, "hidden_size": 16, "intermediate_size": 24, "num_heads": 2, "out_hidden_size": 24}
    model: dict[str, Any] = large_qwen3_vl.MODEL
    monkeypatch.setitem(model, "text_config", {**model["text_config"], **text, "rope_scaling": turns})
    stacked = {"deepstack_visual_indexes": [0, 1], "num_position_embeddings": 64}
    monkeypatch.setitem(model, "vision_config", {**model["vision_config"], **vision, **stacked})
    sizes = {"WORDS": 24, "_SEEN": 2, "_IMAGES": 16, "_MERGED": 64}
    for name, size in sizes.items():
        monkeypatch.setattr(large_qwen3_vl, name, size)
    inside: dict[str, Any] = large_eo1.MODEL
    rope = {"rope_type": "default", "mrope_section": [2, 2, 2]}
    monkeypatch.setitem(inside, "text_config", {**inside["text_config"], **text, "rope_parameters": rope})
    monkeypatch.setitem(inside, "vision_config", vision)
    monkeypatch.setattr(large_wall_x, "EXPERT", 16)
    both: dict[str, Any] = {"layers": 2, "heads": 2, "channels": 8, "hidden": 24}
    monkeypatch.setattr(large_pi0, "GEMMA", replace(large_pi0.GEMMA, width=24, **both))
    monkeypatch.setattr(large_pi0, "EXPERT", replace(large_pi0.EXPERT, width=16, **both))
    seen: dict[str, Any] = {
        "hidden_size": 32,
        "intermediate_size": 24,
        "num_hidden_layers": 2,
        "num_attention_heads": 16,
    }
    monkeypatch.setattr(large_pi0, "VISION", replace(large_pi0.VISION, **seen, image_size=224, patch_size=56))
    octo = large_octo.config()
    stems = {name: replace(stem, features=(32,) * 4, out=24) for name, stem in octo.stems.items()}
    words, head = Words("language", 16, 24, 16, 24, 2, 2, 16, 32), replace(octo.head, width=16)
    octo = replace(octo, width=32, hidden=48, layers=2, heads=4, words=words, head=head, stems=stems)
    monkeypatch.setattr(large_octo, "config", lambda: octo)
    monkeypatch.setattr(large_dita, "SIZES", {**large_dita.SIZES, "width": 64, "heads": 1, "hidden": 48, "layers": 2})
    monkeypatch.setattr(large_dita, "LAYERS", 2)
    for name, size in {"hidden_size": 64, "num_attention_heads": 1, "num_hidden_layers": 2, "vocab_size": 99}.items():
        monkeypatch.setitem(large_dita.TEXT, name, size)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("vla_jepa", (1, 7, 6)),
        ("eo1", (1, 8, 32)),
        ("wall_x", (1, 32, 20)),
        ("pi0", (1, 50, 32)),
        ("pi05", (1, 50, 32)),
        ("octo", (1, 4, 7)),
        ("dita", (1, 11, 7)),
    ],
)
def test_what_is_written_is_read(tmp_path: Path, name: str, shape: tuple[int, ...]) -> None:
    directory, task = large.saved(tmp_path, name)
    module, spec = load_checkpoint_policy(directory, options=LoadOptions(task=task))
    obs, noise = large_smolvla.call(spec)
    made = eager_policy(module, spec)({key: torch.from_numpy(value) for key, value in obs.items()}, noise)
    assert made.shape == shape and made.isfinite().all() and made.std() > 0.1
    assert large.saved(tmp_path, name) == (directory, task)


@pytest.mark.slow
def test_of_vla_jepa_the_language_model_alone_is_in_bf16(tmp_path: Path) -> None:
    directory, _ = large.saved(tmp_path, "vla_jepa")
    halved = {name: value.dtype == torch.bfloat16 for name, value in load_file(directory / "model.safetensors").items()}
    assert halved == {name: name.startswith("model.qwen.") for name in halved}
