"""Speculative steps: a small network drafts some, and the policy checks all of them in one evaluation.

    python examples/evaluation/drafted.py DIR -t calls.npz --drafts 4,8,16

As TS-DP has it (arXiv 2512.15773): a small transformer learns what the policy's network predicts at each step of
recorded calls. In a call it drafts the samples of the next steps, and the network is evaluated at all of them at once
(``falcon.ManySteps``). A draft is taken with a probability that depends on how far its mean is from the one that the
network gives. The first one that is not is replaced, and drafting begins anew there. Its noise is mirrored (arXiv
2501.05370), so that samples have the distribution that they have without drafts, however bad these are. TS-DP learns
from rewards how many steps to draft. Here the number is fixed, and several are tried.

Beside the small network there is a drafter that costs nothing: the last prediction of the network, again. A loop needs
noise in its steps for this, so DIR is of DDPM. Times are of torch on one thread, of the same code with and without.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import click
import numpy as np
import torch
from falcon import ManySteps, output_of
from torch import Tensor, nn

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
from ttscompile.runtimes.reference.sampler import Carried, TorchSampler

WIDTH, HEADS, BATCH, RATE = 64, 4, 256, 2e-3
"""Of the drafter: channels and heads of its one layer, samples of an update, and the learning rate at first."""

Draft = Callable[[Tensor, int, Tensor], Tensor]
"""From a sample ``[1, T, D]``, its step and the network's last prediction to a prediction."""


