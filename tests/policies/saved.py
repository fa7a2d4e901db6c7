"""Checkpoints of action heads as their authors' code writes them, with the weights of the golden files."""

import json
from pathlib import Path
from typing import Any

import torch

from tests.families.checks import Arrays, golden
from tests.families.heads import FAMILIES
from tests.families.weights import draw_weights
from ttscompile.policies.rdt import RDTConfig, RDTHead

RDT: dict[str, Any] = {
    "action_dim": 5,
    "ema": {"power": 0.75},
    "img_adaptor": "mlp2x_gelu",
    "img_cond_len": 8,
    "img_pos_embed_config": [["image", [2, 2, -2]]],
    "img_token_dim": 10,
    "lang_adaptor": "mlp2x_gelu",
    "lang_pos_embed_config": [["lang", -9]],
    "lang_token_dim": 12,
    "max_lang_cond_len": 9,
    "noise_scheduler": {
        "beta_schedule": "squaredcos_cap_v2",
        "clip_sample": False,
        "num_inference_timesteps": 5,
        "num_train_timesteps": 1000,
        "prediction_type": "sample",
        "type": "ddpm",
    },
    "pred_horizon": 6,
    "rdt": {"cond_pos_embed_type": "multimodal", "depth": 4, "hidden_size": 32, "num_heads": 4},
    "state_adaptor": "mlp3x_gelu",
    "state_token_dim": 5,
}
"""As PyTorchModelHubMixin writes the arguments of RDTRunner, its ``config`` among them."""


def weights_of(name: str) -> dict[str, torch.Tensor]:
    """All parameters of the original, those too that are not read."""
    family = FAMILIES[name]()
    own = {key: tuple(value.shape) for key, value in family.module.state_dict().items()}
    return draw_weights(own | family.others, int(golden(name)["seed"]))


def save_rdt(folder: Path, weights: dict[str, torch.Tensor] | None = None, **changes: Any) -> Path:
    """A directory as RDT's ``save_pretrained`` writes it."""
    folder.mkdir(exist_ok=True)
    (folder / "config.json").write_text(json.dumps(RDT | changes))
    torch.save(weights_of("rdt") if weights is None else weights, folder / "pytorch_model.bin")
    return folder


def rdt_with(depths: tuple[int, int, int]) -> RDTHead:
    """The same of other adaptors."""
    torch.manual_seed(0)
    return RDTHead(RDTConfig(32, 4, 4, 6, 5, (9, 8), (12, 10), depths)).eval()


def rdt_observation() -> Arrays:
    """What the golden file observes; language is padded to its longest, as a compiled policy takes it."""
    arrays = {key: golden("rdt")[key] for key in FAMILIES["rdt"]().conditions}
    for key in ("lang_tokens", "lang_attn_mask"):
        padded = torch.from_numpy(arrays[key])
        more = torch.full((len(padded), 2, *padded.shape[2:]), 3).to(padded.dtype) * (key == "lang_tokens")
        arrays[key] = torch.cat([padded, more.to(padded.dtype)], 1).numpy()
    return arrays


def save_cogact(folder: Path, weights: dict[str, torch.Tensor], statistics: Any = None) -> Path:
    """A file as CogACT's training saves it, and beside its folder the statistics of its data sets."""
    (folder / "checkpoints").mkdir(parents=True, exist_ok=True)
    if statistics is not None:
        (folder / "dataset_statistics.json").write_text(json.dumps(statistics))
    path = folder / "checkpoints" / "step-020792-epoch-01-loss=0.0123.pt"
    named = {f"net.{key}": value for key, value in weights.items()}
    other = {"projector.0.weight": torch.zeros(3, 3)}
    torch.save({"model": {"action_model": named, "projector": other, "llm_backbone": other}}, path)
    return path
