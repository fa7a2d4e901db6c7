"""What capture refuses, and how it says so."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from torch import nn

import ttscompile
from tests.heard import heard
from tests.passes.specs import toy_spec
from ttscompile.capture import export
from ttscompile.capture.export import capture
from ttscompile.errors import CaptureError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Batch, TensorType
from ttscompile.ir.verify import verify_graph


class Denoiser(nn.Module):
    """A linear layer and then whatever the test wants."""

    def __init__(self, then: Callable[[torch.Tensor, torch.Tensor, torch.Tensor], object]) -> None:
        super().__init__()
        self.linear, self.then = nn.Linear(2, 2), then

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> object:
        return self.then(self.linear(sample), timestep, obs)


def test_batch_is_the_only_symbolic_size() -> None:
    graph, weights = capture(Denoiser(lambda y, t, o: y + t.view(-1, 1, 1) * o[:, None, :2]), toy_spec())
    assert list(graph.inputs) == ["sample", "timestep", "obs"]
    assert graph.inputs["sample"] == TensorType((Batch(), 4, 2), "float32")
    assert graph.inputs["timestep"] == TensorType((Batch(),), "int64")
    assert set(weights) == {"linear.weight", "linear.bias"}
    assert {n for node in graph.nodes for n in node.type.shape if isinstance(n, Batch)} == {Batch()}


def test_multiples_of_the_batch_are_kept() -> None:
    graph, _ = capture(Denoiser(lambda y, t, o: (y.reshape(-1, 2) * 2).reshape(y.shape)), toy_spec())
    assert any(node.type.shape == (Batch(4), 2) for node in graph.nodes)


def test_the_users_module_is_not_touched() -> None:
    module = Denoiser(lambda y, t, o: y).double().train()
    capture(module, toy_spec())
    assert module.training and module.linear.weight.dtype is torch.float64


@pytest.mark.slow
@pytest.mark.parametrize(
    ("then", "message"),
    [
        (
            lambda y, t, o: y if o.sum() > 0 else -y,
            r"Denoiser at test_export.py:\d+ in <lambda>: what it does depends on",
        ),
        (lambda y, t, o: y if torch.equal(o, o + 1) else -y, r"values of a tensor: .* by torch\.equal, .*torch\.where"),
        (lambda y, t, o: y * float(o.sum()), r"the values of a tensor: .* by a number taken out of one .*torch.where"),
        (lambda y, t, o: y * o.sum().item(), r"%item \(test_export.py:\d+ in \S+\): .* by a number taken out of one"),
        (lambda y, t, o: (y, y), "returns 2 values"),
        (lambda y, t, o: y[:, :2], r"returns float32\[B, 2, 2\]; expected the type of its sample, float32\[B, 4, 2\]"),
        (lambda y, t, o: y.double(), "returns float64"),
        (lambda y, t, o: (y.bfloat16() + 1).float(), r"_to_copy \(test_export.py:\d+ in \S+\) computes in bfloat16"),
        (lambda y, t, o: torch.cat([y, y, y[:1]])[: y.shape[0]], "not a multiple of the batch size"),
        (lambda y, t, o: y[o[:, 0] > 0], r"%index \(.*\) has the size u\d: .* by a mask that picks entries"),
        (lambda y, t, o: y + torch.tensor([t[0].item()]), r"has the size u\d: .*a number taken out of one \(.item"),
    ],
)
def test_what_cannot_be_compiled_is_refused(then: Callable[..., object], message: str) -> None:
    with pytest.raises(CaptureError, match=message):
        capture(Denoiser(then), toy_spec())


@pytest.mark.parametrize(
    "then",
    [
        lambda y, t, o: y if o.sum() > 0 else -y,  # torch.export prints its graph
        lambda y, t, o: y @ torch.zeros(5, 5),  # torch logs the traceback
    ],
)
def test_the_error_is_all_that_is_said(then: Callable[..., object], capsys: pytest.CaptureFixture[str]) -> None:
    message, loggers = r" at test_export.py:\d+ in <lambda>: ", ("", "torch._subclasses.fake_tensor", "torch.fx")
    with heard(*loggers) as told, pytest.raises(CaptureError, match=message) as caught:
        capture(Denoiser(then), toy_spec())
    assert (*capsys.readouterr(), told) == ("", "", [])
    assert not re.search("TORCH|guard_or_false|unhinted", str(caught.value))


def test_what_cannot_be_traced_is_traced_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another number of streams would change nothing, and the user waits for the error."""
    trace = Mock(wraps=export._traced)
    monkeypatch.setattr(export, "_traced", trace)
    with pytest.raises(CaptureError, match="could not capture"):
        capture(Denoiser(lambda y, t, o: y if y.sum() > 0 else -y), toy_spec())
    assert trace.call_count == 1


def test_a_constant_made_of_the_number_of_streams_is_refused() -> None:
    with pytest.raises(CaptureError, match="computes for a batch of 1 something else than for more.* Every stream"):
        capture(Denoiser(lambda y, t, o: y * torch.tensor(float(y.shape[0]))), toy_spec())


@pytest.mark.slow
@pytest.mark.parametrize("small", [1, 2])
def test_a_branch_at_a_small_batch_is_refused(small: int) -> None:
    with pytest.raises(CaptureError, match=f"computes for a batch of {small} something else than for more"):
        capture(Denoiser(lambda y, t, o: -y if small <= y.shape[0] < 4 else y), toy_spec())


