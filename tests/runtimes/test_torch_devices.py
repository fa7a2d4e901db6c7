"""What the torch runtime makes of the process that it is in: the caller's settings of precision, and its GPUs."""

from __future__ import annotations

from contextlib import nullcontext
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from ttscompile.artifact import Artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.plan import Plan
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.torch.backend import TorchBackend, cuda_graphs
from ttscompile.runtimes.torch.devices import device_of, exact_arithmetic
from ttscompile.runtimes.torch.network import Placed

from .agreement import random_inputs
from .conftest import MakeArtifact
from .toys import toy_program


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_what_a_caller_told_torch_about_precision_changes_no_action(
    make_artifact: MakeArtifact, precision: str
) -> None:
    artifact = make_artifact(toy_program(normed=True))
    obs, noise = random_inputs(artifact, np.random.default_rng(0), 2)

    def actions() -> np.ndarray:
        plan = Plan(cells=uniform_plan(5, 5, 3), precision={} if precision == "fp32" else {"blocks": precision})
        return open_runtime(artifact, "torch").predict(obs, noise, plan)[0]

    expected = actions()
    with torch.autocast("cpu", torch.bfloat16):
        found = actions()
        assert torch.is_autocast_enabled("cpu")
    np.testing.assert_array_equal(found, expected)


def by_the_newer_name() -> None:
    torch.backends.cuda.matmul.fp32_precision = "tf32"
    torch.backends.cudnn.conv.fp32_precision = "ieee"


TOLD = {
    "nothing": lambda: None,
    "allowed": lambda: setattr(torch.backends.cuda.matmul, "allow_tf32", True),
    "medium": lambda: torch.set_float32_matmul_precision("medium"),
    "newer": by_the_newer_name,
}


@pytest.mark.parametrize("told", TOLD)
def test_nothing_is_computed_in_tf32_and_the_settings_are_as_they_were(told: str) -> None:
    cuda, cudnn, mkldnn = torch.backends.cuda, torch.backends.cudnn, torch.backends.mkldnn
    several = (cuda.matmul, cudnn.conv, cudnn.rnn, mkldnn.matmul, mkldnn.conv, mkldnn.rnn)

    def settings() -> list[str]:
        return [each.fp32_precision for each in several]

    fresh = settings()
    try:
        TOLD[told]()
        before = settings()
        assert "tf32" in before
        with exact_arithmetic(torch.device("cuda")):
            assert set(settings()) <= {"ieee", "none"}
        assert settings() == before
        if told != "newer":
            assert torch.get_float32_matmul_precision() == {"allowed": "high"}.get(
                told, told.replace("nothing", "highest")
            )
            assert cudnn.allow_tf32
    finally:
        torch.set_float32_matmul_precision("highest")
        cudnn.allow_tf32 = True
        for each, value in zip(several, fresh, strict=True):
            each.fp32_precision = value


def test_a_call_on_another_gpu_makes_it_the_current_one(
    toy_artifact: Artifact, monkeypatch: pytest.MonkeyPatch
) -> None:
    entered: list[torch.device] = []
    backend = TorchBackend(view_of(toy_artifact), Placed(torch.device("cpu")))
    monkeypatch.setattr(torch.cuda, "device", lambda device: entered.append(device) or nullcontext())
    with backend._settings():
        assert entered == []
    backend.device = torch.device("cuda:1")
    with backend._settings():
        assert entered == [torch.device("cuda:1")]


def test_a_device_has_its_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is the current GPU when a policy is loaded stays that policy's."""
    there = MagicMock(device=torch.device("cuda:1"))
    there.add_.return_value = there
    monkeypatch.setattr(torch, "zeros", lambda *_, device: there)
    assert device_of("cuda") == torch.device("cuda:1")


def test_a_graph_is_captured_on_a_stream_of_its_device_that_nothing_else_uses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scratch memory of cuBLAS on that stream is then the graph's own, and nobody frees it."""
    device, runs, cuda = torch.device("cuda:1"), list[object](), MagicMock()
    streams = [MagicMock(), MagicMock()]
    cuda.Stream.side_effect = streams
    for name in ("graph_pool_handle", "Stream", "current_stream", "stream", "CUDAGraph", "graph"):
        monkeypatch.setattr(torch.cuda, name, getattr(cuda, name))
    capture = cuda_graphs(device)
    replays = [capture(lambda: runs.append(0)) for _ in range(2)]
    assert [call.args for call in (*cuda.Stream.call_args_list, *cuda.current_stream.call_args_list)] == [(device,)] * 6
    assert [call.args for call in cuda.stream.call_args_list] == [(streams[0],)] * 2
    assert [call.kwargs["stream"] for call in cuda.graph.call_args_list] == [streams[1]] * 2
    assert len(runs) == 6
    assert replays == [cuda.CUDAGraph.return_value.replay] * 2
