"""What a policy is beside its network: denoising loops, normaliser, chunking, observations. Frozen and checked.

Nothing here imports torch; the same records are written to the artifact and read on the robot.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from ..errors import SpecError
from .chunk import LARGEST as LARGEST, Affine as Affine, ChunkSpec as ChunkSpec, Relative as Relative, Switch as Switch
from .coercion import Array, Arrays, integer
from .pictures import in_bytes
from .rules import LOOP_NAME, OMITTED, DType, LoopName, Positive, Shape
from .sampler import FloatArray as FloatArray, SamplerTable as SamplerTable
from .tokenizer import Instruction as Instruction

FP32, INT8, INT4, BF16, FP16 = "fp32", "int8", "int4", "bf16", "fp16"
PRECISIONS = (FP32, INT8, INT4)
"""Names of what an artifact can hold its weights in."""

ORIGINAL = "original"
"""The loop that a policy was trained to run in: ``PolicySpec.sampler``."""

COMMITTED = "committed"
"""Argument of a network that was trained to go on from a prefix: how many actions of the chunk are committed."""

WITHOUT = "without"
"""In ``PolicySpec.source``: the cameras of the checkpoint that were left out, with commas between."""

_KEY = re.compile(r"\w+([./ -]\w+)*")


@dataclass(frozen=True)
class ObservationSpec:
    """One array of the observation, which is one condition input of the denoiser.

    Attributes:
        shape: shape of one stream's array, for instance ``(To, Do)``.
        normalizer: applied over the last axis before the network sees it; None to pass as it is.
        dtype: numpy name of the dtype that callers must give.
        window: whether the first axis, where there are several, is time: the last To frames. A key without frames, such
            as an instruction, is what it is at the time of the call.
        bounds: the range of the values that random observations are drawn from, low and high, each a number or one for
            each entry of the last axis; None if that is not known. Integers outside it are refused: they are rows of an
            embedding. So are images (``image``). A vector may stray from it. Kept as tuples.
        fit: of an image: one of another size is resized to this shape (``core.values``). With ``start`` and ``centre``
            it keeps its proportions, and the rest is black: after it, or on both sides; likewise with ``bytes``, in 256
            steps. With ``stretch`` it fills the shape, in such steps whatever its size. With ``average`` it fills the
            shape, too, each pixel the mean of those that it touches. None: no other size is taken.
        fill: of an image that keeps its proportions: what is beside it in place of black, a number for each channel.
        recorded: the arrays of a recording of frames that it is made of, in order, where none has its name: ``NAME``,
            or ``NAME:N``, the first N numbers of one (``trajectories.load_trajectories``).
    """

    shape: Shape
    normalizer: Affine | None = None
    dtype: DType = "float32"
    window: bool = True
    bounds: tuple[float | tuple[float, ...], float | tuple[float, ...]] | None = None
    fit: Literal["start", "centre", "bytes", "stretch", "average"] | None = None
    fill: tuple[float, ...] = field(default=(), metadata=OMITTED)
    recorded: tuple[str, ...] = field(default=(), metadata=OMITTED)

    def __post_init__(self) -> None:
        sizes = tuple(integer(n, "a size in an observation's shape", SpecError, 1) for n in self.shape)
        object.__setattr__(self, "shape", sizes)
        if not sizes:
            raise SpecError("an observation needs a shape of one size or more; found ().")
        if self.normalizer is not None and self.normalizer.scale.shape != self.shape[-1:]:
            found = len(self.normalizer.scale)
            raise SpecError(f"normaliser has {found} entries for an observation of shape {self.shape}.")
        if self.bounds is not None:
            low, high = (np.atleast_1d(np.asarray(value, np.float64)) for value in self.bounds)
            fits = low.shape == high.shape and low.shape in ((1,), self.shape[-1:])
            if not (fits and np.isfinite([low, high]).all() and (low <= high).all()):
                raise SpecError(
                    f"bounds of an observation of shape {self.shape} must be two finite numbers in order, or two rows"
                    f" of {self.shape[-1]}; found {self.bounds}."
                )
            object.__setattr__(self, "bounds", (tuple(low.tolist()), tuple(high.tolist())))
        if isinstance(self.recorded, str):
            raise SpecError(f"recorded is a tuple of names of arrays; found {self.recorded!r:.80}.")
        if self.fit is not None and not self.image:
            raise SpecError(f"fit is for images with bounds; found an observation of shape {self.shape}.")
        if self.fill and (self.fit not in ("start", "centre") or len(self.fill) != self.shape[-3]):
            told = f"{len(self.fill)} numbers, fit {self.fit!r} and shape {self.shape}"
            raise SpecError(f"fill is one number for each channel, with fit start or centre; found {told}.")

    @property
    def frames(self) -> int | None:
        """To, the number of frames that the first axis holds; None without such an axis."""
        return self.shape[0] if self.window and len(self.shape) > 1 else None

    @property
    def one_frame(self) -> ObservationSpec:
        """The same of one frame, without an axis of several."""
        return self if self.frames is None else replace(self, shape=self.shape[1:], window=False)

    @property
    def image(self) -> bool:
        """Whether a frame is an image of floats, ``[C, H, W]``, whose bounds are the range of its numbers.

        Bounds of a vector may be statistics, from which the robot may stray; those of an image are how it is encoded.
        """
        axes = len(self.shape) - (self.frames is not None)
        one_pair = self.bounds is not None and len(np.atleast_1d(self.bounds[0])) == 1
        return one_pair and axes >= 3 and np.dtype(self.dtype).kind == "f"

    @property
    def numbers(self) -> bool:
        """Whether a frame is a row of numbers, such as the robot's state: hardly the same in two calls."""
        return len(self.shape) - (self.frames is not None) <= 1 and np.dtype(self.dtype).kind == "f"

    def draw(self, rng: np.random.Generator) -> npt.NDArray[np.generic]:
        """One stream's random observation ``[1, *shape]`` of the specified dtype, not normalised.

        Uniform within ``bounds``; without them within what the normaliser maps to -1..1, or in -1..1.
        """
        shape = (1, *self.shape)
        low, high = (np.asarray(value) for value in self.bounds or (-1.0, 1.0))
        if self.bounds is not None and np.dtype(self.dtype).kind in "iub":
            return rng.integers(low.astype(np.int64), high.astype(np.int64), shape, endpoint=True).astype(self.dtype)
        drawn = rng.uniform(low, high, shape).astype(np.float32)
        if self.bounds is None and self.normalizer is not None:
            drawn = self.normalizer.unnormalize(drawn)
        drawn = in_bytes(drawn) if self.fit == "stretch" else drawn
        return drawn.astype(self.dtype)

    def draw_normalized(self, rng: np.random.Generator, streams: int) -> Array:
        """Random observations ``[streams, *shape]`` as the network is given them."""
        return self.normalized(np.concatenate([self.draw(rng) for _ in range(streams)]))

    def normalized(self, array: Array) -> Array:
        """What the network is given of observations ``[..., *shape]``; the array itself without a normaliser."""
        return array if self.normalizer is None else self.normalizer.normalize(array)


