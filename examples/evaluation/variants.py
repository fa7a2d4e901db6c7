"""Policies as the command line names them, ``DIR`` or ``DIR:PLAN``, and the noise that they are given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import click
import numpy as np
import numpy.typing as npt

import ttscompile
from ttscompile.artifact.load import read_manifest
from ttscompile.cli.output import results_console as results_console, run as run
from ttscompile.core.plan import DENSE, FULL
from ttscompile.runtimes.info import PolicyInfo

PINNED, OTHER = "pinned", "other"
"""What may stand after a directory beside a plan: the noise of an episode's first call in all of its calls, and noise
that nobody else has. The original with other noise shows what chance alone makes of an episode."""

Plan: TypeAlias = str | npt.NDArray[np.int8]
"""The name of a plan in the artifact, or a matrix ``[K, blocks]``."""


class Policy(Protocol):
    """What ``ttscompile.load`` returns, as far as an episode needs it."""

    @property
    def info(self) -> PolicyInfo:
        """What it observes, and the shape of its actions."""

    def reset(self) -> None:
        """A new episode."""

    def predict_action(
        self, obs_dict: Mapping[str, Any], noise: ttscompile.Noise | None = None, plan: Plan | None = None
    ) -> Mapping[str, Any]:
        """Windows ``{key: [N, To, ...]}`` in, ``{"action": [N, Ta, Da]}`` out; without a plan the policy's default."""


@dataclass(frozen=True)
class NoiseShape:
    """Sizes of the random numbers of one call of one stream.

    Attributes:
        steps: K of the loop that the noise is for.
        sample: ``(T, D)``.
        stochastic: whether the sampler draws noise at its steps.
        pinned: whether all calls of an episode have the noise of its first.
        other: whether it is not the noise that all policies share.
    """

    steps: int
    sample: tuple[int, int]
    stochastic: bool
    pinned: bool = False
    other: bool = False


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
    return NoiseShape(info.noise_steps, info.original_sample, info.stochastic)


def full_plan(directory: str | Path) -> str:
    """The name of the plan that computes every cell of what an artifact was converted to.

    That is the original policy, ``dense``, unless another sampler or precision was asked for.
    """
    return FULL if FULL in read_manifest(Path(directory)).plans else DENSE


def open_variant(text: str, runtime: str, threads: int) -> Variant:
    """Load what one argument names.

    Args:
        text: ``DIR`` for the artifact's default plan, ``DIR:dense``, or ``DIR:NAME`` for a plan that it holds, also in
            another precision: ``DIR:NAME@int8+blocks``.
            With ``:pinned`` after it all calls of an episode have the same noise, with ``:other`` another than all
            policies share.
        runtime: of ``ttscompile.load``.
        threads: of ``ttscompile.load``.

    Returns:
        The variant, its label being the text.
    """
    directory, *words = text.split(":")
    plans = [word for word in words if word not in (PINNED, OTHER)]
    if len(plans) > 1:
        raise click.BadParameter(f"{text}: expected one plan; found {':'.join(words)}.")
    policy = ttscompile.load(Path(directory), runtime=runtime, threads=threads, plan=plans[0] if plans else None)
    name = policy.info.default_plan.partition("@")[0]  # in whatever precision
    whole = policy.plans[name].otherwise  # the noise of its calls is for the whole loop
    shape = noise_shape(policy.info)
    if whole is not None and whole.cells is not None:
        shape = replace(shape, steps=len(whole.cells))
    shape = replace(shape, pinned=PINNED in words, other=OTHER in words)
    return Variant(text, policy, plans[0] if plans else None, shape)


def seeded_noise(shape: NoiseShape, seeds: Sequence[int], call: int) -> ttscompile.Noise:
    """The noise of the ``call``-th call of each episode.

    A function of seed and call only: any two policies see the same numbers, in whatever batches they run, unless one
    is to have others. Policies with another number of steps share the initial noise.

    Args:
        shape: sizes.
        seeds: one a stream, not negative.
        call: number of the call in the episode.

    Returns:
        ``initial [N, T, D]`` and ``steps [K, N, T, D]`` (None for a deterministic sampler), float32.
    """
    key = (0 if shape.pinned else call, *(1,) * shape.other)
    generators = [np.random.default_rng([seed, *key]) for seed in seeds]
    initial = np.stack([g.standard_normal(shape.sample, dtype=np.float32) for g in generators])
    if not shape.stochastic:
        return ttscompile.Noise(initial, None)
    sizes = (shape.steps, *shape.sample)
    return ttscompile.Noise(initial, np.stack([g.standard_normal(sizes, dtype=np.float32) for g in generators], axis=1))


runtime_option = click.option("--runtime", default="onnxruntime", show_default=True, help="onnxruntime or reference.")
threads_option = click.option("--threads", default=2, show_default=True, type=click.IntRange(1))
first_seed_option = click.option(
    "--first-seed", default=100_000, show_default=True, type=click.IntRange(0), help="Seeds count up from here."
)
batch_option = click.option(
    "--batch", default=16, show_default=True, type=click.IntRange(1), help="Episodes in lockstep."
)
picture_option = click.option("--picture", type=click.Path(dir_okay=False, path_type=Path), help="PNG, SVG or PDF.")
json_option = click.option("--json", "as_json", is_flag=True, help="One JSON document instead of a table.")
cache_option = click.option(
    "--cache",
    type=click.Path(file_okay=False, path_type=Path),
    help="Where episodes are kept, by what was computed, and taken from; otherwise build/ENVIRONMENT/episodes.",
)


def cache_folder(environment: str) -> Path:
    """Where episodes are kept, if nothing else is said."""
    return Path("build", environment, "episodes")
