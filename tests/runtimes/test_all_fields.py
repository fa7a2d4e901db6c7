"""Plans that are random in all of their fields, in everything that runs a plan, against the reference.

What a runtime cannot do is refused by name, and nothing is left out in silence.
"""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import ttscompile
from tests.families import cameras
from tests.lower.whole_call import Episode
from tests.once import Once
from tests.rounding import bound
from ttscompile import Noise, Plan
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.core.coercion import Array
from ttscompile.core.lattice import Source
from ttscompile.errors import IllegalPlanError, TtscompileError
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.report import CallReport
from ttscompile.runtimes.single_file import inputs_of
from ttscompile.verification.precision import CARRIED, EIGHT_BITS, FOUR_BITS

from .agreement import call_terms
from .all_fields import BLOCKS, LOOPS, STARTS, Drawn, Literally, Scene, compiled

pytestmark = pytest.mark.slow

PRECISIONS = ("int8", "int4", "bf16", "fp16")
ABLE = {"onnxruntime": {"int8", "int4"}, "torch": {"bf16", "fp16"}, "reference": set[str]()}
"""By runtime, the precisions that it may compute in."""
Arrays = Mapping[str, Array]
UNITS = {"bf16": 2.0**-9, "fp16": 2.0**-12}


@pytest.fixture(scope="module", params=["int8", "int4"])
def folder(request: pytest.FixtureRequest, once: Once) -> Path:
    return compiled(once, request.param)


@pytest.fixture(scope="module")
def artifact(folder: Path) -> Artifact:
    return load_artifact(folder / "artifact")


def allowed(artifact: Artifact, precisions: set[str]) -> float:
    """How far actions may be off, in units of the largest, where something of the call was in these precisions."""
    rounding = 4 * bound(call_terms(artifact))
    units = [bound(call_terms(artifact), unit=UNITS[one]) for one in precisions & UNITS.keys()]
    kept = [CARRIED * (EIGHT_BITS if one == "int8" else FOUR_BITS) for one in precisions - UNITS.keys()]
    return max([rounding, *units, *kept])


def distance(found: Array, expected: Array) -> float:
    """In units of the largest number."""
    return float(np.abs(found - expected).max() / np.abs(expected).max())


