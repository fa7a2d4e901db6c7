"""What can be set on an executor, and what of it follows from the policy."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from math import ceil, inf, isfinite
from numbers import Real
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ttscompile.core.coercion import integer
from ttscompile.core.poses import has_rotation, orthonormal
from ttscompile.errors import ExecutorError

from .feasibility import Feasibility
from .guard import GuardLimits, StallRule
from .window import FrameSpec

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ttscompile.core.poses import Pose
    from ttscompile.core.spec import FloatArray, Switch
    from ttscompile.runtimes.frames import FrameWork
    from ttscompile.runtimes.info import PolicyInfo

INTERPOLATIONS = ("hold", "linear")
SEAMS = ("replace", "blend", "ensemble", "prefix")

_MAY_BE_ZERO = frozenset(
    {"blend_steps", "max_hold", "margin_ticks", "warm_up", "trace_events", "reserve", "first", "trained_prefix"}
)
"""Of the whole numbers among the settings; the others are at least 1."""

_MOST = 10**9
"""Of any of them: a week of ticks at a kilohertz, and a queue that Python can have."""

_BETWEEN: dict[str, tuple[Any, ...]] = {
    "rate_tolerance": (0.5, "between 0 and 0.5 periods"),
    "ensemble_coefficient": (10.0, "between -10 and 10", -10.0),
}
"""Of the numbers among the settings those that are not any positive one; see ``require_number``. At a coefficient of 10
one prediction weighs more than 20,000 times as much as the next."""

NO_CHUNK = 10**6
"""Steps to tell ``follow``: more than any chunk has, so that the next call begins with noise."""


class Policy(Protocol):
    """What the executor calls: a ``CompiledPolicy``, or what acts like one."""

    @property
    def info(self) -> Any:
        """Of ``PolicyInfo``: ``observation, action, sample, plans, default_plan``; ``policy_hz`` may be missing."""

    def reset(self, seed: int | None = None) -> None:
        """A new episode; or, without a seed, within one, where a call shall go on from nothing (``stall_after``)."""

    def predict_action(self, obs_dict: Mapping[str, Any], *, plan: str) -> Mapping[str, Any]:
        """``{"action": [1, Ta, Da], "action_pred": [1, T, Da]}``.

        One whose ``default_plan`` is none of its ``plans`` is called without a plan for it. One that has ``follow``,
        too, is told how many steps of its last chunk are executed before the next call, and ``NO_CHUNK`` where that is
        not played. One that has ``with_tokens`` puts them into frames, in any thread.
        """


class SeeingPolicy(Policy, Protocol):
    """A policy whose ``info.frames`` is there, and not 0: the executor has it prepare frames while nothing waits."""

    def prepare_frame(self, frame: Mapping[str, Any], stop: Callable[[], bool]) -> FrameWork:
        """Compute what depends on one frame alone, by key ``[1, ...]``, until ``stop`` says so."""


@dataclass(frozen=True)
class ExecutorSettings:
    """Settings of an ``AsyncExecutor``; times in seconds, rates in Hz.

    Attributes:
        policy_hz: rate of frames and actions that the policy was trained with; None: what the artifact says
            (``PolicyInfo.policy_hz``), or the control rate. The control rate has to be a multiple of it.
        interpolation: between actions, if the control loop is faster than the policy: ``hold`` or ``linear``.
        n_obs_steps: To; None: of the observations' windows; of several, what the chunking implies, ``start + 1``.
        horizon: actions from one call to the next; None: as many as the policy executes of a chunk.
        reserve: actions of a chunk after its horizon that may be played; None: all that the policy predicts. Of these
            as many are planned with as a call and the margin take, so that a chunk which comes late by its latency is
            played for as much longer. What is left bridges a chunk that misses its deadline; that is counted. None are
            kept where the guard refuses one. With 0 no action is played that the policy would not execute, calls start
            sooner, and nothing but the last action is left for a chunk that is late.
        rate_tolerance: how far from its place in the window a frame may be, as a share of the policy's period.
        max_age: of the newest frame of a window when a call starts; None: three periods of the policy.
        seam: how a chunk joins those before: ``replace``; ``blend``, linear over ``blend_steps``; ``ensemble``, each
            action a weighted mean of what all chunks predicted for it; or ``prefix`` (experimental), for policies that
            take ``prefix``, the actions that are committed already, and inpaint.
        blend_steps: control ticks.
        ensemble_coefficient: m of the weights ``exp(-m * i)`` of ``ensemble``, i = 0 for the oldest prediction of a
            tick: 0 for a plain mean, negative where new predictions shall count more than old ones.
        max_hold: control ticks for which the last action is repeated when there is no other, not even in reserve; then
            ``action`` raises. ``displacements`` are 0 meanwhile.
        displacements: channels whose actions say how far to move, or how fast, not where to. What a chunk meant for the
            ticks before it came, less what was given out in them, is added to its next actions, within the guard's
            bounds: at once, or with ``blend`` over ``blend_steps``. Otherwise it is lost at every seam.
        margin_ticks: control ticks that a chunk shall be there before it is needed.
        warm_up: first calls of each plan whose latency does not count.
        measured_calls: calls of each plan, after these, that measure its latency before the executor is ready. Of one
            that begins with the chunk of the call before, some have none.
        latency_window: calls whose longest latency is reckoned with.
        refuse_infeasible: raise if no tier is fast enough; False lets a loop miss its deadlines knowingly.
        tiers: plans from slow to fast; None: the policy's default plan alone.
        down_after: missed deadlines in a row after which the next faster plan is run.
        up_after: calls in time, in a row, after which the next slower plan is tried again.
        stall_after: seconds. If the actions given out for as long stay within ``stall_range`` of the first of them, the
            policy has stopped moving: it forgets all that a call goes on from, and the next call runs ``stall_plan``.
            Then it is given as long again. None: nobody looks.
        stall_range: for each channel, in units of the normalised actions: 2 is a channel's range in training where the
            normaliser knows that, and 1 its standard deviation where it knows this. Without a normaliser, as it is.
        stall_plan: whose latency is measured, too.
        guard: limits on actions.
        cores: processors that the policy's thread is pinned to; None: any.
        statistics_window: measurements that percentiles are made from.
        trace_events: events that the trace keeps; 0 for no trace.
    """

    policy_hz: float | None = None
    interpolation: str = "hold"
    n_obs_steps: int | None = None
    horizon: int | None = None
    reserve: int | None = None
    rate_tolerance: float = 0.3
    max_age: float | None = None
    seam: str = "replace"
    blend_steps: int = 4
    ensemble_coefficient: float = 0.01
    max_hold: int = 3
    displacements: tuple[int, ...] = ()
    margin_ticks: int = 1
    warm_up: int = 2
    measured_calls: int = 5
    latency_window: int = 50
    refuse_infeasible: bool = True
    tiers: tuple[str, ...] | None = None
    down_after: int = 1
    up_after: int = 20
    stall_after: float | None = None
    stall_range: float = 0.02
    stall_plan: str = "dense"
    guard: GuardLimits = field(default_factory=GuardLimits)
    cores: tuple[int, ...] | None = None
    statistics_window: int = 4096
    trace_events: int = 65536

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if one.type == "int" or (one.type == "int | None" and value is not None):
                least = 0 if one.name in _MAY_BE_ZERO else 1
                object.__setattr__(self, one.name, integer(value, one.name, ExecutorError, least, _MOST))
            if one.type == "float" or (one.type == "float | None" and value is not None):
                own = require_number(value, one.name, *_BETWEEN.get(one.name, ()))
                object.__setattr__(self, one.name, own)
        for name, what in (("cores", "a processor"), ("displacements", "a channel")):
            if (given := getattr(self, name)) is not None:
                if not isinstance(given, tuple | list | range):
                    raise ExecutorError(f"{name} must be a tuple of whole numbers; found {given!r:.80}.")
                object.__setattr__(self, name, tuple(integer(n, f"{what} in {name}", ExecutorError) for n in given))
        if not isinstance(self.stall_plan, str):
            raise ExecutorError(f"stall_plan must be the name of a plan; found {self.stall_plan!r}.")
        if self.interpolation not in INTERPOLATIONS:
            raise ExecutorError(f"interpolation must be one of {INTERPOLATIONS}; found {self.interpolation!r}.")
        if self.seam not in SEAMS:
            raise ExecutorError(f"seam must be one of {SEAMS}; found {self.seam!r}.")
        names = self.tiers if isinstance(self.tiers, tuple | list) else ()
        distinct = {name for name in names if isinstance(name, str)}
        if self.tiers is not None and not 0 < len(names) == len(distinct):
            raise ExecutorError(f"tiers must be a tuple of names of plans, each once; found {self.tiers!r:.80}.")


def require_number(
    value: object, name: str, below: float = inf, wanted: str = "positive and finite", above: float = 0.0
) -> float:
    """A number between two others, as a float: in float32 times would be one. Raises ExecutorError: it is no such."""
    if isinstance(value, bool) or not isinstance(value, Real) or not above < float(value) < below:
        raise ExecutorError(f"{name} must be a number, {wanted}; found {value!r}.")
    return float(value)


@dataclass(frozen=True, kw_only=True)
class Resolved(ExecutorSettings):
    """Settings with everything that follows from the policy filled in.

    Attributes:
        control_hz: ticks a second.
        ticks_per_step: control ticks that an action lasts.
        first: index in ``action_pred`` of the first action that is played.
        channels: Da.
        frames: what one frame holds.
        stall: when the policy has stopped moving; None if nobody looks.
        trained_prefix: see ``PolicyInfo``; 0 where the seam is not ``prefix``.
        switches: numbers of an action that have two values alone.
        poses: nine numbers of an action each, of which six are a rotation.
        unnamed: what a default plan is called that was given to ``load`` and is none of ``plans``; None for others.
    """

    policy_hz: float
    horizon: int
    reserve: int
    max_age: float
    tiers: tuple[str, ...]
    control_hz: float
    ticks_per_step: int
    first: int
    channels: int
    frames: FrameSpec
    stall: StallRule | None
    trained_prefix: int
    switches: tuple[Switch, ...]
    poses: tuple[Pose, ...]
    unnamed: str | None

    def plan_argument(self, plan: str) -> dict[str, str]:
        """What asks ``predict_action`` for a plan, by keyword; nothing where it is called without one."""
        return {} if plan == self.unnamed else {"plan": plan}

    def possible(self, row: FloatArray, before: FloatArray | None) -> FloatArray:
        """An action with the nearer of two values where it has no other: a seam or ``linear`` may be between them.

        And with rotations, of which these and a guard's limits may make numbers that are none. Of two that are opposite
        nothing is between: that of the action before stands.
        """
        row = row.copy()
        for pose in self.poses:
            own = row[pose.numbers]
            if has_rotation(own):
                row[pose.numbers] = orthonormal(own)
            elif before is not None:
                own[3:] = before[pose.numbers][3:]
        for one in self.switches:
            row[one.channel] = min(one.below, one.above, key=lambda value: abs(value - row[one.channel]))
        return row

    @property
    def plans(self) -> tuple[str, ...]:
        """All that calls may run: the tiers first."""
        return tuple(dict.fromkeys(self.tiers if self.stall is None else (*self.tiers, self.stall.plan)))

    def feasibility(self, latency: float) -> Feasibility:
        """The arithmetic of calls of so many seconds."""
        own = latency, self.control_hz, self.policy_hz, self.horizon, self.margin_ticks, self.reserve
        return Feasibility(*own, self.trained_prefix)


def resolve(settings: ExecutorSettings, info: PolicyInfo, control_hz: float) -> Resolved:
    """Fit settings to a policy. Raises ExecutorError: they do not fit."""
    control_hz = require_number(control_hz, "control_hz")
    policy_hz = settings.policy_hz or getattr(info, "policy_hz", None) or control_hz  # those of others may lack it
    ticks = control_hz / policy_hz
    ticks_per_step = round(ticks) if isfinite(ticks) else 0
    if ticks_per_step < 1 or abs(ticks_per_step * policy_hz - control_hz) > 1e-6 * control_hz:
        told = "" if settings.policy_hz else ", at which its recordings were made"
        what = f"control_hz = {control_hz:g} is no multiple of policy_hz = {policy_hz:g}{told}"
        lasts = f"an action would last {control_hz / policy_hz:.4g} ticks"
        other = ", or give another policy_hz" if told else ""
        raise ExecutorError(f"{what}: {lasts}. Run the loop at a multiple of the policy's rate{other}.")
    chunk, tiers = info.action, settings.tiers or (info.default_plan,)
    longest = info.sample[0] - chunk.start
    horizon = settings.horizon or chunk.executes
    if horizon > longest:
        predicted = f"{info.sample[0]} actions, {longest} of them from the observation on"
        raise ExecutorError(f"horizon = {horizon}: the policy predicts {predicted}. Give at most {longest}.")
    reserve = longest - horizon if settings.reserve is None else settings.reserve
    if reserve > longest - horizon:
        raise ExecutorError(
            f"reserve = {reserve}: the policy predicts {longest} actions from the observation on, and horizon ="
            f" {horizon} are played anyway. Give at most {longest - horizon}, or None for all."
        )
    if max(settings.displacements, default=0) >= chunk.action_dim:
        have = f"actions have {chunk.action_dim} channels, 0 to {chunk.action_dim - 1}"
        raise ExecutorError(f"displacements = {settings.displacements}: {have}. Name the channels among these.")
    poses = () if chunk.relative is None else chunk.relative.poses
    of_poses = {n for pose in poses for n in range(chunk.action_dim)[pose.numbers]}
    if clash := sorted(of_poses.intersection(settings.displacements)):
        where = "are numbers of poses, which say where to be, and not how far to move. Leave them out"
        raise ExecutorError(f"displacements = {settings.displacements}: {clash} {where}.")
    windows = {spec.frames for spec in info.observation.values() if spec.frames is not None}
    of_window = chunk.start + 1 if len(windows) != 1 else max(windows)
    stall = None
    if settings.stall_after is not None:
        reach = np.float32(settings.stall_range) / np.atleast_2d(chunk.scale).max(0)
        after = ceil(settings.stall_after * control_hz)
        stall = StallRule(after, reach, settings.stall_plan, settings.displacements)
    named = tiers if stall is None else (*tiers, stall.plan)
    if unknown := [name for name in named if name.partition("@")[0] not in (*info.plans, info.default_plan)]:
        known = list(info.plans)
        raise ExecutorError(
            f"the policy has no plan {unknown[0]!r}; it has {known}. Name tiers and stall_plan among these."
        )
    found = vars(settings) | {
        "policy_hz": policy_hz,
        "horizon": horizon,
        "reserve": reserve,
        "max_age": settings.max_age or 3 / policy_hz,
        "tiers": tiers,
        "control_hz": control_hz,
        "ticks_per_step": ticks_per_step,
        "first": chunk.start,
        "channels": chunk.action_dim,
        "frames": FrameSpec.of(info.observation, settings.n_obs_steps or of_window, chunk),
        "stall": stall,
        "trained_prefix": info.trained_prefix if settings.seam == "prefix" else 0,
        "switches": chunk.switches,
        "poses": poses,
        "unnamed": None if info.default_plan.partition("@")[0] in info.plans else info.default_plan,
    }
    return Resolved(**found)
