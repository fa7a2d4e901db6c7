"""The sparse call as a module: the same actions as the policy, exported and compiled too."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import ttscompile
from tests.plans import store_schedules
from tests.rounding import assert_equal_but_for_rounding
from ttscompile import Noise, Plan, Source, TokenReuse
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.manifest import StartRecord
from ttscompile.artifact.write import update_plans
from ttscompile.core.correction import no_correction
from ttscompile.core.envelope import Envelope
from ttscompile.core.lattice import uniform_plan
from ttscompile.errors import IllegalPlanError, ObservationError, RuntimeUnavailableError

from .agreement import call_terms
from .conftest import MakeArtifact
from .plans import random_correction, random_plan
from .toys import toy_program

CELLS = np.zeros((5, 5), np.int8)
NO_COMPILER = "NO C++ COMPILER: the exported module was not compiled; install g++"


def calibrated(artifact: Artifact) -> Artifact:
    """With a schedule that reads residuals of this call alone and has a correction, one that does not, and a pruner."""
    manifest, rng = artifact.manifest, np.random.default_rng(0)
    shape = (manifest.steps, len(manifest.groups))
    plans: dict[str, np.ndarray] = {
        "evenly": uniform_plan(*shape, 2),
        "mixed": random_plan(rng, shape[0], manifest.groups, np.zeros(shape, np.bool_), 0.3),
        "rollout": np.where(np.arange(shape[0])[:, None] == 0, Source.COMPUTE, Source.ROLLOUT) + np.zeros(shape),
    }
    schedules = {name: plan.astype(np.int8) for name, plan in plans.items()}
    corrections = {"mixed": random_correction(artifact, rng)}
    store_schedules(artifact.path, dict(artifact.pruner), schedules, "evenly", {}, corrections=corrections)
    return load_artifact(artifact.path)


@pytest.fixture(scope="module")
def artifact(tmp_path_factory: pytest.TempPathFactory) -> Artifact:
    from .toys import written_artifact

    return calibrated(written_artifact(toy_program(normed=True), tmp_path_factory.mktemp("module") / "artifact"))


Inputs = tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor]


def inputs(streams: int, seed: int = 0) -> Inputs:
    rng = np.random.default_rng(seed)
    shapes = (streams, 2), (streams, 3, 2), (5, streams, 3, 2)
    obs, initial, steps = (torch.from_numpy(rng.standard_normal(shape, dtype=np.float32)) for shape in shapes)
    return {"obs": obs}, initial, steps


def expected(artifact: Artifact, given: Inputs, plan: str) -> np.ndarray:
    policy = ttscompile.load(artifact.path, "reference")
    obs, initial, steps = given
    noise = Noise(initial.numpy(), steps.numpy())
    return np.asarray(policy.predict_action({"obs": obs["obs"].numpy()}, noise=noise, plan=plan)["action_pred"])


def terms(artifact: Artifact) -> float:
    """Those of a call; the actions are divided by a scale of a half at least, so they may be twice as far off."""
    return 4 * call_terms(artifact)


@pytest.mark.parametrize("plan", ["evenly", "mixed", "dense"])
@pytest.mark.parametrize("streams", [1, 3])
def test_it_gives_the_actions_of_the_policy(artifact: Artifact, plan: str, streams: int) -> None:
    module = ttscompile.to_module(artifact.path, plan)
    assert not module.training and not list(module.parameters())
    given = inputs(streams)
    assert_equal_but_for_rounding(module(*given), expected(artifact, given, plan), terms(artifact))


def test_the_default_plan_is_the_artifacts(artifact: Artifact) -> None:
    given = inputs(1)
    found, named = (ttscompile.to_module(artifact.path, plan)(*given) for plan in (None, "evenly"))
    assert torch.equal(found, named)


def test_a_plan_of_ones_own_and_one_that_it_cannot_compute(artifact: Artifact) -> None:
    """Nothing that a plan says is left out in silence."""
    given, mixed, reuse = inputs(1), artifact.plans["mixed"], TokenReuse(0.1, 8)
    found = [ttscompile.to_module(artifact.path, plan)(*given) for plan in ("mixed", mixed, "mixed@fp32")]
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])
    int8 = replace(mixed, precision={"blocks": "int8"})
    lossy: dict[str, str | Plan] = {
        "'mixed@bf16' has bf16": "mixed@bf16",
        "'mixed@fp16.blocks' has fp16": "mixed@fp16+blocks",
        "'given' has int8": int8,
        "'given' has reused tokens": replace(mixed, tokens=reuse),
        "'given' has int8 and reused tokens": replace(int8, tokens=reuse),
    }
    for told, plan in lossy.items():
        remedy = r"Give a plan in fp32: 'NAME@fp32', which is plan\.exact"
        with pytest.raises(IllegalPlanError, match=f"plan {told}, and a module computes all tokens .* fp32. {remedy}"):
            ttscompile.to_module(artifact.path, plan)
        if isinstance(plan, Plan):
            assert torch.equal(found[0], ttscompile.to_module(artifact.path, plan.exact)(*given))


@pytest.mark.slow
@pytest.mark.parametrize("variant", [{"sequence_first": True}, {"noise": 0.0}, {"blocks": 1}], ids=str)
def test_other_forms_of_networks(make_artifact: MakeArtifact, variant: dict[str, bool]) -> None:
    made = make_artifact(toy_program(**variant))
    given = inputs(2)
    found = ttscompile.to_module(made.path, "dense")(*given[: 2 if variant == {"noise": 0.0} else 3])
    assert_equal_but_for_rounding(found, expected(made, given, "dense"), terms(made))


@pytest.mark.slow
def test_it_can_be_exported_and_what_is_exported_computes_the_same(artifact: Artifact) -> None:
    module = ttscompile.to_module(artifact.path, "mixed")
    with torch.no_grad():
        exported = torch.export.export(module, inputs(2))
    other = inputs(2, seed=1)
    found = exported.module()(*other)
    assert_equal_but_for_rounding(found.detach(), expected(artifact, other, "mixed"), terms(artifact))


class OneChannel(torch.nn.Module):
    """Of a sample of one number a step."""

    def __init__(self) -> None:
        super().__init__()
        self.into, self.block, self.out = torch.nn.Linear(1, 4), torch.nn.Linear(4, 4), torch.nn.Linear(4, 1)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        stream = self.into(sample) + obs[:, None, :1]
        return self.out(stream + torch.tanh(self.block(stream)))


@pytest.mark.slow
def test_one_channel_with_an_envelope_can_be_exported(tmp_path: Path) -> None:
    """The branches for near and far give tensors of the same strides, which a size of one leaves open."""
    loop = ttscompile.flow_matching_table(3)
    spec = ttscompile.PolicySpec((3, 1), {"obs": ttscompile.ObservationSpec((2,))}, loop, ttscompile.ChunkSpec(1, 0, 2))
    ttscompile.compile_denoiser(OneChannel().eval(), spec, tmp_path / "artifact")
    made = load_artifact(tmp_path / "artifact")
    plan = Plan(cells=uniform_plan(3, 1, 2), correction=random_correction(made, np.random.default_rng(0)), repair=True)
    near = Envelope(np.ones((made.manifest.condition_numbers, 1), np.float32), np.zeros(1, np.float32))
    update_plans(made.path, {"p": plan}, "p", envelope=near)
    module, given = ttscompile.to_module(made.path), ({"obs": torch.ones(1, 2)}, torch.ones(1, 3, 1))
    with torch.no_grad():
        exported = torch.export.export(module, given).module()
        assert torch.equal(exported(*given), module(*given))


@pytest.mark.soak
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")  # of torch's compiler, about itself
def test_what_is_exported_can_be_compiled_and_run_without_python(artifact: Artifact, tmp_path: Path) -> None:
    if shutil.which("g++") is None:
        pytest.skip(NO_COMPILER)
    module = ttscompile.to_module(artifact.path, "evenly")
    with torch.no_grad():
        exported = torch.export.export(module, inputs(1))
    package = torch._inductor.aoti_compile_and_package(exported, package_path=str(tmp_path / "call.pt2"))
    compiled = torch._inductor.aoti_load_package(package)
    for seed in (1, 2):
        given = inputs(1, seed)
        assert_equal_but_for_rounding(compiled(*given), expected(artifact, given, "evenly"), terms(artifact))


def test_moving_it_moves_everything(artifact: Artifact) -> None:
    """On the device of tensors without numbers, which most operations refuse to mix with the CPU's."""
    module = ttscompile.to_module(artifact.path, "mixed").to("meta")
    obs, initial, steps = inputs(2)
    result = module({key: value.to("meta") for key, value in obs.items()}, initial.to("meta"), steps.to("meta"))
    assert (result.device.type, tuple(result.shape)) == ("meta", (2, 3, 2))


