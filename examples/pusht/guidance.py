"""Real-time chunking on Push-T: guidance to the chunk before, beside the prefix of a compiled policy.

    python examples/pusht/guidance.py DIR:dense --checkpoint examples/policies/flow/policy --ticks 2,5

As in ``delays.py`` the world goes on while a call computes, and a call takes as many ticks as it is told to. Three ways
to begin the next chunk are played on the same seeds with the same noise: ``replace`` (it knows nothing of the one
before), ``prefix`` (the actions that are executed meanwhile are kept) and guidance, which pulls the prediction of every
denoising step towards what is left of the chunk before. Guidance needs the network itself, and runs in PyTorch.

Guidance: real-time chunking (Black et al., arXiv 2506.07339), after pseudoinverse guidance (Song et al., ICLR 2023).
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.cli.contestants import original_policy
from ttscompile.cli.output import manifest_of, print_identity
from ttscompile.frontends.eager import evaluation
from ttscompile.runtimes.inpainting import noise_levels

sys.path.append(str(Path(__file__).resolve().parents[1] / "evaluation"))
from bootstrap import estimate
from delays import SEEDS_A_JOB, Figures, figures, several
from delays_world import Driven, Setup, drive
from environments import Array
from environments.pusht import PushT
from evaluate import Evaluation, summarise
from rollout import Rollout, run_episodes
from variants import Variant, first_seed_option, open_variant, results_console, run, seeded_noise


@dataclass(frozen=True)
class Guidance:
    """How strongly, and through what, predictions are pulled.

    Attributes:
        largest: weight of the correction at most; it is without bound at the first step.
        exponential: whether weights of actions that are not committed fall exponentially; evenly otherwise.
        through: whether the error of the prediction goes back through the network; otherwise it is added as it is.
    """

    largest: float
    exponential: bool
    through: bool

    def weights(self, committed: int, left: int) -> torch.Tensor:
        """Of what is left of the chunk before, ``[left, 1]``: 1 for the committed actions, then falling to 0."""
        free = left - committed
        falling = torch.arange(free, 0, -1) / (free + 1)
        if self.exponential:
            falling = falling * torch.expm1(falling) / float(np.expm1(1.0))
        return torch.cat([torch.ones(committed), falling])[:, None]

    def strength(self, signal: float, deviation: float) -> float:
        """Weight of the correction where a sample is ``signal * actions + deviation * noise``."""
        if signal <= 0:
            return self.largest
        return min(self.largest, (signal**2 + deviation**2) / (signal * deviation))


COMMITTED = 4
"""Actions that a call is given when it is timed."""

WAYS = {
    "published": Guidance(largest=5.0, exponential=True, through=True),
    "lerobot": Guidance(largest=10.0, exponential=False, through=False),
}
"""The paper's, and what LeRobot 0.6.1 computes by default: it evaluates the network before it asks for gradients, so
that none go through it."""

SEAMS = ("replace", "prefix", *WAYS)
"""How a chunk may begin."""


class GuidedPolicy:
    """A flow-matching policy in PyTorch whose chunks are guided to what is left of the chunk before.

    Args:
        checkpoint: of the policy.
        directory: the artifact that was made from it.
        info: of the compiled policy; an executor asks it.
        guidance: how.

    Raises:
        ValueError: the policy is not one of flow matching by Euler's method.
    """

    def __init__(self, checkpoint: Path, directory: Path, info: Any, guidance: Guidance) -> None:
        self.info, self._guidance = info, guidance
        self._module, self._spec = original_policy(checkpoint, load_artifact(directory).manifest.spec)
        self._module.requires_grad_(False)
        levels, table = noise_levels(self._spec.sampler), self._spec.sampler
        if levels is None or not (table.sample_to_x0 == 1).all() or table.memories:
            raise ValueError(f"{checkpoint}: guidance takes flow matching by Euler's method; found {table.name}.")
        self._levels = list(zip(*(level.tolist() for level in levels), strict=True))
        self._before: torch.Tensor | None = None

    def reset(self) -> None:
        """A new episode: there is no chunk before."""
        self._before = None

    def predict_action(
        self, obs_dict: Mapping[str, Any], noise: ttscompile.Noise, plan: str = "dense", prefix: Array | None = None
    ) -> dict[str, Array]:
        """Windows of one robot in, as a compiled policy takes them; ``prefix [1, N, Da]``: what is committed.

        Returns:
            ``action [1, Ta, Da]`` and ``action_pred [1, T, Da]``.
        """
        spec, chunk = self._spec, self._spec.chunk
        given = {key: torch.from_numpy(one.normalized(obs_dict[key])) for key, one in spec.observations.items()}
        sample = self._denoised(evaluation(self._module, spec, given), torch.from_numpy(noise.initial), prefix)
        self._before = sample[:, chunk.start :]
        actions = chunk.unnormalized(sample.numpy())
        return {"action": actions[:, chunk.start : chunk.stop], "action_pred": actions}

    def _left(self, prefix: Array | None) -> torch.Tensor | None:
        """What is left of the chunk before, normalised ``[1, left, D]``, from the first committed action on."""
        if prefix is None or not prefix.shape[1] or self._before is None:
            return None
        known, count = self._spec.chunk.unnormalized(self._before.numpy()), prefix.shape[1]
        for begin in range(known.shape[1] - count + 1):
            if np.allclose(known[:, begin : begin + count], prefix, atol=1e-3):
                return self._before[:, begin:]
        return None  # actions of two chunks, or one that was held

    def _denoised(self, evaluate: Any, sample: torch.Tensor, prefix: Array | None) -> torch.Tensor:
        """The loop; see ``ttscompile.frontends.eager``."""
        left, table, start = self._left(prefix), self._spec.sampler, self._spec.chunk.start
        for k, (signal, deviation) in enumerate(self._levels):
            guided = left is not None and self._guidance.through
            sample = sample.detach().requires_grad_(guided)
            with torch.set_grad_enabled(guided):
                out = evaluate(sample, torch.from_numpy(table.timesteps)[k].expand(len(sample)))
                x0 = sample + float(table.out_to_x0[k]) * out
            if left is not None and prefix is not None:
                error = torch.zeros_like(sample)
                wanted = left - x0[:, start : start + left.shape[1]].detach()
                error[:, start : start + left.shape[1]] = wanted * self._guidance.weights(
                    prefix.shape[1], left.shape[1]
                )
                pull = torch.autograd.grad(x0, sample, error)[0] if guided else error
                towards = float(np.sign(table.out_to_x0[k]))
                out = out.detach() + towards * self._guidance.strength(signal, deviation) * pull
                x0 = sample.detach() + float(table.out_to_x0[k]) * out
            to_next = (table.x0_to_next[k], x0), (table.sample_to_next[k], sample), (table.out_to_next[k], out)
            sample = sum((float(weight) * term.detach() for weight, term in to_next), torch.zeros(()))
        return sample


@dataclass(frozen=True)
class Way:
    """One way to play.

    Attributes:
        variant: artifact and plan, as ``open_variant`` takes them.
        seam: ``replace``, ``prefix``, or a name of ``WAYS``.
        ticks: that a call takes.
        horizon: actions from one call to the next.
    """

    variant: str
    seam: str
    ticks: float
    horizon: int

    def setup(self, hz: float = 10.0) -> Setup:
        """For the executor."""
        seam = "prefix" if self.seam in WAYS else self.seam
        return Setup(1e3 * self.ticks / hz, seam, 0, self.horizon, hz)


@lru_cache
def opened(text: str, seam: str, checkpoint: Path) -> Variant:
    """The policy of a way, once a process."""
    variant = open_variant(text, "onnxruntime", 1)
    if seam not in WAYS:
        return variant
    torch.set_num_threads(1)
    policy: Any = GuidedPolicy(checkpoint, Path(text.partition(":")[0]), variant.policy.info, WAYS[seam])
    return replace(variant, policy=policy, plan="dense")


def play(way: Way, checkpoint: Path, seeds: Sequence[int]) -> list[Driven]:
    """Some episodes."""
    return [drive(PushT, opened(way.variant, way.seam, checkpoint), way.setup(), seed) for seed in seeds]


def roughness(rollout: Sequence[Driven]) -> list[float]:
    """Mean length of the second difference of executed actions, an episode each: pixels a tick a tick."""
    return [float(np.linalg.norm(np.diff(one.episode.actions, n=2, axis=0), axis=-1).mean()) for one in rollout]


@click.command()
@click.argument("variant", metavar="DIR[:PLAN]")
@click.option(
    "--checkpoint", required=True, type=click.Path(exists=True, path_type=Path), help="What DIR was made from."
)
@click.option("--sparse", metavar="DIR[:PLAN]", help="Another plan of the policy, played with the seam prefix.")
@click.option("--seams", default=",".join(SEAMS), show_default=True, callback=several(str), help="Played with DIR.")
@click.option("--ticks", default="2,5", show_default=True, callback=several(float), help="That a call takes.")
@click.option("--horizon", default=8, show_default=True, help="Actions from one call to the next.")
@click.option("--episodes", default=100, show_default=True, type=click.IntRange(2))
@first_seed_option
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(1), help="Processes, of one thread each.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document instead of a table.")
def main(
    variant: str,
    checkpoint: Path,
    sparse: str | None,
    seams: list[str],
    ticks: list[float],
    horizon: int,
    episodes: int,
    first_seed: int,
    jobs: int,
    as_json: bool,
) -> None:
    """Play the policy of DIR with calls that take time, and say what each way to begin a chunk costs."""
    seeds = range(first_seed, first_seed + episodes)
    if "prefix" not in seams or not set(seams) <= set(SEAMS):
        raise click.BadParameter(f"expected prefix, which all are compared with, and others of {SEAMS}; found {seams}.")
    played_with = [(variant, seam) for seam in seams] + ([(sparse, "prefix")] if sparse else [])
    ways = [Way(text, seam, each, horizon) for each in ticks for text, seam in played_with]
    found: dict[tuple[Way, int], Driven] = {}
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("episodes", total=len(ways) * episodes)
        with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
            parts = [(way, seeds[i : i + SEEDS_A_JOB]) for way in ways for i in range(0, episodes, SEEDS_A_JOB)]
            running = {pool.submit(play, way, checkpoint, some): way for way, some in parts}
            for future in as_completed(running):
                found |= {(running[future], driven.episode.seed): driven for driven in future.result()}
                progress.update(task, completed=len(found))
    waiting = run_episodes(PushT, open_variant(variant, "onnxruntime", 1), seeds, SEEDS_A_JOB)
    baseline = summarise("the world waits", waiting, waiting)
    played = {way: [found[way, seed] for seed in seeds] for way in ways}
    rows = {way: figures(way.setup(), each, prefixed(played, way, variant)) for way, each in played.items()}
    times = milliseconds([opened(text, seam, checkpoint) for text, seam in played_with])
    if as_json:
        told = [
            {**vars(way), **one.to_json(), "roughness": roughness(played[way]), "ms": times[i % len(times)]}
            for i, (way, one) in enumerate(rows.items())
        ]
        click.echo(json.dumps({"baseline": baseline.to_json(), "ways": told}, indent=2, allow_nan=False))
        return
    console = results_console()
    console.print(shown(rows, {way: roughness(each) for way, each in played.items()}, times, baseline))
    print_identity(manifest_of(Path(variant.partition(":")[0])).identity, console)


def prefixed(played: Mapping[Way, Sequence[Driven]], way: Way, variant: str) -> Rollout:
    """What the others are compared with: the same policy and ticks with the seam prefix."""
    same = played[replace(way, variant=variant, seam="prefix")]
    return Rollout(tuple(one.episode for one in same), ())


def milliseconds(variants: Sequence[Variant], calls: int = 20) -> list[float]:
    """Median time of a call that is given the actions before it, on one thread; the policies take turns."""
    spent: list[list[float]] = [[] for _ in variants]
    draw = np.random.default_rng(0)
    obs = {key: one.draw(draw) for key, one in variants[0].policy.info.observation.items()}
    before: list[Array | None] = [None] * len(variants)
    for one in variants:
        one.policy.reset()
    for number in range(calls + 3):  # two warm up, and the first has nothing before it
        for i, variant in enumerate(variants):
            known, start = before[i], time.perf_counter()
            given: Any = {} if known is None else {"prefix": known}
            noise = seeded_noise(variant.noise, [0], number)
            made = variant.policy.predict_action(obs, noise=noise, plan=variant.plan, **given)
            spent[i].append(1e3 * (time.perf_counter() - start))
            before[i] = np.ascontiguousarray(made["action"][:, -COMMITTED:])
    return [float(np.median(each[3:])) for each in spent]


def shown(
    rows: Mapping[Way, Figures], rough: Mapping[Way, Sequence[float]], times: Sequence[float], baseline: Evaluation
) -> Table:
    """A row for each way, and the world that waits first; ``times`` of the ways of one number of ticks, in order."""
    count = len(baseline.rollout.episodes)
    table = Table(title=f"Push-T, {count} paired episodes, mean and 95 % interval; differences from the prefix")
    columns = ("ticks a call", "seam", "score", "difference", "success", "difference", "roughness, px", "still", "ms")
    for column in columns:
        table.add_column(column, justify="left" if column == "seam" else "right")
    table.add_row("", "the world waits", str(baseline.score), "", f"{baseline.success.mean:.3f}")
    for i, (way, one) in enumerate(rows.items()):
        table.add_row(
            f"{way.ticks:g}",
            f"{way.seam}, {Path(way.variant).name}",
            str(one.evaluation.score),
            str(one.evaluation.score_difference),
            f"{one.evaluation.success.mean:.3f}",
            str(one.evaluation.success_difference),
            str(estimate(rough[way])),
            f"{one.still:.1%}",
            f"{times[i % len(times)]:.1f}",
        )
    return table


if __name__ == "__main__":
    run(main)
