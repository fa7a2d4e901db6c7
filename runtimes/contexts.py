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
        self._manifest, self._module, self._zeros, self.streams = manifest, module, zeros, streams
        self._of_all_steps: dict[str, Any] = {}  # as the step piece reads them
        self._by_step: dict[str, Any] = {}  # views of values, as it gives them: made anew, a tenth of a small call
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
        """What the step piece reads for all steps in one batch of K * B, step-major; the next call writes over it."""
        return [self._for_all_steps(name) for name in names]

    def _for_all_steps(self, name: str) -> Any:
        value, axis, steps = self.values[name], self._manifest.contexts[name].type.batch_axis, self._manifest.steps
        if self.is_stepwise(name):
            if name not in self._of_all_steps:
                self._of_all_steps[name] = self._module.concatenate(list(value), self._axis(name))
            return self._of_all_steps[name]
        if axis is None:
            return value
        before, after = tuple(value.shape[:axis]), tuple(value.shape[axis + 1 :])
        if name not in self._of_all_steps:
            whole = (*before, steps * self.streams, *after)
            self._of_all_steps[name] = self._zeros(whole, self._manifest.contexts[name].type.dtype)
        by_step = self._of_all_steps[name].reshape(*before, steps, self.streams, *after)
        by_step[...] = value[(*(slice(None),) * axis, None)]  # [..., 1, B, ...]
        return self._of_all_steps[name]

    def keep_steps(self, made: Iterable[tuple[str, Any]]) -> None:
        """Keep what the step piece gave for that batch. Raises ArtifactError: it has no axis for the streams."""
        for name, value in made:
            if name not in self._by_step:  # [..., K, B, ...] of what is [K, ..., B, ...]
                self._by_step[name] = self._module.moveaxis(self.values[name], 0, self._axis(name))
            self._by_step[name][...] = value.reshape(self._by_step[name].shape)

    def take(self, whole: ContextValues, index: Any) -> None:
        """Copy the values of some streams of a batch."""
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
