"""The calls of a calibration, and what the dense policy answers to them: computed once, and saved as it grows."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from ..artifact.view import view_of
from ..core.plan import Plan
from ..core.spec import PolicySpec
from ..pool import Here, Pool, Work, artifact_arguments, artifact_elsewhere, workers
from ..runtimes.inpainting import known_samples, prefix_refusal
from ..trajectories.episodes import Episode
from .calls import Calls, Split, draw_noise, prepare_calls, sample_calls
from .clock import Clock
from .progress import Bar
from .runner import Runner
from .state import StateFile

REPEATS = 8
"""How often an observation may be learned from, each time with another noise."""

LATE = 3
"""One call in so many is learned from once more, with a prefix."""

TARGETS_AT_ONCE = 16
"""Dense calls that go through the loop together, on one core; after a round of these the state is saved."""


def with_targets(
    runner: Runner, name: str, calls: Calls, fewest: int, state: StateFile, clock: Clock, bar: Bar, pool: Pool
) -> Calls:
    """The calls with what the dense policy answers to them; the first of them where the clock's time ends before.

    ``fewest`` of them are needed whatever the time; ``name`` is what they are called in the state.
    """
    known = state.get("targets").get(name)
    sample = calls.initial.shape[1:]
    path = torch.empty(0, runner.model.steps, *sample)
    if known is not None:
        with state.reading():
            path = torch.cat([path, torch.from_numpy(known)])
    bar.stage(f"dense, {name}", calls.count, len(path))
    rounds, key = dense_rounds(runner, calls, len(path), pool), f"{name} targets"
    # A calibration that was interrupted later goes on with as many as it had then.
    count = min(calls.count, int(state.progress.get(key, calls.count)))
    while len(path) < count and (len(path) < fewest or clock.left() > 0):
        path = torch.cat([path, next(rounds)])
        state.put("targets", {**state.get("targets"), name: path.numpy()})
        state.save(seconds=clock.elapsed())
        bar.update(len(path), "", clock.left())
    state.progress[key] = len(path)
    if len(path) < calls.count:
        path = path[: max(len(path) // calls.window, 1) * calls.window]
        calls = runner.select(calls, np.arange(len(path)))
    return replace(calls, path=path)


def dense_rounds(runner: Runner, calls: Calls, begin: int = 0, pool: Pool | None = None) -> Iterator[torch.Tensor]:
    """What the dense policy answers to calls, from number ``begin`` on, a round of all workers at a time.

    Yields:
        Paths ``[n, K, T, D]``, in order.
    """
    pool = pool or Here()
    at_once = max(pool.count, torch.get_num_threads()) * TARGETS_AT_ONCE
    work = Work(runner.run_dense, _dense_elsewhere, runner_arguments(runner), threads=True)
    while begin < calls.count:
        end = min(begin + at_once, calls.count)
        parts = [np.arange(i, min(i + TARGETS_AT_ONCE, end)) for i in range(begin, end, TARGETS_AT_ONCE)]
        found = list(pool.map(work, [runner.select(calls, part) for part in parts]))
        begin = end
        yield torch.cat(found)


def inpaints_prefixes(spec: PolicySpec) -> bool:
    """Whether a policy takes prefixes and was not trained to go on from them, which its prologue would be told of."""
    return not spec.trained_prefix and prefix_refusal(spec) is None


def late_calls(runner: Runner, calls: Calls, seed: int) -> Calls:
    """The first of some answered calls once more, with other noise and as a prefix some of the actions executed."""
    spec, count = runner.view.manifest.spec, calls.count // LATE
    initial, noise = draw_noise(spec, count, (seed, 2, 1))
    answers = spec.chunk.executed(calls.targets[:count]).numpy()
    known = known_samples(spec, answers, initial.numpy())
    lengths = np.random.default_rng((seed, 2, 2)).integers(1, answers.shape[1] + 1, (count, 1))
    assert known is not None
    known.values[:, np.arange(answers.shape[1]) >= lengths] = np.nan
    same = runner.select(calls, np.arange(count), consecutive=True)
    return replace(same, initial=initial, noise=noise, path=None, known=known)


def runner_arguments(runner: Runner) -> tuple[str, str, str]:
    """The arguments of ``runner_elsewhere``."""
    return *artifact_arguments(runner.view.artifact), runner.view.variant.loop


def runner_elsewhere(path: str, identity: str, loop: str) -> Runner:
    """The same runner in another process, which may be on another machine."""
    return Runner(view_of(artifact_elsewhere(path, identity), Plan(loop)))


def _dense_elsewhere(path: str, identity: str, loop: str) -> Callable[[Calls], torch.Tensor]:
    runner = runner_elsewhere(path, identity, loop)

    def answer(calls: Calls) -> torch.Tensor:
        with workers() as threads:  # one thread does a part, as here
            return threads.submit(runner.run_dense, calls).result()

    return answer


def draw_calls(
    runner: Runner, episodes: Sequence[Episode], split: Split, limit: int, seed: int, window: int = 1
) -> Calls:
    """The calls to learn from, without targets: at most ``limit`` of them, in windows of so many.

    The seed is that of their choice and of their noise.
    """
    chosen = sample_calls(episodes, split.calibration, limit, seed, REPEATS, window)
    return prepare_calls(runner.model, runner.view.manifest.spec, episodes, chosen, (seed, 2, 0), window)
