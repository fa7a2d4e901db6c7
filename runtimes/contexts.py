"""What the pieces read beside the residual stream, for one number of streams: arrays or tensors that stay."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from ttscompile.artifact.manifest import Manifest
from ttscompile.errors import ArtifactError
from ttscompile.ir.program import Binding


class ContextValues:
    """Contexts for B streams, so that whatever reads them can be bound to where they are.

    Args:
        manifest: of the artifact.
        streams: B.
        module: numpy or torch, whichever the values are of.
        zeros: makes one, of a shape and the name of a dtype.
        tables: ``[K, ...]`` by name, of one stream.

    Attributes:
        values: by name; of the condition as they are, of steps and tables ``[K, ...]``.
    """

    def __init__(
        self,
        manifest: Manifest,
        streams: int,
        module: Any,
        zeros: Callable[[tuple[int, ...], str], Any],
        tables: Mapping[str, Any],
    ) -> None:
        self._manifest, self._module, self.streams = manifest, module, streams
        self._tables_of_streams: dict[str, Any] = {}  # as the step piece reads them
        self.values: dict[str, Any] = {}
        for name, context in manifest.contexts.items():
            steps = (manifest.steps,) if self.is_stepwise(name) else ()
            self.values[name] = zeros((*steps, *context.type.at(streams)), context.type.dtype)
            if context.binding is Binding.TABLE:
                self.values[name][...] = tables[name]

    def at(self, name: str, k: int) -> Any:
        """The value of a context at step k; still an array where it is one number."""
        return self.values[name][k, ...] if self.is_stepwise(name) else self.values[name]

    def features(self) -> Any:
        """What a correction reads of the condition, one row of numbers a stream, ``[B, N]``."""
        contexts, move = self._manifest.contexts, self._module.moveaxis
        rows = [move(self.values[name], contexts[name].type.batch_axis or 0, 0) for name in self._manifest.features]
        return self._module.concatenate([row.reshape(self.streams, -1) for row in rows], 1)

    def keep(self, made: Iterable[tuple[str, Any]]) -> None:
        """Keep what the condition piece gave."""
        for name, value in made:
            if name in self.values:  # a network that ignores the condition has values that nobody reads
                self.values[name][...] = value

    def for_step_piece(self, names: Iterable[str]) -> list[Any]:
        """What the step piece reads for all steps in one batch of K * B, step-major."""
        found, steps, together = list[Any](), self._manifest.steps, self._module.concatenate
        for name in names:
            value, axis = self.values[name], self._manifest.contexts[name].type.batch_axis
            if not self.is_stepwise(name):
                found.append(value if axis is None else together([value] * steps, axis))
                continue
            if name not in self._tables_of_streams:
                self._tables_of_streams[name] = together(list(value), self._axis(name))
            found.append(self._tables_of_streams[name])
        return found

    def keep_steps(self, made: Iterable[tuple[str, Any]]) -> None:
        """Keep what the step piece gave for that batch. Raises ArtifactError: it has no axis for the streams."""
        move = self._module.moveaxis
        for name, value in made:
            axis = self._axis(name)
            front = move(value, axis, 0)  # from [..., K * B, ...] to [K, ..., B, ...]
            split = front.reshape(self._manifest.steps, self.streams, *front.shape[1:])
            self.values[name][...] = move(split, 1, axis + 1)

    def take(self, whole: ContextValues, index: Any) -> None:
        """The values of some streams of a batch."""
        move = self._module.moveaxis
        for name, context in self._manifest.contexts.items():
            own, theirs, axis = self.values[name], whole.values[name], context.type.batch_axis
            if axis is None:
                own[...] = theirs
            elif context.binding is not Binding.TABLE:  # which all streams have alike
                first = axis + self.is_stepwise(name)
                move(own, first, 0)[...] = move(theirs, first, 0)[index]

    def is_stepwise(self, name: str) -> bool:
        """Whether a context differs from step to step, as those of the condition do not."""
        return self._manifest.contexts[name].binding is not Binding.CONDITION

    def _axis(self, name: str) -> int:
        context = self._manifest.contexts[name]
        if context.type.batch_axis is None:
            problem = f"{name!r} : {context.type}, which the step piece reads or gives, has no axis for the streams"
            raise ArtifactError(f"{problem}. Convert the checkpoint again.")
        return context.type.batch_axis
