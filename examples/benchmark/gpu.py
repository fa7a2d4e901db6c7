"""Calls on a GPU: eager PyTorch, torch.compile, and the compiled policy on the runtime of torch, in one run.

    python examples/benchmark/gpu.py pusht
    python examples/benchmark/gpu.py smolvla --output build/smolvla --json > build/gpu.json

Push-T's transformer and U-Net are trained policies. The wide transformer has random weights, and so has SmolVLA, at its
published size. Contestants take turns call by call, on the same observations and noise. A call begins and ends on the
processor: observations and noise go to the GPU, and actions come back. Plans reuse whole steps, evenly spaced, because
their time does not depend on which. For each there is the largest difference of its actions from those of onnxruntime
on the processor with the same cells, in fp32, as a share of the range of these actions.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import large_smolvla
import numpy as np
import torch
from networks import Network, compile_with_plans, plan_name, pusht_network, random_network
from rounds import EAGER, TORCH_COMPILE, eager_contestant, torch_compile_contestant

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.cli.output import only_results_on_stdout, print_json, progress, results_console, run, say, table
from ttscompile.core.spec import ORIGINAL, Noise
from ttscompile.errors import RuntimeUnavailableError
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.report.timing import Contestant, measure, plan_contestant
from ttscompile.runtimes.random_calls import Observation, random_calls

UNET = Path(__file__).parents[1] / "policies" / "unet" / "pusht_unet_ema_fp16.ckpt"
COMPARED = 2
"""Observations that actions are compared on."""

SMOLVLA = "smolvla"


def unet(_: Path) -> Network:
    """Push-T's U-Net, in the loop that it was trained with."""
    module, spec = load_checkpoint_policy(UNET)
    return Network("Push-T, U-Net", 0, module, spec.in_loop(ORIGINAL))


def smolvla(folder: Path) -> Network:
    """LeRobot's SmolVLA, whole, with its default configuration and two cameras."""
    if not (folder / "smolvla").exists():
        large_smolvla.save(folder / "smolvla")
    return Network("SmolVLA", 0, *load_checkpoint_policy(folder / "smolvla"))


NETWORKS: Mapping[str, tuple[Callable[[Path], Network], float]] = {
    "pusht": (lambda _: pusht_network("ddpm", 100), 0.95),
    "unet": (unet, 0.95),
    "wide": (lambda _: random_network(768, "ddpm", 100), 0.95),
    SMOLVLA: (smolvla, 0.8),
}
"""By name, what makes a network; and the share of its cells that the sparse plan reuses."""


@dataclass(frozen=True)
class Row:
    """What a contestant took; how far its actions are off, and how many kernels it has; None where that is unknown."""

    network: str
    contestant: str
    median_ms: float
    quartiles_ms: tuple[float, float]
    off: float | None
    kernels: int | None
    times_ms: tuple[float, ...]


def time_network(
    name: str, folder: Path, device: str, calls: int, torch_compiled: bool, say_that: Callable[[str], None]
) -> list[Row]:
    """Compile a network, unless that was done, and time all contestants on it.

    Args:
        name: of ``NETWORKS``.
        folder: where its artifact is, or is written.
        device: as torch calls it.
        calls: that are counted, of each contestant.
        torch_compiled: whether torch.compile is one of them.
        say_that: is told what begins.
    """
    make, share = NETWORKS[name]
    network, directory, sparse = make(folder), folder / "compiled", plan_name(share)
    if not directory.exists():
        say_that("compiling")
        compile_with_plans(network, directory, [share])
    spec, calls_compared = network.spec, random_calls(network.spec, COMPARED, seed=1)
    say_that("the same on the processor")
    processor = ttscompile.load(directory, plan=sparse, threads=os.cpu_count() or 1)
    expected = {
        plan: [processor.predict_action(obs, noise=noise, plan=plan)["action_pred"] for obs, noise in calls_compared]
        for plan in ("dense", sparse)
    }
    network.module.to(device)
    flops = load_artifact(directory).manifest.flops.dense
    eager = eager_contestant(network, flops)
    entered = [eager, _autocast(eager, device)]
    for label, plan in (("dense", "dense"), (f"{share:.0%} reused", sparse)):
        for precision in ("fp32", "bf16+blocks", "bf16"):
            policy = ttscompile.load(directory, "torch", device=device, plan=f"{plan}@{precision}")
            entered.append(plan_contestant(f"{label}, {precision}", policy, f"{plan}@{precision}", spec))
    unfused = f"{share:.0%} reused, fp32, idle steps not fused"
    entered.append(plan_contestant(unfused, _unfused(directory, sparse, device), sparse, spec))
    if name != SMOLVLA:  # of which a call takes seconds there
        one = ttscompile.load(directory, plan=sparse)
        entered.append(plan_contestant(f"{share:.0%} reused, fp32, one core", one, sparse, spec))
    off = {one.label: _off(one, calls_compared, expected[one.plan.partition("@")[0]]) for one in entered}
    counted = {one.label: kernels(one, device) for one in entered}
    if torch_compiled:
        say_that("torch.compile")
        try:
            entered.insert(1, torch_compile_contestant(network, flops, 1, "reduce-overhead"))
        except RuntimeUnavailableError as error:
            say_that(f"left out: {error}")
    say_that("timing")
    measured = measure(entered, calls, seed=0)
    return [
        Row(network.name, m.label, m.median_ms, m.quartiles_ms, off.get(m.label), counted.get(m.label), m.times_ms)
        for m in measured
    ]


