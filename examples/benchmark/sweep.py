"""Latency against sparsity: eager PyTorch, torch.compile, dense onnxruntime and compiled policies, in one run.

    python examples/benchmark/sweep.py --plot build/benchmark.png --json > build/benchmark.json
    python examples/benchmark/sweep.py --widths 256 --loops ddpm:100 --threads 1

The Push-T policy (width 256) and networks of its family in other widths, with random weights; every network is
compiled afresh. Contestants take turns call by call on the same observations and noise, and all thread counts are gone
through several times. Plans reuse whole steps, evenly spaced: the time of a call depends on how many cells are
computed, the actions on which, and this program times. The floor is in ``floor.py``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import click
from commands import numbers
from drawing import draw
from floor import FLOOR, blocks_contestant, floor_ms
from networks import PUSHT_WIDTH, Network, compile_with_plans, plan_name, pusht_network, random_network
from rich.progress import Progress
from rich.table import Table
from rounds import (
    DENSE,
    EAGER,
    Effort,
    eager_contestant,
    measure_in_passes,
    rounds_of,
    tenths,
    torch_compile_contestant,
)

import ttscompile
from ttscompile.artifact.load import load_artifact
from ttscompile.cli.output import only_results_on_stdout, print_json, progress, results_console, run, table
from ttscompile.errors import RuntimeUnavailableError
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.report.timing import Contestant, Measurement, plan_contestant

COMPILED = "compiled"


@dataclass(frozen=True)
class Settings:
    """What is timed, and how often.

    Attributes:
        threads: thread counts.
        sparsities: shares of reused cells; 0 is dense onnxruntime.
        effort: how often everything is called.
        wide_effort: the same for networks wider than Push-T's, on which a call takes ten times as long.
        torch_compile: whether it takes part.
    """

    threads: tuple[int, ...]
    sparsities: tuple[float, ...]
    effort: Effort
    wide_effort: Effort
    torch_compile: bool


FULL = Settings(
    threads=(1, 2, 4),
    sparsities=(0.0, 0.8, 0.9, 0.95, 0.98),
    effort=Effort(runs=8, passes=2),
    wide_effort=Effort(runs=3, passes=1, warm_up=1),
    torch_compile=True,
)
QUICK = Settings((1, 2), (0.0, 0.8, 0.9), Effort(runs=2, passes=2), FULL.wide_effort, torch_compile=False)


@dataclass(frozen=True)
class Row:
    """What one contestant took.

    Attributes:
        network: for people.
        width: of the residual stream.
        loop: sampler and steps, for people.
        threads: of arithmetic.
        contestant: for people.
        sparsity: share of reused cells that was asked for; None for PyTorch and for the blocks alone.
        gflop: of a call; of the blocks alone, of one timed run of them.
        floor_ms: of the computed cells; None for PyTorch and for the blocks alone.
        median_ms: of the counted calls.
        p10_ms: their 10th percentile.
        p90_ms: their 90th.
        times_ms: each of them.
    """

    network: str
    width: int
    loop: str
    threads: int
    contestant: str
    sparsity: float | None
    gflop: float
    floor_ms: float | None
    median_ms: float
    p10_ms: float
    p90_ms: float
    times_ms: tuple[float, ...]


Announce = Callable[[str, int], Callable[[], None]]
"""Told what begins and how many rounds it has; gives what to call after each."""


def time_network(network: Network, settings: Settings, announce: Announce) -> tuple[list[Row], list[str]]:
    """Compile a network, and time it at all thread counts and sparsities.

    Returns:
        The rows, and a line about each thing that could not be timed.
    """
    title, steps, left_out = f"{network.name}, width {network.width}, {network.loop}", network.spec.sampler.steps, []
    with TemporaryDirectory() as folder:
        directory = Path(folder)
        announce(f"compiling: {title}", 1)
        plans = compile_with_plans(network, directory, settings.sparsities)
        if impossible := [f"{s:.0%}" for s in settings.sparsities if s not in plans]:
            left_out.append(f"{title}: {', '.join(impossible)} reused (step 0 is dense: {1 / steps:.2%} of the cells)")
        artifact = load_artifact(directory)
        rivals = [eager_contestant(network, artifact.manifest.flops.dense)]
        if settings.torch_compile:
            announce(f"torch.compile: {title}", 1)
            try:
                rivals.append(torch_compile_contestant(network, artifact.manifest.flops.dense, settings.threads[0]))
            except RuntimeUnavailableError as error:
                left_out.append(f"{title}: {error}")
        by_threads = {
            threads: [*rivals, *_compiled(network, directory, threads, plans), blocks_contestant(directory, threads)]
            for threads in settings.threads
        }
        effort = settings.effort if network.width <= PUSHT_WIDTH else settings.wide_effort
        on_round = announce(f"timing: {title}", rounds_of(by_threads, effort))
        measured = measure_in_passes(by_threads, effort, on_round)
    rows = []
    for threads, measurements in measured.items():
        blocks = next(m for m in measurements if m.label == FLOOR)
        for m in measurements:
            sparsity = next((s for s in plans if plan_name(s) == m.plan), None)
            floor = None if sparsity is None else floor_ms(plans[sparsity], artifact, blocks)
            rows.append(_row(network, threads, m, sparsity, floor))
    return rows, left_out


def _compiled(network: Network, directory: Path, threads: int, plans: Iterable[float]) -> list[Contestant]:
    """The compiled policy at each sparsity; the plans read nothing of earlier calls, so one policy serves all."""
    policy = ttscompile.load(directory, threads=threads)
    return [plan_contestant(COMPILED if s else DENSE, policy, plan_name(s), network.spec) for s in plans]


def _row(network: Network, threads: int, m: Measurement, sparsity: float | None, floor: float | None) -> Row:
    low, high = tenths(m.times_ms)
    assert m.flops is not None
    return Row(
        network=network.name,
        width=network.width,
        loop=network.loop,
        threads=threads,
        contestant=m.label,
        sparsity=sparsity,
        gflop=m.flops / 1e9,
        floor_ms=floor,
        median_ms=m.median_ms,
        p10_ms=low,
        p90_ms=high,
        times_ms=m.times_ms,
    )


def results_table(rows: Sequence[Row]) -> Table:
    """Medians, spread, how many times faster than eager PyTorch with as many threads, and the floor."""
    made = table("", "network", "loop", "threads", "reused", "ms", "p10..p90", "eager / it", "floor ms", "ms / floor")
    eager = {(r.network, r.width, r.loop, r.threads): r.median_ms for r in rows if r.contestant == EAGER}
    before = None
    for r in rows:
        key = r.network, r.width, r.loop, r.threads
        if before not in (None, key):
            made.add_section()
        before = key
        made.add_row(
            r.contestant,
            f"{r.network} {r.width}",
            r.loop,
            str(r.threads),
            "" if r.sparsity is None else f"{r.sparsity:.0%}",
            f"{r.median_ms:.4g}",
            f"{r.p10_ms:.4g}..{r.p90_ms:.4g}",
            "" if r.contestant == FLOOR else f"{eager[key] / r.median_ms:.1f}",
            "" if r.floor_ms is None else f"{r.floor_ms:.4g}",
            "" if r.floor_ms is None else f"{r.median_ms / r.floor_ms:.2f}",
        )
    return made


def networks(widths: Sequence[int], loops: Sequence[tuple[str, int]]) -> list[Network]:
    """Push-T at its width and random weights at others, with every loop."""
    return [
        pusht_network(*loop) if width == PUSHT_WIDTH else random_network(width, *loop)
        for width in widths
        for loop in loops
    ]


def _loops(_: click.Context, __: click.Parameter, values: Sequence[str]) -> tuple[tuple[str, int], ...]:
    """``ddpm:100`` of an option that can be given several times."""
    parts = [value.partition(":") for value in values]
    for sampler, colon, steps in parts:
        if sampler not in ("ddpm", "ddim") or not steps.isdecimal() or not int(steps):
            raise click.BadParameter(f"{sampler + colon + steps!r}: expected ddpm:STEPS or ddim:STEPS.")
    return tuple((sampler, int(steps)) for sampler, colon, steps in parts)


@click.command()
@click.option("--widths", default="256,768", show_default=True, callback=numbers, help="256 is the Push-T policy.")
@click.option("--loops", multiple=True, default=("ddpm:100", "ddim:16", "ddim:8"), callback=_loops, show_default=True)
@click.option("--threads", callback=numbers, help="Thread counts.  [default: 1,2,4]")
@click.option("--runs", type=click.IntRange(1), help="Counted calls a pass.  [default: 8; 3 of wide networks]")
@click.option("--passes", type=click.IntRange(1), help="Over all thread counts.  [default: 2; 1 of wide networks]")
@click.option("--quick", is_flag=True, help="A network of one layer, few runs, no torch.compile.")
@click.option("--plot", type=click.Path(path_type=Path), help="Where a picture goes: .png, .svg or .pdf.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document instead of the table.")
def main(
    widths: tuple[int, ...],
    loops: tuple[tuple[str, int], ...],
    threads: tuple[int, ...] | None,
    runs: int | None,
    passes: int | None,
    quick: bool,
    plot: Path | None,
    as_json: bool,
) -> None:
    """Time calls against sparsity, thread count, number of steps and width."""
    settings = QUICK if quick else FULL
    effort, wide = (
        replace(one, runs=runs or one.runs, passes=passes or one.passes)
        for one in (settings.effort, settings.wide_effort)
    )
    settings = replace(settings, threads=threads or settings.threads, effort=effort, wide_effort=wide)
    timed = [random_network(64, "ddim", 16, layers=1)] if quick else networks(widths, loops)
    rows: list[Row] = []
    left_out = ["torch.compile: it takes no part in a quick run"] if not settings.torch_compile else []
    console = progress()
    with Progress(console=console) as bar, only_results_on_stdout():

        def announce(text: str, total: int) -> Callable[[], None]:
            task = bar.add_task(text, total=total)
            return lambda: bar.advance(task)

        for network in timed:
            more, without = time_network(network, settings, announce)
            rows += more
            left_out += without
    document = {
        "machine": fingerprint(),
        "settings": asdict(settings),
        "left_out": left_out,
        "rows": [asdict(row) for row in rows],
    }
    if plot is not None:
        draw(document, plot)
    if as_json:
        print_json(document)
        return
    output = results_console()
    output.print(results_table(rows))
    for line in left_out:
        output.print(f"not timed: {line}", markup=False, soft_wrap=True)
    output.print(one_line(fingerprint()), markup=False, soft_wrap=True)


if __name__ == "__main__":
    run(main)
