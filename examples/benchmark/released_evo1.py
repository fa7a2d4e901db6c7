"""The weights of ``large.py --evo1`` under the names of its authors, which vla.cpp's converter reads.

    python examples/benchmark/released_evo1.py DIR
    python convert_evo1_to_gguf.py --ckpt DIR/Evo-1 --out evo1.gguf
    gguf-set-metadata --force evo1.gguf evo1.max_text_length 564

``DIR`` is what ``large.py`` leaves. vla.cpp pads the prompt to a length that it has of the model's file, and its head
looks at the padding, too, which lerobot's does not. The last command (of the package ``gguf``) sets the length to that
of the prompt, so that both compute the same, and vla.cpp less.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click
import torch
from large_evo1 import PADDED, STEPS
from large_smolvla import ACTION, STATE, write_json
from safetensors.torch import load_file

from ttscompile.frontends.saved_weights import renamed

BASE, _TIMES = "Evo-1", "action_head.time_pos_enc.pe"
_NAMES = (
    (r"^model\.", ""),
    (r"^embedder\.", "embedder.model."),
    (r"\.language_model\.", ".language_model.model."),
    (r"\.vision_tower\.", ".vision_model."),
    (r"\.cls_token$", ".class_embedding"),
    (r"\.position_embeddings$", ".position_embedding"),
    (r"\.projection\.", ".patch_embedding."),
    (r"\.lambda_(\d)$", r".ls\1"),
    (r"\.layer_norm(\d)\.", r".norm\1."),
    (r"(\.vision_model\..*)\.self_attn\.out_proj\.", r"\1.attn.proj."),
    (r"(\.vision_model\..*)\.self_attn\.q_proj\.", r"\1.attn.qkv."),
    (r"\.multi_modal_projector\.layer_norm\.", ".mlp1.0."),
    (r"\.multi_modal_projector\.linear_1\.", ".mlp1.1."),
    (r"\.multi_modal_projector\.linear_2\.", ".mlp1.3."),
    (r"\.action_encoder\.first\.", ".action_encoder.W1.linear."),
    (r"\.action_encoder\.second\.", ".action_encoder.W2.linear."),
    (r"\.action_encoder\.third\.", ".action_encoder.W3.linear."),
    (r"\.(mlp_head|state_encoder)\.fc(\d)\.", r".\1.fc\2.linear."),
    (r"\.places$", ".pos_encoding.pe"),
    (r"\.times$", ".time_pos_enc.pe"),
)
_ROWS, _OUR_ROWS = 1000, 999
"""Of the timestep's embedding: what a time in 0..1 is multiplied by for its row."""


def released(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The weights under the names of the release; the embedding of each step's time is in the row that vla.cpp reads.

    The image encoder's queries, keys and values have one matrix.
    """
    found, times = dict[str, torch.Tensor](), torch.arange(STEPS) / STEPS
    for name, value in weights.items():
        own = next((each for each in "qkv" if ".vision_tower." in name and f".{each}_proj." in name), None)
        if own == "q":
            value = torch.cat([weights[name.replace(".q_proj.", f".{each}_proj.")] for each in "qkv"])
        if own in (None, "q"):
            found[renamed(name, _NAMES)] = value
    rows = found[_TIMES]
    found[_TIMES] = rows.index_copy(1, (times * _ROWS).long(), rows[:, (times * _OUR_ROWS).long()])
    return found


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(folder: Path) -> None:
    """Write the weights of FOLDER/evo1 into a folder beside it, with what the converter reads, too."""
    made, weights = folder / BASE, released(load_file(folder / "evo1" / "model.safetensors"))
    made.mkdir(exist_ok=True)
    torch.save({"module": weights}, made / "mp_rank_00_model_states.pt")
    numbers, width = len(weights["action_head.mlp_head.fc2.linear.bias"]), PADDED
    entries = {"action_head": "flowmatching", "horizon": numbers // width, "num_inference_timesteps": STEPS}
    write_json(made / "config.json", {**entries, "action_dim": numbers, "per_action_dim": width, "state_dim": width})
    bounds = {key: {"min": [-1.0] * 6, "max": [1.0] * 6} for key in (STATE, ACTION)}
    write_json(made / "norm_stats.json", {"robot": bounds})


if __name__ == "__main__":
    main()
