"""A criterion that decides during the call, on the product's own sessions: what ``online`` freezes, as it is published.

No plan says so. A plan is settled before a call, and a runtime lowers it to instructions; here each step is asked for
what the steps before it gave. So this is no runtime, and no runtime has a branch for it: it drives the workspace of the
onnxruntime backend step by step, and is there to be held against the plan that a criterion was frozen into, by error
and by milliseconds (``examples/benchmark/online.py``).

Deciding has a price beside the criterion's own arithmetic. The feature of a step is known only after its stem, so that
steps without a computed block cannot be passed in one go, as those of a plan are; and where blocks come first, a step
that is computed whole cannot be one session.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ttscompile.artifact.load import Artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import BoolArray, PlanArray, Source
from ttscompile.core.plan import Plan
from ttscompile.core.spec import FloatArray, Noise
from ttscompile.core.update import bounded
from ttscompile.runtimes.backend import Call
from ttscompile.runtimes.onnxruntime.backend import OnnxBackend
from ttscompile.runtimes.onnxruntime.sessions import Sessions
from ttscompile.runtimes.onnxruntime.workspace import Workspace

from .online import Criterion, Decisions

Table = tuple[Correction, ...]
"""By *age*: how many steps ago one was computed whole. A stream of a greater age takes the last one."""


class Deciding:
    """Calls of an artifact whose cells a criterion decides step by step.

    Args:
        plan: whose loop, weights and precision the calls have; its cells and its correction are not read.
        threads: of arithmetic.
        table: corrections by age, which ``examples/benchmark/ages.py`` fits; empty for none.

    Raises:
        RuntimeUnavailableError: onnxruntime is missing.
        IllegalPlanError: the plan names what the artifact lacks.
    """

    def __init__(
        self, artifact: Artifact, plan: Plan, criterion: Criterion, threads: int = 1, table: Table = ()
    ) -> None:
        view = view_of(artifact, plan)
        self._spec, self._criterion = view.manifest.spec, criterion
        self._shape = view.manifest.steps, len(view.manifest.blocks)
        self._axis = view.manifest.blocks[0].type.batch_axis or 0
        self._backend, self._table = OnnxBackend(view, Sessions(threads), {}), table
        # What is added to the sample beside the features' part, in the place of what age 0 has.
        self._bias = [one.bias - table[0].bias for one in table]
        self._observed = [one.observed - table[0].observed for one in table]
        Decisions(criterion, *self._shape, 1)  # refused before the first call

    def forget_frames(self) -> None:
        """Forget all frames, so that the next call computes every one of its own."""
        self._backend.frames.forget()

    def predict(self, obs: Mapping[str, FloatArray], noise: Noise) -> tuple[FloatArray, PlanArray]:
        """One call. Streams decide for themselves; a block is computed for all of them where one of them computes it.

        With corrections the streams go through the loop one after the other, since their ages differ.

        Args:
            obs: normalised observations by key, ``[B, ...]`` each.
            noise: of the loop; see ``Runtime.predict``.

        Returns:
            The denoised sample, float32 ``[B, T, D]``, and what was decided, int8 ``[B, K, blocks]``.
        """
        streams, backend = len(noise.initial), self._backend
        if self._table and streams > 1:
            calls = [self.predict(*one) for one in _each(obs, noise)]
            samples, plans = zip(*calls, strict=True)
            return np.concatenate(samples), np.concatenate(plans)
        steps, blocks = self._shape
        backend.prepare(streams, None if self._criterion.always else ())  # with sessions of single blocks, or without
        nothing = np.zeros(self._shape, np.bool_)
        obs = {**obs, **self._spec.committed(streams, 0)}
        written, correction = np.broadcast_to(nothing, (streams, *self._shape)), self._table[0] if self._table else None
        backend.start(Call(obs, noise, correction, None, nothing, written))
        work = backend.workspace
        assert work is not None  # ``prepare``
        decisions, rows = Decisions(self._criterion, steps, blocks, streams), list[PlanArray]()
        read, age = np.zeros((streams, 0), np.float32), 0
        if correction is not None and correction.reads:
            read = correction.read(work.condition())
        work.begin()
        for k in range(steps):
            rows.append(self._step(work, k, decisions))
            age = 0 if rows[-1][0, -1] == Source.COMPUTE else age + 1
            if correction is not None and age:
                self._advance(work, k, min(age, len(self._table) - 1), read)
            else:
                work.advance(k)
        return bounded(self._spec.sampler, work.result()), np.stack(rows, 1)

    def _advance(self, work: Workspace, k: int, age: int, read: FloatArray) -> None:
        """What ``Workspace.advance`` does, with the correction of an age above 0, which is no anchor."""
        work.offset[k] += self._bias[age][k] + np.einsum("bf,fdt->dbt", read, self._observed[age][:, k])
        work.advances_with(self._table[age]).steps[k].run()

    def _step(self, work: Workspace, k: int, decisions: Decisions) -> PlanArray:
        """The blocks of step k, and what was decided about them."""
        first, blocks = range(self._criterion.always), len(work.current)
        np.copyto(work.hidden, work.fresh)
        _run(work, k, first)
        feature = work.current[: len(first)].sum(0) if first else work.fresh
        row = decisions.decide(k, np.moveaxis(feature, self._axis, 0))
        reused: BoolArray = row[:, -1] != Source.COMPUTE
        kept = work.current.copy() if reused.any() and not reused.all() else work.current
        if not reused.all() and first:
            _run(work, k, range(len(first), blocks))
        elif not reused.all():
            work.run_dense(k)
        if kept is not work.current:
            np.moveaxis(work.current, 1 + self._axis, 0)[reused] = np.moveaxis(kept, 1 + self._axis, 0)[reused]
        if reused.any():
            total = work.fresh + work.current.sum(0)
            np.moveaxis(work.hidden, self._axis, 0)[reused] = np.moveaxis(total, self._axis, 0)[reused]
        return row


def _each(obs: Mapping[str, FloatArray], noise: Noise) -> Iterator[tuple[Mapping[str, FloatArray], Noise]]:
    """Observation and noise of one stream after the other."""
    for i in range(len(noise.initial)):
        own = slice(i, i + 1)
        steps = None if noise.steps is None else noise.steps[:, own]
        yield {key: one[own] for key, one in obs.items()}, Noise(noise.initial[own], steps)


def _run(work: Workspace, k: int, blocks: Sequence[int]) -> None:
    """Compute these blocks, one after the other, for all streams."""
    for b in blocks:
        work.run(k, b)
        np.add(work.hidden, work.current[b], out=work.hidden)
