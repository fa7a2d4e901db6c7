"""What would a fifth source bring? Published ways to fill a cell that the lattice has no word for, measured.

    python examples/ablation/sources.py compiled/ --trajectories calls.npz --computed-steps 3

A cell that is not computed adds a residual that was. TaylorSeer adds a forecast of two or three, FastCache a linear map
of what the block is given, and ToCa computes some tokens of it. Each runs here in calibration's runner, on calls of
episodes that nothing was learned from, with as many computed cells as evenly spaced whole steps have. Nothing is
written, and no runtime knows of any.

- ``forecast``: ``r[o] + w (r[o] - r[p])`` of each block, and with the second difference; of the network's output it is
  a correction, which a plan may have (the rival ``taylorseer``).
- ``linear``: ``A h + c`` of the block's input h, fitted by least squares to dense calls. It is not free: a product of
  the width with itself for each token. The last column counts it.
- ``gate``: FastCache's. A block is computed where its input has changed by more than a threshold since it last was,
  relative, by the Frobenius norm; the threshold is the lowest that keeps the cells. Else it is linear, or reused.
- ``published``: the same gate with the threshold of its authors' code, and with that of its paper. How many cells they
  compute, they decide.
- ``tokens``: ToCa's, of each block those whose residual changed most, as if somebody knew before computing them. Their
  number is rounded up. One more row has ToCa's own score.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import numpy as np
import torch
from published import Gate, Keeps, authors_keep, below, paper_threshold, toca_score
from three_parts import answered
from torch import Tensor

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import (
    FRACTION,
    Actions,
    Calls,
    load_episodes,
    prepare_calls,
    sample_calls,
    split_episodes,
)
from ttscompile.calibration.progress import Bar
from ttscompile.calibration.runner import Runner, last
from ttscompile.calibration.targets import REPEATS
from ttscompile.calibration.task import Task
from ttscompile.calibration.trials import base_of
from ttscompile.cli.output import print_json, results_console, run, say, table
from ttscompile.cli.sections import SectionedCommand, Sources, trajectories_options
from ttscompile.core.lattice import Source, uniform_plan
from ttscompile.errors import CalibrationError
from ttscompile.rivals.taylorseer import correction_for

PROBES = 12
"""Of a threshold."""

WAYS = ("forecast", "linear", "gate", "published", "tokens")

Steps = tuple[int, ...]

Linear = tuple[Tensor, Tensor]
"""``[D, D]`` and ``[D]``: from a block's input to its residual."""


@dataclass(frozen=True)
class Row:
    """One way to fill the cells that are not computed.

    Attributes:
        cells: computed in a call, mean.
        error: mean absolute difference of the executed actions from the same loop with every step computed.
        flops: of the blocks, and of what fills the other cells, as a share of those of a dense call.
    """

    way: str
    cells: float
    error: float
    flops: float


@dataclass
class Filled:
    """What a loop did: the denoised samples, and how many cells it computed, mean over calls."""

    samples: Tensor
    cells: float


Fill = Callable[[int, int, Tensor, Sequence[tuple[int, Tensor]]], tuple[Tensor, float]]
"""Of a step, a block, its input and what it computed last, newest first: what it adds, and what share was computed."""


