"""The rungs of whole calls on the recorded inputs: against the original, between runtimes, and of each plan."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from ..artifact.golden import Golden, GoldenPlan, is_sparse, project
from ..artifact.load import Artifact
from ..artifact.view import view_of
from ..core.coercion import Array, Arrays
from ..core.lattice import BoolArray, PlanArray, Source, dense_plan
from ..core.plan import DENSE, ORIGINAL, Plan
from ..core.spec import Noise
from ..core.update import bounded
from ..errors import RuntimeUnavailableError
from ..ir.pieces import SCENE
from ..runtimes.frames import FrameWork
from ..runtimes.open import open_runtime
from ..runtimes.policy import CompiledPolicy
from ..runtimes.runtime import Runtime
from .network import CONVERT, Probe, block_errors, describe_blocks, largest
from .rung import FAILED, PASSED, SKIPPED, Rung, finite, judged

DENSE_CALL, RUNTIMES, PLANS = "dense call", "runtimes", "plans"

SAMPLE = 2e-3
"""Tolerance of a denoised sample, relative to its largest value. Push-T after 100 steps: 1e-5."""

CELLS = 0.005
"""Share of cells in which the plans that a pruner makes may differ: its logits are rounded otherwise on another
processor, and near ties fall the other way."""

REFERENCE_STEPS = 3
"""Steps at which the reference runtime's blocks are looked at."""

ACTION, VALUE = "of the largest action", "of the largest value"
"""Of what errors are shares."""


def computed(artifact: Artifact, loop: str = ORIGINAL, precision: Mapping[str, str] = MappingProxyType({})) -> Plan:
    """The plan that computes every cell of a loop that begins with noise."""
    cells = dense_plan(artifact.manifest.sampler_of(loop).steps, len(artifact.manifest.blocks))
    return Plan(loop, cells, precision=precision)


def check_dense(policy: CompiledPolicy, artifact: Artifact, golden: Golden) -> Rung:
    """A dense call in every loop against the original in eager PyTorch with the same noise: the error of the export."""
    spec, worst, found, step = artifact.manifest.spec, 0.0, dict[str, float](), None
    for loop in spec.all_loops:
        own = golden.in_loop(loop)
        policy.reset()
        made = policy.predict_action(own.raw_observations(spec), noise=own.noise, plan=computed(artifact, loop))
        error = max(largest(made["action_pred"], own.actions), largest(made["action"], own.executed))
        units = found[loop] = float(np.abs(made["action"].astype(np.float64) - own.executed).max())
        if not error <= SAMPLE:
            step, cause = _where(artifact, own, computed(artifact, loop), own.path)
            told = f"the executed actions of a dense call in loop {loop!r} are up to {units:.2g} off: {cause}"
            return judged(DENSE_CALL, error, SAMPLE, ACTION, told, CONVERT, step=step)
        worst = max(worst, error)
    units = max(found.values())
    told = f"a dense call of {golden.streams} streams: its executed actions are within {units:.2g} of the original's"
    told += f" in each of {len(found)} loops" * (len(found) > 1)
    return judged(DENSE_CALL, worst, SAMPLE, ACTION, told, CONVERT, details={"error_in_units": finite(units)})


def check_runtimes(artifact: Artifact, golden: Golden, runtime: Runtime) -> Rung:
    """A dense call in the runtimes on torch, and single blocks in the reference; skipped where there is no torch."""
    dense = artifact.plans[DENSE]
    try:
        reference, line = (open_runtime(artifact, name, plan=dense) for name in ("reference", "torch"))
    except RuntimeUnavailableError:
        remedy = "Install 'ttscompile[compile]' to have the runtimes compared."
        return Rung(RUNTIMES, SKIPPED, "the reference runtime was not run: it needs torch", remedy=remedy)
    manifest, obs = artifact.manifest, golden.network_observations(artifact.manifest.spec)
    samples = []
    for one in (reference, runtime, line):
        one.reset()
        samples.append(one.predict(obs, golden.noise, dense)[0])
    error, of_line = (largest(sample, samples[0]) for sample in samples[1:])
    if max(error, of_line) <= SAMPLE:
        told = "onnxruntime, torch and the reference runtime give the same denoised sample"
        return judged(RUNTIMES, max(error, of_line), SAMPLE, VALUE, told, "")
    if error <= SAMPLE:
        told = "the runtime on torch gives another sample than onnxruntime and the reference runtime"
        return judged(RUNTIMES, of_line, SAMPLE, VALUE, told, "Use onnxruntime, and report this: it is a defect.")
    rows = np.unique(np.linspace(0, len(golden.steps) - 1, REFERENCE_STEPS).round().astype(np.int64))
    errors = block_errors(manifest, golden, _reference_blocks(reference.backend, obs), rows)
    wrong, step, where = describe_blocks(errors, golden.steps[rows], tuple(block.kind for block in manifest.blocks))
    found = f"in the reference runtime {where}" if wrong else "every block is the original's in both"
    told = f"onnxruntime and the reference runtime give other samples: {found}"
    remedy = "Their weights or graphs differ: convert the checkpoint again."
    return judged(RUNTIMES, error, SAMPLE, VALUE, told, remedy, step=step, blocks=wrong)


