"""Drive Push-T in real time: a control loop that asks for an action every tick, while the policy computes beside it.

    python examples/pusht/realtime.py build/pusht/transformer/compiled --hz 10 --hz 50 --minutes 10 --against-eager

The world does not wait. At 10 Hz it runs at its own speed: a step of the environment is 0.1 s, as in the
demonstrations. At another rate the world runs faster or slower, one step a tick: at 50 Hz, five times as fast as in
the demonstrations, so that a chunk of 8 actions lasts 160 ms. What the policy sees and does is the same at every rate;
only the time to compute differs.

Each run writes statistics (JSON), a trace that https://ui.perfetto.dev opens, and all runs together a picture of their
traces. Exit status 1: the compiled policy missed a deadline.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from benchmark import CHECKPOINT
from realtime_plot import plot_traces
from rich.console import Console
from rich.table import Table

import ttscompile
from ttscompile import AsyncExecutor, ExecutorSettings
from ttscompile.cli.output import manifest_of, print_identity
from ttscompile.errors import DeadlineMissedError
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.runtimes.info import PolicyInfo

sys.path.append(str(Path(__file__).resolve().parents[1] / "evaluation"))
from environments.pusht import PushT
from variants import NoiseShape, noise_shape, results_console, run, seeded_noise

EAGER, COMPILED = "eager PyTorch", "compiled"
OUTPUT = Path(__file__).resolve().parents[2] / "build" / "pusht" / "realtime"


class NumberedNoise:
    """A policy behind the executor's interface, with noise that depends on a seed and the number of the call only.

    Args:
        policy: compiled or eager.
        info: of the compiled policy; the eager one is the same policy.
        shape: of its noise.
        takes_plan: whether it has plans.
    """

    def __init__(self, policy: Any, info: PolicyInfo, shape: NoiseShape, takes_plan: bool) -> None:
        self._policy, self._shape, self._takes_plan = policy, shape, takes_plan
        self.info = info
        self._seed, self._call = 0, 0

    @property
    def last_report(self) -> Any:
        """Of the last call, for the trace; None of a policy without reports."""
        return getattr(self._policy, "last_report", None)

    def reset(self, seed: int | None = None) -> None:
        """A new episode."""
        self._policy.reset()
        self._seed, self._call = seed or 0, 0

    def follow(self, executed: int) -> None:
        """See ``CompiledPolicy.follow``."""
        getattr(self._policy, "follow", lambda _: None)(executed)

    def predict_action(self, obs_dict: Any, *, plan: str) -> Any:
        """One call, with the next noise."""
        noise = seeded_noise(self._shape, [self._seed], self._call)
        self._call += 1
        return self._policy.predict_action(obs_dict, noise=noise, **({"plan": plan} if self._takes_plan else {}))


@dataclass(frozen=True)
class RealTime:
    """What one run came to.

    Attributes:
        label: of the policy.
        hz: ticks a second, each one step of the environment.
        seconds: that the loop ran for.
        episodes: that were started.
        best_coverage: of each finished episode.
        missed_ticks: without an action, with the last one held, or with one in reserve, because the chunk was late;
            later in an episode than any policy that is fast enough for this loop has its first chunk.
        late_ticks: of the loop itself, by more than half a period.
        statistics: of the executor.
        feasibility: the arithmetic.
        trace: file of the trace.
    """

    label: str
    hz: float
    seconds: float
    episodes: int
    best_coverage: tuple[float, ...]
    missed_ticks: int
    late_ticks: int
    statistics: dict[str, Any]
    feasibility: str
    trace: str


class World:
    """Push-T, one tick after another, one episode after another.

    Attributes:
        episode: number of the episode under way.
        best: best coverage of each finished episode.
    """

    def __init__(self, first_seed: int) -> None:
        self._environment, self._first_seed = PushT(), first_seed
        self.episode = -1
        self.best: list[float] = []

    def next_episode(self) -> int:
        """Start it; its seed."""
        if self.episode >= 0:
            self.best.append(self._environment.coverage)
        self.episode += 1
        seed = self._first_seed + self.episode
        self._environment.reset(seed)
        return seed

    @property
    def done(self) -> bool:
        """Whether the episode is."""
        return self._environment.done

    def frame(self) -> dict[str, Any]:
        """What the policy observes now."""
        return {"obs": self._environment.observe()["obs"]}

    def step(self, target: Any) -> None:
        """Let the world go on for one step; without an action the agent is told to stay where it is."""
        self._environment.step(self._environment.rest() if target is None else target)


def drive(
    label: str, policy: NumberedNoise, hz: float, seconds: float, first_seed: int, margin_ticks: int, trace: Path
) -> RealTime:
    """Run episodes in real time; the loop never waits for the policy, except for the first chunk of an episode.

    Args:
        label: for tables.
        policy: to drive with.
        hz: ticks a second.
        seconds: for how long.
        first_seed: of the first episode; the next ones have the next.
        margin_ticks: ticks that a chunk shall be there before it is needed.
        trace: file to write.
    """
    settings = ExecutorSettings(
        margin_ticks=margin_ticks, refuse_infeasible=False, warm_up=1, measured_calls=3, trace_events=1 << 17
    )
    world = World(first_seed)
    missed = late = 0
    executor = AsyncExecutor(policy, hz, settings)
    try:
        (each,) = executor.feasibility().values()
        window = max(spec.frames or 1 for spec in policy.info.observation.values())
        patience = window / hz + max(each.max_latency, 0.0)
        start = time.monotonic()
        while time.monotonic() - start < seconds:
            executor.reset(world.next_episode())
            begun = time.monotonic()
            tick = 0
            while not world.done and time.monotonic() - start < seconds:
                executor.observe(world.frame())
                action, fresh = act(executor)
                missed += not fresh and time.monotonic() - begun > patience
                world.step(action)
                tick += 1
                due = begun + tick / hz
                time.sleep(max(due - time.monotonic(), 0.0))
                late += time.monotonic() - due > 0.5 / hz
        took = time.monotonic() - start
        statistics = executor.statistics()
    finally:
        executor.close(timeout=120)  # an eager call may take long
    executor.trace.write(trace, f"Push-T at {hz:g} Hz, {label}")
    return RealTime(
        label=label,
        hz=hz,
        seconds=took,
        episodes=world.episode + 1,
        best_coverage=tuple(world.best),
        missed_ticks=missed,
        late_ticks=late,
        statistics=statistics.to_json(),
        feasibility=each.explain(),
        trace=trace.name,
    )


def act(executor: AsyncExecutor) -> tuple[Any, bool]:
    """The action for now, None if there is none, and whether its chunk came in time."""
    bridged = executor.bridged
    try:
        action = executor.action()
    except DeadlineMissedError:
        return None, False
    return action, executor.bridged == bridged


def runs_table(runs: Sequence[RealTime]) -> Table:
    """The runs, one a row."""
    table = Table(title="Push-T in real time")
    table.add_column("")
    for column in (
        "Hz",
        "seconds",
        "episodes",
        "coverage",
        "call p50, ms",
        "p99",
        "max",
        "missed ticks",
        "of these bridged",
        "of",
        "late ticks",
    ):
        table.add_column(column, justify="right")
    for each in runs:
        latency = each.statistics["latency_ms"]
        times = [f"{latency[name]:.1f}" for name in ("p50", "p99", "max")] if latency else [""] * 3
        table.add_row(
            each.label,
            f"{each.hz:g}",
            f"{each.seconds:.0f}",
            f"{each.episodes}",
            f"{np.mean(each.best_coverage):.2f}" if each.best_coverage else "",
            *times,
            f"{each.missed_ticks}",
            f"{each.statistics['reserve'] + each.statistics['holds']}",
            f"{each.statistics['ticks'] + each.statistics['starved']}",
            f"{each.late_ticks}",
        )
    return table


def opened(artifact: Path, threads: int, checkpoint: Path | None) -> list[tuple[str, NumberedNoise]]:
    """The policies to drive with: the compiled one, and the eager one if there is a checkpoint."""
    policy = ttscompile.load(artifact, threads=threads)
    info, shape = policy.info, noise_shape(policy.info)
    found = [(COMPILED, NumberedNoise(policy, info, shape, takes_plan=True))]
    if checkpoint is not None:
        from original import EagerPolicy

        eager = EagerPolicy(checkpoint, threads)
        found.append((EAGER, NumberedNoise(eager, info, eager.noise, takes_plan=False)))
    return found


@click.command()
@click.argument("artifact", type=click.Path(exists=True, path_type=Path))
@click.option("--hz", "rates", multiple=True, default=(10.0, 50.0), show_default=True, type=click.FloatRange(min=1))
@click.option("--minutes", default=1.0, show_default=True, type=click.FloatRange(min=0.05), help="Of each run.")
@click.option("--threads", default=2, show_default=True, type=click.IntRange(1), help="Of either policy.")
@click.option("--against-eager", is_flag=True, help="Also run the original network in eager PyTorch.")
@click.option("--checkpoint", default=CHECKPOINT, show_default=True, type=click.Path(exists=True, path_type=Path))
@click.option("--first-seed", default=100_000, show_default=True, type=click.IntRange(0))
@click.option(
    "--margin-ticks", default=2, show_default=True, type=click.IntRange(0), help="Ticks that a chunk shall be early by."
)
@click.option("-o", "--output", default=OUTPUT, show_default=True, type=click.Path(file_okay=False, path_type=Path))
@click.option(
    "--window", default=4.0, show_default=True, type=click.FloatRange(min=0.1), help="Seconds in the picture."
)
def main(
    artifact: Path,
    rates: tuple[float, ...],
    minutes: float,
    threads: int,
    against_eager: bool,
    checkpoint: Path,
    first_seed: int,
    margin_ticks: int,
    output: Path,
    window: float,
) -> None:
    """Drive Push-T in real time with the compiled policy of ARTIFACT, and with the eager original for comparison."""
    output.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=True)
    runs: list[RealTime] = []
    for label, policy in opened(artifact, threads, checkpoint if against_eager else None):
        for hz in rates:
            with console.status(f"{label} at {hz:g} Hz"):
                trace = output / f"trace-{label.split()[0]}-{hz:g}hz.json"
                runs.append(drive(label, policy, hz, 60 * minutes, first_seed, margin_ticks, trace))
    machine = fingerprint()
    identity = manifest_of(artifact).identity
    figures = [asdict(each) for each in runs]
    document = {"identity": identity, "machine": machine, "threads": threads, "runs": figures}
    (output / "realtime.json").write_text(json.dumps(document, indent=1, allow_nan=False))
    plot_traces(
        {f"{each.label}, {each.hz:g} Hz": output / each.trace for each in runs}, output / "realtime.png", window
    )
    results = results_console()
    results.print(runs_table(runs))
    for each in runs:
        results.print(f"{each.label}, {each.hz:g} Hz: {each.feasibility}", markup=False, highlight=False)
    print_identity(identity, results)
    results.print(one_line(machine), highlight=False)
    if any(each.missed_ticks for each in runs if each.label == COMPILED):
        sys.exit(1)


if __name__ == "__main__":
    run(main)
