"""Timing at several thread counts, in passes, so that a slow minute of the machine hits every thread count alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from networks import Network
from torch import nn
from torch.utils._pytree import tree_map

from ttscompile.cli.contestants import network_contestant
from ttscompile.errors import RuntimeUnavailableError
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.report.timing import WARM_UP, Contestant, Measurement, measure
from ttscompile.runtimes.random_calls import random_calls

EAGER, TORCH_COMPILE, DENSE = "eager PyTorch", "torch.compile", "dense onnxruntime"


@dataclass(frozen=True)
class Effort:
    """How often each contestant is called.

    Attributes:
        runs: counted calls a pass.
        passes: how often all thread counts are gone through.
        warm_up: calls before the first pass; there is one before each that follows.
    """

    runs: int
    passes: int
    warm_up: int = WARM_UP


def eager_contestant(network: Network, dense_flops: float) -> Contestant:
    """The network in eager PyTorch, with as many threads as torch has at the moment of the call."""
    return network_contestant(EAGER, eager_policy(network.module, network.spec), network.spec, dense_flops)


def torch_compile_contestant(network: Network, dense_flops: float, threads: int, mode: str | None = None) -> Contestant:
    """The same loop over ``torch.compile``'s code, which is made anew for each number of threads.

    Args:
        network: whose module is compiled, encoder and denoiser apart where it has both.
        dense_flops: of a call.
        threads: what it is compiled for now, to see whether that can be done.
        mode: of torch.compile; ``reduce-overhead`` makes a CUDA graph of each evaluation.

    Raises:
        RuntimeUnavailableError: it cannot be had here; inductor needs a C++ compiler.
    """
    torch.compiler.reset()  # it gives up on a function that it compiled for too many modules
    module: Any = network.module
    if isinstance(module, EncodedDenoiser):
        module = EncodedDenoiser(_Cloned(module.encoder, mode), _Cloned(module.denoiser, mode))
    else:
        module = torch.compile(module, fullgraph=True, dynamic=False, mode=mode)
    contestant = network_contestant(TORCH_COMPILE, eager_policy(module, network.spec), network.spec, dense_flops)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        contestant.call(*random_calls(network.spec, 1, seed=0)[0])
    except Exception as error:  # dynamo's, inductor's and the C++ compiler's errors have no class of their own
        reason = " ".join([line for line in str(error).splitlines() if line.strip()][:2])
        raise RuntimeUnavailableError(
            f"torch.compile cannot compile {network.name}: {type(error).__name__}: {reason} (inductor needs g++ or"
            " clang.)"
        ) from error
    finally:
        torch.set_num_threads(before)
    return contestant


class _Cloned(nn.Module):
    """A compiled module whose results outlive its next call, which a CUDA graph of torch's writes over."""

    def __init__(self, module: nn.Module, mode: str | None) -> None:
        super().__init__()
        self.run: Any = torch.compile(module, fullgraph=True, dynamic=False, mode=mode)

    def forward(self, *given: Any) -> Any:
        """What the module gives."""
        return tree_map(torch.clone, self.run(*given))


def measure_in_passes(
    by_threads: Mapping[int, Sequence[Contestant]], effort: Effort, on_round: Callable[[], None] = lambda: None
) -> dict[int, list[Measurement]]:
    """Time contestants, one thread count after the other, and all thread counts in every pass.

    Contestants of one thread count take turns call by call. Warm-up is not counted.

    Args:
        by_threads: the contestants of each number of threads.
        effort: see there.
        on_round: called after each round of each thread count.

    Returns:
        One measurement a contestant, by number of threads.
    """
    seen: dict[int, list[list[Measurement]]] = {threads: [] for threads in by_threads}
    before = torch.get_num_threads()
    try:
        for number in range(effort.passes):
            for threads, entered in by_threads.items():
                torch.set_num_threads(threads)
                warm_up = effort.warm_up if number == 0 else 1
                seen[threads].append(measure(entered, effort.runs, number, lambda *_: on_round(), warm_up))
    finally:
        torch.set_num_threads(before)
    return {threads: [_pooled(one) for one in zip(*of, strict=True)] for threads, of in seen.items()}


def rounds_of(by_threads: Mapping[int, Sequence[Contestant]], effort: Effort) -> int:
    """How often ``on_round`` will be called."""
    return len(by_threads) * (effort.warm_up + effort.passes - 1 + effort.passes * effort.runs)


def tenths(times_ms: Sequence[float]) -> tuple[float, float]:
    """The 10th and 90th percentile."""
    low, high = np.percentile(times_ms, [10, 90])
    return float(low), float(high)


def _pooled(parts: Sequence[Measurement]) -> Measurement:
    """One measurement of all passes."""
    times = tuple(ms for part in parts for ms in part.times_ms)
    return replace(parts[0], times_ms=times, legalised=sum(part.legalised for part in parts))