@dataclass
class Compared:
    """A runtime beside the reference, call by call.

    Attributes:
        carried: precisions of what the last chunk was made of; a plan may begin with it.
        refused: calls that were refused by name.
        ran: the plans that were executed, and how far from the reference's actions theirs were.
    """

    name: str
    artifact: Artifact
    literally: Literally
    carried: set[str] = field(default_factory=set)
    refused: int = 0
    ran: list[tuple[Plan, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        record = self.artifact.manifest.precision
        assert record is not None
        self.held, self.kept = record.name, record.kept
        self.policy, self.reference = (open_policy(self.artifact, n, plan="dense") for n in (self.name, "reference"))

    def reset(self) -> None:
        """Of both."""
        self.policy.reset()
        self.reference.reset()
        self.carried = set()

    def follow(self, executed: int) -> None:
        """Of both."""
        self.policy.follow(executed)
        self.reference.follow(executed)

    def executed(self, plan: Plan) -> Plan:
        """The plan that a call executes."""
        begins = plan.otherwise is None or self.policy._runtime._chunk is not None
        return plan if begins else plan.otherwise or plan

    def refusals(self, plan: Plan, prefix: Array | None) -> list[str]:
        """Why a call cannot be made; one of these is said."""
        found, executed = list[str](), self.executed(plan)
        for part, precision in plan.precision.items():
            if precision not in ABLE[self.name]:
                found.append(f"runtime '{self.name}' computes in fp32, and .* wants '{part}' in '{precision}'")
            elif self.name == "onnxruntime" and (precision != self.held or part not in self.kept):
                found.append(f"a plan wants '{part}' in '{precision}'; the artifact has .* in {self.held}")
        if plan.tokens is not None and self.name != "onnxruntime":
            found.append(f"runtime '{self.name}' computes all tokens of a frame; the plan reuses some")
        if executed.cells is None and executed.loop in STARTS:
            found.append(f"a plan without cells needs a pruner, and loop '{executed.loop}' has none")
        if plan.otherwise is not None and prefix is not None:
            found.append("its plan begins with the chunk of the call before")
        return found

    def possible(self, plan: Plan) -> Plan:
        """The plan without what the runtime cannot do."""
        precision, tokens = dict(plan.precision), None
        if self.name == "onnxruntime":
            precision, tokens = {part: self.held for part in precision if part in self.kept}, plan.tokens
        elif not set(precision.values()) <= ABLE[self.name]:
            precision = {}
        otherwise = None if plan.otherwise is None else self.possible(plan.otherwise)
        if plan.cells is None and plan.loop in STARTS:
            plan = replace(plan, cells=np.zeros((STARTS[plan.loop].steps, BLOCKS), np.int8))
        return replace(plan, precision=precision, tokens=tokens, otherwise=otherwise)

    def reads_nothing(self, executed: Plan, streams: int) -> bool:
        """Whether a plan that is not to be repaired reads what no call of the episode has computed."""
        if executed.cells is None or executed.repair:
            return False
        runtime, cells = self.policy._runtime, np.broadcast_to(executed.cells, (streams, *executed.cells.shape[-2:]))
        entries = runtime._entries if runtime._used.view.variant == executed.variant else None
        return bool(((cells == Source.ROLLOUT) & (True if entries is None else ~entries.written)).any())

    def call(self, obs: Arrays, noise: Noise, plan: Plan, prefix: Array | None) -> None:
        """One call of both, which are alike."""
        if problems := self.refusals(plan, prefix):
            with pytest.raises(TtscompileError, match="|".join(problems)):
                self.policy.predict_action(obs, noise, plan, prefix)
            plan, self.refused = self.possible(plan), self.refused + 1
            prefix = prefix if plan.otherwise is None else None
            assert not self.refusals(plan, prefix)
        executed, begun = self.executed(plan), self.policy._runtime._chunk is not None
        if self.reads_nothing(executed, len(noise.initial)):
            for one, own in ((self.policy, plan), (self.reference, plan.exact)):
                with pytest.raises(IllegalPlanError, match="its ROLLOUT residual was never computed"):
                    one.predict_action(obs, noise, own, prefix)
            self.refused += 1
            return
        found = self.policy.predict_action(obs, noise, plan, prefix)["action_pred"]
        report, lossy = report_of(self.policy), set(executed.precision.values())
        self.literally.frames, exact = self.policy._runtime.frames, plan.exact
        if lossy and executed.cells is None:  # the pruner reads other numbers
            made = replace(executed.exact, cells=report.plan, repair=True)
            exact = made if executed is plan else replace(exact, otherwise=made)
        expected = self.reference.predict_action(obs, noise, exact, prefix)["action_pred"]
        wanted = report_of(self.reference)
        np.testing.assert_array_equal(report.plan, wanted.plan)
        assert (report.loop, report.computed, report.plan_name) == (wanted.loop, wanted.computed, "given")
        if not lossy:
            assert (report.legalised, report.flops) == (wanted.legalised, wanted.flops)
        self.carried = lossy | (self.carried if executed.otherwise is not None and begun else set())
        off = distance(found, expected)
        assert off < allowed(self.artifact, self.carried), executed.variant
        self.ran.append((executed, off))


def report_of(policy: CompiledPolicy) -> CallReport:
    assert policy.last_report is not None
    return policy.last_report


@pytest.mark.parametrize("name", ["onnxruntime", "torch"])
def test_any_combination_is_the_references_or_is_refused_by_name(
    artifact: Artifact, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Episodes in which a few variants come again and again: nothing of one may be read by another."""
    literally, ran, refused = Literally(monkeypatch, artifact), list[tuple[Plan, float]](), 0
    able = sorted(ABLE[name] - ({"int8", "int4"} - {str(artifact.manifest.precision_name)}))
    drawn = Drawn(artifact, (*PRECISIONS, *able * 3))
    for seed in range(6):
        rng, streams, both = np.random.default_rng(seed), 1 + seed % 2, Compared(name, artifact, literally)
        shape, variants = (streams, *artifact.manifest.spec.sample), drawn.variants(rng, 3)
        for calls in (9, 6):
            scene = Scene(rng, streams)
            for call in range(calls):
                plan = drawn.plan(rng, variants[call // 2 % 3], streams)
                prefix = rng.uniform(-1, 1, (streams, 2, 3)).astype(np.float32) if rng.random() < 0.3 else None
                if rng.random() < 0.3:
                    both.follow(int(rng.integers(0, 4)))  # of two that are executed: with more the call is late
                both.call(scene.step(), Noise(rng.standard_normal(shape, dtype=np.float32)), plan, prefix)
            both.reset()
        ran, refused = ran + both.ran, refused + both.refused
    assert len(ran) > 60 and refused > 10
    plans = [plan for plan, _ in ran]
    for precision in able:
        lossy = [off for plan, off in ran if precision in plan.precision.values()]
        assert lossy and max(lossy) > allowed(artifact, set()), "not in that precision"
    assert {plan.loop for plan in plans} == {*STARTS, *LOOPS} and {plan.weights for plan in plans} > {"original"}
    assert any(plan.cells is None and plan.correction is not None for plan in plans)
    assert any(plan.tokens is not None for plan in plans) == bool(literally.works) == (name == "onnxruntime")
    if literally.works:
        reasons = ("first", "refresh", "changed", "filled", "forward")
        assert all(any(getattr(work, reason) for work in literally.works) for reason in reasons)
        assert {work.camera for work in literally.works} == set(cameras.CAMERAS)


def named(drawn: Drawn, rng: np.random.Generator, count: int) -> dict[str, Plan]:
    """So many plans that an artifact may hold: one schedule for all streams, or the pruner's."""
    plans, kept = dict[str, Plan](), drawn.artifact.plans["full"].precision
    while len(plans) < count:
        fields = drawn.variants(rng, 1)[0]
        fields["precision"] = {part: one for part, one in fields["precision"].items() if part in kept}
        if rng.random() < 0.5:  # else most would be refused
            fields |= {"tokens": None, "weights": "original", "precision": {} if rng.random() < 0.5 else kept}
        plan = drawn.plan(rng, fields, 1)
        own = [one.cells for one in (plan, plan.otherwise) if one is not None]
        if all(cells is None or cells.ndim == 2 for cells in own) and (plan.cells is not None or len(own) == 1):
            first = None if plan.otherwise is None else replace(plan.otherwise, repair=True)
            plans |= {} if first is None else {f"first-{len(plans)}": first}
            plans[f"plan-{len(plans)}"] = replace(plan, otherwise=first, repair=True)
    return plans


def of_module(name: str, plan: Plan) -> list[str]:
    """Why ``to_module`` refuses it; one of these is said."""
    found = [f"plan {name!r} begins with the chunk of the call before"] if plan.otherwise is not None else []
    lossy = [*sorted(set(plan.precision.values())), *["reused tokens"] * (plan.tokens is not None)]
    if lossy:
        found.append(f"plan {name!r} has {' and '.join(lossy)}, and a module computes all tokens of all frames in fp32")
    if plan.cells is not None and (plan.cells == Source.ROLLOUT).any():
        found.append(f"plan {name!r} reads residuals of earlier calls")
    return found


def of_file(name: str, plan: Plan, kept: Mapping[str, str]) -> list[str]:
    """Why there are no inputs of the single file for it; one of these is said."""
    found = [f"plan {name!r} has weights of its own"] if plan.weights != "original" else []
    if plan.otherwise is not None:
        found.append(f"plan {name!r} has a chunk to begin with")
    if plan.loop != "original":
        found.append(f"plan {name!r} is .*, and a single file of this artifact is of loop 'original'")
    if plan.precision != kept or plan.tokens is not None:
        found.append(f"plan {name!r} is .*, and a single file .* has all tokens, int. in ")
    return found


def test_a_module_and_a_single_file_compute_a_plan_or_refuse_it_by_name(folder: Path, tmp_path: Path) -> None:
    """Nothing that a plan says is left out in silence."""
    path, rng = shutil.copytree(folder / "artifact", tmp_path / "artifact"), np.random.default_rng(0)
    artifact, ran = load_artifact(path), set[tuple[str, bool]]()
    kept, streams = artifact.plans["full"].precision, 2
    plans, scene = named(Drawn(artifact, (artifact.manifest.precision_name,)), rng, 60), Scene(rng, streams)
    update_plans(path, {**artifact.plans, **plans}, "dense")
    reference, model = open_policy(load_artifact(path), "reference", plan="dense"), str(folder / "call.onnx")
    for name, plan in plans.items():
        obs, noise = scene.step(), Noise(rng.standard_normal((streams, *artifact.manifest.spec.sample), np.float32))
        if problems := of_module(name, plan):
            with pytest.raises(IllegalPlanError, match="|".join(problems)):
                ttscompile.to_module(path, name)
        else:
            given = {key: torch.from_numpy(value) for key, value in obs.items()}
            made = ttscompile.to_module(path, name)(given, torch.from_numpy(noise.initial))
            found = made[0] if isinstance(made, tuple) else made
            reference.reset()
            expected = reference.predict_action(obs, noise, plan)["action_pred"]
            assert distance(found.numpy(), expected) < allowed(artifact, set())
            ran.add(("module", plan.pruned))
        if problems := of_file(name, plan, kept):
            with pytest.raises(IllegalPlanError, match="|".join(problems)):
                inputs_of(path, name, streams)
        else:
            whole = Episode(model, streams).call(obs, noise, **inputs_of(path, name, streams))
            reference.reset()  # the pruner reads other numbers there
            expected = reference.predict_action(obs, noise, replace(plan.exact, cells=whole["executed_plan"]))[
                "action_pred"
            ]
            assert (
                allowed(artifact, set())
                < distance(whole["action_pred"], expected)
                < allowed(artifact, set(kept.values()))
            )
            ran.add(("file", plan.pruned))
    assert ran == {(what, pruned) for what in ("module", "file") for pruned in (False, True)}
