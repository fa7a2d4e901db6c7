"""What reusing tokens means, literally: every value of the tower is computed whole, and then most of it is thrown away.

In a value that has a row for each token, the rows of tokens that are not computed are those that it had when they were,
or those that a computed token has now.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
import torch

from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import GETITEM, Graph, Ref
from ttscompile.ir.tokens import find_tokens


class LiteralTokens:
    """A tower of one frame after the other.

    Args:
        tower: of a program.
        weights: of its constants.
    """

    def __init__(self, tower: Graph, weights: Mapping[str, npt.NDArray[np.generic]]) -> None:
        stream = find_tokens(tower, weights)
        assert not isinstance(stream, str)
        self.tower, self.stream = tower, stream
        self.weights = {name: torch.from_numpy(np.array(weights[name])) for name in tower.constants}
        self.kept: dict[str, torch.Tensor] = {}

    def __call__(
        self,
        row: npt.NDArray[np.float32],
        computed: Sequence[int] | npt.NDArray[np.int64],
        similar: Mapping[int, int] | None = None,
    ) -> list[npt.NDArray[np.float32]]:
        """What the tower gives for a row ``[1, ...]``, of which these tokens are computed.

        Args:
            similar: by token that is not computed, one that is, whose rows it gets; of the others it keeps them.
        """
        values = {**self.weights, **{name: torch.from_numpy(row) for name in self.tower.inputs}}
        chosen = torch.zeros(self.stream.tokens, dtype=torch.bool)
        chosen[torch.as_tensor(computed)] = True
        taken = torch.arange(self.stream.tokens)
        for token, other in (similar or {}).items():
            chosen[token], taken[token] = True, other
        types, several = self.tower.types(), dict[str, Sequence[torch.Tensor]]()
        for node in self.tower.nodes:
            if node.op == GETITEM:
                source, place = node.args
                assert isinstance(source, Ref)
                assert isinstance(place, int)
                value = several[source.name][place]
            else:
                alone = Graph({name: types[name] for name in node.refs()}, {}, (node,), (node.name,))
                (value,) = evaluate(alone, {}, values)
            if isinstance(value, list | tuple):  # each of which is masked where it is taken
                several[node.name] = value
                continue
            axis = self.stream.axes.get(node.name)
            if axis is not None and node.name in self.kept:
                mask = chosen.reshape(-1, *[1] * (value.ndim - axis - 1))
                value = torch.where(mask, value.index_select(axis, taken), self.kept[node.name])
            values[node.name] = self.kept[node.name] = value
        return [values[name].numpy() for name in self.tower.outputs]