@pytest.mark.parametrize(
    ("then", "why"),
    [
        (lambda y, t, o: y - y.mean(0), "for a stream beside another something else than alone"),
        (lambda y, t, o: y / y.shape[0], r"%div .* computes with a multiple of 109. Every stream"),
        (
            lambda y, t, o: y * torch.arange(y.shape[0])[:, None, None],
            "for a stream beside another something else than alone",
        ),
    ],
)
def test_streams_that_depend_on_each_other_are_refused(then: Callable[..., object], why: str) -> None:
    with pytest.raises(CaptureError, match=why):
        capture(Denoiser(then), toy_spec())


def test_a_buffer_may_have_the_name_of_an_operation() -> None:
    class Rotates(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.cos: torch.Tensor = nn.Buffer(torch.rand(2))

        def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
            return sample * self.cos + timestep.cos()[:, None, None]

    module = Rotates()
    graph, weights = capture(module, toy_spec())
    verify_graph(graph, "denoiser")
    values = {"sample": torch.randn(2, 4, 2), "timestep": torch.tensor([1, 2]), "obs": torch.randn(2, 3)}
    with torch.no_grad():
        expected = module(**values)
    found = evaluate(graph, {name: torch.from_numpy(value) for name, value in weights.items()}, values)
    torch.testing.assert_close(found, (expected,))


def test_a_module_that_cannot_be_copied_is_refused() -> None:
    module: Any = Denoiser(lambda y, t, o: y * module.scale)
    module.scale = nn.Parameter(torch.rand(2)).exp()
    with pytest.raises(CaptureError, match="Denoiser cannot be copied: .*call torch.nn.utils.remove_weight_norm"):
        capture(module, toy_spec())


def test_what_an_attribute_raises_is_told() -> None:
    """A lock, an open file or a logger's stream makes copying raise a TypeError."""
    module: Any = Denoiser(lambda y, t, o: y)
    module.lock = threading.Lock()
    with pytest.raises(CaptureError, match="Denoiser cannot be copied: .*lock.* object .*take locks and files out"):
        ttscompile.compile_denoiser(module, toy_spec())


@pytest.mark.filterwarnings("ignore:`torch.jit.trace")  # whose class torch has changed
def test_torchscript_is_refused() -> None:
    module = Denoiser(lambda y, t, o: y)
    module.linear = torch.jit.trace(module.linear, torch.zeros(1, 4, 2))
    with pytest.raises(CaptureError, match="Denoiser holds TorchScript.* Pass the module that was scripted or traced"):
        ttscompile.compile_denoiser(module, toy_spec())


@pytest.mark.slow
def test_state_that_changes_is_refused() -> None:
    class Counter(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.count = nn.Buffer(torch.zeros(()))

        def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
            self.count.add_(1)
            return sample + self.count

    with pytest.raises(CaptureError, match="changes its own buffers"):
        capture(Counter(), toy_spec())


class Keeping(nn.Module):
    """Computes something of what it is given at its first call, keeps it in ``place``, and adds it at every call."""

    def __init__(self, place: str, make: Callable[[torch.Tensor], torch.Tensor]) -> None:
        super().__init__()
        self.linear, self.place, self.make, self.kept = nn.Linear(2, 2), place, make, None
        self.all: dict[str, torch.Tensor] = {}

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        kept: Any = vars(self) if self.place == "kept" else self.all
        if kept.get(self.place) is None:
            kept[self.place] = self.make(obs)
        return self.linear(sample) + kept[self.place]


@pytest.mark.slow
@pytest.mark.parametrize("place", ["kept", "entry"])
def test_what_is_kept_from_call_to_call_is_refused(place: str) -> None:
    with pytest.raises(CaptureError, match="for a batch of 2 .* keeps|called before. It keeps something of one call"):
        capture(Keeping(place, lambda obs: obs[:, None, :2]), toy_spec())


def test_what_is_kept_may_be_the_same_in_every_call() -> None:
    """As a table of positions that is made when it is first needed; of such torch.export warns."""
    module = Keeping("kept", lambda obs: torch.arange(2.0))
    graph, _ = capture(module, toy_spec())
    assert any(node.op.startswith("aten.arange") for node in graph.nodes)
    assert module.kept is None


def test_arguments_of_other_names_are_told_with_what_names_them() -> None:
    class Other(Denoiser):
        def forward(self, x: torch.Tensor, t: torch.Tensor, obs: torch.Tensor) -> object:
            return self.linear(x)

    module = Other(lambda y, t, o: y)
    why = r"Other is called with the arguments sample, timestep, obs: missing .* 'x'\. .*sample_argument=\.\.\., time"
    with pytest.raises(CaptureError, match=why):
        capture(module, toy_spec())
    graph, _ = capture(module, replace(toy_spec(), sample_argument="x", timestep_argument="t"))
    assert list(graph.inputs) == ["x", "t", "obs"]


def test_what_is_no_module_or_around_one_is_refused() -> None:
    module: Any = Denoiser(lambda y, t, o: y)
    others: list[tuple[Any, str]] = [
        (lambda sample: sample, "function"),
        (module.forward, "method"),
        (Denoiser, "type"),
    ]
    for given, what in others:
        with pytest.raises(CaptureError, match=f"expected an nn.Module; found {what}"):
            ttscompile.compile_denoiser(given, toy_spec())
    with pytest.raises(CaptureError, match="found DataParallel around it. Pass module.module"):
        ttscompile.compile_denoiser(nn.DataParallel(module), toy_spec())


def test_messages_name_a_line_and_no_path() -> None:
    graph, _ = capture(Denoiser(lambda y, t, o: y), toy_spec())
    (node,) = [n for n in graph.nodes if n.op == "aten.linear.default"]
    assert node.source.startswith("test_export.py:") and "/" not in node.source
