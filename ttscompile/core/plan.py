"""What a call computes, as a value: every choice that can be made about a call is a field of ``Plan``.

An artifact has plans by name. Others are made of them with ``dataclasses.replace``. ``docs/design.md`` section 2 says
what the fields mean; no runtime has another way of being told what to compute.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from numbers import Real
from types import MappingProxyType

from ..errors import IllegalPlanError
from .coercion import integer
from .correction import Correction
from .lattice import PlanArray, Source
from .rules import OMITTED, NotNegative, Positive
from .spec import FP32, ORIGINAL as ORIGINAL

DENSE = "dense"
"""The plan that is the original policy: its loop, its weights, every cell computed. Every artifact has it."""
FULL = "full"
"""The plan that computes every cell of the loop, and in the precision, that ``convert`` was asked for."""
SCHEDULE = "schedule"
"""The best plan of a calibration that does not depend on the observation; and the proposer that finds such plans."""
UNIFORM = "uniform"
"""The plan that calibration adds for comparisons alone: as many steps computed, evenly spaced. Not for a robot."""


@dataclass(frozen=True)
class TokenReuse:
    """When a token of an image encoder, or of the scene, is computed anew.

    Attributes:
        threshold: a patch has changed where its pixels, as the encoder reads them, differ by more than this on average
            from those that its token was last computed for.
        refresh: of so many new frames of a camera, and of so many new scenes, one is computed whole.
        scene: a row of the sequence that the scene's language model reads has changed where its numbers differ by more
            than this share of their mean size, both on average. None: all tokens of a new scene are computed.
    """

    threshold: NotNegative
    refresh: Positive
    scene: NotNegative | None = field(default=None, metadata=OMITTED)

    def __post_init__(self) -> None:
        object.__setattr__(self, "refresh", integer(self.refresh, "refresh of a plan's tokens", IllegalPlanError, 1))
        for name in ("threshold", *["scene"] * (self.scene is not None)):
            value = getattr(self, name)
            number = isinstance(value, Real) and not isinstance(value, bool)
            if not number or not float(value) >= 0:  # a patch is never further than NaN from another one
                wanted = f"{name} of a plan's tokens: expected a number that is not negative"
                raise IllegalPlanError(f"{wanted}; found {value!r:.80}.")
            object.__setattr__(self, name, float(value))


@dataclass(frozen=True)
class Variant:
    """What has to be opened for a plan, and is common to all plans that differ in cells and correction alone."""

    loop: str = ORIGINAL
    weights: str = ORIGINAL
    precision: tuple[tuple[str, str], ...] = ()
    tokens: TokenReuse | None = None


@dataclass(frozen=True, eq=False)
class Plan:
    """What a call computes. Two plans are the same only if they are one object.

    Attributes:
        loop: name of a loop of the artifact: which sampler, at which timesteps, and whether it begins with noise or
            with the chunk of the call before.
        cells: int8 ``[K, blocks]`` of ``Source``, or ``[B, K, blocks]`` for streams that differ; None: the pruner makes
            them for each observation.
        correction: what is added to the sampler's steps, jumps included; None for nothing.
        weights: name of the weights that residual blocks have from step 1 on.
        precision: by part (``ir.pieces.part_of``) the precision of its weights; parts that are not named are in fp32.
        tokens: when a token of an image encoder or of the scene is computed anew; None: all of what is new are.
        otherwise: of a loop that begins with the chunk of the call before, the plan of a call that has none: the first
            of an episode, and one that is late. None for the loops that begin with noise.
        repair: whether reads of what was never computed are replaced and counted (``lattice.legalize``), or the call is
            refused. The plans of an artifact are repaired.
    """

    loop: str = ORIGINAL
    cells: PlanArray | None = None
    correction: Correction | None = None
    weights: str = ORIGINAL
    precision: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    tokens: TokenReuse | None = None
    otherwise: Plan | None = None
    repair: bool = False

    def __post_init__(self) -> None:
        for name in ("loop", "weights"):
            if not isinstance(getattr(self, name), str):
                raise IllegalPlanError(f"a plan's {name}: expected a name; found {getattr(self, name)!r:.80}.")
        for name, kind in (("correction", Correction), ("tokens", TokenReuse), ("otherwise", Plan)):
            if not isinstance(value := getattr(self, name), kind | None):
                raise IllegalPlanError(f"a plan's {name}: expected a {kind.__name__}, or None; found {value!r:.80}.")
        if not isinstance(self.precision, Mapping):
            wanted = "expected a precision by part, {'blocks': 'int8'}"
            raise IllegalPlanError(f"a plan's precision: {wanted}; found {self.precision!r:.80}.")
        narrow = {part: one for part, one in self.precision.items() if one != FP32}
        object.__setattr__(self, "precision", MappingProxyType(narrow))

    def __reduce__(self) -> tuple[type[Plan], tuple[object, ...]]:
        """Sent to another process, or copied: another plan with the same fields. A read-only mapping cannot be sent."""
        own = {one.name: getattr(self, one.name) for one in fields(self)}
        return Plan, tuple({**own, "precision": dict(self.precision)}.values())

    @property
    def pruned(self) -> bool:
        """Whether the pruner makes the cells."""
        return self.cells is None

    @cached_property
    def variant(self) -> Variant:
        """What has to be opened for it."""
        return Variant(self.loop, self.weights, tuple(sorted(self.precision.items())), self.tokens)

    def in_words(self) -> str:
        """What it does: ``3 of 16 steps of dpmsolver++-16, int8 in blocks and condition``."""
        if self.cells is None:
            told = [f"the steps of {self.loop} that the pruner chooses"]
        else:
            steps = (self.cells == Source.COMPUTE).any(axis=-1).sum(axis=-1).max()
            told = [f"{steps} of {self.cells.shape[-2]} steps of {self.loop}"]
        for one in sorted(set(self.precision.values())):
            told.append(f"{one} in {' and '.join(part for part, own in self.precision.items() if own == one)}")
        told += [f"weights {self.weights!r}"] * (self.weights != ORIGINAL)
        if self.tokens is not None:
            told += ["some tokens of each new frame" + " and scene" * (self.tokens.scene is not None)]
        told += ["from the chunk of the call before"] * (self.otherwise is not None)
        return ", ".join(told)

    @property
    def exact(self) -> Plan:
        """The same with all parts in fp32 and all tokens computed, which every runtime can do; itself if it is so."""
        otherwise = None if self.otherwise is None else self.otherwise.exact
        if not self.precision and self.tokens is None and otherwise is self.otherwise:
            return self
        return replace(self, precision={}, tokens=None, otherwise=otherwise)
