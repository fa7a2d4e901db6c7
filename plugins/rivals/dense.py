"""What several rivals look at before they decide: some calls, and what a dense call adds step by step."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from ttscompile.calibration.calls import Calls
from ttscompile.calibration.runner import Runner, StreamCaches
from ttscompile.calibration.task import Task
from ttscompile.core.lattice import dense_plan


def some_calls(task: Task, count: int) -> Calls:
    """Some of the calls to learn from, always the same ones, in whole windows; all if there are fewer."""
    window = task.calls.window
    chosen = task.draw(0).permutation(task.calls.count // window)[: max(1, count // window)]
    return task.runner.select(task.calls, (chosen[:, None] * window + np.arange(window)).reshape(-1))


@torch.no_grad()
def dense_steps(runner: Runner, calls: Calls) -> Iterator[tuple[Tensor, list[Tensor]]]:
    """Step by step, the residual stream after the stem of dense calls, and what each block adds to it."""
    plan = dense_plan(runner.model.steps, runner.model.blocks)[None]
    caches, stems = StreamCaches(), list[Tensor]()

    def blocks(k: int, stem: Tensor) -> Tensor:
        stems.append(stem)
        return runner.step(plan[:, k], k, stem, calls, caches)

    for _ in runner.corrected(None).samples(calls, blocks):
        yield stems.pop(), [caches.timestep[b] for b in range(runner.model.blocks)]