def test_a_schedule_that_a_module_cannot_have_is_refused(artifact: Artifact) -> None:
    with pytest.raises(IllegalPlanError, match="keeps nothing between calls"):
        ttscompile.to_module(artifact.path, "rollout")
    for cells, message in ((np.ones((5, 5), np.int8), "step 0 must be dense"), (np.stack([CELLS] * 2), r"\(2, 5, 5\)")):
        with pytest.raises(IllegalPlanError, match=message):  # though a runtime would repair the first
            ttscompile.to_module(artifact.path, Plan(cells=cells, repair=True))


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (
            Plan(),
            r"plan 'given' is made by a pruner, and loop 'original' has none.*by its name, say: \['dense', 'warm'",
        ),
        (
            Plan(cells=CELLS, correction=no_correction(4, (3, 2))),
            r"has weights \[4, 2, 18, 3\]; this policy needs \[5, 2",
        ),
        (Plan("last-2", CELLS[:2]), "plan 'given' begins with the chunk of the call before"),
    ],
)
def test_a_plan_of_ones_own_that_does_not_fit_is_refused(make_artifact: MakeArtifact, plan: Plan, message: str) -> None:
    """As a runtime refuses it."""
    made = make_artifact(toy_program(pruner=False))
    dense = made.plans["dense"]
    plans = {"dense": dense, "warm": Plan("last-2", CELLS[:2], otherwise=dense, repair=True)}
    update_plans(made.path, plans, "dense", starts={"last-2": StartRecord("original", 2)})
    with pytest.raises(IllegalPlanError, match=message):
        ttscompile.to_module(made.path, plan)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda obs, initial, steps: (obs, initial[:, :2], steps), r"initial must be float32 .*found .*\[1, 2, 2\]"),
        (lambda obs, initial, steps: (obs, initial.double(), steps), "float64"),
        (lambda obs, initial, steps: (obs, initial), "steps must be .* found none"),
        (lambda obs, initial, steps: (obs, initial, steps[1:]), "steps must be"),
        (lambda obs, initial, steps: ({}, initial, steps), r"'obs' must be a Tensor, float32 \[1, 2\]; found none"),
        (lambda obs, initial, steps: ({"obs": obs["obs"][:, :1]}, initial, steps), r"a Tensor, torch.float32 \[1, 1\]"),
        (lambda obs, initial, steps: ({"obs": obs["obs"].numpy()}, initial, steps), "found a ndarray, float32"),
        (lambda obs, initial, steps: ({"obs": obs["obs"].long()}, initial, steps), "found a Tensor, torch.int64"),
    ],
)
def test_inputs_that_do_not_fit_are_refused(artifact: Artifact, change: object, message: str) -> None:
    module = ttscompile.to_module(artifact.path)
    with pytest.raises(ObservationError, match=message):
        module(*change(*inputs(1)))  # type: ignore[operator]


def test_without_torch_it_says_what_to_install(artifact: Artifact, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.delitem(vars(ttscompile), "to_module", raising=False)
    monkeypatch.delitem(sys.modules, "ttscompile.runtimes.torch.module", raising=False)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(RuntimeUnavailableError, match="to_module needs torch, which is not installed"):
        ttscompile.to_module(artifact.path)
