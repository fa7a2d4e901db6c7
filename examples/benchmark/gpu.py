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
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import large_smolvla
import numpy as np
import torch
from networks import Network, compile_with_plans, plan_name, pusht_network, random_network
from rounds import EAGER, TORCH_COMPILE
from torch import nn
from torch.utils._pytree import tree_map

import ttscompile
from ttscompile.cli.contestants import network_contestant
from ttscompile.cli.output import only_results_on_stdout, print_json, progress, results_console, run, say, table
from ttscompile.core.spec import ORIGINAL, Noise
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.encoded import EncodedDenoiser
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
    """What one contestant took, and how far its actions are off; None for a network of which no call was compared."""

    network: str
    contestant: str
    median_ms: float
    quartiles_ms: tuple[float, float]
    off: float | None
    times_ms: tuple[float, ...]


def time_network(name: str, folder: Path, device: str, calls: int, say_that: Callable[[str], None]) -> list[Row]:
    """Compile a network, unless that was done, and time all contestants on it.

    Args:
        name: of ``NETWORKS``.
        folder: where its artifact is, or is written.
        device: as torch calls it.
        calls: that are counted, of each contestant.
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
    entered = [network_contestant(EAGER, eager_policy(network.module, spec), spec, None)]
    for label, plan in (("dense", "dense"), (f"{share:.0%} reused", sparse)):
        for precision in ("fp32", "bf16"):
            policy = ttscompile.load(directory, "torch", device=device, plan=f"{plan}@{precision}")
            entered.append(plan_contestant(f"{label}, {precision}", policy, f"{plan}@{precision}", spec))
    if name != SMOLVLA:  # of which a call takes seconds there
        one = ttscompile.load(directory, plan=sparse)
        entered.append(plan_contestant(f"{share:.0%} reused, fp32, one core", one, sparse, spec))
    off = {one.label: _off(one, calls_compared, expected[one.plan.partition("@")[0]]) for one in entered}
    say_that("torch.compile")
    try:
        entered.insert(1, _torch_compile(network))
    except Exception as error:  # dynamo's and inductor's have no class of their own, and the others are worth a table
        say_that(f"left out: {type(error).__name__}: {str(error)[:500]}")
    say_that("timing")
    measured = measure(entered, calls, seed=0)
    return [Row(network.name, m.label, m.median_ms, m.quartiles_ms, off.get(m.label), m.times_ms) for m in measured]


class _Cloned(nn.Module):
    """A compiled module whose results outlive its next call, which a CUDA graph of torch's writes over."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.run: Any = torch.compile(module, fullgraph=True, dynamic=False, mode="reduce-overhead")

    def forward(self, *given: Any) -> Any:
        """What the module gives."""
        return tree_map(torch.clone, self.run(*given))


def _torch_compile(network: Network) -> Contestant:
    """The same loop over ``torch.compile``'s code, each evaluation of which is a CUDA graph (``reduce-overhead``)."""
    torch.compiler.reset()
    module: Any = network.module
    if isinstance(module, EncodedDenoiser):
        module = EncodedDenoiser(_Cloned(module.encoder), _Cloned(module.denoiser))
    else:
        module = torch.compile(module, fullgraph=True, dynamic=False, mode="reduce-overhead")
    made = network_contestant(TORCH_COMPILE, eager_policy(module, network.spec), network.spec, None)
    made.call(*random_calls(network.spec, 1, seed=0)[0])
    return made


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
    made = table(rows[0].network, "ms", "quartiles", "eager / it", "torch.compile / it", "actions off")
    own = {one.contestant: one.median_ms for one in rows}
    for row in rows:
        low, high = row.quartiles_ms
        factors = (f"{own[name] / row.median_ms:.1f}" if name in own else "" for name in (EAGER, TORCH_COMPILE))
        off = "" if row.off is None else f"{row.off:.1e}"
        made.add_row(row.contestant, f"{row.median_ms:.4g}", f"{low:.4g}..{high:.4g}", *factors, off)
    results_console().print(made)


@click.command()
@click.argument("name", type=click.Choice(list(NETWORKS)))
@click.option("--device", default="cuda", show_default=True, help="As torch calls it.")
@click.option("--calls", type=click.IntRange(1), default=20, show_default=True, help="That are counted, of each.")
@click.option("--output", type=click.Path(path_type=Path), help="A folder to keep the artifact in, for another run.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document instead of the table.")
def main(name: str, device: str, calls: int, output: Path | None, as_json: bool) -> None:
    """Time calls of the policy NAME on a GPU."""
    torch.set_num_threads(1)
    with TemporaryDirectory() as temporary, only_results_on_stdout():
        rows = time_network(name, output or Path(temporary), device, calls, progress().print)
    machine = fingerprint() | {"device": torch.cuda.get_device_name(device) if device != "cpu" else device}
    if as_json:
        print_json({"machine": machine, "calls": calls, "rows": [asdict(row) for row in rows]})
        return
    results_table(rows)
    say(results_console(), f"{machine['device']}; {one_line(machine)}")


if __name__ == "__main__":
    run(main)