def _reference_blocks(reference: Any, obs: Arrays) -> Any:
    import torch

    with torch.no_grad():
        contexts = reference.model.prologue({key: torch.from_numpy(value) for key, value in obs.items()})

    def residual(b: int, k: int, hidden: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        with torch.no_grad():
            made: npt.NDArray[np.float32] = reference.model.block(b, k, torch.from_numpy(hidden), contexts).numpy()
        return made

    return residual


def check_plans(
    artifact: Artifact, golden: Golden, recorded: Mapping[str, GoldenPlan], runtime: Runtime
) -> tuple[Rung, dict[str, BoolArray]]:
    """Episodes of two sparse calls with each plan, in fp32, against what calibration stored.

    Also, by plan, the cells ``[K, blocks]`` that differ, where some do.
    """
    plans = artifact.manifest.plans
    if not any(map(is_sparse, plans.values())):
        return Rung(PLANS, SKIPPED, "no plan reuses anything: every call computes all cells"), {}
    if not recorded:
        told = f"no record of {', '.join(plans)}: they were written by other means than 'ttscompile calibrate'"
        return Rung(PLANS, SKIPPED, told, remedy="Calibrate the artifact to have its plans verified."), {}
    failures: list[tuple[str, int | None, tuple[int, ...]]] = []
    cells, worst = dict[str, BoolArray](), 0.0
    for name, record in recorded.items():
        plan = artifact.plans[name].exact
        made, differ, few, error = replay(artifact, golden, runtime, plan, record)
        if not few:
            cells[name] = differ
            step, block = np.argwhere(differ)[0].tolist()
            told = f"plan {name!r} is not what calibration stored in {int(differ.sum())} of {differ.size} cells"
            told += f", first at step {step}, block {block}{_shifted(made[0, 0], record.plan[0, 0])}"
            failures.append((told, step, tuple(np.flatnonzero(differ[step]).tolist())))
            continue
        worst = max(worst, error)
        if not error <= SAMPLE:
            own = ["a correction"] * (plan.correction is not None)
            if plan.weights != ORIGINAL or plan.otherwise is not None:  # the probe has the original's, and noise
                step, cause = None, "its samples differ"
                own += ["weights of its own"] * (plan.weights != ORIGINAL)
            else:
                step, cause = _where(artifact, golden, replace(plan, cells=record.plan[0]), record.path[0])
            more = f"; it has {' and '.join(own)}: the likely culprit where dense calls hold" if own else ""
            failures.append((f"plan {name!r} is what calibration stored, but {cause}{more}", step, ()))
    if failures:
        told = "; ".join(told for told, _, _ in failures)
        remedy = "Plans or corrections were changed or exchanged after calibration: calibrate again."
        first = min((step for _, step, _ in failures if step is not None), default=None)
        details = {"plans": sorted(cells), "failures": [told for told, _, _ in failures]}
        return Rung(PLANS, FAILED, told, finite(worst), SAMPLE, VALUE, remedy, first, failures[0][2], details), cells
    told = f"{', '.join(recorded)}: plans, corrections and samples of two calls are what calibration stored"
    return Rung(PLANS, PASSED, told, worst, SAMPLE, VALUE), {}


def replay(
    artifact: Artifact, golden: Golden, runtime: Runtime, plan: Plan, record: GoldenPlan
) -> tuple[PlanArray, BoolArray, bool, float]:
    """The episode that ``GoldenPlan`` describes.

    Returns:
        Executed plans ``[2, B, K, blocks]``; the cells ``[K, blocks]`` that are not those of the record; whether these
        may differ; and the error of the samples, with the stored plan where cells differ.
    """
    loop = artifact.manifest.whole_loop(plan.loop)
    own, obs = golden.in_loop(loop), golden.network_observations(artifact.manifest.spec)

    def episode(plans: Iterable[Plan]) -> tuple[PlanArray, Array]:
        made, samples = [], []
        runtime.reset()
        if loop != plan.loop:  # the chunk before the first call is that of the original
            runtime.predict(obs, own.noise, computed(artifact, loop))
        for order, one in zip((1, -1), plans, strict=True):
            draws = None if own.draws is None else np.ascontiguousarray(own.draws[:, ::order])
            noise = Noise(np.ascontiguousarray(own.initial[::order]), draws)
            turned = {key: np.ascontiguousarray(value[::order]) for key, value in obs.items()}
            sample, report = runtime.predict(turned, noise, one)
            made.append(report.plan)
            samples.append(sample)
        return np.stack(made), np.stack(samples)

    made, samples = episode([plan] * 2)
    differ = (made != record.plan).any((0, 1))
    if differ.any():  # a near tie, maybe: hold what the stored plan gives against the record
        _, samples = episode([replace(plan, cells=cells) for cells in record.plan])
    few = bool(np.count_nonzero(differ) <= (CELLS * differ.size if plan.pruned else 0))
    expected = bounded(artifact.manifest.sampler_of(loop), record.sample)  # records are older than what bounds a sample
    return made, differ, few, largest(samples, expected)


def _where(artifact: Artifact, golden: Golden, plan: Plan, path: npt.NDArray[np.float32]) -> tuple[int | None, str]:
    """The first step after which the sample is another than recorded, and what that says."""
    cells = plan.cells
    if cells is None or (cells == Source.ROLLOUT).any():
        return None, "its samples differ"
    cells = np.broadcast_to(cells, (golden.streams, *cells.shape[-2:]))
    probe = Probe(view_of(artifact, plan), golden.network_observations(artifact.manifest.spec))
    samples, predictions = probe.trace(golden.in_loop(plan.loop).noise, cells, plan.correction)
    norms = np.linalg.norm(path.astype(np.float64), axis=(1, 2))
    found = np.stack([project(one, 0) for one in samples])
    errors = np.linalg.norm(found.astype(np.float64) - path, axis=(1, 2)) / np.maximum(norms, 1e-30)
    above = np.flatnonzero(~(errors <= SAMPLE))
    if not len(above):
        return None, "the pieces, run one by one, give the recorded sample, so that the runtime is at fault"
    k = int(above[0])
    if (cells == Source.COMPUTE).all():
        predicted = largest(project(predictions[k], 0), golden.in_loop(plan.loop).predictions[k])
        if predicted <= SAMPLE:
            return k, f"the sampler goes another way from step {k} on, where the network's output is the original's"
        return k, f"the network's output is another from step {k} on"
    return k, f"the sample is another from step {k} on"


def _shifted(found: PlanArray, recorded: PlanArray) -> str:
    """In words: whether one plan ``[K, blocks]`` is the other, moved by a few steps."""
    for by in (1, -1, 2, -2, 3, -3):
        if len(found) <= abs(by):
            continue
        moved = np.roll(recorded, by, axis=0)
        inner = slice(max(by, 0) + 1, len(found) + min(by, 0))
        if np.array_equal(found[inner], moved[inner]) and (moved[inner] != recorded[inner]).any():
            direction = "later" if by > 0 else "earlier"
            return f": it is the stored plan {abs(by)} step{'s' * (abs(by) > 1)} {direction}"
    return ""


TOKENS = "tokens"


def check_tokens(artifact: Artifact, golden: Golden, runtime: Runtime) -> Rung | None:
    """A dense call in which all tokens are computed against one without their pieces, and one that reuses them.

    None where no plan reuses any.
    """
    obs = golden.network_observations(artifact.manifest.spec)
    reuse = next((plan.tokens for plan in artifact.plans.values() if plan.tokens is not None), None)
    if reuse is None:
        return None
    samples, works = [], list[FrameWork]()
    for settings in (None, replace(reuse, refresh=1), reuse):
        plan = replace(computed(artifact), tokens=settings)
        runtime.reset()
        sample, report = runtime.predict(obs, golden.noise, plan)
        samples.append(sample)
        if settings is reuse:  # the newest pictures again, with a bright spot
            shown = {key: value.copy() for key, value in obs.items()}
            for key, spec in artifact.manifest.spec.observations.items():
                if spec.image:
                    newest = shown[key][:, -1] if spec.frames else shown[key]
                    y, x = (slice(n // 2, n // 2 + n // 8 + 1) for n in newest.shape[-2:])
                    newest[..., y, x] += np.float32(10)
            _, report = runtime.predict(shown, golden.noise, plan)
        works.append(report.frames)
    _, whole, some = works
    told = (
        f"a dense call that computes {whole.tokens} of {whole.of} tokens against one by whole frames; where a spot is"
        f" new, {some.tokens} of {some.of} are computed"
    )
    error = largest(samples[1], samples[0])
    few = some.tokens < some.of or list(artifact.manifest.tokens) == [SCENE]  # a whole encoder may change all rows
    if whole.tokens != whole.of or not (some.tokens and few):
        error = np.inf
    details = {"spot": [some.tokens, some.of], **vars(reuse)}
    remedy = "Take plans that compute all tokens (plan.exact), or convert the checkpoint again."
    return replace(judged(TOKENS, error, SAMPLE, VALUE, told, remedy), details=details)
