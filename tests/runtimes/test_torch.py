"""The runtime on torch: it agrees with the reference, and its calls can be captured."""

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch.fx.experimental.proxy_tensor import make_fx

import ttscompile
from tests.families import cameras
from tests.once import Once
from tests.rounding import assert_equal_but_for_rounding, bound
from ttscompile import Source
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.plan import DENSE, Plan
from ttscompile.errors import IllegalPlanError, RuntimeUnavailableError
from ttscompile.runtimes import Runtime, open_runtime
from ttscompile.runtimes.instructions import instructions_of
from ttscompile.runtimes.random_calls import normalized, random_call
from ttscompile.runtimes.torch.backend import Line, Lines, TorchBackend
from ttscompile.runtimes.torch.loop import denoise
from ttscompile.runtimes.torch.network import Parts, Placed, StreamsNetwork
from ttscompile.runtimes.torch.sampler import Advance

from .agreement import assert_alike, call_terms, random_inputs
from .conftest import MakeArtifact
from .plans import random_correction, random_plan
from .pruners import scheduled
from .toys import toy_program


def replaying(lines: list[Line]) -> Callable[[Line], Line]:
    """A capture as CUDA makes it, on the CPU: the operations are recorded once, between the tensors of the moment.

    What a line takes from anywhere else than from these tensors stays as it was when it was recorded, and so does
    every decision. Each recording is added to ``lines``.
    """

    def capture(line: Line) -> Line:
        line()  # as the runs before a capture
        recorded = make_fx(lambda: line())()
        lines.append(recorded)
        return recorded

    return capture


@pytest.mark.slow
def test_streams_with_one_plan_are_a_batch(make_artifact: MakeArtifact) -> None:
    """Two streams follow one plan and the third another: residuals of an earlier call stay with their stream."""
    artifact = make_artifact(toy_program(normed=True, pruner=False))
    manifest, rng = artifact.manifest, np.random.default_rng(0)
    runtimes = [open_runtime(artifact, name) for name in ("torch", "reference")]
    written = np.zeros((3, manifest.steps, len(manifest.groups)), np.bool_)
    for _ in range(4):
        one, other = (random_plan(rng, manifest.steps, manifest.groups, np.all(written, axis=0)) for _ in range(2))
        plans = np.stack([one, other, one])
        assert_alike(artifact, runtimes, Plan(cells=plans), rng, 3)
        written |= plans == Source.COMPUTE
    assert isinstance(runtimes[0].backend, TorchBackend)
    assert sorted(runtimes[0].backend._some) == [1, 2]


@pytest.fixture
def calibrated(make_artifact: MakeArtifact) -> Artifact:
    return scheduled(make_artifact(toy_program(steps=4, blocks=3, normed=True)))


def both(artifact: Artifact, lines: list[Line]) -> list[Runtime]:
    return [
        Runtime(artifact, partial(TorchBackend, placed=Placed(torch.device("cpu")), capture=replaying(lines))),
        open_runtime(artifact, "reference"),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["evenly", "mixed", DENSE])
@pytest.mark.parametrize("streams", [1, 3])
def test_a_call_is_captured_once_and_replayed_on_other_inputs(calibrated: Artifact, name: str, streams: int) -> None:
    lines: list[Line] = []
    runtimes, rng = both(calibrated, lines), np.random.default_rng(0)
    for called in (DENSE, name, name, name):
        assert_alike(calibrated, runtimes, calibrated.plans[called], rng, streams, times=2)
    assert len(lines) == (1 if name == DENSE else 2)


def test_the_first_call_of_an_episode_is_captured_too(calibrated: Artifact) -> None:
    """Its plan is the one that was repaired, since nothing was computed before."""
    lines: list[Line] = []
    runtimes, rng = both(calibrated, lines), np.random.default_rng(0)
    for _ in range(2):
        assert_alike(calibrated, runtimes, calibrated.plans["mixed"], rng)
        for runtime in runtimes:
            runtime.reset()
    assert len(lines) == 1


def test_what_a_pruner_decides_selects_among_captured_calls_and_a_matrix_is_captured_when_it_comes_again(
    calibrated: Artifact,
) -> None:
    lines: list[Line] = []
    runtimes, rng = both(calibrated, lines), np.random.default_rng(1)
    seen = set()
    for _ in range(3):
        obs, noise = random_inputs(calibrated, rng, 1)
        ours, report = runtimes[0].predict(obs, noise, Plan(repair=True))
        theirs, _ = runtimes[1].predict(obs, noise, Plan(cells=report.plan))
        assert_equal_but_for_rounding(ours, theirs, call_terms(calibrated))
        seen.add(report.plan.tobytes())
    assert len(lines) == 1 + len(seen)  # the prologue is a line of its own, since the pruner reads it
    matrix = random_plan(rng, 4, calibrated.manifest.groups, np.zeros((4, 3), np.bool_))
    for number in range(3):
        assert_alike(calibrated, runtimes, Plan(cells=matrix), rng)
        assert len(lines) == 1 + len(seen) + (number > 0)