def _autocast(one: Contestant, device: str) -> Contestant:
    """Eager PyTorch with its products in bf16."""

    def call(obs: Observation, noise: Noise) -> object:
        with torch.autocast(device, torch.bfloat16):
            return one.call(obs, noise)

    return replace(one, label=f"{one.label}, bf16", call=call)


def _unfused(directory: Path, plan: str, device: str) -> ttscompile.CompiledPolicy:
    """A policy whose idle steps are kernels of torch's, as where there is no Triton."""
    policy = ttscompile.load(directory, "torch", device=device, plan=plan)
    backend: Any = policy._runtime.backend
    if backend._parts.idle is not None:
        backend._parts.idle.fused = None
    return policy


def kernels(one: Contestant, device: str) -> int | None:
    """Kernels of a call of a contestant; None on the processor."""
    if device == "cpu":
        return None
    obs, noise = random_calls(one.spec, 1, seed=0)[0]
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profiler:
        one.call(obs, noise)
    return sum(event.count for event in profiler.key_averages() if event.self_device_time_total)


def _off(one: Contestant, calls: Sequence[tuple[Observation, Noise]], expected: Sequence[np.ndarray]) -> float:
    """Largest difference of actions from the expected ones, as a share of the range of these."""
    worst = 0.0
    for (obs, noise), actions in zip(calls, expected, strict=True):
        made: Any = one.call(obs, noise)
        found = made["action_pred"] if isinstance(made, dict) else one.spec.chunk.unnormalized(made.numpy())
        worst = max(worst, float(np.abs(found - actions).max() / np.ptp(actions)))
    return worst


def results_table(rows: Sequence[Row]) -> None:
    """Of one network: medians, quartiles, how many times faster than eager PyTorch and than torch.compile."""
    made = table(rows[0].network, "ms", "quartiles", "eager / it", "torch.compile / it", "actions off", "kernels")
    own = {one.contestant: one.median_ms for one in rows}
    for row in rows:
        low, high = row.quartiles_ms
        factors = (f"{own[name] / row.median_ms:.1f}" if name in own else "" for name in (EAGER, TORCH_COMPILE))
        rest = (*factors, "" if row.off is None else f"{row.off:.1e}", str(row.kernels or ""))
        made.add_row(row.contestant, f"{row.median_ms:.4g}", f"{low:.4g}..{high:.4g}", *rest)
    results_console().print(made)


@click.command()
@click.argument("name", type=click.Choice(list(NETWORKS)))
@click.option("--device", default="cuda", show_default=True, help="As torch calls it.")
@click.option("--calls", type=click.IntRange(1), default=20, show_default=True, help="That are counted, of each.")
@click.option("--torch-compile/--no-torch-compile", default=True, show_default=True, help="It compiles for minutes.")
@click.option("--output", type=click.Path(path_type=Path), help="A folder to keep the artifact in, for another run.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document instead of the table.")
def main(name: str, device: str, calls: int, torch_compile: bool, output: Path | None, as_json: bool) -> None:
    """Time calls of the policy NAME on a GPU."""
    torch.set_num_threads(1)
    with TemporaryDirectory() as temporary, only_results_on_stdout():
        rows = time_network(name, output or Path(temporary), device, calls, torch_compile, progress().print)
    machine = fingerprint() | {"device": torch.cuda.get_device_name(device) if device != "cpu" else device}
    if as_json:
        print_json({"machine": machine, "calls": calls, "rows": [asdict(row) for row in rows]})
        return
    results_table(rows)
    say(results_console(), f"{machine['device']}; {one_line(machine)}")


if __name__ == "__main__":
    run(main)
