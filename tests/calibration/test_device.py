"""Calibration on a device: everything of the network is there, and the rest on the CPU."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch

import ttscompile
from ttscompile.calibration.runner import Runner
from ttscompile.errors import CalibrationError, RuntimeUnavailableError

from .killed import killed


class _Home(torch.autograd.Function):
    """From a tensor without numbers to the CPU, with numbers of some sort."""

    @staticmethod
    def forward(ctx: Any, value: torch.Tensor) -> torch.Tensor:
        return torch.linspace(-1, 1, max(value.numel(), 1))[: value.numel()].reshape(value.shape)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> torch.Tensor:
        return torch.empty_like(gradients[0], device="meta")


class _Away(torch.autograd.Function):
    """The way there."""

    @staticmethod
    def forward(ctx: Any, value: torch.Tensor) -> torch.Tensor:
        return torch.empty_like(value, device="meta")

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> torch.Tensor:
        return torch.ones(gradients[0].shape)


@pytest.fixture
def arriving(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """What comes back from torch's device of tensors without numbers; most operations refuse to mix it with the CPU."""
    original, moved, shapes = torch.Tensor.cpu, torch.Tensor.to, list[tuple[int, ...]]()

    def cpu(value: torch.Tensor) -> torch.Tensor:
        if value.device.type != "meta":
            return original(value)
        shapes.append(tuple(value.shape))
        arrived: torch.Tensor = _Home.apply(value)
        return arrived

    def to(value: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
        away = args == (torch.device("meta"),) and value.requires_grad and value.device.type == "cpu"
        there: torch.Tensor = _Away.apply(value) if away else moved(value, *args, **kwargs)
        return there

    monkeypatch.setattr(torch.Tensor, "cpu", cpu)
    monkeypatch.setattr(torch.Tensor, "to", to)
    return shapes


@pytest.mark.slow
@pytest.mark.parametrize("name", ["schedule", "bac", "sag", "teacache"])
def test_the_network_stays_on_its_device(
    artifact: Path, recording: Path, arriving: list[tuple[int, ...]], name: str
) -> None:
    """Corrections and a pruner, statistics of residuals, gradients, and plans that are decided in the loop.

    The numbers are no policy's, so that the plan may be refused; nothing fails for want of a device.
    """
    with suppress(CalibrationError):
        ttscompile.calibrate(
            artifact, [recording], 0.5, learn=(name,), device="meta", max_minutes=0.01, max_intervals=1, progress=False
        )
    assert len(arriving) > 10


def test_a_device_that_torch_does_not_have_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    with pytest.raises(RuntimeUnavailableError, match="device 'abacus' cannot be had"):
        ttscompile.calibrate(tmp_path / "nowhere", [tmp_path / "nothing.npz"], device="abacus", progress=False)


@pytest.mark.slow
def test_nothing_is_computed_in_fewer_bits_than_the_policy_has(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the caller chose for its own: TF32, which is what cuDNN does unless it is told, and autocast."""
    run_dense, seen = Runner.run_dense, set[Any]()

    def looking(self: Runner, calls: Any) -> Any:
        seen.add((torch.backends.cudnn.allow_tf32, torch.is_autocast_enabled("cpu")))
        return run_dense(self, calls)

    monkeypatch.setattr(Runner, "run_dense", looking)
    with torch.autocast("cpu", torch.bfloat16), suppress(CalibrationError):
        ttscompile.calibrate(artifact, [recording], 0.5, max_minutes=0.01, max_intervals=1, progress=False)
    assert seen == {(False, False)}
    assert torch.backends.cudnn.allow_tf32


def test_a_calibration_is_not_resumed_on_another_device(artifact: Path, recording: Path) -> None:
    def calibrate(**options: Any) -> None:
        ttscompile.calibrate(artifact, [recording], 0.5, max_minutes=0.01, progress=False, **options)

    with killed():
        calibrate()
    with pytest.raises(CalibrationError, match="other settings: device was cpu, now meta"):
        calibrate(device="meta", resume=True)
