"""Policies as the command line names them: ``DIR`` or ``DIR:PLAN``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click
from rollout import NoiseShape, Policy

import ttscompile
from ttscompile.cli.output import results_console as results_console
from ttscompile.cli.output import run as run
from ttscompile.runtimes.policy import PolicyInfo


@dataclass(frozen=True)
class Variant:
    """One way to drive the robot.

    Attributes:
        label: for tables.
        policy: a policy of its own; its caches are shared with no other variant.
        plan: as in ``predict_action``; None for the policy's default.
        noise: sizes of the policy's noise.
    """

    label: str
    policy: Policy
    plan: str | None
    noise: NoiseShape


def noise_shape(info: PolicyInfo) -> NoiseShape:
    """Sizes of the noise that a compiled policy takes."""
    return NoiseShape(info.K, info.original_sample, info.stochastic)


def open_variant(text: str, runtime: str, threads: int) -> Variant:
    """Load what one argument names.

    Args:
        text: ``DIR`` for the artifact's default plan, ``DIR:dense``, or ``DIR:NAME`` for a plan that it holds.
        runtime: of ``ttscompile.load``.
        threads: of ``ttscompile.load``.

    Returns:
        The variant, its label being the text.
    """
    directory, colon, plan = text.partition(":")
    policy = ttscompile.load(Path(directory), runtime=runtime, threads=threads)
    return Variant(text, policy, plan if colon else None, noise_shape(policy.info))


runtime_option = click.option("--runtime", default="onnxruntime", show_default=True, help="onnxruntime or reference.")
threads_option = click.option("--threads", default=2, show_default=True, type=click.IntRange(1))
first_seed_option = click.option(
    "--first-seed", default=100_000, show_default=True, type=click.IntRange(0), help="Seeds count up from here."
)
cache_option = click.option(
    "--cache",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("build/pusht/episodes"),
    show_default=True,
    help="Where episodes are kept, by what was computed, and taken from.",
)