def test_a_plan_in_another_precision_is_captured(calibrated: Artifact) -> None:
    lines: list[Line] = []
    runtime, rng = both(calibrated, lines)[0], np.random.default_rng(0)
    for number in range(3):
        runtime.predict(*random_inputs(calibrated, rng, 1), calibrated.plan("evenly@bf16"))
        assert len(lines) == 1 + (number > 0), "the prologue, and the second call"


@pytest.mark.filterwarnings("ignore:.*learned plans:UserWarning")  # one artifact takes the other's place
def test_a_plan_in_another_precision_keeps_what_others_read(calibrated: Artifact, make_artifact: MakeArtifact) -> None:
    runtime, rng = open_runtime(calibrated, "torch"), np.random.default_rng(0)
    for name in ("dense@bf16", "mixed@bf16"):
        _, report = runtime.predict(*random_inputs(calibrated, rng, 1), calibrated.plan(name))
    assert report.plan_name == "mixed@bf16" and (report.plan == Source.ROLLOUT).any() and sum(report.legalised) == 0
    unread = make_artifact(toy_program(normed=True, pruner=False))
    runtime = open_runtime(unread, "torch")
    runtime.predict(*random_inputs(unread, rng, 1), unread.plan("dense@bf16"))
    assert not runtime._given, "no plan of the artifact reads an earlier call"


@pytest.mark.slow
def test_another_batch_size_is_captured_anew(calibrated: Artifact) -> None:
    lines: list[Line] = []
    runtimes, rng = both(calibrated, lines), np.random.default_rng(1)
    for streams in (1, 1, 2, 2, 1):
        assert_alike(calibrated, runtimes, calibrated.plans["evenly"], rng, streams)
        for runtime in runtimes:
            runtime.reset()
    assert len(lines) == 3


def test_a_recording_shows_what_a_line_takes_from_elsewhere() -> None:
    """The comparison can fail: a value that is read when a line is recorded stays."""
    tensor, result, number = torch.ones(1), torch.zeros(1), [1.0]

    def line() -> None:
        result.copy_(tensor * number[0])

    lines = Lines(replaying([]))
    lines.run("key", line)
    tensor.fill_(3.0)
    number[0] = 2.0
    lines.run("key", line)
    assert result.item() == 3.0


def test_lines_that_were_captured_long_ago_are_let_go() -> None:
    captured: list[int] = []
    lines = Lines(lambda line: captured.append(1) or line)  # type: ignore[func-returns-value]
    for key in [*range(70), 69, 0]:
        lines.run(key, lambda: None)
    assert len(captured) == 71


@pytest.mark.parametrize("precision", ["bf16", "fp16"])
@pytest.mark.parametrize(
    "parts", [("blocks",), ("condition",), ("step",), ("blocks", "condition", "step")], ids="+".join
)
def test_products_in_fewer_bits_are_near_those_in_fp32(
    make_artifact: MakeArtifact, precision: str, parts: tuple[str, ...]
) -> None:
    """Any part, and all of them, which is what the precision alone names."""
    artifact = make_artifact(toy_program(normed=True))
    rng = np.random.default_rng(0)
    obs, noise = random_inputs(artifact, rng, 2)
    plan = uniform_plan(5, 5, 3)
    exact = open_runtime(artifact, "torch").predict(obs, noise, Plan(cells=plan))[0]
    runtime, narrowed = open_runtime(artifact, "torch"), Plan(cells=plan, precision=dict.fromkeys(parts, precision))
    narrow = runtime.predict(obs, noise, narrowed)[0]
    unit = {"bf16": 2.0**-8, "fp16": 2.0**-11}[precision]
    difference = np.abs(narrow - exact).max() / np.abs(exact).max()
    assert bound(1) < difference < bound(call_terms(artifact), unit=unit)
    assert artifact.plan(f"dense@{precision}+{'+'.join(parts)}").precision == narrowed.precision
    if len(parts) == 3:
        assert artifact.plan(f"dense@{precision}").precision == narrowed.precision