class Study:
    """The loop of a policy, with cells filled in any way."""

    def __init__(self, runner: Runner, actions: Actions, learned: Calls, judged: Calls, seed: int) -> None:
        types = runner.types
        if not runner.alike or len(types[0].at(2)) != 3:
            raise CalibrationError(
                f"expected blocks whose residuals are tokens, [streams, tokens, width]; found {types[0]}. A network"
                " without a residual stream is one block, and has no tokens."
            )
        self.runner, self.actions, self.learned, self.judged = runner, actions, learned, judged
        self.task, self._maps = Task.of(runner, learned, 0, seed), list[Linear]()
        self.steps, self.blocks = runner.model.steps, runner.model.blocks
        at = runner.axes[0]
        shape = list(types[0].at(2))
        del shape[at]
        self.tokens, self.width = shape
        manifest = runner.view.manifest
        self._block_flops = float(np.mean(manifest.flops.blocks))

    def filled(self, calls: Calls, whole: Steps, fill: Fill) -> Filled:
        """Run calls with some whole steps, and the other cells filled."""
        model, kept = self.runner.model, [list[tuple[int, Tensor]]() for _ in range(self.blocks)]
        computed = 0.0

        def blocks(k: int, stream: Tensor) -> Tensor:
            nonlocal computed
            for b in range(self.blocks):
                if k in whole:
                    residual, share = model.block(b, k, stream, calls.contexts), 1.0
                    kept[b] = [(k, residual), *kept[b][:2]]
                else:
                    residual, share = fill(k, b, stream, kept[b])
                computed += share
                stream = stream + residual
            return stream

        with torch.no_grad():
            samples = last(self.runner.samples(calls, blocks))
        return Filled(samples, computed)

    def row(self, way: str, done: Filled, beside: float = 0.0) -> Row:
        """What calls with cells filled were worth; ``beside`` are FLOPs of what fills a cell, times tokens of all."""
        wrong = self.actions.errors(done.samples, self.judged.targets, units=True)
        cells, filled = done.cells, self.steps * self.blocks - done.cells
        dense = self.steps * self.blocks * self._block_flops
        return Row(way, cells, float(wrong.mean()), (cells * self._block_flops + filled * beside) / dense)

    def reused(self, k: int, b: int, stream: Tensor, kept: Sequence[tuple[int, Tensor]]) -> tuple[Tensor, float]:
        """As TIMESTEP."""
        return kept[0][1], 0.0

    def forecast(self, order: int) -> Fill:
        """TaylorSeer's, by finite differences."""

        def fill(k: int, b: int, stream: Tensor, kept: Sequence[tuple[int, Tensor]]) -> tuple[Tensor, float]:
            (o, newest), ahead = kept[0], k - kept[0][0]
            found = newest
            if order and len(kept) > 1:
                p, older = kept[1]
                slope = (newest - older) / (o - p)
                found = found + ahead * slope
                if order > 1 and len(kept) > 2:
                    before = (older - kept[2][1]) / (p - kept[2][0])
                    found = found + ahead**2 / 2 * (slope - before) / (o - p)
            return found, 0.0

        return fill

    @property
    def maps(self) -> list[Linear]:
        """Fitted to the steps after step 0 of dense calls."""
        if not self._maps:
            size = self.width + 1
            sums = [
                (torch.zeros(size, size).double(), torch.zeros(size, self.width).double()) for _ in range(self.blocks)
            ]

            def seen(k: int, b: int, stream: Tensor, kept: Sequence[tuple[int, Tensor]]) -> tuple[Tensor, float]:
                residual = self.runner.model.block(b, k, stream, self.learned.contexts)
                x = stream.reshape(-1, self.width).double()
                x = torch.cat([x, torch.ones(len(x), 1).double()], 1)
                sums[b][0].addmm_(x.T, x)
                sums[b][1].addmm_(x.T, residual.reshape(-1, self.width).double())
                return residual, 1.0

            self.filled(self.learned, (0,), seen)
            for products, targets in sums:
                ridge = 1e-6 * products.diagonal().mean() * torch.eye(size).double()
                found = torch.linalg.solve(products + ridge, targets).float()
                self._maps.append((found[:-1], found[-1]))
        return self._maps

    def linear(self, k: int, b: int, stream: Tensor, kept: Sequence[tuple[int, Tensor]]) -> tuple[Tensor, float]:
        """FastCache's map."""
        matrix, shift = self.maps[b]
        return stream @ matrix + shift, 0.0

    def gated(self, calls: Calls, keeps: Keeps, otherwise: Fill) -> Filled:
        """Calls in which a block is computed where its input has changed too much since it last was."""
        axis, gate, latest = self.runner.axes[0], Gate(keeps), dict[int, Tensor]()

        def fill(k: int, b: int, stream: Tensor, kept: Sequence[tuple[int, Tensor]]) -> tuple[Tensor, float]:
            latest.setdefault(b, kept[0][1])  # of step 0, which is whole, and whose inputs are not seen here
            new, shape = gate(k, b, stream.movedim(axis, 0).flatten(1)), [1, 1, 1]
            shape[axis] = -1
            chosen = new.reshape(shape)
            computed = self.runner.model.block(b, k, stream, calls.contexts)
            other, _ = otherwise(k, b, stream, [(k, latest[b])])
            latest[b] = torch.where(chosen, computed, latest[b])
            return torch.where(chosen, computed, other), float(new.float().mean())

        return self.filled(calls, (0,), fill)

    def published(self) -> list[tuple[str, Keeps]]:
        """FastCache's own thresholds."""
        size, timesteps = self.tokens * self.width, self.runner.view.manifest.spec.sampler.timesteps
        return [
            ("FastCache's own gate", lambda change, k: authors_keep(change, float(timesteps[k]), size)),
            ("the gate of FastCache's paper", lambda change, k: change <= paper_threshold(size)),
        ]

    def threshold(self, cells: float, otherwise: Fill) -> float:
        """The lowest, by bisection, with which calls that are learned from compute so many cells on average."""

        def enough(found: float) -> bool:
            return self.gated(self.learned, below(found), otherwise).cells <= cells

        low, high = 0.0, 1.0
        while not enough(high) and high < 1e3:
            low, high = high, 2 * high
        for _ in range(PROBES):
            middle = (low + high) / 2
            low, high = (low, middle) if enough(middle) else (middle, high)
        return high

    def some_tokens(self, whole: Steps, count: int, toca: bool = False) -> Filled:
        """Calls in which so many tokens of a block are computed at other steps.

        Args:
            whole: steps that are computed whole.
            count: of tokens.
            toca: those with ToCa's highest score, in place of those whose residual changed most.
        """
        axis, calls, latest = self.runner.axes[0], self.judged, dict[int, Tensor]()
        waited = dict[int, Tensor]()

        def fill(k: int, b: int, stream: Tensor, kept: Sequence[tuple[int, Tensor]]) -> tuple[Tensor, float]:
            if k - 1 in whole:
                latest[b] = kept[0][1]
            computed = self.runner.model.block(b, k, stream, calls.contexts).movedim(axis, 0)
            old = latest[b].movedim(axis, 0)
            if k - 1 in whole:
                waited[b] = torch.zeros(old.shape[:2])
            score = toca_score(stream.movedim(axis, 0), old, waited[b]) if toca else (computed - old).norm(dim=-1)
            mask = torch.zeros(old.shape[:2]).scatter(1, score.topk(count, 1).indices, 1.0) > 0
            waited[b] = torch.where(mask, 0.0, waited[b] + 1)
            latest[b] = torch.where(mask[..., None], computed, old).movedim(0, axis)
            return latest[b], count / self.tokens

        return self.filled(calls, whole, fill)


