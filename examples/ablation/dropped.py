"""The authors' decoder layer while it is trained: with their dropout, which the graph of ``decoder_head.py`` has not.

Dropout is more than regularisation here. Plans are made of the logits with it, so cells near the edge are computed in
one update and not in the next, and training sees both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from decoder_head import BASE, tokens_of
from torch import Tensor
from torch.nn.functional import layer_norm, linear, relu

from ttscompile.calibration.runner import Runner
from ttscompile.runtimes.reference.model import Contexts

DROPPED = 0.1
"""Theirs: share of the numbers that are left out, of attention's weights and of what each part of the layer adds."""


class DroppedHead:
    """The layer as a torch function of its numbers.

    Args:
        runner: of an artifact with this head.
        rate: share that is left out; 0 for what the graph gives.
    """

    def __init__(self, runner: Runner, rate: float = DROPPED) -> None:
        pruner = runner.view.pieces.pruner
        assert pruner is not None
        self._features, self._rate, self._fixed = dict(pruner.inputs), rate, runner.model.weights
        (split,) = (node for node in pruner.nodes if node.name == "plan.split")
        self._heads = split.types[0].at(1)[2]
        self._draw = np.random.default_rng(0)

    def __call__(self, contexts: Contexts, values: Mapping[str, Tensor], draw: np.random.Generator) -> Tensor:
        """Logits, float32 ``[N, K, blocks, 4]``."""
        self._draw = draw
        given = {name[7:]: value for name, value in {**self._fixed, **values}.items() if name.startswith("pruner.")}
        query, heads = given["query"], self._heads
        memory = self._memory(contexts, given)
        cells = (*memory.shape[:2], *query.shape)

        joint = _linear(given, "self.in", _norm(given, 1, query)).unflatten(-1, (3, heads, -1)).permute(1, 2, 0, 3)
        seen = self._looked(joint[0], joint[1], joint[2], cells)
        tokens = query + self._dropped(_linear(given, "self.out", seen))

        asked = _linear(given, "cross.q", _norm(given, 2, tokens)).unflatten(-1, (heads, -1)).transpose(2, 3)
        keys, kept = (_linear(given, f"cross.{one}", memory).unflatten(-1, (heads, -1)).transpose(2, 3) for one in "kv")
        seen = self._looked(asked, keys, kept, cells)
        tokens = tokens + self._dropped(_linear(given, "cross.out", seen))

        wide = self._dropped(relu(_linear(given, "wide", _norm(given, 3, tokens))))
        tokens = tokens + self._dropped(_linear(given, "narrow", wide))
        return _linear(given, "head", tokens).float() + given[BASE[7:]] + given["mask"]

    def _memory(self, contexts: Contexts, given: Mapping[str, Tensor]) -> Tensor:
        """Features and the time of each step, ``[N, K, tokens + 1, width]``."""
        time = _linear(given, "clock", given["time"])[None, :, None]
        parts = list[Tensor]()
        for i, (name, type_) in enumerate(self._features.items()):
            rows = contexts.condition[name].movedim(type_.batch_axis or 0, 0)
            made = _linear(given, f"memory{i}", rows.reshape(len(rows), *tokens_of(type_)))
            parts.append(made[:, None].expand(-1, time.shape[1], -1, -1))
        return torch.cat([*parts, time.expand(contexts.streams, -1, -1, -1).to(parts[0].dtype)], 2)

    def _looked(self, asked: Tensor, keys: Tensor, kept: Tensor, cells: Sequence[int]) -> Tensor:
        """What queries ``[..., heads, blocks, part]`` see, ``[N, K, blocks, width]``."""
        shares = (asked @ keys.transpose(-1, -2) * keys.shape[-1] ** -0.5).softmax(-1).to(kept.dtype)
        shares = self._dropped(shares.expand(*cells[:2], *shares.shape[-3:]))
        return (shares @ kept).transpose(2, 3).flatten(-2)

    def _dropped(self, value: Tensor) -> Tensor:
        if not self._rate:
            return value
        drawn = np.frombuffer(self._draw.bytes(2 * value.numel()), np.uint16) >= round(self._rate * 2**16)
        return value * torch.from_numpy(drawn).reshape(value.shape) * (1 / (1 - self._rate))


def _linear(given: Mapping[str, Tensor], name: str, value: Tensor) -> Tensor:
    return linear(value, given[f"{name}.weight"], given[f"{name}.bias"])


def _norm(given: Mapping[str, Tensor], number: int, value: Tensor) -> Tensor:
    return layer_norm(value, value.shape[-1:], given[f"norm{number}.weight"], given[f"norm{number}.bias"])
