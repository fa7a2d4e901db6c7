"""How one graph holds all residual blocks: which inputs they share, and how a run says which block it wants.

onnxruntime's threads belong to a session. With a session a block they cannot be kept awake from one block to the next;
with one session for all blocks they can. Its graph is a tree of ``If`` nodes over a few booleans::

    which.0 --If--+-- which.1 --If--+-- block 0
                  |                 +-- block 1
                  +-- which.1 --If--+-- block 2
                                    +-- block 3

Steps that compute all blocks have a graph of their own, in which nothing is between one block and the next::

    stream --block 0--> residual.0, stream + residual.0 --block 1--> residual.1, ... --> stream_next
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from .graph import TensorType
from .pieces import STREAM


@dataclass(frozen=True)
class Joint:
    """The interface of the graph of all blocks.

    Attributes:
        slots: inputs that carry contexts, and their types; a block reads some of them.
        places: for each block its contexts in order, as names of slots.
        turns: for each block the values of ``which.0``, ``which.1``, ...; true takes the first branch.
    """

    slots: tuple[tuple[str, TensorType], ...]
    places: tuple[tuple[str, ...], ...]
    turns: tuple[tuple[bool, ...], ...]

    @property
    def switches(self) -> tuple[str, ...]:
        """Names of the booleans."""
        return tuple(f"which.{i}" for i in range(len(self.turns[0])))

    @property
    def inputs(self) -> tuple[str, ...]:
        """All inputs, in order."""
        return (*self.switches, STREAM, *(name for name, _ in self.slots))


def join(contexts: Iterable[Sequence[TensorType]]) -> Joint:
    """The interface for blocks whose contexts have these types; blocks share slots of one type."""
    slots: dict[tuple[TensorType, int], str] = {}
    places = []
    for types in contexts:
        own: list[tuple[TensorType, int]] = []
        for type_ in types:
            own.append((type_, sum(seen == type_ for seen, _ in own)))
        places.append(tuple(slots.setdefault(key, f"context.{len(slots)}") for key in own))
    turns, depth = list(_turns(0, len(places))), max(len(places) - 1, 0).bit_length()
    return Joint(
        slots=tuple((name, type_) for (type_, _), name in slots.items()),
        places=tuple(places),
        turns=tuple((*own, *[False] * (depth - len(own))) for own in turns),
    )


def halves(first: int, stop: int) -> int:
    """Where the range of blocks of a node of the tree is parted."""
    return (first + stop) // 2


def _turns(first: int, stop: int) -> Iterator[tuple[bool, ...]]:
    """The way to each of these blocks."""
    if stop - first == 1:
        yield ()
    elif stop > first:
        middle = halves(first, stop)
        yield from ((True, *rest) for rest in _turns(first, middle))
        yield from ((False, *rest) for rest in _turns(middle, stop))
