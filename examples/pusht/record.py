"""Record calls for calibration: drive Push-T with the dense policy and keep what it observed.

    python examples/pusht/record.py build/pusht/compiled -o build/pusht/calls.npz --episodes 16

The seeds start at 0; evaluation starts at 100000, so that no policy is judged on episodes it was calibrated on.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rollout import Episode, run_episodes
from variants import open_variant, run, runtime_option, threads_option


def save_trajectories(path: Path, episodes: Sequence[Episode]) -> None:
    """Write episodes as a trajectory file.

    Args:
        path: an ``.npz``: ``obs [N, 2, 20]`` float32, one row a call, in order; ``episode_ends [E]`` int64, the row
            after the last of each episode.
        episodes: at least one.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        path,
        obs=np.concatenate([episode.windows for episode in episodes]),
        episode_ends=np.cumsum([len(episode.windows) for episode in episodes]).astype(np.int64),
    )


@click.command()
@click.argument("artifact")
@click.option("-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path))
@click.option("--episodes", default=16, show_default=True, type=click.IntRange(1))
@click.option("--first-seed", default=0, show_default=True, type=click.IntRange(0), help="Seeds count up from here.")
@click.option("--batch", default=8, show_default=True, type=click.IntRange(1), help="Episodes in lockstep.")
@runtime_option
@threads_option
def main(artifact: str, output: Path, episodes: int, first_seed: int, batch: int, runtime: str, threads: int) -> None:
    """Drive Push-T with the dense policy of ARTIFACT and write its observations."""
    variant = open_variant(f"{artifact}:dense", runtime, threads)
    seeds = range(first_seed, first_seed + episodes)
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("recording episodes", total=episodes)
        rollout = run_episodes(
            variant.policy, seeds, variant.noise, batch, variant.plan, lambda n: progress.update(task, completed=n)
        )
    save_trajectories(output, rollout.episodes)
    calls = sum(len(episode.windows) for episode in rollout.episodes)
    score = np.mean([episode.score for episode in rollout.episodes])
    click.echo(f"{output}: {calls} calls in {episodes} episodes, mean score {score:.3f}")


if __name__ == "__main__":
    run(main)
