"""Record calls for calibration: drive the robot with every block computed, and keep what it observed.

    python examples/evaluation/record.py build/pusht/flow/compiled -o build/pusht/flow/calls.npz --episodes 16

With --wander the robot goes to random places instead, which is another task in the same world: ``departures.py``.

The seeds start at 0; evaluation starts at 100000, so that no policy is judged on episodes it was calibrated on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from environments import Array, environment_class, environment_option
from rich.console import Console
from rich.progress import Progress
from rollout import run_episodes
from variants import Policy, full_plan, open_variant, run, runtime_option, threads_option

from ttscompile import Noise
from ttscompile.runtimes.info import PolicyInfo


def save_trajectories(path: Path, episodes: Sequence[Mapping[str, Array]]) -> None:
    """Write what was observed in episodes as a trajectory file.

    Args:
        path: an ``.npz``: by key of the observation ``[N, To, ...]``, one row a call, in order; ``episode_ends [E]``
            int64, the row after the last of each episode.
        episodes: at least one; of each the windows of its calls, by key ``[calls, To, ...]``.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {key: np.concatenate([episode[key] for episode in episodes]) for key in episodes[0]}
    ends = np.cumsum([len(next(iter(episode.values()))) for episode in episodes])
    np.savez(path, **arrays, episode_ends=ends.astype(np.int64))


class Wanderer:
    """Goes to another place within the range of the actions at every call, whatever it sees.

    Args:
        policy: whose observations it reads, and whose actions have this range.
    """

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    @property
    def info(self) -> PolicyInfo:
        """See ``Policy``."""
        return self._policy.info

    def reset(self) -> None:
        """See ``Policy``."""

    def predict_action(
        self, obs_dict: Mapping[str, Any], noise: Noise | None = None, plan: Any = None
    ) -> dict[str, Any]:
        """Actions ``[B, Ta, Da]``, all of a chunk the same: where its noise says."""
        assert noise is not None
        action = self.info.action
        places = np.tanh(noise.initial[:, :1, : action.action_dim])
        chunks = np.repeat(places, action.stop - action.start, axis=1)
        reached = chunks.astype(np.float32)
        return {"action": reached if action.normalizer is None else action.normalizer.unnormalize(reached)}


@click.command()
@click.argument("artifact")
@environment_option
@click.option("-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path))
@click.option("--episodes", default=16, show_default=True, type=click.IntRange(1))
@click.option("--first-seed", default=0, show_default=True, type=click.IntRange(0), help="Seeds count up from here.")
@click.option("--batch", default=8, show_default=True, type=click.IntRange(1), help="Episodes in lockstep.")
@click.option("--wander", is_flag=True, help="Go to random places, and ask no policy.")
@runtime_option
@threads_option
def main(
    artifact: str,
    environment: str,
    output: Path,
    episodes: int,
    first_seed: int,
    batch: int,
    wander: bool,
    runtime: str,
    threads: int,
) -> None:
    """Drive the robot with the policy in ARTIFACT, in the loop that it was converted to, and write its observations."""
    make = environment_class(environment)
    variant = open_variant(f"{artifact}:{full_plan(artifact)}", runtime, threads)
    if wander:
        variant = replace(variant, policy=Wanderer(variant.policy))
    seeds = range(first_seed, first_seed + episodes)
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("recording episodes", total=episodes)
        rollout = run_episodes(make, variant, seeds, batch, lambda n: progress.update(task, completed=n))
    save_trajectories(output, [episode.windows for episode in rollout.episodes])
    calls = sum(episode.calls for episode in rollout.episodes)
    score = np.mean([episode.score for episode in rollout.episodes])
    click.echo(f"{output}: {calls} calls in {episodes} episodes, mean score {score:.3f}")


if __name__ == "__main__":
    run(main)
