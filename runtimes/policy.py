"""The object that users hold: observations in, actions out. ``docs/design.md`` section 8."""

import threading
import weakref
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ttscompile.artifact.load import Artifact
from ttscompile.core.coercion import Array, Arrays, integer
from ttscompile.core.plan import Plan
from ttscompile.core.spec import FP32, FloatArray, Noise
from ttscompile.errors import NonFiniteActionsError, TtscompileError
from ttscompile.measure.machine import elsewhere
from ttscompile.measure.process import LONGEST_WAIT, Process

from .arrays import check_observation, check_seed, like, read_observation
from .frames import FrameWork
from .info import BlockInfo, PolicyInfo
from .inpainting import check_prefix, prefix_refusal
from .instruct import Instruct
from .liveness import rollout_needs
from .queues import Queues, is_window
from .random_calls import noise_of_any_horizon
from .report import GIVEN, CallReport
from .runtime import Runtime
from .tokens import Seen

NO_PREFIX = "its plan begins with the chunk of the call before, and so keeps to it already."

AnyPlan: TypeAlias = str | Plan | npt.ArrayLike | None
"""What ``predict_action`` takes as a plan."""


class CompiledPolicy:
    """A policy that takes the place of the original: ``reset`` at the start of an episode, then ``predict_action``.

    One caller at a time; a second one gets an error rather than somebody else's residuals. A forked process gets one,
    too, where the call might hang: load the policy in the process that calls it.

    Args:
        artifact: loaded and checked.
        runtime: opened on the same artifact, and for the same plan.
        seed: of the noise that is drawn when none is given.
        plan: see ``load``.
        origin: ``hf://org/name@commit`` of an artifact from the hub; None for another.
        instruct: puts tokens in the place of a task's text; None for none.

    Raises:
        IllegalPlanError: the artifact has no plan of this name.
    """

    def __init__(
        self,
        artifact: Artifact,
        runtime: Runtime,
        seed: int | None = None,
        plan: str | Plan | None = None,
        origin: str | None = None,
        instruct: Instruct | None = None,
    ) -> None:
        self.origin = origin
        self._artifact, self._runtime, self._instruct = artifact, runtime, instruct
        self._spec = artifact.manifest.spec  # of what all loops have in common
        self._default = plan_of(artifact, plan)
        self._rng = np.random.default_rng(check_seed(seed))
        self._report: CallReport | None = None
        self._queues = Queues(artifact.manifest.spec.observations)
        self._lock, self._process = threading.Lock(), Process()
        self._exit = weakref.finalize(self, _end_calls, self._lock, self._process)

    def __getstate__(self) -> None:
        """Refuse to be copied, and to be sent to another process. Raises TtscompileError: always."""
        remedy = "Load it again, where it is called: ttscompile.load(DIR)."
        raise TtscompileError(f"a compiled policy cannot be copied, nor sent to another process. {remedy}")

    @property
    def last_report(self) -> CallReport | None:
        """What the last call did; None before the first, and after one that was refused."""
        return self._report

    @property
    def info(self) -> PolicyInfo:
        """What this policy is: with the plan that it was loaded with."""
        view, default = self._runtime.view(self._default), self._default
        manifest, begun = view.manifest, self._runtime.noise_spec(default).sampler
        shapes = [tuple(n for i, n in enumerate(b.type.at(1)) if i != b.type.batch_axis) for b in manifest.blocks]
        blocks, record = zip(manifest.blocks, shapes, strict=True), manifest.calibration or {}
        return PolicyInfo(
            K=manifest.steps,
            blocks=tuple(BlockInfo(block.kind, shape, block.flops) for block, shape in blocks),
            dense_flops=manifest.flops.dense,
            observation=manifest.spec.observations,
            action=manifest.spec.chunk,
            sample=manifest.spec.sample,
            original_sample=manifest.spec.whole_horizon.sample,
            stochastic=begun.stochastic,
            noise_steps=begun.steps,
            identity=manifest.identity,
            model_identity=manifest.model_identity,
            plans=tuple(self._artifact.plans),
            default_plan=self._artifact.told(default) or GIVEN,
            precision=" and ".join(dict.fromkeys(default.precision.values())) or FP32,
            rollout=rollout_needs(view),
            prefix_refusal=self.prefix_refusal(),
            frames=len(self._runtime.frames),
            reuses_tokens=self._runtime.frames.reuses_tokens,
            follows=default.otherwise is not None,
            noise=manifest.spec.noise,
            other_noise=record.get("other_noise") or None,
            policy_hz=record.get("policy_hz"),
            trained_prefix=manifest.spec.trained_prefix,
            timed_on=elsewhere(record.get("timed_on")),
        )

    @property
    def plans(self) -> Mapping[str, Plan]:
        """The plans of the artifact by name, ``dense`` among them. ``dataclasses.replace`` makes others of them."""
        return self._artifact.plans

    @property
    def queued(self) -> int:
        """How many actions ``select_action`` gives before it computes a chunk; it does at once where there are none."""
        return self._queues.queued

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode: nothing of earlier calls is reused.

        Args:
            seed: of the noise from here on; None goes on with the sequence under way.

        Raises:
            TtscompileError: the seed is no whole number of at least 0; nothing was done.
        """
        seed = check_seed(seed)
        with self._turn():
            self._runtime.reset()
            self._queues.reset()
            if seed is not None:
                self._rng = np.random.default_rng(seed)

    def predict_action(
        self, obs_dict: Mapping[str, Any], noise: Noise | None = None, plan: AnyPlan = None, prefix: Any = None
    ) -> dict[str, Any]:
        """One call of the policy.

        Args:
            obs_dict: by key ``[B, ...]``, numpy arrays or torch tensors, not normalised. ``info.observation`` has keys,
                shapes and dtypes. B may only change after ``reset``.
            noise: the random numbers of the call; None has them drawn.
            plan: what to compute: None for the plan of ``load``; the name of a plan of the artifact, ``dense`` among
                them, whose reads of what was never computed are repaired and counted in the report; a
                ``ttscompile.Plan``; or int8 ``[K, blocks]`` or ``[B, K, blocks]`` of ``ttscompile.Source``, which are
                the cells of a plan with the loop, precision and tokens of the plan of ``load``, without its correction
                and with the original's weights, executed as they are or refused.
            prefix: experimental: the actions that are committed already, float32 ``[B, N, Da]``, not normalised, from
                the first executed one on. They are kept, and the rest of the chunk goes on from them
                (``runtimes.inpainting``). None or N = 0: none are.

        Returns:
            ``action [B, Ta, Da]``, what to execute, and ``action_pred [B, T, Da]``, of the kind that came in.

        Raises:
            ObservationError: an observation, noise or prefix that does not fit, is not finite, or is larger than any
                that a policy can have seen (``core.chunk.LARGEST``); or a prefix where ``info.prefix_refusal`` says
                that there can be none. Nothing was executed.
            IllegalPlanError: a plan that is unknown, malformed or illegal; nothing was executed.
            NonFiniteActionsError: the arithmetic overflowed, and the episode has ended.
        """
        with self._turn():
            obs, example = self._read(obs_dict)
            predicted = self._predict(obs, noise, plan, prefix)
            executed = self._spec.chunk.executed(predicted)
            return {"action": like(executed.copy(), example), "action_pred": like(predicted.copy(), example)}

    def prepare_frame(self, frame: Mapping[str, Any], stop: Callable[[], bool] = lambda: False) -> FrameWork:
        """Compute what depends on one frame alone, before the call that reads it: a camera's image, the instruction.

        ``predict_action`` and the others then find it by its content. It changes no action, only when the work is done;
        without frame pieces (``info.frames``) there is none.

        Where tokens are reused (``info.reuses_tokens``) actions depend on the frames before, and so on those that are
        prepared, and on their order: prepare those that calls will read, oldest first.

        Args:
            frame: by key ``[B, ...]``, not normalised, as ``select_action`` takes it. Nothing is kept of it but what
                was computed, until ``reset``.
            stop: asked before each piece of work; the rest is left to the call if it says so.

        Returns:
            What was computed, and what was known.

        Raises:
            ObservationError: a frame that does not fit, or of another number of streams than the episode has.
            TtscompileError: the policy is in the middle of a call.
        """
        with self._turn():
            if not self._runtime.frames:
                return FrameWork()
            specs = self._spec.observations
            one, whole = Queues(specs), self._read(frame, others=True)[0]
            obs = one.observation(one.after(whole))  # a window that holds nothing else
            self._runtime.require_streams(len(next(iter(obs.values()))))
            with np.errstate(all="ignore"):
                normalized = {key: specs[key].normalized(array) for key, array in obs.items()}
                return self._runtime.frames.learn(normalized, stop)

    def with_tokens(self, frame: Mapping[str, Any]) -> Mapping[str, Any]:
        """One frame by key, ``[...]``, with tokens in the place of its text ``task``.

        As it is where the policy has no tokenizer. Any thread may ask, whoever else calls the policy; the first text
        takes longer, since the artifact's own tokenizer is read then.

        Raises:
            ObservationError: the task is no text, or has more tokens than the policy reads.
        """
        return frame if self._instruct is None else self._instruct.of_frame(frame)

    def seen(self) -> tuple[Seen, ...]:
        """What the policy sees of each camera of each stream, and which patches were computed last.

        Returns:
            A ``Seen`` a camera and stream; nothing after ``reset``, and where no tokens are reused.
        """
        with self._turn():
            return self._runtime.frames.seen()

    def follow(self, executed: int) -> None:
        """Say how many steps of the last chunk are executed before the next call, where it is not all of ``action``.

        It matters to plans that begin with the chunk of the call before: they move it by as many. A call that is late,
        since more steps were due than ``action`` has, begins with noise.
        """
        executed = integer(executed, "executed", TtscompileError)
        with self._turn():
            self._runtime.follow(executed)

    def forget_frames(self) -> None:
        """Have the next call compute all of its frames, as if none had been seen: to measure what a call may take.

        Or where tokens of another task come, which hold a state (pi0.5): they do not tell that the task is another one.
        """
        with self._turn():
            self._runtime.forget_frames()

    def select_action(self, batch: Mapping[str, Any], noise: Noise | None = None, plan: AnyPlan = None) -> Any:
        """The next action, as LeRobot's policies give it: a chunk is computed when the one before it is used up.

        Args:
            batch: one frame of every stream by key, ``[B, ...]``, not normalised; ``reset`` forgets earlier ones. Keys
                that are not the policy's are left alone.

        Returns:
            ``[B, Da]`` of the kind that came in.

        Raises:
            ObservationError: a frame or noise that does not fit; nothing was executed, and the frame was not kept.
            IllegalPlanError, NonFiniteActionsError: as ``predict_action``.
        """
        with self._turn():
            obs, example = self._read(batch, others=True)
            frames = self._queues.after(obs)
            if not self._queues.queued:
                self._queues.extend(self._chunk(self._queues.observation(frames), noise, plan))
            self._queues.keep(frames)
            return like(self._queues.pop().copy(), example)

    def predict_action_chunk(
        self, batch: Mapping[str, Any], noise: Noise | None = None, plan: AnyPlan = None, prefix: Any = None
    ) -> Any:
        """A chunk of actions ``[B, Ta, Da]``, as LeRobot's policies give it; the queue of ``select_action`` stays.

        Args:
            batch: whole windows ``[B, To, ...]``; or one frame of every stream ``[B, ...]``, which is added to the
                frames that this method and ``select_action`` were given since ``reset``. Keys that are not the policy's
                are left alone.

        Raises:
            ObservationError: a window, a frame, noise or a prefix that does not fit; nothing was executed or kept.
            IllegalPlanError, NonFiniteActionsError: as ``predict_action``.
        """
        with self._turn():
            specs = self._spec.observations
            obs, example = self._read(batch, others=True)
            if is_window(obs, specs):
                chunk = self._chunk(obs, noise, plan, prefix)
            else:
                frames = self._queues.after(obs)
                chunk = self._chunk(self._queues.observation(frames), noise, plan, prefix)
                self._queues.keep(frames)
            return like(chunk.copy(), example)

    def _read(self, given: Mapping[str, Any], others: bool = False) -> tuple[dict[str, Array], Any]:
        """The caller's observation, a text in it turned into tokens; see ``read_observation``."""
        given = given if self._instruct is None else self._instruct(given)
        return read_observation(given, self._spec.observations, others)

    def _chunk(self, obs: Arrays, noise: Noise | None, plan: AnyPlan, prefix: Any = None) -> FloatArray:
        """What is executed of a call, ``[B, Ta, Da]``."""
        executed: FloatArray = self._spec.chunk.executed(self._predict(obs, noise, plan, prefix))
        return executed

    def _predict(self, obs: Arrays, noise: Noise | None, plan: AnyPlan, prefix: Any) -> FloatArray:
        """One call; the actions ``[B, T, Da]``, which are finite."""
        self._report, wanted = None, self._plan(plan)
        spec = self._runtime.view(wanted).manifest.spec
        obs = check_observation(obs, spec.observations)
        streams = len(next(iter(obs.values())))
        self._runtime.require_streams(streams)
        if self._instruct is not None and self._instruct.other_task():
            self._runtime.forget_frames()
        reference = spec.chunk.reference(obs)
        if prefix is not None:
            prefix = check_prefix(prefix, streams, spec, self.prefix_refusal(wanted), reference)
        if noise is None:
            noise = noise_of_any_horizon(self._runtime.noise_spec(wanted), self._rng, streams)
        with np.errstate(all="ignore"):  # onnxruntime and torch raise no flags either: a call is judged by its actions
            normalized = {key: spec.observations[key].normalized(array) for key, array in obs.items()}
            sample, report = self._runtime.predict(normalized, noise, wanted, prefix)
            actions = spec.chunk.unnormalized(sample, reference)
        if not np.isfinite(actions).all():
            self._runtime.reset()  # what it kept may not be finite either
            self._queues.reset()
            bad = f"{np.count_nonzero(~np.isfinite(actions))} of {actions.size}"
            raise NonFiniteActionsError(
                f"{bad} numbers of the actions are not finite: the arithmetic of plan {report.plan_name!r} overflowed."
                " Look at the observation. If it is as in training, weights or plan are damaged: run 'ttscompile"
                " verify', and try plan='dense'. The episode has ended, as by reset()."
            )
        self._report = report
        return actions

    def _plan(self, plan: AnyPlan) -> Plan:
        if plan is None:
            return self._default
        if isinstance(plan, str | Plan):
            return plan_of(self._artifact, plan)
        own = self._default.otherwise or self._default
        cells: Any = plan  # whatever it is: the runtime checks it
        return Plan(own.loop, cells, precision=own.precision, tokens=own.tokens)

    def prefix_refusal(self, plan: AnyPlan = None) -> str | None:
        """Why a call with this plan takes no ``prefix``; None if it does. Raises IllegalPlanError: it is unknown."""
        own = self._plan(plan)
        return NO_PREFIX if own.otherwise is not None else prefix_refusal(self._runtime.view(own).manifest.spec)

    def _turn(self) -> threading.Lock:
        """The lock, to hold during a call. Not a manager of contexts of our own: an interrupt might keep it locked."""
        if self._process.left:
            what = f"the policy was loaded in {self._process}. Threads and locks that a call needs are missing here"
            raise TtscompileError(f"{what}. Load the policy in the process that calls it, after the fork.")
        if self._lock.locked():
            if not self._exit.alive:
                if threading.current_thread() is not threading.main_thread():
                    threading.Event().wait()  # for the end of the interpreter, which is the end of a daemon thread
                remedy = "Register what shall call it then, with atexit, after the policy was loaded."
                raise TtscompileError(f"the program is ending, and the policy makes no more calls. {remedy}")
            remedy = "It serves one caller at a time: load one policy a thread, or send all streams in one batch."
            raise TtscompileError(f"the policy is in the middle of a call on another thread. {remedy}")
        return self._lock


def _end_calls(lock: threading.Lock, process: Process) -> None:
    """At the end of the interpreter: wait for the call under way, and let no other begin.

    A daemon thread that comes back from onnxruntime when the interpreter is gone would abort the process.
    """
    if not process.left:
        lock.acquire(timeout=LONGEST_WAIT)


def plan_of(artifact: Artifact, plan: str | Plan | None) -> Plan:
    """A plan, or the one of this name; None for the default. Raises IllegalPlanError: the artifact has no such plan."""
    if plan is None:
        return artifact.default
    return plan if isinstance(plan, Plan) else artifact.plan(plan)
