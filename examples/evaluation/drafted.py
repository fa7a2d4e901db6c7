"""Speculative steps: a small network drafts some, and the policy checks all of them in one evaluation.

    python examples/evaluation/drafted.py DIR -t calls.npz --drafts 4,8,16

As TS-DP has it (arXiv 2512.15773): a small transformer learns what the policy's network predicts at each step of
recorded calls. In a call it drafts the samples of the next steps, and the network is evaluated at all of them at once
(``falcon.ManySteps``). A draft is taken with a probability that depends on how far its mean is from the one that the
network gives. The first one that is not is replaced, and drafting begins anew there. Its noise is mirrored (arXiv
2501.05370), so that samples have the distribution that they have without drafts, however bad these are. TS-DP learns
from rewards how many steps to draft. Here the number is fixed, and several are tried; and the small network's drafts
are as many as the last round says, as the step says, or as will be taken, which nobody can know (``draft_lengths``).

Beside the small network there is a drafter that costs nothing: the last prediction of the network, again. A loop needs
noise in its steps for this, so DIR is of DDPM. Times are the processor's, of torch on one thread, of the same code with
and without. All have the same noise, and chance, at each step of a call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import click
import numpy as np
import torch
from draft_lengths import Ahead, Place, after_the_last, by_step, fixed, that_will_be_taken
from drafter import Drafter, trained
from falcon import ManySteps, output_of
from torch import Tensor

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import FRACTION, Calls, load_episodes, prepare_calls, sample_calls, split_episodes
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.targets import REPEATS
from ttscompile.calibration.trials import base_of
from ttscompile.cli.options import count_option, json_option
from ttscompile.cli.output import print_json, progress, results_console, run, say, table
from ttscompile.cli.sections import SectionedCommand, Sources, trajectories_options
from ttscompile.core.spec import SamplerTable
from ttscompile.errors import CalibrationError
from ttscompile.runtimes.reference.model import Contexts
from ttscompile.runtimes.reference.sampler import TorchSampler

TIMED, TOLD = 2, 16
"""Calls that rounds of each length are timed on, and those whose rounds say how far they go."""

Draft = Callable[[Tensor, int, Tensor], Tensor]
"""From a sample ``[1, T, D]``, its step and the network's last prediction to a prediction."""


def moved_on(sampler: TorchSampler, sample: Tensor, prediction: Tensor, k: int) -> Tensor:
    """The mean of the next sample."""
    carried = sampler.begin(sample)
    return sampler.advance(carried, prediction, torch.zeros_like(sample), k).sample


def settled(wanted: Tensor, drafted: Tensor, noise: Tensor, deviation: float, chance: float) -> tuple[Tensor, bool]:
    """The next sample, distributed about the wanted mean, and whether it is the draft.

    The draft is ``drafted + deviation * noise``. It is taken with the probability that makes both distributions as
    alike as can be; otherwise its noise is mirrored on the plane between both means.

    Args:
        wanted: mean that the network gives, ``[1, T, D]``.
        drafted: mean of the draft.
        noise: standard normal.
        deviation: of both; 0 where a step draws no noise, whose sample is the wanted one.
        chance: uniform from 0 to 1.
    """
    if deviation == 0:
        return wanted, bool(torch.equal(wanted, drafted))
    apart = (drafted - wanted) / deviation
    likelier = (noise**2).sum() - ((noise + apart) ** 2).sum()  # twice the logarithm of their ratio
    if np.log(chance) <= min(0.0, float(likelier) / 2):
        return drafted + deviation * noise, True
    way = apart / apart.norm()
    return wanted + deviation * (noise - 2 * (way * noise).sum() * way), False


@dataclass
class Done:
    """What calls took.

    Attributes:
        rounds: evaluations of the network, of any number of rows.
        rows: all of these.
        drafts: that were checked.
        taken: of them.
        seconds: of the processor, of all calls.
        gone: by step, how many steps each round went on that began there.
    """

    rounds: int = 0
    rows: int = 0
    drafts: int = 0
    taken: int = 0
    seconds: float = 0.0
    gone: dict[int, list[int]] = field(default_factory=dict)


@dataclass(frozen=True)
class Drawn:
    """What is drawn for one call, so that it is the same however its steps are drafted.

    Attributes:
        noise: standard normal, ``[K, 1, T, D]``.
        chance: uniform from 0 to 1, ``[K]``.
    """

    noise: Tensor
    chance: Tensor

    @classmethod
    def of(cls, steps: int, sample: Tensor, seed: int) -> Drawn:
        """For so many steps of a sample ``[1, T, D]``."""
        draw = torch.Generator().manual_seed(seed)
        return cls(torch.randn(steps, *sample.shape, generator=draw), torch.rand(steps, generator=draw))


class Checked(NamedTuple):
    """After a round of drafts: the sample before step k, the network's last prediction, and how many drafts it took."""

    sample: Tensor
    k: int
    prediction: Tensor
    taken: int


