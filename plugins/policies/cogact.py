"""CogACT's action model, read from a checkpoint of the whole: what is around it becomes an observation, one token.

Source: ``CogACT.predict_action_batch`` of microsoft/CogACT at b174a1b, from the cognition feature to the action, with
its guidance and statistics.

Guidance doubles the batch, with the cognition token and with the learned none. Parameters are called as in a
checkpoint. Token 0 is the sum of timestep and condition.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.checkpoint import read_checkpoint
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.refusals import refuse_payload
from ttscompile.frontends.saved_weights import as_float32, filled

from .loops import respaced_loops
from .networks.layers import TimestepEmbedder, TimmAttention, TimmMlp
from .quantiles import GRIPPER, read_statistics

MODELS = {"DiT-S": (384, 6, 4), "DiT-B": (768, 12, 12), "DiT-L": (1024, 24, 16)}
"""Width, layers and heads of the action models; the shapes of the weights tell the first two."""
GUIDANCE, STEPS = 1.5, 10
_UNREAD = "history_embedder."


class _Layer(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attn, self.mlp = TimmAttention(width, heads), TimmMlp(width)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(functional.layer_norm(x, x.shape[-1:], eps=1e-6))
        done: Tensor = x + self.mlp(functional.layer_norm(x, x.shape[-1:], eps=1e-6))
        return done


class _Linear(nn.Module):
    def __init__(self, features: int, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(features, width)

    def forward(self, x: Tensor) -> Tensor:
        made: Tensor = self.linear(x)
        return made


class _Cognition(_Linear):
    def __init__(self, features: int, width: int) -> None:
        super().__init__(features, width)
        self.uncondition = nn.Parameter(torch.zeros(1, features))

    def guided(self, cognition: Tensor) -> Tensor:
        """The batch twice: with what is known, and with what the training learned of not knowing it."""
        return self.forward(torch.cat([cognition, self.uncondition[None].expand(len(cognition), -1, -1)], 0))


class CogACTHead(nn.Module):
    """``forward_with_cfg``, which doubles the batch, on a batch that is not doubled yet.

    Inputs: ``sample [B, T, D]``, ``timestep [B]``, ``cognition [B, 1, .]``.
    """

    def __init__(
        self, width: int, heads: int, layers: int, horizon: int, actions: int, cognition: int, guidance: float
    ) -> None:
        super().__init__()
        self.guidance = guidance
        self.x_embedder, self.t_embedder = _Linear(actions, width), TimestepEmbedder(width)
        self.z_embedder = _Cognition(cognition, width)
        self.positional_embedding = nn.Parameter(torch.zeros(horizon + 1, width))
        self.blocks = nn.ModuleList(_Layer(width, heads) for _ in range(layers))
        self.final_layer = _Linear(width, actions)

    def forward(self, sample: Tensor, timestep: Tensor, cognition: Tensor) -> Tensor:
        """See the class."""
        c = self.t_embedder(torch.cat([timestep, timestep], 0))[:, None] + self.z_embedder.guided(cognition)
        x = torch.cat([c, self.x_embedder(torch.cat([sample, sample], 0))], 1) + self.positional_embedding
        for layer in self.blocks:
            x = layer(x)
        x = self.final_layer(functional.layer_norm(x, x.shape[-1:], eps=1e-6))[:, 1:]
        given, free = torch.split(x, len(x) // 2, dim=0)
        return free + self.guidance * (given - free)


def load(path: Path, options: LoadOptions) -> tuple[nn.Module, PolicySpec]:
    """Rebuild an action model from a checkpoint; see ``Family.load``."""
    weights = _weights(path)
    width, layers, horizon, actions, cognition = _sizes(weights, path)
    heads = next((n for w, depth, n in MODELS.values() if (w, depth) == (width, layers)), None)
    if heads is None:
        known = ", ".join(f"{name} of {depth} layers {w} wide" for name, (w, depth, _) in MODELS.items())
        raise CheckpointError(
            f"{path}: the action model has {layers} layers {width} wide; expected {known}. Weights do not tell the"
            " number of heads: build it with the code that trained it and use ttscompile.compile_denoiser."
        )
    sizes = {"layers": layers, "horizon": horizon, "actions": actions, "cognition": cognition}
    head = filled(lambda: CogACTHead(width, heads, guidance=GUIDANCE, **sizes), weights, "the first of each kind", path)
    loops = respaced_loops(path, STEPS, options)
    own = read_statistics(path, actions, (GRIPPER,) if actions > GRIPPER else ())
    spec = PolicySpec(
        sample=(horizon, actions),
        observations={"cognition": ObservationSpec((1, cognition), window=False)},
        sampler=loops.original,
        loops=loops.others,
        chunk=ChunkSpec(actions, 0, horizon, own.normalizer, switches=own.switches),
        source={"format": "cogact", "guidance": str(GUIDANCE), "statistics": own.name, **loops.source},
    )
    return head.eval(), spec


def _weights(path: Path) -> dict[str, Tensor]:
    """Copies of those of the action model; the rest, some 30 GB, stays on the disk."""
    whole = read_checkpoint(path, mapped=True)
    if any(str(name).startswith("qwen_vl_interface.") for name in whole):  # whose action head has the same name
        try:
            refuse_payload(whole)
        except CheckpointError as error:
            raise CheckpointError(f"{path}: {error}") from error
    payload: Any = whole.get("model")
    found = payload.get("action_model") if isinstance(payload, dict) else None
    if not isinstance(found, dict):
        what = f"found {sorted(map(str, payload))[:8]}" if isinstance(payload, dict) else "found no entry model"
        raise CheckpointError(
            f"{path}: expected {{model: {{action_model: weights, ...}}}}, as CogACT's training saves it; {what}. Give a"
            " .pt file of its folder checkpoints."
        )
    weights = as_float32(found, f"{path}: ")
    read = {name.removeprefix("net."): value for name, value in weights.items()}
    return {name: value.clone() for name, value in read.items() if not name.startswith(_UNREAD)}


def _sizes(weights: Mapping[str, Tensor], path: Path) -> tuple[int, int, int, int, int]:
    """Width, layers, horizon, numbers of an action and of the cognition token, as shapes tell them."""
    shapes = []
    for name in ("positional_embedding", "x_embedder.linear.weight", "z_embedder.linear.weight"):
        if name not in weights or weights[name].ndim != 2:
            found = f"shape {list(weights[name].shape)}" if name in weights else "none"
            raise CheckpointError(
                f"{path}: the action model's {name} must be a matrix; found {found}. Give what CogACT's training saved."
            )
        shapes.append(tuple(weights[name].shape))
    (tokens, width), (_, actions), (_, cognition) = shapes
    layers = {name.split(".")[1] for name in weights if name.startswith("blocks.")}
    return width, len(layers), tokens - 1, actions, cognition
