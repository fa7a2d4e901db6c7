"""Image encoders alone, of real size with random weights: eager PyTorch, onnxruntime in fp32, and in eight bits.

    python examples/benchmark/towers.py [--only clip,siglip,resnet]

One image, one thread. Milliseconds are the processor's, medians of calls in turn: the machine may be busy.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from time import process_time
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import ModelProto, numpy_helper
from torch import nn

from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.capture.export import capture
from ttscompile.frontends.clip import ClipVision, VisionConfig
from ttscompile.frontends.resnet import group_norm, resnet
from ttscompile.frontends.siglip import Siglip, SiglipConfig
from ttscompile.ir.pieces import CONDITION
from ttscompile.lower.precision import LEAST_ROWS, quantize_model
from ttscompile.lower.program import lower_graph
from ttscompile.samplers.flow import flow_matching_table

SIGLIP = SiglipConfig(768, 3072, 12, 12, image_size=512, patch_size=16)
TOWERS: dict[str, tuple[str, Callable[[], nn.Module], int]] = {
    "clip": ("CLIP B/16, 224 x 224", lambda: ClipVision(VisionConfig(patch_size=16)), 224),
    "siglip": ("SigLIP of SmolVLA, 512 x 512", lambda: Siglip(SIGLIP, (512, 512)), 512),
    "resnet": ("ResNet-18, group norms, 224 x 224", lambda: resnet(3, group_norm), 224),
    "small": ("ResNet-18, group norms, 96 x 96", lambda: resnet(3, group_norm), 96),
}


class Seeing(nn.Module):
    """A tower as a policy: what is captured has a sample and a timestep."""

    def __init__(self, tower: nn.Module) -> None:
        super().__init__()
        self.tower = tower
        for name, weight in tower.named_parameters():
            if weight.ndim > 1:
                flat = weight.ndim == 2 and "embedding" in name
                nn.init.normal_(weight, 0, 0.02 if flat else weight[0].numel() ** -0.5)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        """Eight of the features, added to the sample ``[B, 4, 2]``."""
        return sample + self.tower(image).flatten(1)[:, :8].unflatten(1, (4, 2))


def session(model: ModelProto, weights: dict[str, Any]) -> onnxruntime.InferenceSession:
    """On one thread."""
    for tensor in model.graph.initializer:
        if tensor.name in weights:
            tensor.CopyFrom(numpy_helper.from_array(np.ascontiguousarray(weights[tensor.name]), tensor.name))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def measure(title: str, tower: nn.Module, size: int, rounds: int) -> str:
    """One row of the table."""
    module = Seeing(tower).eval()
    spec = PolicySpec(
        sample=(4, 2),
        observations={"image": ObservationSpec((3, size, size), window=False)},
        sampler=flow_matching_table(1),
        chunk=ChunkSpec(2, 0, 4),
    )
    graph, weights = capture(module, spec)
    model = lower_graph(graph, CONDITION)
    integer, more = quantize_model(model, weights, LEAST_ROWS)
    draw = np.random.default_rng(0)
    given = {"sample": np.zeros((1, 4, 2), np.float32), "timestep": np.zeros(1, np.float32)}
    given["image"] = draw.standard_normal((1, 3, size, size), dtype=np.float32)
    sessions = [
        session(onnx.ModelProto.FromString(m.SerializeToString()), {**weights, **more}) for m in (model, integer)
    ]

    @torch.inference_mode()
    def eager() -> np.ndarray:
        return module(**{name: torch.from_numpy(value) for name, value in given.items()}).numpy()  # type: ignore[no-any-return]

    def running(one: onnxruntime.InferenceSession) -> Callable[[], np.ndarray]:
        read = {value.name: given[value.name] for value in one.get_inputs()}
        return lambda: one.run(None, read)[0]

    calls = [eager, *map(running, sessions)]
    times: list[list[float]] = [[], [], []]
    for _ in range(rounds + 1):  # the first does not count
        found = []
        for call, own in zip(calls, times, strict=True):
            start = process_time()
            found.append(call())
            own.append(process_time() - start)
    ms = [1000 * statistics.median(own[1:]) for own in times]
    off = np.abs(found[2] - found[1]).mean() / np.abs(found[1]).mean()
    row = (*(f"{each:.1f}" for each in ms), f"{ms[1] / ms[2]:.1f}", f"{ms[0] / ms[2]:.1f}", f"{off:.1%}")
    return f"| {title} | {' | '.join(row)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--only", default=",".join(TOWERS), help="names of towers")
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    print("| ms | eager | fp32 | int8 | fp32 / int8 | eager / int8 | features off |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in options.only.split(","):
        title, make, size = TOWERS[name]
        print(measure(title, make(), size, options.rounds), flush=True)


if __name__ == "__main__":
    main()
