"""The weights of openpi's JAX checkpoints, ``params``, under the names of its PyTorch.

Layers are stacked there, kernels have their inputs first, and heads axes of their own. Source: ``models/gemma.py``,
``siglip.py`` and ``lora.py`` of Physical-Intelligence/openpi at 15a9616.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from ttscompile.errors import CheckpointError
from ttscompile.frontends.saved_weights import disk_room, names_of, require_memory_for

from .orbax_files import read_arrays

Part = tuple[str, Callable[[Tensor], Tensor]]

_BOTH = "paligemma_with_expert."
_VISION = f"{_BOTH}paligemma.model.vision_tower."
_MODELS = {"": f"{_BOTH}paligemma.model.language_model.", "_1": f"{_BOTH}gemma_expert.model."}
"""The two stacks of language layers, by what the names of their arrays end with."""


def _same(x: Tensor) -> Tensor:
    return x


def _turned(x: Tensor) -> Tensor:
    """Of a linear layer."""
    return x.mT


def _inward(x: Tensor) -> Tensor:
    """Of attention: ``[in, heads, channels]`` as the weight of a linear layer."""
    return x.flatten(1).T


def _outward(x: Tensor) -> Tensor:
    """``[heads, channels, out]`` likewise."""
    return x.flatten(0, 1).T


def _norm(name: str, own: str) -> dict[str, tuple[Part, ...]]:
    """A norm with a scale, or one that the timestep modulates."""
    return {
        f"{name}.scale": ((f"{own}.weight", _same),),
        f"{name}.Dense_0.kernel": ((f"{own}.dense.weight", _turned),),
        f"{name}.Dense_0.bias": ((f"{own}.dense.bias", _same),),
    }


def _linear(name: str, own: str, kernel: Callable[[Tensor], Tensor] = _turned) -> dict[str, tuple[Part, ...]]:
    """A linear layer, a convolution, or a norm with a bias."""
    weight = f"{own}.weight"
    ends = {"kernel": (weight, kernel), "scale": (weight, _same), "bias": (f"{own}.bias", torch.flatten)}
    return {f"{name}.{end}": (part,) for end, part in ends.items()}


_LANGUAGE: dict[str, tuple[Part, ...]] = {
    "attn.q_einsum.w": (("self_attn.q_proj.weight", lambda x: x.mT.flatten(0, 1)),),
    "attn.kv_einsum.w": (
        ("self_attn.k_proj.weight", lambda x: x[0].mT.flatten(0, 1)),
        ("self_attn.v_proj.weight", lambda x: x[1].mT.flatten(0, 1)),
    ),
    "attn.attn_vec_einsum.w": (("self_attn.o_proj.weight", _outward),),
    "mlp.gating_einsum": (("mlp.gate_proj.weight", lambda x: x[0].mT), ("mlp.up_proj.weight", lambda x: x[1].mT)),
    "mlp.linear": (("mlp.down_proj.weight", _turned),),
    **_norm("pre_attention_norm", "input_layernorm"),
    **_norm("pre_ffw_norm", "post_attention_layernorm"),
}
_ATTENTION = "MultiHeadDotProductAttention_0"
_SEEN: dict[str, tuple[Part, ...]] = {
    **_linear("LayerNorm_0", "layer_norm1"),
    **_linear("LayerNorm_1", "layer_norm2"),
    **_linear("MlpBlock_0.Dense_0", "mlp.fc1"),
    **_linear("MlpBlock_0.Dense_1", "mlp.fc2"),
    **_linear(f"{_ATTENTION}.query", "self_attn.q_proj", _inward),
    **_linear(f"{_ATTENTION}.key", "self_attn.k_proj", _inward),
    **_linear(f"{_ATTENTION}.value", "self_attn.v_proj", _inward),
    **_linear(f"{_ATTENTION}.out", "self_attn.out_proj", _outward),
}
_ALONE: dict[str, tuple[Part, ...]] = {
    **_linear("PaliGemma.img.embedding", f"{_VISION}embeddings.patch_embedding", lambda x: x.permute(3, 2, 0, 1)),
    "PaliGemma.img.pos_embedding": ((f"{_VISION}embeddings.position_embedding.weight", lambda x: x[0]),),
    **_linear("PaliGemma.img.Transformer.encoder_norm", f"{_VISION}post_layernorm"),
    **_linear("PaliGemma.img.head", f"{_BOTH}paligemma.model.multi_modal_projector.linear"),
    "PaliGemma.llm.embedder.input_embedding": ((f"{_MODELS['']}embed_tokens.weight", _same),),
    **_norm("PaliGemma.llm.final_norm_1", f"{_MODELS['_1']}norm"),
    **_linear("action_in_proj", "action_in_proj"),
    **_linear("action_out_proj", "action_out_proj"),
    **_linear("state_proj", "state_proj"),
    **_linear("action_time_mlp_in", "action_time_mlp_in"),
    **_linear("action_time_mlp_out", "action_time_mlp_out"),
    **_linear("time_mlp_in", "time_mlp_in"),
    **_linear("time_mlp_out", "time_mlp_out"),
}
_UNREAD = "PaliGemma.llm.final_norm.scale"
_STACKS = {"PaliGemma.llm.layers.": _LANGUAGE, "PaliGemma.img.Transformer.encoderblock.": _SEEN}


def read_params(folder: Path) -> tuple[dict[str, Tensor], bool]:
    """The weights, and whether adapters (LoRA) were merged into them.

    Raises:
        CheckpointError: see ``read_arrays``; or an array that openpi's pi0 and pi0.5 do not have, or of another shape.
    """
    saved = read_arrays(folder, lambda sizes: require_memory_for(folder, sizes), disk_room()[0])
    names = {name: name.removeprefix("params.") for name in saved}
    if all(name.endswith(".value") for name in names):  # a state of nnx, in place of plain arrays
        names = {name: short.removesuffix(".value") for name, short in names.items()}
    arrays = {names[name]: torch.from_numpy(array) for name, array in saved.items()}
    found, unknown = dict[str, Tensor](), list[str]()
    for name, array in arrays.items():
        if "lora_" in name or name == _UNREAD:
            continue
        try:
            made = _weights(name, _adapted(name, array, arrays))
        except (IndexError, RuntimeError) as error:
            raise CheckpointError(
                f"{folder}: {name} has shape {list(array.shape)}, which no pi0 or pi0.5 of openpi has. Copy it again."
            ) from error
        unknown += [] if made else [name]
        found |= made
    if unknown:
        told = f"{names_of(unknown)} are no arrays of openpi's pi0 or pi0.5"
        raise CheckpointError(f"{folder}: {told}. A network that was changed is not rebuilt here.")
    return found, any("lora_" in name for name in arrays)


def _adapted(name: str, array: Tensor, arrays: Mapping[str, Tensor]) -> Tensor:
    """With its adapter added, of scale 1 as in openpi's variants; what leaves attention adds that of all heads."""
    start = f"{name.removesuffix('.w')}." if name.endswith(".w") else f"{name}_"
    inner, outer = (arrays.get(f"{start}lora_{end}") for end in "ab")
    if inner is None or outer is None:
        return array
    return array + inner @ (outer.sum(1, keepdim=True) if "attn_vec_einsum" in name else outer)


def _weights(name: str, array: Tensor) -> dict[str, Tensor]:
    """What becomes of an array, by name; nothing if it is not known."""
    if name in _ALONE:
        return {own: turn(array) for own, turn in _ALONE[name]}
    start = next((each for each in _STACKS if name.startswith(each)), "")
    rest, table, model = name.removeprefix(start), _STACKS.get(start, {}), f"{_VISION}encoder."
    if table is _LANGUAGE:
        model = _MODELS["_1" if rest != (rest := re.sub(r"_1(?=\.|$)", "", rest)) else ""]
    parts = table.get(rest, ())
    return {f"{model}layers.{i}.{own}": turn(one) for own, turn in parts for i, one in enumerate(array)}