@pytest.mark.slow
def test_frames_are_computed_in_fewer_bits(once: Once) -> None:
    """The features of a tower in bf16 are read by a prologue in fp32, and the other way round."""
    artifact = load_artifact(once.folder("seeing", cameras.compile_seeing) / "artifact")
    spec, runtime = artifact.manifest.spec, open_runtime(artifact, "torch")
    (obs, noise), (_, other) = (random_call(spec, number, 8) for number in (0, 1))
    obs = normalized(spec, obs)
    exact = runtime.predict(obs, noise, artifact.plan("dense"))[0]
    apart = np.abs(runtime.predict(obs, other, artifact.plan("dense"))[0] - exact).max()
    assert {"frame_00", "frame_01", "condition", "blocks"} <= set(artifact.plan("dense@bf16").precision)
    for name in ("dense@bf16", "dense@bf16+frame_00+frame_01", "dense@bf16+condition"):
        found = runtime.predict(obs, noise, artifact.plan(name))[0]
        assert 0 < np.abs(found - exact).max() < 2.0**-4 * apart, name


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"device": "abacus"}, "device 'abacus' cannot be had"),
        ({"device": "cuda:97"}, "device 'cuda:97' cannot be had"),
        ({"device": 3}, "expected the name of a device"),
        ({"plan": "dense@int8"}, "runtime 'torch' computes in fp32, and beside it bf16, fp16; the plan wants 'blocks'"),
        ({"runtime": "onnxruntime", "device": "cuda"}, "on the CPU alone; found device 'cuda'. Use runtime='torch'"),
        (
            {"runtime": "reference", "plan": "dense@bf16"},
            "'reference' computes in fp32 alone; the plan wants 'blocks' in 'bf16'",
        ),
        (
            {"runtime": "onnxruntime", "plan": "dense@fp16"},
            "computes in fp32, and beside it int8, int4; the plan wants 'blocks'",
        ),
    ],
)
def test_what_cannot_be_had_is_refused(toy_artifact: Artifact, options: dict[str, Any], message: str) -> None:
    with pytest.raises(RuntimeUnavailableError, match=message):
        ttscompile.load(toy_artifact.path, **({"runtime": "torch"} | options))


def test_a_part_that_there_is_not_is_refused(toy_artifact: Artifact) -> None:
    told = "a plan wants 'frame_07' in 'bf16'; the artifact's parts are blocks, condition, step. Name some of these."
    with pytest.raises(IllegalPlanError, match=re.escape(told)):
        ttscompile.load(toy_artifact.path, "torch", plan="dense@bf16+frame_07")


def test_the_precision_is_told(toy_artifact: Artifact) -> None:
    told = [ttscompile.load(toy_artifact.path, "torch", plan=name).info for name in ("dense", "dense@bf16")]
    assert [(one.precision, one.default_plan) for one in told] == [("fp32", "dense"), ("bf16", "dense@bf16")]


def test_settings_of_torch_are_as_they_were_after_a_call(toy_artifact: Artifact) -> None:
    torch.set_num_threads(2)
    policy = ttscompile.load(toy_artifact.path, "torch", threads=1, seed=0)
    assert torch.get_num_threads() == 2
    during: list[int] = []
    backend: Any = policy._runtime.backend
    original = backend._lines.run

    def run(*given: Any, **kwargs: Any) -> Any:
        during.append(torch.get_num_threads())
        return original(*given, **kwargs)

    backend._lines.run = run
    policy.predict_action({"obs": np.zeros((1, 2), np.float32)}, plan="dense")
    assert (set(during), torch.get_num_threads()) == ({1}, 2)
    assert torch.is_grad_enabled() and not torch.is_inference_mode_enabled()


@pytest.mark.slow
@pytest.mark.parametrize("variant", [{}, {"normed": True, "sequence_first": True}], ids=str)
def test_everything_of_a_call_is_on_its_device(make_artifact: MakeArtifact, variant: dict[str, bool]) -> None:
    """On torch's device of tensors without numbers, which most operations refuse to mix with the CPU's."""
    artifact = make_artifact(toy_program(**variant))
    manifest, device, rng = artifact.manifest, torch.device("meta"), np.random.default_rng(0)
    with pytest.raises(RuntimeError, match="device"):
        torch.zeros(2, device=device) + torch.zeros(2)
    (horizon, channels), groups = manifest.spec.sample, manifest.groups
    plan = random_plan(rng, manifest.steps, groups, np.ones((5, 5), np.bool_), computed=0.4)
    lowered = instructions_of(plan, groups)
    assert lowered.rollout.any()
    parts = Parts(view_of(artifact), Placed(device))
    network = StreamsNetwork(parts, {"obs": torch.zeros((2, 2), device=device)}, 2)
    advance = Advance(manifest.spec, random_correction(artifact, rng), device)
    network.prologue()
    initial = torch.zeros((2, horizon, channels), device=device)
    offset = torch.zeros((5, channels, 2, horizon), device=device).unbind()
    entry = parts.zeros(manifest.blocks[0].type.at(2), "float32")
    rollout = dict.fromkeys(np.flatnonzero(lowered.rollout).tolist(), entry)
    read, _ = advance.of_condition(network.condition())
    assert advance.jumps
    sample, residuals = denoise(network, lowered, range(25), advance, initial, offset, rollout, read)
    results = [sample, network.logits(), network.condition(), *residuals.values()]
    assert len(results) == 3 + np.count_nonzero(plan == Source.COMPUTE)
    assert {each.device.type for each in results} == {"meta"}
