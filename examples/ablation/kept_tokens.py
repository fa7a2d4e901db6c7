"""A policy whose image encoder computes some tokens of a new frame, in torch: for any of them, and with gradients.

What is computed is what ``docs/design.md`` section 2 says of tokens. Beside that a token that is not computed may have
the rows of another one: of this frame, or of what was kept.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ttscompile.artifact.view import View
from ttscompile.errors import CalibrationError
from ttscompile.ir.evaluate import evaluator
from ttscompile.ir.graph import Graph, Node, Ref, Size, TensorType, backward_slice
from ttscompile.ir.pieces import frame_name
from ttscompile.ir.tokens import ATTENTION, TokenStream, find_tokens
from ttscompile.runtimes.random_calls import Observation
from ttscompile.runtimes.reference.model import ReferenceModel

Kept = Mapping[str, Tensor]
"""What is kept of a frame, by value; each has a row for each token."""


def kept_values(tower: Graph, stream: TokenStream) -> tuple[str, ...]:
    """The values of all tokens that are read otherwise than token by token: of the others nothing needs old rows."""
    axes, found = stream.axes, list(tower.outputs)
    for node in tower.nodes:
        if node.name not in axes:
            found += node.refs()
        elif node.op == ATTENTION:
            found += list(node.refs())[1:]
    return tuple(name for name in dict.fromkeys(found) if name in axes)


class MaskedTower:
    """A tower for some of its tokens.

    Attributes:
        tokens, fixed: how many there are, and how many of them, the first ones, are of no patch.
        grid: rows and columns of patches.
    """

    def __init__(self, tower: Graph, view: View, patch: tuple[int, int]) -> None:
        stream = find_tokens(tower, view.weights)
        assert not isinstance(stream, str)  # the artifact says that it has tokens
        types = tower.types()
        self.tokens, self.fixed, self._patch = stream.tokens, stream.fixed, patch
        _, _, high, wide = types[stream.pixels].at(1)
        self.grid = high // patch[0], wide // patch[1]
        (self._row,), self._names = tower.inputs, kept_values(tower, stream)
        self._axes = {name: stream.axes[name] for name in self._names}
        self._cut = evaluator(backward_slice(tower, (stream.pixels,), {}), view.weights)
        self._outputs = len(tower.outputs)
        self._whole = evaluator(replace(tower, outputs=(*tower.outputs, *self._names)), view.weights)
        inputs, nodes = dict(tower.inputs), list[Node]()
        for node in tower.nodes:
            if node.name not in self._names:
                nodes.append(node)
                continue
            name, type_ = node.name, types[node.name]
            if self._axes[name] != len(type_.shape) - 2:
                raise CalibrationError(f"expected the tokens of %{name} in its last axis but one. {ANOTHER}")
            middle = [1] * (len(type_.shape) - 3)
            sizes: list[Size] = [type_.shape[0], *middle, self.tokens]
            mix, rest = (TensorType((*sizes, last), "float32") for last in (self.tokens, 1))
            inputs |= {f"{name}.kept": type_, f"{name}.mix": mix, f"{name}.rest": rest}
            nodes += [
                replace(node, name=f"{name}.new"),
                Node(f"{name}.now", "aten.matmul.default", (Ref(f"{name}.mix"), Ref(f"{name}.new")), (), (type_,)),
                Node(f"{name}.then", "aten.mul.Tensor", (Ref(f"{name}.kept"), Ref(f"{name}.rest")), (), (type_,)),
                Node(name, "aten.add.Tensor", (Ref(f"{name}.now"), Ref(f"{name}.then")), (), (type_,)),
            ]
        graph = Graph(inputs, tower.constants, tuple(nodes), (*tower.outputs, *self._names))
        self._some = evaluator(graph, view.weights)

    def whole(self, rows: Tensor) -> tuple[Sequence[Tensor], Kept]:
        """What it gives for frames ``[N, ...]``, and what is kept of them."""
        found = self._whole({self._row: rows})
        return found[: self._outputs], dict(zip(self._names, found[self._outputs :], strict=True))

    def some(self, rows: Tensor, mix: Tensor, kept: Kept) -> tuple[Sequence[Tensor], Kept]:
        """The same for some of the tokens.

        Args:
            mix: ``[N, tokens, tokens]``; row i says of which tokens of this frame token i has the rows: of itself where
                it is computed, of none where it has what was kept.
        """
        feed, rest = {self._row: rows}, 1 - mix.sum(2, keepdim=True)
        for name, value in kept.items():
            middle = [1] * (value.ndim - 3)
            feed |= {
                f"{name}.kept": value,
                f"{name}.mix": mix.reshape(len(mix), *middle, self.tokens, self.tokens),
                f"{name}.rest": rest.reshape(len(mix), *middle, self.tokens, 1),
            }
        found = self._some(feed)
        return found[: self._outputs], dict(zip(self._names, found[self._outputs :], strict=True))

    def moved(self, kept: Kept, sources: Tensor) -> Kept:
        """What is kept, with each patch's rows taken from those of another one: ``sources [N, patches]``."""
        fixed = torch.arange(self.fixed).expand(len(sources), -1)
        index = torch.cat([fixed, sources + self.fixed], 1)
        shapes = {name: (len(index), *[1] * (value.ndim - 3), self.tokens, 1) for name, value in kept.items()}
        return {n: value.gather(value.ndim - 2, index.reshape(shapes[n]).expand_as(value)) for n, value in kept.items()}

    def patches(self, rows: Tensor) -> Tensor:
        """The pixels of the patches, row by row: ``[N, patches, C, height, width]``."""
        pixels = self._cut({self._row: rows})[0]
        (high, wide), (down, across) = self._patch, self.grid
        cut = pixels[:, :, : down * high, : across * wide]
        cut = cut.reshape(len(cut), -1, down, high, across, wide)
        return cut.permute(0, 2, 4, 1, 3, 5).reshape(len(cut), down * across, -1, high, wide)