class Speculating:
    """The loop of one call, in which steps are drafted and checked.

    Args:
        runner: of the loop.
        many: its network.
    """

    def __init__(self, runner: Runner, many: ManySteps) -> None:
        self._table: SamplerTable = runner.view.manifest.spec.sampler
        self._sampler, self._many = TorchSampler(self._table), many
        self._steps, self._model = self._table.steps, runner.model
        self._deviations: list[float] = self._table.noise_to_next.tolist()

    def call(self, contexts: Contexts, initial: Tensor, draft: Draft, ahead: Ahead, drawn: Drawn, done: Done) -> Tensor:
        """The denoised sample; a round checks the next step, whose sample is known, and drafts after it."""
        begun = process_time()
        prediction = output_of(self._model, initial, 0, contexts)
        mean = moved_on(self._sampler, initial, prediction, 0)
        at = Checked(mean + self._deviations[0] * drawn.noise[0], 1, prediction, 0)
        done.seconds += process_time() - begun
        done.rounds, done.rows, asked, gone = done.rounds + 1, done.rows + 1, 0, 0
        while at.k < self._steps:
            left = self._steps - at.k

            def checked(count: int, at: Checked = at, left: int = left) -> Checked:
                return self._round(contexts, at, draft, range(at.k, at.k + min(count, left)), drawn)

            def peek(count: int, checked: Callable[[int], Checked] = checked, k: int = at.k) -> int:
                return checked(count).k - k

            asked = min(left, ahead(Place(at.k, asked, gone, peek)))
            begun, after = process_time(), checked(asked)
            done.seconds += process_time() - begun
            gone = after.k - at.k
            done.gone.setdefault(at.k, []).append(gone)
            done.rounds, done.rows = done.rounds + 1, done.rows + asked
            done.drafts += sum(self._deviations[k] > 0 for k in range(at.k, after.k))
            done.taken, at = done.taken + after.taken, after
        return at.sample

    def _round(self, contexts: Contexts, at: Checked, draft: Draft, steps: range, drawn: Drawn) -> Checked:
        """Draft the samples after these steps, and check them."""
        samples, means, prediction, taken = [at.sample], list[Tensor](), at.prediction, 0
        for step in steps:
            means.append(moved_on(self._sampler, samples[-1], draft(samples[-1], step, prediction), step))
            samples.append(means[-1] + self._deviations[step] * drawn.noise[step])
        found, sample = self._many.outputs(samples[:-1], steps, contexts), at.sample
        for place, step in enumerate(steps):
            prediction, deviation = found[place], self._deviations[step]
            wanted = moved_on(self._sampler, samples[place], prediction, step)
            chance = float(drawn.chance[step])
            sample, drafted = settled(wanted, means[place], drawn.noise[step], deviation, chance)
            taken += drafted and deviation > 0
            if not drafted:
                break
        return Checked(sample, step + 1, prediction, taken)

    def plain(self, contexts: Contexts, initial: Tensor, drawn: Drawn, done: Done) -> Tensor:
        """The same without drafts."""
        begun, sample = process_time(), initial
        for k in range(self._steps):
            mean = moved_on(self._sampler, sample, output_of(self._model, sample, k, contexts), k)
            sample = mean + self._deviations[k] * drawn.noise[k]
        done.rounds, done.rows = done.rounds + self._steps, done.rows + self._steps
        done.seconds += process_time() - begun
        return sample


@dataclass(frozen=True)
class Row:
    """One drafter, and how many steps are checked at once.

    Attributes:
        ahead: how many steps a round checks.
        taken: share of the drafts.
        rounds: evaluations of the network in a call, of several rows each.
        rows: of these, in a call.
        ms: of a call in torch.
    """

    drafter: str
    ahead: str
    taken: float
    rounds: float
    rows: float
    ms: float


@torch.no_grad()
def measured(
    runner: Runner, calls: Calls, drafter: Drafter, ahead: Sequence[int], learned: Calls, seed: int
) -> list[Row]:
    """The loop without drafts, and each drafter with each way to say how many, on the same calls in turn."""
    loop, features = Speculating(runner, ManySteps(runner.view)), runner.model.condition(calls.contexts)
    most = max(ahead)
    counts = {str(count): fixed(count) for count in ahead}
    schedulers = {
        "as the last round says": after_the_last(most),
        "as the step says": rounds_of(loop, runner, learned, drafter, (1, *ahead), seed),
        "as will be taken": that_will_be_taken(most),
    }
    ways = [("none", "1", fixed(1)), *(("the last prediction", *one) for one in counts.items())]
    ways += [("a small network", *one) for one in (counts | schedulers).items()]
    done = [Done() for _ in ways]
    for number in range(calls.count):
        one, small = runner.select(calls, [number]), drafting(drafter, features[number : number + 1])
        drawn = Drawn.of(runner.model.steps, one.initial, seed + number)
        for (name, _, said), told in zip(ways, done, strict=True):
            if name == "none":
                loop.plain(one.contexts, one.initial, drawn, told)
            else:
                draft = small if name == "a small network" else _last
                loop.call(one.contexts, one.initial, draft, said, drawn, told)
    return [_row(name, count, told, calls.count) for (name, count, _), told in zip(ways, done, strict=True)]


