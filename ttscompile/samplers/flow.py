"""Flow matching as a table of numbers: ``dx/dt = v(x, t)``, integrated by Euler or by classical Runge-Kutta.

Nothing is probed here: the methods are written down, and tests hold them against an integration in float64. Numpy only.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.coercion import integer, numbers
from ..core.spec import SamplerTable
from ..errors import SpecError

Times = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Method:
    """A way to integrate.

    Attributes:
        evaluations: of the network in each step; each is a row of the table.
        table: of N + 1 times, of what timesteps are multiplied with, and of a bound on the sample or None.
    """

    evaluations: int
    table: Callable[[Times, float, float | None], SamplerTable]


def flow_matching_table(
    steps: int | Sequence[float],
    method: str = "euler",
    *,
    start: float = 0.0,
    end: float = 1.0,
    timestep_scale: float = 1.0,
    clip: float | None = None,
) -> SamplerTable:
    """The denoising loop of a flow-matching policy whose network predicts the velocity ``v = dx/dt``.

    The sample is noise at ``start`` and the action at ``end``. LeRobot's ``multi_task_dit`` goes from 0 to 1; SmolVLA,
    pi0 and pi0.5 from 1 to 0: ``flow_matching_table(10, start=1.0, end=0.0)``.

    With ``rk4`` a step of length h evaluates the network four times, and each evaluation is a step of the table, so
    that plans decide about each of them: K = 4 N. Memories are the sample at the beginning of the step, and what the
    stages so far make of the sample at its end::

        v1 = v(x, t)              next = x + h/2 v1     memory = x, x + h/6 v1
        v2 = v(next, t + h/2)     next = x + h/2 v2     memory = x, ... + h/3 v2
        v3 = v(next, t + h/2)     next = x + h v3       memory = x, ... + h/3 v3
        v4 = v(next, t + h)       next = ... + h/6 v4

    Args:
        steps: N, number of steps of equal length; or the N + 1 times themselves, from ``start`` to ``end``, which then
            are not to be given.
        method: ``euler``, ``rk4``, or another row of ``METHODS``.
        timestep_scale: the network is given ``time * timestep_scale``, as a float32.
        clip: bound on the sample that the velocity leads to from where it is, ``x + (end - t) v``; Euler only.

    Returns:
        The table, of K = N (Euler) or K = 4 N (rk4) rows, deterministic.

    Raises:
        SpecError: no steps, times that do not go one way, a method that is not known, or a bound that it cannot keep.
    """
    times = _times(steps, start, end)
    if method not in METHODS:
        raise SpecError(f"flow-matching method {method!r} is not known; expected one of {', '.join(METHODS)}.")
    if not np.isfinite(timestep_scale):
        raise SpecError(f"timestep_scale must be a finite number; found {timestep_scale}.")
    return METHODS[method].table(times, timestep_scale, clip)


def refuse_bound(clip: float | None, method: str) -> None:
    """Raise SpecError for a bound that a method of several evaluations a step cannot keep."""
    if clip is not None:
        raise SpecError(f"clip needs method 'euler': between the stages of {method} there is no sample to bound.")


def _times(steps: int | Sequence[float], start: float, end: float) -> Times:
    if isinstance(steps, Sequence) or np.ndim(steps):
        times = numbers(steps, "steps", SpecError, "float64")
    else:
        count = integer(steps, "steps", SpecError, 1)
        times = start + (end - start) * np.arange(count + 1) / count
    lengths = np.diff(np.atleast_1d(times))
    if times.ndim != 1 or len(times) < 2 or not np.isfinite(times).all() or not (lengths * lengths[0] > 0).all():
        raise SpecError(f"flow-matching times must all rise or all fall, and be two or more; found {times.tolist()}.")
    return times


def _euler(times: Times, scale: float, clip: float | None) -> SamplerTable:
    lengths, left = np.diff(times), times[-1] - times[:-1]
    zero, one = np.zeros_like(lengths), np.ones_like(lengths)
    # x + h v = x0 h / left + x (1 - h / left) where x0 = x + left v; unclipped it is added directly.
    share = zero if clip is None else lengths / left
    return deterministic_table(
        "euler",
        times[:-1] * scale,
        clip,
        sample_to_x0=one,
        out_to_x0=left,
        x0_to_next=share,
        sample_to_next=1 - share,
        out_to_next=lengths if clip is None else zero,
    )


def _rk4(times: Times, scale: float, clip: float | None) -> SamplerTable:
    refuse_bound(clip, "rk4")
    count, (h,) = len(times) - 1, (np.diff(times),)
    own = np.arange(count)[:, None] * 4 + np.arange(4)
    at = times[:-1, None] + h[:, None] * np.array([0, 0.5, 0.5, 1])
    sample_to_next, out_to_next = np.zeros((2, 4 * count))
    memory_to_next, to_memory = np.zeros((4 * count, 2)), np.zeros((4 * count, 2, 5))
    sample_to_next[own[:, 0]] = 1
    out_to_next[own] = h[:, None] * np.array([1 / 2, 1 / 2, 1, 1 / 6])
    memory_to_next[own[:, 1:3], 0] = memory_to_next[own[:, 3], 1] = 1
    x, out, base, result = 1, 2, 3, 4  # columns of ``to_memory``
    to_memory[own[:, 0], :, x] = 1
    to_memory[own[:, 1:3], 0, base] = to_memory[own[:, 1:3], 1, result] = 1
    to_memory[own[:, :3], 1, out] = h[:, None] * np.array([1 / 6, 1 / 3, 1 / 3])
    return deterministic_table(
        "rk4",
        at.ravel() * scale,
        None,
        sample_to_next=sample_to_next,
        out_to_next=out_to_next,
        memory_to_next=memory_to_next,
        to_memory=to_memory,
    )


def deterministic_table(
    name: str, timesteps: npt.NDArray[np.float64], clip: float | None, **columns: npt.NDArray[np.float64]
) -> SamplerTable:
    """A table in float32, with zeros ``[K]`` for columns that are not given: no noise, for one."""
    zeros = {column: np.zeros(len(timesteps)) for column in SamplerTable.COLUMNS}
    narrow = {column: np.asarray(values, np.float32) for column, values in (zeros | columns).items()}
    return SamplerTable(name=name, timesteps=np.asarray(timesteps, np.float32), clip=clip, **narrow)


METHODS: Mapping[str, Method] = {"euler": Method(1, _euler), "rk4": Method(4, _rk4)}
"""What ``convert --sampler`` takes for a policy that was trained with flow matching."""