class Drafter(nn.Module):
    """One layer of a transformer over the tokens of a chunk, which knows the step and the observation.

    Args:
        shape: T and D.
        steps: of the loop.
        features: numbers of the observation.
    """

    def __init__(self, shape: tuple[int, int], steps: int, features: int) -> None:
        super().__init__()
        horizon, channels = shape
        self.embed = nn.Linear(2 * channels, WIDTH)
        self.place = nn.Parameter(torch.zeros(horizon, WIDTH))
        self.time = nn.Embedding(steps, WIDTH)
        self.observe = nn.Linear(features, WIDTH)
        self.layer = nn.TransformerEncoderLayer(WIDTH, HEADS, 2 * WIDTH, 0.0, batch_first=True, norm_first=True)
        self.head = nn.Linear(WIDTH, channels)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, sample: Tensor, k: Tensor, last: Tensor, features: Tensor) -> Tensor:
        """A prediction ``[N, T, D]``: the network's last one, and what has changed."""
        hidden = self.embed(torch.cat([sample, last], 2)) + self.place
        hidden = hidden + (self.time(k) + self.observe(features))[:, None]
        changed: Tensor = self.head(self.layer(hidden))
        return last + changed


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
        seconds: of all calls.
    """

    rounds: int = 0
    rows: int = 0
    drafts: int = 0
    taken: int = 0
    seconds: float = 0.0


class Speculating:
    """The loop of one call, in which steps are drafted and checked.

    Args:
        runner: of the loop.
        many: its network.
        seed: of noise and chance.
    """

    def __init__(self, runner: Runner, many: ManySteps, seed: int) -> None:
        self._table: SamplerTable = runner.view.manifest.spec.sampler
        self._sampler, self._many = TorchSampler(self._table), many
        self._steps, self._draw = self._table.steps, torch.Generator().manual_seed(seed)
        self._model = runner.model

    def call(self, contexts: Contexts, initial: Tensor, draft: Draft, ahead: int, done: Done) -> Tensor:
        """The denoised sample ``[1, T, D]``; drafts ``ahead - 1`` steps after the next one, whose sample is known."""
        begun = perf_counter()
        prediction = output_of(self._model, initial, 0, contexts)
        sample, k = self._noisy(moved_on(self._sampler, initial, prediction, 0), 0), 1
        done.rounds, done.rows = done.rounds + 1, done.rows + 1
        while k < self._steps:
            steps = range(k, min(k + ahead, self._steps))
            samples, means, noises = [sample], list[Tensor](), list[Tensor]()
            for step in steps:
                means.append(moved_on(self._sampler, samples[-1], draft(samples[-1], step, prediction), step))
                noises.append(torch.randn(sample.shape, generator=self._draw))
                samples.append(means[-1] + float(self._table.noise_to_next[step]) * noises[-1])
            found = self._many.outputs(samples[:-1], steps, contexts)
            done.rounds, done.rows = done.rounds + 1, done.rows + len(steps)
            for place, step in enumerate(steps):
                prediction = found[place]
                wanted = moved_on(self._sampler, samples[place], prediction, step)
                chance = float(torch.rand((), generator=self._draw))
                deviation = float(self._table.noise_to_next[step])
                sample, drafted = settled(wanted, means[place], noises[place], deviation, chance)
                k = step + 1
                if deviation:
                    done.drafts, done.taken = done.drafts + 1, done.taken + drafted
                if not drafted:
                    break
        done.seconds += perf_counter() - begun
        return sample

    def plain(self, contexts: Contexts, initial: Tensor, done: Done) -> Tensor:
        """The same without drafts."""
        begun, sample = perf_counter(), initial
        for k in range(self._steps):
            mean = moved_on(self._sampler, sample, output_of(self._model, sample, k, contexts), k)
            sample = self._noisy(mean, k)
        done.rounds, done.rows = done.rounds + self._steps, done.rows + self._steps
        done.seconds += perf_counter() - begun
        return sample

    def _noisy(self, mean: Tensor, k: int) -> Tensor:
        return mean + float(self._table.noise_to_next[k]) * torch.randn(mean.shape, generator=self._draw)


@torch.no_grad()
def predictions(runner: Runner, calls: Calls) -> tuple[Tensor, Tensor]:
    """Samples and predictions at each step of dense calls, ``[K, N, T, D]`` both."""
    model, sampler, carried = runner.model, runner.model.sampler, runner.model.sampler.begin(calls.initial)
    samples, found = list[Tensor](), list[Tensor]()
    for k in range(model.steps):
        samples.append(carried.sample)
        found.append(output_of(model, carried.sample, k, calls.contexts))
        carried = Carried(*sampler.advance(carried, found[-1], None if calls.noise is None else calls.noise[k], k))
    return torch.stack(samples), torch.stack(found)


def trained(runner: Runner, calls: Calls, ahead: int, updates: int, seed: int) -> Drafter:
    """A drafter that learned from dense calls what the network says up to so many steps after its last prediction."""
    samples, found = predictions(runner, calls)
    features = runner.model.condition(calls.contexts)
    steps, count = samples.shape[:2]
    torch.manual_seed(seed)
    drafter = Drafter((samples.shape[2], samples.shape[3]), steps, features.shape[1])
    optimizer = torch.optim.AdamW(drafter.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(1, updates))
    for _ in range(updates):
        k, call = torch.randint(1, steps, (BATCH,)), torch.randint(count, (BATCH,))
        before = (k - torch.randint(1, ahead + 1, (BATCH,))).clamp(min=0)
        wrong = drafter(samples[k, call], k, found[before, call], features[call]) - found[k, call]
        loss = wrong.square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return drafter.eval()


@dataclass(frozen=True)
class Row:
    """One drafter, and how many steps are checked at once.

    Attributes:
        ahead: steps; 1 is the loop without drafts.
        taken: share of the drafts.
        rounds: evaluations of the network in a call, of several rows each.
        rows: of these, in a call.
        ms: of a call in torch.
    """

    drafter: str
    ahead: int
    taken: float
    rounds: float
    rows: float
    ms: float


@torch.no_grad()
def measured(runner: Runner, calls: Calls, drafter: Drafter, ahead: Sequence[int], seed: int) -> list[Row]:
    """The loop without drafts, and each drafter with each number of steps, on the same calls in turn."""
    many, features = ManySteps(runner.view), runner.model.condition(calls.contexts)
    ways = [("none", 1), *((name, count) for name in ("the last prediction", "a small network") for count in ahead)]
    done = [Done() for _ in ways]
    loops = [Speculating(runner, many, seed) for _ in ways]
    for number in range(calls.count):
        one = runner.select(calls, [number])

        def small(sample: Tensor, k: int, last: Tensor, own: Tensor = features[number : number + 1]) -> Tensor:
            found: Tensor = drafter(sample, torch.tensor([k]), last, own)
            return found

        for (name, count), loop, told in zip(ways, loops, done, strict=True):
            if name == "none":
                loop.plain(one.contexts, one.initial, told)
            else:
                loop.call(one.contexts, one.initial, small if name == "a small network" else _last, count, told)
    return [_row(name, count, told, calls.count) for (name, count), told in zip(ways, done, strict=True)]


def _last(sample: Tensor, k: int, last: Tensor) -> Tensor:
    return last


def _row(name: str, ahead: int, done: Done, calls: int) -> Row:
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
    rows = measured(runner, given[1], drafter, drafts, seed)
    if as_json:
        print_json({"calls": given[1].count, "rows": [asdict(row) for row in rows]})
        return
    told = table("drafter", "at once", "drafts taken", "evaluations", "rows", "ms a call")
    for row in rows:
        counts = (f"{row.taken:.1%}" if row.ahead > 1 else "", f"{row.rounds:.1f}", f"{row.rows:.1f}", f"{row.ms:.0f}")
        told.add_row(row.drafter, str(row.ahead), *counts)
    results_console().print(told)
    say(results_console(), f"{given[1].count} calls of episodes that nothing was learned from, each of one stream.")


if __name__ == "__main__":
    run(main)
