"""The rung of episodes: what reuse changes in the actions, beside what other noise would change."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..artifact.golden import Golden
from ..artifact.load import Artifact
from ..core.plan import DENSE, FULL
from ..core.spec import Noise, PolicySpec
from ..measure.energy import pairs, rooted
from ..runtimes.policy import CompiledPolicy
from ..runtimes.random_calls import random_noise
from ..trajectories.episodes import Episode
from .rung import SKIPPED, Rung, finite, judged

SPARSITY, UNIT, OF_NOISE = "sparsity error", "action units", "other noise"

AS_CALIBRATED, FEW_AS_CALIBRATED = 2.0, 3.0
"""How often the mean error that calibration measured on held-out calls a plan's may be; and with ``FEW`` calls or less,
which are of a few episodes, whose calls are alike."""

FEW = 32

ROUNDING, NEGLIGIBLE = 0.001, 0.05
"""Share of the yardstick below which an error, or a distance, is no worse than calibrated: other processors round
otherwise, and distances are estimates."""

Progress = Callable[[str], None]
"""Told what is being done."""

Errors = dict[str | None, list[float]]
"""By plan, for each call: mean absolute difference of the executed actions from the dense call's with the same noise,
in their units. None: of a dense call with other noise."""


def choose(episodes: Sequence[Episode], calls: int) -> list[Episode]:
    """Whole episodes, spread over the recordings, until they hold this many calls; at least one."""
    order = np.random.default_rng(0).permutation(len(episodes))
    chosen, total = list[int](), 0
    for number in order.tolist():
        if total >= calls:
            break
        chosen.append(number)
        total += episodes[number].calls
    return [episodes[number] for number in sorted(chosen)]


def check_episodes(
    artifact: Artifact, golden: Golden, policy: CompiledPolicy, episodes: Sequence[Episode], told: Progress
) -> Rung:
    """Every plan against the dense policy with the same noise, call by call through whole episodes.

    A plan of another sampler, or one that begins with the chunk before, answers the same noise with other actions; what
    is judged of it is how far its answers to two draws of noise are from two of the dense policy's, in units of what
    other noise changes (``measure.energy``). Else:

    The mean error of the default plan has to keep within what two dense calls with different noise are apart, or within
    what calibration measured on held-out calls (90th percentile), whichever is more. It also has to keep within
    ``AS_CALIBRATED`` times the mean that calibration measured, where it did: a plan that is much worse than it was may
    still be within the noise of its policy. Without episodes the recorded observations are used, which are random: then
    nothing is judged.
    """
    manifest = artifact.manifest
    if manifest.plans.keys() <= {FULL}:
        return Rung(SPARSITY, SKIPPED, "the artifact is not calibrated: every call computes all cells")
    spec, draw = manifest.spec, np.random.default_rng(0)
    name = manifest.default_plan if manifest.default_plan in manifest.plans else next(iter(manifest.plans))
    errors: Errors = {each: [] for each in (*manifest.plans, None)}
    own = artifact.plans[name]
    shared = own.otherwise is None and manifest.sampler_of(own.loop).takes_noise_as(spec.sampler)
    unpaired = None if shared else Unpaired(name)
    for i, obs in enumerate([one.observations for one in episodes] or [golden.raw_observations(spec)]):
        rows = [{k: a[r : r + 1] for k, a in obs.items()} for r in range(len(next(iter(obs.values()))))]
        if episodes:
            told(f"episode {i + 1} of {len(episodes)}, {len(rows)} call{'s' * (len(rows) != 1)}")
        _run(policy, spec, rows, draw, errors, unpaired)
    calls, other_noise = len(errors[None]), float(np.mean(errors.pop(None)))
    figures = {
        name: {"error": finite(float(np.mean(e))), "error_p90": finite(float(np.quantile(e, 0.9)))}
        for name, e in errors.items()
    }
    error = float(np.mean(errors[name]))
    details = {"plan": name, "calls": calls, "episodes": len(episodes), "plans": figures, "other_noise": other_noise}
    others = ", ".join(f"{n!r} {np.mean(e):.3g}" for n, e in errors.items() if n != name)
    found = f"executed actions of plan {name!r} are {error:.3g} from the dense policy's with the same noise, in their"
    found += f" units{f' ({others})' if others else ''}"
    found += f"; two dense calls with different noise are {other_noise:.3g} apart"
    if not episodes:
        found += f". No trajectories were given: these are {calls} calls on random observations, and not judged"
        remedy = "Give recorded episodes with --trajectories to have this judged."
        return Rung(SPARSITY, SKIPPED, found, finite(error), None, UNIT, remedy, details=details)
    promised, promised_p90 = (_promised(manifest.calibration, name, key) for key in ("error", "error_p90"))
    noise, unit, least = other_noise, UNIT, ROUNDING * other_noise
    if unpaired is not None:
        error, noise, unit, least = unpaired.distance, 1.0, OF_NOISE, NEGLIGIBLE
        promised, promised_p90 = _promised(manifest.calibration, name, "distance"), None
        found += f". It is of another loop, in which the same noise means something else: by two draws {error:.3g} away"
    beyond = max(noise, promised_p90 or 0.0)
    factor, worse = allowed(promised, least, calls)
    reasons = list[str]()
    if not error <= beyond:
        reasons.append("more than other noise would change")
    if not error <= worse:
        before = f"more than {factor:g} times the {promised:.3g} that calibration measured on held-out calls"
        reasons.append(f"worse than calibrated, {before}")
    details |= {"promised": promised, "promised_p90": promised_p90, "reasons": reasons}
    made = f"{calls} call{'s' * (calls != 1)} of {len(episodes)} episode{'s' * (len(episodes) != 1)}: {found}"
    if reasons:
        made += f". This is {'; and '.join(reasons)}"
    remedy = "These episodes are unlike those of the calibration, or the plan is too sparse: calibrate with such"
    remedy += " episodes, or with a lower --target-sparsity."
    return judged(SPARSITY, error, min(beyond, worse), unit, made, remedy, details=details)


class Unpaired:
    """What a plan and the dense policy answer to the same two draws of noise, over many calls.

    Args:
        plan: its name.
    """

    def __init__(self, plan: str) -> None:
        self.plan = plan
        self._own, self._dense = list[npt.NDArray[np.float64]](), list[npt.NDArray[np.float64]]()

    def add(self, own: npt.NDArray[np.float64], dense: npt.NDArray[np.float64]) -> None:
        """The actions that were executed of one call, ``[2, ...]``: a draw each."""
        self._own.append(own.reshape(2, -1))
        self._dense.append(dense.reshape(2, -1))

    @property
    def distance(self) -> float:
        """Between the two, in units of what other noise changes."""
        # All calls at once: whether noise changes anything is asked of the policy, and not of a call at rest.
        h, apart = pairs(np.stack(self._own), np.stack(self._dense))
        return rooted(float(h.mean()), float(apart.mean()))


def _run(
    policy: CompiledPolicy,
    spec: PolicySpec,
    rows: Sequence[Mapping[str, npt.NDArray[Any]]],
    draw: np.random.Generator,
    errors: Errors,
    unpaired: Unpaired | None,
) -> None:
    noises, others = ([random_noise(spec, draw) for _ in rows] for _ in range(2))

    def actions(plan: str, with_noise: Sequence[Noise]) -> list[npt.NDArray[np.float64]]:
        policy.reset()
        made = (policy.predict_action(o, noise=n, plan=plan)["action"] for o, n in zip(rows, with_noise, strict=True))
        return [np.asarray(one, np.float64) for one in made]

    dense, other = actions(DENSE, noises), actions(DENSE, others)
    for name, found in errors.items():
        made = other if name is None else actions(name, noises)
        found += [float(np.abs(one - same).mean()) for one, same in zip(made, dense, strict=True)]
    if unpaired is not None:
        own = zip(actions(unpaired.plan, noises), actions(unpaired.plan, others), strict=True)
        scale = 1.0 if spec.chunk.normalizer is None else np.abs(spec.chunk.normalizer.scale)
        for pair, both in zip(own, zip(dense, other, strict=True), strict=True):
            unpaired.add(*(np.stack(each) * scale for each in (pair, both)))


def allowed(promised: float | None, least: float, calls: int) -> tuple[float, float]:
    """How often the error that calibration measured a plan's may be, and what that comes to.

    An error is recorded by whoever made the artifact: one that is better than what is measured is no excuse, however
    small both are.
    """
    factor = FEW_AS_CALIBRATED if calls <= FEW else AS_CALIBRATED
    return factor, float("inf") if promised is None else max(factor * promised, least)


def _promised(calibration: Mapping[str, Any] | None, name: str, key: str) -> float | None:
    """``error`` or ``error_p90`` that calibration measured for a plan on held-out calls; None if it did not."""
    found = (calibration or {}).get("plans", {}).get(name, {}).get(key)
    return None if found is None else float(found)
