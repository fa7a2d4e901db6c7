"""What a compiled policy is, for whoever calls it."""

from collections.abc import Mapping
from dataclasses import dataclass

from ttscompile.core.spec import ChunkSpec, ObservationSpec

from .liveness import RolloutNeeds


@dataclass(frozen=True)
class BlockInfo:
    """One residual block: its kind, the shape of one stream's residual, and FLOPs of one evaluation."""

    kind: str
    shape: tuple[int, ...]
    flops: int


@dataclass(frozen=True)
class PolicyInfo:
    """What a compiled policy is.

    Attributes:
        K: number of denoising steps of the plan that it was loaded with.
        blocks: block table, in order of execution.
        dense_flops: of one call of the policy as it was before it was compiled, one stream.
        observation: specification of each key of the observation.
        action: which part of the denoised sample is action, and which of it is executed.
        sample: ``(T, D)``, the shape of one stream's noise and of what is predicted.
        original_sample: the same of the original, which may predict more steps; noise of this shape fits as well.
        stochastic: whether its loop draws noise in its steps, so that ``Noise.steps`` is needed; of a plan that begins
            with the chunk of the call before the whole loop.
        noise_steps: K of ``Noise.steps``, of the same loop; of more, the first K are taken.
        identity: sha256 of what the artifact computes.
        model_identity: the same without plans, corrections and pruner: what calibration leaves as it is.
        plans: names that ``predict_action(plan=...)`` takes.
        default_plan: the one that is taken when none is given; ``given`` for one that is none of the artifact's.
        precision: ``fp32``, or what that plan has some parts in: ``int8``, or on torch ``bf16`` and ``fp16``.
        rollout: what keeping the rollout cache of one stream takes.
        prefix_refusal: why ``predict_action`` takes no ``prefix``; None if it does.
        trained_prefix: how many actions a ``prefix`` may hold that the policy was trained to go on from; 0 where it was
            not, and a ``prefix`` of any length is inpainted.
        frames: how many pieces depend on one frame alone, and are remembered by its content; 0 where there are none, or
            where the runtime computes all of them in every call.
        reuses_tokens: whether of new frames only some tokens are computed, so that a call depends on the frames before.
        noise: what a loop begins with: numbers of the ``normal`` distribution, or ``uniform`` ones of -1..1.
        follows: whether that plan begins with the chunk of the call before, so that each call has to be one chunk later
            than the one before (``CompiledPolicy.follow`` tells it of one that is not).
        policy_hz: rate of the frames and actions that the policy was trained with, if the recordings or ``build`` said
            it.
        timed_on: where the plans were timed that the default was chosen among, in words, and what to do if that was
            another machine; None if none were.
        other_noise: mean difference of two answers of the original to one observation, if the calibration found one.
    """

    K: int
    blocks: tuple[BlockInfo, ...]
    dense_flops: int
    observation: Mapping[str, ObservationSpec]
    action: ChunkSpec
    sample: tuple[int, int]
    original_sample: tuple[int, int]
    stochastic: bool
    noise_steps: int
    identity: str
    model_identity: str
    plans: tuple[str, ...]
    default_plan: str
    precision: str
    rollout: RolloutNeeds
    prefix_refusal: str | None
    frames: int = 0
    reuses_tokens: bool = False
    follows: bool = False
    noise: str = "normal"
    other_noise: float | None = None
    trained_prefix: int = 0
    policy_hz: float | None = None
    timed_on: str | None = None
