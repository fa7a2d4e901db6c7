"""What differs from one kind of machine to another: executing the pieces of an artifact. ``Runtime`` does the rest."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from ttscompile.artifact.manifest import Manifest
from ttscompile.artifact.view import View
from ttscompile.core.correction import Correction
from ttscompile.core.lattice import BoolArray, PlanArray
from ttscompile.core.spec import FloatArray, Noise, SamplerTable
from ttscompile.errors import ArtifactError, ObservationError, TtscompileError
from ttscompile.ir.graph import TensorType

from .inpainting import Known

Lowered = TypeVar("Lowered")
"""What a backend makes of the plan of one stream, to execute it."""


@dataclass(frozen=True, eq=False)
class Call:
    """What a backend is given for one call. Everything was checked.

    Attributes:
        obs: normalised observation by key, ``[B, ...]`` each; empty for that of the call before, whose prologue stands.
        noise: ``initial [B, T, D]``; ``steps [K, B, T, D]`` if the sampler is stochastic.
        correction: of the sampler's steps; None for none.
        known: what a prefix makes known of the samples; None for nothing.
        keep: bool ``[K, blocks]``; computed residuals that have to go into the rollout cache.
        written: bool ``[B, K, blocks]``; entries of the rollout cache that the plan may read. All others are of an
            earlier episode, or were never made; none is True in the first call of an episode.
    """

    obs: Mapping[str, FloatArray]
    noise: Noise
    correction: Correction | None
    known: Known | None
    keep: BoolArray
    written: BoolArray


class Backend(Protocol[Lowered]):
    """Executes calls of plans of one variant: on one view of an artifact.

    ``Runtime`` calls the methods in this order::

        prepare    start    first_step                                other_steps -> sample
                            logits, where the plan is the pruner's

    Where a call may be far outside of what was recorded, ``condition`` stands before ``first_step``.

    Methods may raise anything: the runtime then ends the episode. ``lower`` and ``logits`` are called on a thread of
    their own while ``first_step`` runs; nothing else is.

    A backend that has ``frames`` too, a ``FramePieces``, computes with it what depends on one frame alone, and so only
    for frames that are new; one that has none computes all of them in ``start``.

    Attributes:
        keeps: bool ``[K, blocks]``; entries of the rollout cache that are worth keeping when a plan of the artifact is
            executed. Those that none of these plans reads may be left out.
    """

    keeps: BoolArray

    def lower(self, plan: PlanArray) -> Lowered:
        """What ``other_steps`` needs of a legal plan, int8 ``[K, blocks]``. The runtime keeps it for the next time."""

    def prepare(self, streams: int, plans: Sequence[Lowered] | None) -> None:
        """Have the memory that a call of B streams needs, until the episode ends. It is not timed.

        Of each stream there is its plan, or None for the pruner's, which are not known yet.
        """

    def start(self, call: Call) -> None:
        """Take in a call, and run what the observation decides before the loop: the prologue."""

    def condition(self) -> FloatArray:
        """What a correction reads of the observation of the call, float32 ``[B, N]``; asked for after ``start``."""

    def logits(self) -> FloatArray:
        """The pruner's logits for the call, float32 ``[B, K, blocks, 4]``; asked for only if there is a pruner."""

    def first_step(self) -> None:
        """Step 0, which is dense in every plan. A backend that cannot begin without a plan does nothing here."""

    def other_steps(self, plans: Sequence[Lowered]) -> FloatArray:
        """The rest of the call: the denoised sample, float32 ``[B, T, D]``, which no later call changes."""


@contextmanager
def fitting(view: View) -> Iterator[None]:
    """Within the block whatever fails is an error of the artifact: its hashes are right, and its parts do not fit.

    Raises:
        ArtifactError: in place of any exception that is not the package's own, but for a package that is missing.
    """
    try:
        yield
    except (TtscompileError, ModuleNotFoundError):
        raise
    except Exception as error:
        problem = f"its manifest, tables and graphs do not fit each other ({type(error).__name__}: {str(error)[:300]})"
        raise ArtifactError(f"{view.artifact.path}: {problem}. Convert the checkpoint again.") from error


def stream_type(manifest: Manifest, streams: int) -> TensorType:
    """The type of the residual stream, which is float32, and the same for all blocks.

    Raises:
        ArtifactError: it is not.
        ObservationError: it has no axis for the streams, of which there are several.
    """
    kind = manifest.blocks[0].type
    if any(block.type != kind for block in manifest.blocks) or kind.dtype != "float32":
        types = sorted({str(block.type) for block in manifest.blocks})
        raise ArtifactError(f"the residual stream changes its type, or is not float32: {types}. It cannot be executed.")
    if kind.batch_axis is None and streams > 1:
        problem = f"this policy's residual stream has type {kind}, without an axis for the streams"
        raise ObservationError(f"{problem}; found {streams} streams. Call it with one stream at a time.")
    return kind


def fill_initial(initial: FloatArray, noise: Noise, known: Known | None) -> None:
    """Write the sample at step 0, ``[B, T, D]``."""
    np.copyto(initial, noise.initial)
    if known is not None:
        initial[:, known.positions, known.channels] = known.values[0]


def fill_offset(offset: FloatArray, sampler: SamplerTable, noise: Noise, correction: Correction | None) -> None:
    """What every step adds to the sample that depends neither on it nor on the observation, ``[K, D, B, T]``."""
    if sampler.stochastic and noise.steps is not None:
        column = sampler.noise_to_next[:, None, None, None]
        np.multiply(noise.steps.transpose(0, 3, 1, 2), column, out=offset)
    else:
        offset.fill(0)
    if correction is not None:
        offset += correction.bias


def hold_known(offset: FloatArray, known: Known) -> None:
    """What a prefix makes known of the samples takes the place of what is added to them ``[K, D, B, T]``."""
    offset[:, known.channels, :, known.positions] = known.values[1:].transpose(0, 3, 1, 2)
