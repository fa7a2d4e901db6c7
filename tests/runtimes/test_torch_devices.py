"""What the torch runtime makes of the process that it is in: the caller's settings of precision, and its GPUs."""

import gc
from contextlib import nullcontext
from typing import Any
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


BACKENDS: Any = torch.backends  # the precisions of single operations are not in its types


def by_the_newer_name() -> None:
    BACKENDS.cuda.matmul.fp32_precision = "tf32"
    BACKENDS.cudnn.conv.fp32_precision = "ieee"


TOLD = {
    "nothing": lambda: None,
    "allowed": lambda: setattr(torch.backends.cuda.matmul, "allow_tf32", True),
    "medium": lambda: torch.set_float32_matmul_precision("medium"),
    "newer": by_the_newer_name,
}


@pytest.mark.parametrize("told", TOLD)
def test_nothing_is_computed_in_tf32_and_the_settings_are_as_they_were(told: str) -> None:
    cuda, cudnn, mkldnn = BACKENDS.cuda, BACKENDS.cudnn, BACKENDS.mkldnn
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

    def enter(device: torch.device) -> nullcontext[None]:
        entered.append(device)
        return nullcontext()

    monkeypatch.setattr(torch.cuda, "device", enter)
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


def test_a_graph_is_captured_on_a_stream_of_its_device_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a pool of its own, both of which are new once no graph is left: its scratch memory is then nobody else's."""
    device, runs, cuda = torch.device("cuda:1"), list[object](), MagicMock()
    cuda.CUDAGraph.side_effect = cuda.Stream.side_effect = cuda.graph_pool_handle.side_effect = lambda *_: MagicMock()
    for name in ("graph_pool_handle", "Stream", "CUDAGraph", "graph"):
        monkeypatch.setattr(torch.cuda, name, getattr(cuda, name))
    capture = cuda_graphs(device)
    graphs = [capture(lambda: runs.append(0)) for _ in range(2)]
    given = [call.kwargs for call in cuda.graph.call_args_list]
    assert given[0] == given[1] and [call.args for call in cuda.Stream.call_args_list] == [(device,)]
    assert len(runs) == 6
    del graphs
    cuda.reset_mock()  # which holds them, too
    gc.collect()
    kept = capture(lambda: runs.append(0))
    (last,) = (call.kwargs for call in cuda.graph.call_args_list)
    assert last["stream"] is not given[0]["stream"] and last["pool"] is not given[0]["pool"]
    assert kept is not None
