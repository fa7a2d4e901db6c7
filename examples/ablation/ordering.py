"""Which tokens of a new frame are computed: does anything order them better than how much their patches differ?

    python examples/ablation/ordering.py DIR --trajectories calls.npz --camera observation.images.wrist

Consecutive calls of recorded episodes compute as many tokens of one camera's frames, chosen in several ways; the other
cameras are computed whole. What is executed is compared with what it is with all tokens, and the same noise. What has
to be learned is learned on other episodes. Nothing is written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
import torch
from kept_tokens import TokenPolicy
from orders import CALLS, Chains, Orders

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.calibration.calls import FRACTION, load_episodes, split_episodes
from ttscompile.calibration.progress import Bar, Progress
from ttscompile.calibration.trials import base_of
from ttscompile.cli.output import print_json, results_console, run, say, table
from ttscompile.cli.sections import SectionedCommand, Sources, trajectories_options
from ttscompile.core.coercion import integer
from ttscompile.errors import CalibrationError
from ttscompile.trajectories.episodes import Episode

Errors = npt.NDArray[np.float64]

TOGETHER = 16
"""Stretches of calls that are learned from at once."""
RESAMPLED = 2000
"""Samples of the bootstrap over episodes."""
WAYS = {
    "chance": "chance",
    "difference": "how much the patch differs",
    "importance": "the same times the patch's importance",
    "head": "a learned head",
    "found": "importance; the others from where their patch was",
    "similar": "how much the patch differs; the others from a similar one that is computed, as plans do",
    "merged": "importance; the others from a similar one that is computed",
    "effect": "the effect in this very call, after the fact",
}
EIGHTHS = (1, 2, 4)
"""Of a frame's tokens are computed."""
FIRST = "difference"
"""The way that others are held against."""


@dataclass(frozen=True)
class Row:
    """What a way does.

    Attributes:
        way: what tokens are ordered by.
        size: how many tokens are computed of a frame.
        error: mean, in units of what other noise does; and the median over calls.
        less: share of the error of ``FIRST`` that is saved, and its 95 % interval over episodes.
    """

    way: str
    size: int
    error: float
    median: float
    less: tuple[float, float, float]


@dataclass(frozen=True)
class Ordering:
    """What was found.

    Attributes:
        rows: of all ways, for each number of tokens.
        tokens: of a frame.
        stretches: of ``CALLS`` calls that orders were learned on, and that were judged.
        flops: of the head for a frame, as a share of the prologue's.
    """

    rows: tuple[Row, ...]
    tokens: int
    stretches: tuple[int, int]
    flops: float