@dataclass(frozen=True)
class PolicySpec:
    """Everything ``compile_denoiser`` has to know about a module ``eps(sample, timestep, **conditions)``.

    Attributes:
        sample: shape ``(T, D)`` of one stream's noisy sample.
        observations: condition inputs in the order of the module's keyword arguments; the keys are the keys of the
            observation dictionary that ``predict_action`` takes. Dots in a key are underscores in its argument's name.
        sampler: the denoising loop that the policy was trained to run in, ``original``.
        chunk: from sample to actions.
        sample_argument: name of the module's sample argument.
        timestep_argument: name of the module's timestep argument (a ``[B]`` tensor).
        source: what this was compiled from, for people: format and variant, no path.
        left_out: steps that the original predicts after the last one of the sample (``ttscompile.capture.narrow``).
        instruction: of a policy that is told its task in words, which a text alone gives; None for all others.
        loops: further denoising loops of the same network, by name: lower-case letters, digits, ``+ . -``. Sample,
            observations and chunk are common to all.
        noise: what a loop begins with: numbers of the ``normal`` distribution, or ``uniform`` ones of -1..1.
        trained_prefix: how many committed actions the network was trained to go on from, at most. It is told of them as
            ``committed``, int64 ``[B, 1]``, and finds them in the sample as they are, at every step. 0: it knows of no
            prefix, and one is inpainted.
    """

    sample: tuple[Positive, Positive]
    observations: Mapping[str, ObservationSpec]
    sampler: SamplerTable
    chunk: ChunkSpec
    sample_argument: str = "sample"
    timestep_argument: str = "timestep"
    source: Mapping[str, str] = field(default_factory=dict)
    left_out: int = 0
    instruction: Instruction | None = None
    loops: Mapping[LoopName, SamplerTable] = field(default_factory=dict)
    noise: Literal["normal", "uniform"] = field(default="normal", metadata=OMITTED)
    trained_prefix: int = field(default=0, metadata=OMITTED)

    def _require_arguments(self) -> None:
        """Raise unless every observation has an argument of its own."""
        own = self.sample_argument, self.timestep_argument, *[COMMITTED] * bool(self.trained_prefix)
        taken = dict.fromkeys(own, "an input of the loop")
        for key in self.observations:
            if not _KEY.fullmatch(key):
                expected = "expected letters, digits and _, with single . / - or blanks between them"
                raise SpecError(f"observation key {key!r}: {expected}.")
            argument = self.arguments[key]
            if argument in taken:
                told = f"observation key {key!r} is the argument {argument!r}, and so is {taken[argument]}"
                raise SpecError(f"{told}. Rename it: in a policy of LeRobot's by rename_map of its preprocessor.")
            taken[argument] = repr(key)

    def __post_init__(self) -> None:
        sizes = tuple(integer(n, "a size in the sample's shape", SpecError, 1) for n in self.sample)
        object.__setattr__(self, "sample", sizes)
        object.__setattr__(self, "left_out", integer(self.left_out, "left_out", SpecError))
        if len(sizes) != 2:
            raise SpecError(f"the sample's shape must be (T, D); found {self.sample}.")
        if self.noise not in ("normal", "uniform"):
            raise SpecError(f"noise is {self.noise!r:.80}; expected normal or uniform.")
        if not self.observations:
            raise SpecError("a policy needs at least one observation: a condition input of the denoiser.")
        self._require_arguments()
        horizon, channels = self.sample
        if self.chunk.stop > horizon or self.chunk.action_dim > channels:
            told = f"chunk [{self.chunk.start}:{self.chunk.stop}] of {self.chunk.action_dim} channels does not fit a"
            raise SpecError(f"{told} sample of {horizon} steps and {channels} channels.")
        longest = horizon + self.left_out - self.chunk.start - 1  # one action is left free
        count = integer(self.trained_prefix, "trained_prefix", SpecError, most=longest)
        object.__setattr__(self, "trained_prefix", count)
        words = self.instruction
        read = set() if words is None else {words.tokens, words.mask, *([words.state.key] if words.state else [])}
        if absent := sorted(read - self.observations.keys()):
            raise SpecError(f"the instruction's keys {absent} must be observations.")
        if words is not None and words.state is not None:
            counts = math.prod(self.observations[words.state.key].shape), len(words.state.first), len(words.state.width)
            if len(set(counts)) > 1 or 0 in words.state.width:
                raise SpecError(f"the state in the instruction must have as many numbers as widths, none 0: {counts}.")
        scale = np.ones(self.chunk.action_dim) if self.chunk.normalizer is None else self.chunk.normalizer.scale
        if scale.shape not in ((self.chunk.action_dim,), (horizon + self.left_out, self.chunk.action_dim)):
            expected = f"[{self.chunk.action_dim}], or a row for each of {horizon + self.left_out} steps"
            raise SpecError(f"action normaliser: expected {expected}; found shape {list(scale.shape)}.")
        self._check_relative()
        for name, table in self.loops.items():
            if not isinstance(name, str) or name == ORIGINAL or not LOOP_NAME.holds(name):
                told = f"expected {LOOP_NAME.expected}, and not {ORIGINAL!r}, which is the policy's own sampler"
                raise SpecError(f"loop {name!r:.80}: {told}.")
            kind, own = table.timesteps.dtype, self.sampler.timesteps.dtype
            if kind != own:
                told = f"its timesteps are {kind}, and those of the policy's own sampler {own}"
                raise SpecError(f"loop {name!r}: {told}: one network takes one kind. Convert them.")

    def _check_relative(self) -> None:
        if (relative := self.chunk.relative) is None:
            return
        if (seen := self.observations.get(relative.key)) is None:
            raise SpecError(f"actions are relative to {relative.key!r}, which is none of {sorted(self.observations)}.")
        shape, width = seen.shape[bool(seen.frames) :], 1 + max(n or 0 for n in relative.columns)
        if seen.dtype != "float32" or len(shape) != 1 or shape[0] < width:
            told = f"float32 [N] with N of {width} at least; found {seen.dtype} {list(shape)}"
            raise SpecError(f"actions are relative to observation {relative.key!r}: expected {told}.")

    @property
    def inputs(self) -> Mapping[str, ObservationSpec]:
        """What the network reads beside sample and timestep: the observations, and maybe how much is committed."""
        count = ObservationSpec((1,), dtype="int64", window=False, bounds=(0, self.trained_prefix))
        return {**self.observations, COMMITTED: count} if self.trained_prefix else self.observations

    def committed(self, streams: int, count: int = 0) -> dict[str, Array]:
        """What a network that was trained with prefixes reads of one of so many actions; of all others nothing."""
        return {COMMITTED: np.full((streams, 1), count)} if self.trained_prefix else {}

    def reference(self, obs: Arrays) -> FloatArray | None:
        """``ChunkSpec.reference`` of observations as the network is given them."""
        if (relative := self.chunk.relative) is None:
            return None
        seen, own = obs[relative.key], self.observations[relative.key].normalizer
        return self.chunk.reference({relative.key: seen if own is None else own.unnormalize(seen)})

    @property
    def arguments(self) -> Mapping[str, str]:
        """By observation key: the name of the module's argument that it is given as."""
        return {key: key.replace(".", "_") for key in self.inputs}

    @property
    def whole_horizon(self) -> PolicySpec:
        """The same with all steps that the original predicts."""
        return replace(self, sample=(self.sample[0] + self.left_out, self.sample[1]), left_out=0)

    @property
    def all_loops(self) -> dict[str, SamplerTable]:
        """Every loop by name, ``original`` first."""
        return {ORIGINAL: self.sampler, **self.loops}

    def draw_initial(self, rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
        """Random samples of this shape that loops begin with."""
        if self.noise == "uniform":
            return np.asarray(2 * rng.random(shape, dtype=np.float32) - 1)
        return rng.standard_normal(shape, dtype=np.float32)

    def in_loop(self, name: str) -> PolicySpec:
        """The policy that has this loop alone, as its own. Raises SpecError: there is no such loop."""
        if name not in self.all_loops:
            raise SpecError(f"loop {name!r:.80}: expected one of {', '.join(self.all_loops)}.")
        return replace(self, sampler=self.all_loops[name], loops={})


@dataclass(frozen=True)
class Noise:
    """The random numbers of one call.

    Attributes:
        initial: float32 ``[B, T, D]``, the sample at step 0.
        steps: float32 ``[K, B, T, D]``, the draw used at step k; None for a deterministic sampler.
    """

    initial: FloatArray
    steps: FloatArray | None = None