ANOTHER = "Take another policy."


class TokenPolicy:
    """The original policy, which is told what its image encoder gives."""

    def __init__(self, view: View) -> None:
        self.view, self.spec = view, view.manifest.spec
        self.model, pieces = ReferenceModel.from_view(view), view.pieces
        known = view.manifest.tokens
        numbers = [i for i in range(len(pieces.towers)) if frame_name(i) in known]
        if len(numbers) != 1 or pieces.frames is None:
            raise CalibrationError(
                f"expected a policy with one image encoder whose tokens can be reused; this one has {len(numbers)}."
                f" 'ttscompile convert --explain' says of each encoder why. {ANOTHER}"
            )
        self._piece, graph = frame_name(numbers[0]), pieces.towers[numbers[0]]
        self.tower = MaskedTower(graph, view, known[self._piece].patch)
        self._frames = evaluator(backward_slice(pieces.frames, tuple(graph.inputs), {}), view.weights)

        self.cameras = [key for key, one in self.spec.observations.items() if one.image]
        once: dict[str, Any] = {**self.model._once, self._piece: lambda _: self._given}
        self.model._once = once
        self._given: Sequence[Tensor] = ()

    def rows(self, obs: Observation) -> Tensor:
        """What the tower reads of normalised observations ``[B, ...]``, all rows."""
        return self._frames(_tensors(obs))[0]

    def lanes(self, obs: Observation) -> list[Tensor]:
        """By camera the numbers of its rows ``[frames, B]``, in the order of time.

        Rows are made by moving numbers. So if every picture shows a number of its own, rows tell which they are.
        """
        streams, shown = len(next(iter(obs.values()))), {key: np.zeros_like(value) for key, value in obs.items()}
        frames = [shown[key].reshape(streams, -1, *shown[key].shape[-3:]) for key in self.cameras]
        total = sum(one.shape[1] for one in frames)
        for number, (camera, frame) in enumerate((c, f) for c, one in enumerate(frames) for f in range(one.shape[1])):
            for stream in range(streams):
                frames[camera][stream, frame] = (number * streams + stream) / (total * streams)
        order = self.rows(shown).flatten(1).mean(1).argsort().reshape(-1, streams)
        return list(order.split([one.shape[1] for one in frames]))

    def executed(self, obs: Observation, given: Sequence[Tensor], noise: tuple[Tensor, Tensor | None]) -> Tensor:
        """The actions that are executed, normalised ``[B, Ta, Da]``.

        Args:
            given: by the tower for all of its rows.
            noise: initial sample, and the draws of the steps.
        """
        model, chunk, self._given = self.model, self.spec.chunk, given
        contexts = model.prologue(_tensors(obs))

        def blocks(k: int, stream: Tensor) -> Tensor:
            for b in range(model.blocks):
                stream = stream + model.block(b, k, stream, contexts)
            return stream

        sample = deque(model.steps_of(contexts, *noise, blocks), maxlen=1).pop().sample
        return sample[:, chunk.start : chunk.stop, : chunk.action_dim]


def _tensors(obs: Observation) -> dict[str, Tensor]:
    return {key: torch.from_numpy(np.array(value)) for key, value in obs.items()}
