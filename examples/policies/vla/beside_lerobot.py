"""The calls of lerobot's own policy and of compiled ones, in turns: how far apart, and how long each takes.

    MUJOCO_GL=osmesa python examples/policies/vla/beside_lerobot.py build/vla/smolvla DIR:dense DIR

The first argument is the folder of ``train.py``, whose language model's folder lerobot reads; the policy is the one
that is kept. All have the same frames and noise, of one robot on one thread; tokens are made before. lerobot has to be
importable, beside ttscompile.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from rich.console import Console
from rich.table import Table

import ttscompile

sys.path.insert(1, str(Path(__file__).parents[2] / "evaluation"))

from environments.fetch_blocks import FetchBlocks

KEPT = Path(__file__).resolve().parent / "trained" / "smolvla" / "policy"
WARM_UP = 4


@click.command()
@click.argument("run", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("variants", nargs=-1, required=True, metavar="DIR[:PLAN]...")
@click.option("--calls", default=40, show_default=True, type=click.IntRange(1))
def main(run: Path, variants: tuple[str, ...], calls: int) -> None:
    """Print a table: milliseconds, their part before the loop, and differences from lerobot's executed actions."""
    torch.set_num_threads(1)
    policies = {}
    for text in variants:
        directory, _, plan = text.partition(":")
        policies[text] = ttscompile.load(directory, threads=1, plan=plan or None)
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    os.chdir(run)
    original = SmolVLAPolicy.from_pretrained(KEPT).eval()
    before, after = make_pre_post_processors(original.config, pretrained_path=KEPT)
    world, own = FetchBlocks(), list[float]()
    took: dict[str, list[tuple[float, float, float]]] = {text: [] for text in variants}
    for seed in range(calls + WARM_UP):
        world.reset(seed)
        frame = world.observe()
        noise = np.random.default_rng(seed).standard_normal(
            (1, original.config.chunk_size, original.config.max_action_dim), dtype=np.float32
        )
        given: dict[str, Any] = {key: torch.from_numpy(each) for key, each in frame.items() if "language" not in key}
        batch = before({**given, "task": world.instruction})
        started = time.perf_counter()
        with torch.no_grad():
            chunk = original.predict_action_chunk(batch, noise=torch.from_numpy(noise))
        own.append(time.perf_counter() - started)
        wanted = after(chunk)[:, : original.config.n_action_steps].numpy()
        windows = {key: each[None] if "language" in key else each[None, None] for key, each in frame.items()}
        for text, policy in policies.items():
            started = time.perf_counter()
            found = policy.predict_action(windows, noise=ttscompile.Noise(noise, None))["action"]
            seconds = time.perf_counter() - started
            assert policy.last_report is not None
            prologue = policy.last_report.timings.prologue
            took[text].append((1000 * seconds, prologue, float(np.abs(found - wanted).max())))
    world.close()
    table = Table(title=f"{calls} first calls of episodes, one thread, medians")
    for column in ("variant", "ms a call", "times faster than lerobot", "before the loop, ms", "largest difference"):
        table.add_column(column, justify="left" if column == "variant" else "right", overflow="fold")
    eager = 1000 * float(np.median(own[WARM_UP:]))
    table.add_row("lerobot", f"{eager:.2f}")
    for text, rows in took.items():
        whole, prologue, _ = np.median(rows[WARM_UP:], axis=0)
        table.add_row(
            text, f"{whole:.2f}", f"{eager / whole:.2f}", f"{prologue:.2f}", f"{max(row[2] for row in rows):.1e}"
        )
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