def even(steps: int, count: int) -> Steps:
    """Evenly spaced steps."""
    return tuple(np.flatnonzero((uniform_plan(steps, 1, count) == Source.COMPUTE)[:, 0]).tolist())


def rows_of(study: Study, count: int, only: Sequence[str] = WAYS) -> list[Row]:
    """Ways with as many computed cells as so many whole steps have."""
    whole, judged, cells = even(study.steps, count), study.judged, count * study.blocks
    product = 2.0 * study.tokens * study.width**2
    found = [study.row("reused (TIMESTEP)", study.filled(judged, whole, study.reused))]
    if "forecast" in only:
        for order in (1, 2)[: count - 1]:
            done = study.filled(judged, whole, study.forecast(order))
            found.append(study.row(f"forecast of each block, order {order}", done))
        plan = uniform_plan(study.steps, study.blocks, count)
        corrected = study.runner.corrected(correction_for(study.task, whole))
        found.append(study.row("forecast of the output, a correction", Filled(corrected.run(plan, judged), cells)))
    if "linear" in only:
        found.append(study.row("linear in the input", study.filled(judged, whole, study.linear), product))
    for name, otherwise, beside in (("reused", study.reused, 0.0), ("linear", study.linear, product)):
        if "gate" in only:
            done = study.gated(judged, below(study.threshold(cells, otherwise)), otherwise)
            found.append(study.row(f"FastCache's gate, else {name}", done, beside))
        if "published" in only:
            for gate, keeps in study.published():
                found.append(study.row(f"{gate}, else {name}", study.gated(judged, keeps, otherwise), beside))
    if "tokens" in only:
        for fewer in range(count - 1, 0, -1):
            tokens = -(-(count - fewer) * study.tokens // (study.steps - fewer))  # rounded up
            whole_steps = f"{fewer} whole step{'s' * (fewer > 1)}"
            for which, toca in (("the best", False), ("ToCa's", True)):
                done = study.some_tokens(even(study.steps, fewer), tokens, toca)
                found.append(study.row(f"{whole_steps}, and {which} {tokens} of {study.tokens} tokens", done))
    return found


@click.command(cls=SectionedCommand, context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@trajectories_options()
@click.option("--computed-steps", default=3, help="Whose cells a call may compute.")
@click.option("--calls", default=96, help="To judge on, and as many to learn from, at most.")
@click.option("--only", type=click.Choice(WAYS), multiple=True, default=WAYS, help="These ways.")
@click.option("--seed", default=0, help="Of the division of the episodes, the calls and the noise.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def main(
    directory: Path,
    trajectories: Sequence[Path],
    sources: Sources,
    computed_steps: int,
    calls: int,
    only: Sequence[str],
    seed: int,
    as_json: bool,
) -> None:
    """Measure it for the policy of the artifact in DIRECTORY."""
    artifact = load_artifact(directory)
    view = view_of(artifact, base_of(artifact).exact)
    spec, runner = view.manifest.spec, Runner(view)
    if not 1 < computed_steps < view.manifest.steps:
        raise CalibrationError(
            f"computed steps: expected between 2 and {view.manifest.steps - 1}, of the loop; found {computed_steps}."
        )
    episodes = load_episodes(spec, trajectories, sources)
    split = split_episodes(len(episodes), FRACTION, seed)
    with Bar(shown=True) as bar:
        parts = []
        for stage, numbers in enumerate((split.calibration, split.validation)):
            chosen = sample_calls(episodes, numbers, calls, seed, REPEATS)
            drawn = prepare_calls(runner.model, spec, episodes, chosen, (seed, 17, stage))
            parts.append(answered(runner, drawn, "dense calls", bar.tell))
        learned, judged = parts
        rows = rows_of(Study(runner, Actions(spec), learned, judged, seed), computed_steps, only)
    if as_json:
        print_json({"rows": [asdict(one) for one in rows]})
        return
    output, made = results_console(), table("cells that are not computed", "cells", "error", "FLOPs")
    for one in rows:
        made.add_row(one.way, f"{one.cells:.0f}", f"{one.error:.3g}", f"{100 * one.flops:.0f} %")
    output.print(made)
    say(
        output,
        "Error: mean absolute difference of the executed actions, in their units, from those of the same loop with"
        f" every step computed and the same noise; {judged.count} calls of episodes that nothing was learned from."
        " FLOPs: of blocks, and of what fills the other cells, as a share of those of a dense call.",
    )


if __name__ == "__main__":
    run(main)