def ordering(
    path: Path,
    trajectories: Sequence[Path],
    camera: str,
    *,
    observation: Sources | None = None,
    ways: Sequence[str] = tuple(WAYS),
    eighths: Sequence[int] = EIGHTHS,
    learned: int = 160,
    judged: int = 64,
    seed: int = 0,
    progress: Progress = lambda what, done, total: None,
) -> Ordering:
    """Measure it. Nothing is written.

    Args:
        trajectories: recorded episodes, see ``ttscompile.trajectories``.
        camera: the observation whose tokens are chosen.
        observation: see ``ttscompile.calibrate``.
        ways: some of ``WAYS``, beside ``FIRST``.
        eighths: for how many of these of its tokens a frame is computed.
        learned: stretches of calls that are learned from, at most.
        judged: those of other episodes, at most.
        seed: of the division of the episodes, the noise and the head.

    Raises:
        CalibrationError: arguments out of range, or episodes that are too short.
        TrajectoryError: the recordings do not fit the policy.
        ArtifactError: the artifact cannot be opened.
    """
    seed = integer(seed, "seed", CalibrationError)
    artifact = load_artifact(path)
    policy = TokenPolicy(view_of(artifact, base_of(artifact).exact))
    if camera not in policy.cameras:
        raise CalibrationError(f"camera: expected one of {', '.join(policy.cameras)}; found {camera!r}.")
    number, spec = policy.cameras.index(camera), policy.spec
    episodes = [one for one in load_episodes(spec, trajectories, observation) if one.calls >= CALLS]
    if len(episodes) < 2:
        raise CalibrationError(
            f"expected two episodes of {CALLS} calls at least; found {len(episodes)}. Record more: about a hundred are"
            " enough."
        )
    split, draw = split_episodes(len(episodes), FRACTION, seed), np.random.default_rng((seed, 15))

    def chains(numbers: Sequence[int], limit: int) -> list[tuple[Episode, int]]:
        """Some episodes, and a call of each that the next ones follow."""
        places = [(episodes[n], first) for n in numbers for first in range(0, episodes[n].calls - CALLS + 1, CALLS)]
        return [places[i] for i in draw.permutation(len(places))[:limit]]

    own, others = chains(split.calibration, learned), chains(split.validation, judged)
    of = np.unique([id(episode) for episode, _ in others], return_inverse=True)[1]
    told = []
    for begin in range(0, len(own), TOGETHER):
        progress("effects of tokens", begin, len(own))
        told.append(Chains(policy, number, own[begin : begin + TOGETHER], seed + begin).effects(seed + begin))
    orders = Orders(
        policy.tower.grid,
        [each for one in told for each in one[0]],
        torch.cat([one[1] for one in told]),
        torch.cat([one[2] for one in told]),
        seed,
    )
    judging, sizes = Chains(policy, number, others, seed), [-(-policy.tower.tokens * one // 8) for one in eighths]
    unit, rows = judging.other_noise(seed), []
    asked = [(size, way) for size in sizes for way in dict.fromkeys([FIRST, *ways])]
    errors = dict[tuple[int, str], Errors]()
    for done, (size, way) in enumerate(asked):
        progress("orders of tokens", done, len(asked))
        errors[size, way] = judging.errors(way, size - policy.tower.fixed, orders, seed) / unit
        rows.append(_row(way, size, errors[size, way], errors[size, FIRST], of, seed))
    progress("orders of tokens", len(asked), len(asked))
    share = orders.head.flops / artifact.manifest.flops.prologue
    return Ordering(tuple(rows), policy.tower.tokens, (len(own), len(others)), share)


def _row(way: str, size: int, errors: Errors, first: Errors, episodes: npt.NDArray[np.int64], seed: int) -> Row:
    """Of errors ``[N, CALLS - 1]``, and the episode of each N."""
    sums = np.stack([np.bincount(episodes, one.sum(1)) for one in (errors, first)])
    drawn = np.random.default_rng((seed, 16)).integers(0, sums.shape[1], (RESAMPLED, sums.shape[1]))
    own, theirs = sums[:, drawn].sum(2)
    low, high = np.quantile(1 - own / theirs, (0.025, 0.975))
    less = float(1 - errors.sum() / first.sum()), float(low), float(high)
    return Row(way, size, float(errors.mean()), float(np.median(errors)), less)


@click.command(cls=SectionedCommand, context_settings={"show_default": True})
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@trajectories_options()
@click.option("--camera", required=True, help="The observation whose tokens are chosen.")
@click.option("--ways", default=",".join(WAYS), help="Of choosing tokens; some of these.")
@click.option("--eighths", default=",".join(map(str, EIGHTHS)), help="Of a frame's tokens that are computed.")
@click.option("--learned", default=160, help="Stretches of calls to learn from, at most.")
@click.option("--judged", default=64, help="Those of other episodes, to judge on, at most.")
@click.option("--seed", default=0, help="Of the division of the episodes, the noise and the head.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def main(
    directory: Path,
    trajectories: Sequence[Path],
    sources: Sources,
    camera: str,
    ways: str,
    eighths: str,
    learned: int,
    judged: int,
    seed: int,
    as_json: bool,
) -> None:
    """Measure it for the policy of the artifact in DIRECTORY."""
    asked = ways.split(",")
    if unknown := set(asked) - set(WAYS):
        raise click.BadParameter(f"expected some of {', '.join(WAYS)}; found {', '.join(sorted(unknown))}.")
    counts = [int(one) for one in eighths.split(",") if one in tuple("1234567")]
    if len(counts) != len(eighths.split(",")):
        raise click.BadParameter(f"expected numbers from 1 to 7; found {eighths!r}.", param_hint="--eighths")
    sizes: dict[str, Any] = {"eighths": counts, "learned": learned, "judged": judged, "seed": seed}
    with Bar(shown=True) as bar:
        found = ordering(directory, trajectories, camera, observation=sources, ways=asked, **sizes, progress=bar.tell)
    if as_json:
        print_json(asdict(found))
    else:
        show(found)


def show(found: Ordering) -> None:
    """What was found as a table, and what the words in it mean."""
    output = results_console()
    made = table("which tokens are computed", "tokens", "error", "median", "less than the first", "95 % interval")
    for number, one in enumerate(found.rows):
        if number and one.size != found.rows[number - 1].size:
            made.add_section()
        share, low, high = (f"{100 * each:.0f}" for each in one.less)
        told = [] if one.way == FIRST else [f"{share} %", f"{low} .. {high}"]
        made.add_row(WAYS[one.way], f"{one.size} of {found.tokens}", f"{one.error:.3g}", f"{one.median:.3g}", *told)
    output.print(made)
    learned, judged = found.stretches
    say(
        output,
        f"Error: mean absolute difference of the executed actions, normalised, from those with all tokens and the same"
        f" noise, in units of what other noise does; the last {CALLS - 1} of {CALLS} consecutive calls, {judged} times."
        f" Importance and head were learned on {learned} such stretches of other episodes; the head takes"
        f" {found.flops:.2%} of the FLOPs of the prologue. After the fact nobody can choose so.",
    )


if __name__ == "__main__":
    run(main)
