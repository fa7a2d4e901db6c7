"""Recorded episodes in three parts that share none, and what the dense policy answers to calls of theirs."""

from __future__ import annotations

from dataclasses import replace

import torch

from ttscompile.calibration.calls import FRACTION, Calls, split_episodes
from ttscompile.calibration.progress import Progress
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.targets import dense_rounds

Numbers = tuple[int, ...]


def in_three(count: int, seed: int) -> tuple[Numbers, Numbers, Numbers]:
    """Numbers of the episodes to fit corrections on, to learn on, and to judge on: those that calibration holds out."""
    split = split_episodes(count, FRACTION, seed)
    inner = split_episodes(len(split.calibration), 1 / 3, seed)
    fitting, learning = (tuple(split.calibration[i] for i in part) for part in (inner.calibration, inner.validation))
    return fitting, learning, split.validation


def answered(runner: Runner, calls: Calls, what: str, progress: Progress) -> Calls:
    """The calls with the samples of the dense policy after every step (``Calls.path``); tells of it as ``what``."""
    paths: list[torch.Tensor] = []
    progress(what, 0, calls.count)
    for found in dense_rounds(runner, calls):
        paths.append(found)
        progress(what, sum(map(len, paths)), calls.count)
    return replace(calls, path=torch.cat(paths))
