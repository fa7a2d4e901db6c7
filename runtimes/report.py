"""What a runtime says about a call that it made."""

from dataclasses import dataclass, field

from ttscompile.core.envelope import FAR
from ttscompile.core.lattice import PlanArray
from ttscompile.core.plan import ORIGINAL

from .frames import FrameWork

GIVEN = "given"
"""``CallReport.plan_name`` of a plan that is none of the artifact's."""


@dataclass(frozen=True)
class Timings:
    """Wall time of one call in milliseconds.

    Attributes:
        prologue: condition values and step values from the observation.
        pruner: the pruner network and what makes a plan of its logits; 0 if the plan was given.
        wait_pruner: how long the denoising loop stood still for the pruner's plan; 0 if the plan was given.
        decode: the denoising loop, without that wait.
        total: from the normalised observation to the denoised sample.
        frames: of the prologue, what depends on frames and instruction alone and was not known.
    """

    prologue: float
    pruner: float
    wait_pruner: float
    decode: float
    total: float
    frames: float = 0.0


@dataclass(frozen=True)
class CallReport:
    """What one call did.

    Attributes:
        plan: int8 ``[B, K, blocks]`` of ``Source``, as executed. Read-only.
        plan_name: of a plan of the artifact, ``dense`` among them; or ``given`` for the caller's. Of a plan that begins
            with the chunk of the call before, where there was none, the plan that took its place.
        computed: computed cells of each stream.
        legalised: cells of each stream that were replaced because their residual was never computed.
        flops: FLOPs of each stream, multiply and add counted as two, prologue and pruner included.
        timings: wall time in milliseconds.
        frames: how many frames and scenes were computed and how many were known, and what that took and saved.
        loop: name of the loop that was executed.
        outside: of each stream of a plan with a correction, how far the observation is from what was recorded: 1 for
            the furthest recorded one. Above ``FAR`` a stream had as many steps, evenly spaced, and no correction.
            Empty where nothing is said of that: ``core.envelope``.
        unfitted: whether the prefix was longer than those that the plan's correction was fitted with.
    """

    plan: PlanArray
    plan_name: str
    computed: tuple[int, ...]
    legalised: tuple[int, ...]
    flops: tuple[float, ...]
    timings: Timings
    frames: FrameWork = field(default_factory=FrameWork)
    loop: str = ORIGINAL
    outside: tuple[float, ...] = ()
    unfitted: bool = False

    @property
    def far(self) -> bool:
        """Whether a stream was so far outside that it had no correction."""
        return any(distance > FAR for distance in self.outside)