def rounds_of(
    loop: Speculating, runner: Runner, calls: Calls, drafter: Drafter, counts: Sequence[int], seed: int
) -> Ahead:
    """What rounds of other calls say about each step: how far the longest went, and what those of each length took."""
    features, gone, seconds = runner.model.condition(calls.contexts), Done().gone, dict[int, float]()
    for number in range(calls.count):
        one, small = runner.select(calls, [number]), drafting(drafter, features[number : number + 1])
        drawn = Drawn.of(runner.model.steps, one.initial, seed - 1 - number)
        for count in sorted(counts) if number < TIMED else (max(counts),):
            told = Done()
            loop.call(one.contexts, one.initial, small, fixed(count), drawn, told)
            seconds[count] = min(seconds.get(count, np.inf), told.seconds / told.rounds)
        for step, some in told.gone.items():  # of the longest rounds
            gone.setdefault(step, []).extend(some)
    return by_step(gone, seconds)


def drafting(drafter: Drafter, features: Tensor) -> Draft:
    """The small network, for an observation."""

    def small(sample: Tensor, k: int, last: Tensor) -> Tensor:
        found: Tensor = drafter(sample, torch.tensor([k]), last, features)
        return found

    return small


def _last(sample: Tensor, k: int, last: Tensor) -> Tensor:
    return last


def _row(name: str, ahead: str, done: Done, calls: int) -> Row:
    taken = done.taken / done.drafts if done.drafts else 0.0
    return Row(name, ahead, taken, done.rounds / calls, done.rows / calls, 1000 * done.seconds / calls)


def _several(_: click.Context, __: click.Parameter, value: str) -> tuple[int, ...]:
    parts = value.split(",")
    if not all(part.isdecimal() and int(part) > 1 for part in parts):
        raise click.BadParameter(f"{value!r}: expected whole numbers from 2 on with commas between them.")
    return tuple(int(part) for part in parts)


@click.command(cls=SectionedCommand, context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, file_okay=False, path_type=Path))
@trajectories_options()
@click.option("--drafts", default="4,8,16", callback=_several, help="Check so many steps at once.")
@count_option("--learned", "Calls that the drafter learns from, at most.", default=256)
@count_option("--calls", "Calls to judge on, at most.", default=32)
@count_option("--updates", "Of the drafter.", default=2000)
@click.option("--seed", default=0, help="Of the division of the episodes, the calls, the noise and the drafter.")
@json_option
def main(
    directory: Path,
    trajectories: Sequence[Path],
    sources: Sources,
    drafts: tuple[int, ...],
    learned: int,
    calls: int,
    updates: int,
    seed: int,
    as_json: bool,
) -> None:
    """Measure it for the policy of the artifact in DIRECTORY."""
    torch.set_num_threads(1)
    artifact = load_artifact(directory)
    runner = Runner(view_of(artifact, base_of(artifact).exact))
    spec = runner.view.manifest.spec
    if not spec.sampler.stochastic or spec.sampler.memories:
        raise CalibrationError(f"{directory}: its loop draws no noise in its steps. Convert it with --sampler ddpm.")
    episodes = load_episodes(spec, trajectories, sources)
    split = split_episodes(len(episodes), FRACTION, seed)
    given: list[Any] = []
    for stage, (numbers, most) in enumerate(((split.calibration, learned), (split.validation, calls))):
        chosen = sample_calls(episodes, numbers, most, seed, REPEATS)
        given.append(prepare_calls(runner.model, spec, episodes, chosen, (seed, 23, stage)))
    say(progress(), f"a drafter learns from {given[0].count} calls")
    drafter = trained(runner, given[0], max(drafts), updates, seed)
    told_by = runner.select(given[0], range(min(TOLD, given[0].count)))
    rows = measured(runner, given[1], drafter, drafts, told_by, seed)
    if as_json:
        print_json({"calls": given[1].count, "rows": [asdict(row) for row in rows]})
        return
    told = table("drafter", "at once", "drafts taken", "evaluations", "rows", "ms a call")
    for row in rows:
        taken = "" if row.drafter == "none" else f"{row.taken:.1%}"
        told.add_row(row.drafter, row.ahead, taken, f"{row.rounds:.1f}", f"{row.rows:.1f}", f"{row.ms:.0f}")
    results_console().print(told)
    say(results_console(), f"{given[1].count} calls of episodes that nothing was learned from, each of one stream.")


if __name__ == "__main__":
    run(main)
