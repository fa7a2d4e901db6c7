"""What of a denoised sample is action: its normaliser, what is relative or has two values alone, what is executed."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import ObservationError, SpecError
from .coercion import Arrays, integer, numbers
from .poses import NUMBERS, Pose, composed, has_rotation
from .rules import OMITTED
from .sampler import FloatArray

LARGEST = 1e6
"""No number that goes into the network, normalised, is larger, either way; what is cannot be from training. A range
maps to -1..1, and of N samples none is further than sqrt(N - 1) deviations from their mean. A network multiplies up to
four of its numbers (a gated product of two, and a LayerNorm squares that): this leaves 1e14 for weights and sums."""


@dataclass(frozen=True)
class Affine:
    """A normaliser: ``x * scale + offset``; inverted as ``(x - offset) / scale``.

    Attributes:
        scale: float32 ``[D]``, finite and not zero; or ``[T, D]``, a row for each step of a chunk.
        offset: float32, of the same shape, finite.
    """

    scale: FloatArray
    offset: FloatArray

    def __post_init__(self) -> None:
        for name in ("scale", "offset"):
            array = numbers(getattr(self, name), f"normaliser {name}", SpecError)
            if array.ndim not in (1, 2) or not np.isfinite(array).all():
                raise SpecError(f"normaliser {name} must be finite, [D] or [T, D]; found shape {array.shape}, {array}.")
            object.__setattr__(self, name, array)
        if self.scale.shape != self.offset.shape:
            raise SpecError(f"normaliser scale {self.scale.shape} and offset {self.offset.shape} differ in shape.")
        if (self.scale == 0).any():
            raise SpecError(f"normaliser scale is zero at {np.flatnonzero(self.scale == 0).tolist()}: not invertible.")

    def at(self, steps: slice | npt.NDArray[np.int64]) -> Affine:
        """The same with the rows of these steps alone, in their order, where there is one for each step."""
        return self if self.scale.ndim == 1 else Affine(self.scale[steps], self.offset[steps])

    @cached_property
    def reach(self) -> float:
        """Numbers up to this size, either way, are normalised to at most ``LARGEST`` in every entry."""
        return float(((LARGEST - np.abs(self.offset, dtype=np.float64)) / np.abs(self.scale)).min())

    def normalize(self, x: npt.NDArray[np.float32]) -> FloatArray:
        """``x * scale + offset`` over the last axis."""
        return np.asarray(x * self.scale + self.offset, dtype=np.float32)

    def unnormalize(self, x: npt.NDArray[np.float32]) -> FloatArray:
        """``(x - offset) / scale`` over the last axis."""
        return np.asarray((x - self.offset) / self.scale, dtype=np.float32)


@dataclass(frozen=True)
class Switch:
    """A number of the actions that has two values alone, as a gripper's may.

    Attributes:
        channel: which number it is.
        threshold: of the denoised sample: from there on the value is ``above``, else ``below``.
        below: in the actions' own units, like ``above``.
    """

    channel: int
    threshold: float
    below: float
    above: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "channel", integer(self.channel, "a switch's channel", SpecError))
        if not np.isfinite([self.threshold, self.below, self.above]).all():
            raise SpecError(f"a switch's threshold and values must be finite; found {self}.")


@dataclass(frozen=True)
class Relative:
    """Numbers of the actions that are relative to what the robot measures: the network gives the difference.

    Attributes:
        key: of the observation; it counts as it is given, and of several frames the newest.
        entries: for each number of the actions, which number of the observation is added to it; None for none.
        poses: nine numbers of the actions each, which are composed with nine of the observation, and not added.
    """

    key: str
    entries: tuple[int | None, ...]
    poses: tuple[Pose, ...] = field(default=(), metadata=OMITTED)

    def __post_init__(self) -> None:
        own = tuple(None if n is None else integer(n, "an entry of relative", SpecError) for n in self.entries)
        object.__setattr__(self, "entries", own)
        taken = [n for n, entry in enumerate(own) if entry is not None]
        taken += [n for pose in self.poses for n in range(pose.action, pose.action + NUMBERS)]
        if len(set(taken)) < len(taken) or max(taken, default=-1) >= len(own):
            told = f"{NUMBERS} numbers each of {len(own)}, of which no other pose has one, with None in entries"
            raise SpecError(f"relative has the poses {self.poses} and the entries {own}; expected {told}.")

    @cached_property
    def columns(self) -> tuple[int | None, ...]:
        """For each number of the actions, which number of the observation it needs; None for none."""
        found = list(self.entries)
        for pose in self.poses:
            found[pose.numbers] = range(pose.measured, pose.measured + NUMBERS)
        return tuple(found)

    def places(self, width: int) -> list[int]:
        """Where each number finds what it needs, in an observation of this width with a zero behind it."""
        return [width if entry is None else entry for entry in self.columns]

    def absolute(self, actions: Any, reference: Any, library: Any = np, inverse: bool = False) -> Any:
        """Actions ``[..., Da]`` of the robot, of what the network gives and of ``ChunkSpec.reference``; or the inverse.

        Arrays of numpy, as float64; or tensors where torch is the library. NaN where a pose has no rotation.
        """
        if library is np:
            actions, reference = np.float64(actions), np.float64(reference)
        changed = actions - reference if inverse else actions + reference
        with np.errstate(all="ignore"):
            for pose in self.poses:
                both = reference[..., pose.numbers], actions[..., pose.numbers]
                changed[..., pose.numbers] = composed(*both, library, inverse)
        return changed


@dataclass(frozen=True)
class ChunkSpec:
    """What of the denoised sample ``[T, D]`` is action, and what of the actions is executed.

    Attributes:
        action_dim: the first ``action_dim`` channels of the sample are the action (``action_pred``).
        start: first executed step of the chunk (``To - 1`` for Diffusion Policy).
        stop: one past the last executed step.
        normalizer: its inverse is applied to the actions; None to return them as they are. With rows, those of all
            steps that the original predicts.
        ranged: whether the normaliser maps the range of the actions in training to -1..1, so that no action should be
            far outside; not one by mean and deviation, or by quantiles.
        switches: numbers of the actions that the normaliser is not for.
        relative: what actions are relative to, once they are denormalised; None for nothing.
    """

    action_dim: int
    start: int
    stop: int
    normalizer: Affine | None = None
    ranged: bool = True
    switches: tuple[Switch, ...] = field(default=(), metadata=OMITTED)
    relative: Relative | None = field(default=None, metadata=OMITTED)

    def __post_init__(self) -> None:
        for name in ("action_dim", "start", "stop"):
            object.__setattr__(self, name, integer(getattr(self, name), f"a chunk's {name}", SpecError))
        if not self.start < self.stop or self.action_dim < 1:
            raise SpecError(f"chunk [{self.start}:{self.stop}] of {self.action_dim} channels is empty.")
        channels = [one.channel for one in self.switches]
        if len(set(channels)) < len(channels) or max(channels, default=0) >= self.action_dim:
            raise SpecError(
                f"switches are of the channels {channels}; expected different ones below {self.action_dim}."
            )
        entries = (None,) * self.action_dim if self.relative is None else self.relative.columns
        if len(entries) != self.action_dim or any(entries[channel] is not None for channel in channels):
            raise SpecError(f"relative has {entries}; expected {self.action_dim} entries, and None for {channels}.")

    @cached_property
    def scale(self) -> FloatArray:
        """How large a unit of each number of the executed actions is once normalised, ``[Da]`` or ``[Ta, Da]``."""
        if self.normalizer is None:
            return np.ones(self.action_dim, np.float32)
        return np.abs(self.normalizer.at(slice(self.start, self.stop)).scale)

    @property
    def usual(self) -> Affine | None:
        """What maps the range in which actions usually are to -1..1; None where it is not known."""
        if self.normalizer is None or not self.ranged or self.relative is not None:
            return None
        scale, offset = self.normalizer.scale.copy(), self.normalizer.offset.copy()
        for one in self.switches:
            width = abs(one.above - one.below) or 2.0
            scale[..., one.channel], offset[..., one.channel] = 2 / width, -(one.above + one.below) / width
        return Affine(scale, offset)

    @property
    def executes(self) -> int:
        """Ta: how many steps of the chunk are executed."""
        return self.stop - self.start

    def executed(self, samples: Any) -> Any:
        """The executed part ``[..., Ta, Da]`` of denoised samples ``[..., T, D]``, or of actions ``[..., T, Da]``."""
        return samples[..., self.start : self.stop, : self.action_dim]

    def reference(self, obs: Arrays) -> FloatArray | None:
        """What actions of a call with these observations, as given, are relative to, ``[B, 1, Da]``; None for nothing.

        There are zeros where actions are not relative. Raises ObservationError: a measured pose has no rotation.
        """
        if self.relative is None:
            return None
        seen = obs[self.relative.key]
        newest = np.pad(seen.reshape(len(seen), -1, seen.shape[-1])[:, -1:], ((0, 0), (0, 0), (0, 1)))
        for pose in self.relative.poses:
            own = newest[:, 0, pose.measured : pose.measured + NUMBERS]
            if not (turned := has_rotation(own)).all():
                told = f"numbers {pose.measured + 3} to {pose.measured + NUMBERS - 1} are to be two rows of a rotation"
                found = f"{own[~turned][0, 3:].tolist()} of stream {int(np.flatnonzero(~turned)[0])}"
                raise ObservationError(
                    f"observation {self.relative.key!r}: {told}, of length 1 and at right angles; found {found}, which"
                    " gives none. Give the measured pose: a position, then the first two rows of its matrix."
                )
        return np.asarray(newest[..., self.relative.places(seen.shape[-1])])

    def unnormalized(self, sample: FloatArray, reference: FloatArray | None = None, first: int = 0) -> FloatArray:
        """The actions ``[..., Da]`` of denoised samples ``[..., D]``, in their own units.

        Args:
            sample: with an axis of steps before the last.
            reference: what they are relative to, from the method of that name.
            first: which step of the chunk is the sample's first.
        """
        assert (reference is None) is (self.relative is None)
        own = sample[..., : self.action_dim]
        actions = own if self.normalizer is None else self.normalizer.at(_from(first, own)).unnormalize(own)
        if self.relative is not None:
            actions = self.relative.absolute(actions, reference).astype(np.float32)
        for one in self.switches:
            beyond = own[..., [one.channel]] >= np.float32(one.threshold)
            at = np.arange(self.action_dim) == one.channel
            actions = np.where(at, np.where(beyond, np.float32(one.above), np.float32(one.below)), actions)
        return actions

    def moved(
        self, sample: FloatArray, executed: int, change: tuple[FloatArray, FloatArray] | None = None
    ) -> FloatArray:
        """Denoised samples ``[B, T, D]`` so many steps later; the last step is repeated where none is left.

        ``change`` is what their actions are relative to, and what they will be: the actions stay the same.
        """
        steps = np.minimum(np.arange(sample.shape[1]) + executed, sample.shape[1] - 1)
        later, normalizer = sample[:, steps], self.normalizer
        if change is not None or (normalizer is not None and normalizer.scale.ndim > 1):
            own = later[..., : self.action_dim]
            actions = own if normalizer is None else normalizer.at(steps).unnormalize(own)
            if self.relative is not None and change is not None:
                before, now = change
                actions = self.relative.absolute(self.relative.absolute(actions, before), now, inverse=True)
            later[..., : self.action_dim] = self.normalized(actions)
        return later

    def normalized(self, actions: FloatArray, first: int = 0) -> FloatArray:
        """What a network has for actions ``[..., N, Da]`` that are what it gives, from this step of a chunk on."""
        return actions if self.normalizer is None else self.normalizer.at(_from(first, actions)).normalize(actions)


def _from(first: int, sample: FloatArray) -> slice:
    """The steps of a sample ``[..., N, D]`` that begins with this one."""
    return slice(first, first + sample.shape[-2])
