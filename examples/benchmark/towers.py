"""Image encoders alone, of real size with random weights: eager PyTorch, onnxruntime in fp32, and in eight bits.

    python examples/benchmark/towers.py [--only clip,siglip,resnet] [--profile]

One image, one thread. Milliseconds are the processor's, medians of calls in turn: the machine may be busy. The floor is
what the arithmetic takes alone (``rate.py``). With ``--profile`` the share of each operation of int8 follows.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import ModelProto
from rate import rates, run_all, session
from torch import nn

from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.capture.export import capture
from ttscompile.ir.flops import graph_flops
from ttscompile.ir.pieces import CONDITION
from ttscompile.lower.integer_attention import HEADS
from ttscompile.lower.precision import LEAST_ROWS, quantize_model
from ttscompile.lower.program import lower_graphs
from ttscompile.policies.networks.clip import ClipVision, VisionConfig
from ttscompile.policies.networks.resnet import group_norm, resnet
from ttscompile.policies.networks.siglip import Siglip, SiglipConfig
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


def measure(title: str, tower: nn.Module, size: int, rounds: int, profiled: bool) -> str:
    """One row of the table, and where it is asked for the profile."""
    module = Seeing(tower).eval()
    spec = PolicySpec(
        sample=(4, 2),
        observations={"image": ObservationSpec((3, size, size), window=False)},
        sampler=flow_matching_table(1),
        chunk=ChunkSpec(2, 0, 4),
    )
    graph, weights = capture(module, spec)
    model = lower_graphs({CONDITION: graph})[CONDITION]
    integer, more = quantize_model(model, weights, LEAST_ROWS)
    draw = np.random.default_rng(0)
    given = {"sample": np.zeros((1, 4, 2), np.float32), "timestep": np.zeros(1, np.float32)}
    given["image"] = draw.standard_normal((1, 3, size, size), dtype=np.float32)
    products = rates()
    sessions = [
        session(onnx.ModelProto.FromString(m.SerializeToString()), {**weights, **more}) for m in (model, integer)
    ]

    @torch.inference_mode()
    def eager() -> np.ndarray:
        return module(**{name: torch.from_numpy(value) for name, value in given.items()}).numpy()

    def running(one: onnxruntime.InferenceSession) -> Callable[[], np.ndarray]:
        read = {value.name: given[value.name] for value in one.get_inputs()}
        return lambda: one.run(None, read)[0]

    calls = [eager, *map(running, sessions)]
    times: list[list[float]] = [[], [], []]
    for _ in range(rounds + 1):  # the first does not count
        run_all(products.values())
        found = []
        for call, own in zip(calls, times, strict=True):
            start = process_time()
            found.append(call())
            own.append(process_time() - start)
    ms = [1000 * statistics.median(own[1:]) for own in times]
    off = np.abs(found[2] - found[1]).mean() / np.abs(found[1]).mean()
    floors = [1000 * product.seconds(graph_flops(graph)) for product in products.values()]
    cells = [f"{each:.1f}" for each in (ms[0], ms[1], floors[0], ms[2], floors[1])]
    row = (*cells, f"{ms[1] / ms[2]:.1f}", f"{ms[0] / ms[2]:.1f}", f"{off:.1%}")
    split = profile(integer, {**weights, **more}, given, rounds) if profiled else ""
    return f"| {title} | {' | '.join(row)} |{split}"


def profile(model: ModelProto, weights: dict[str, np.ndarray], given: dict[str, np.ndarray], rounds: int) -> str:
    """A line for each operation that takes 1 % of a model's time, the largest first; ``Scan`` is attention."""
    with tempfile.TemporaryDirectory() as folder:
        one = session(model, weights, Path(folder) / "profile")
        for _ in range(rounds):
            one.run(None, {value.name: given[value.name] for value in one.get_inputs()})
        took = by_operation(json.loads(Path(one.end_profiling()).read_bytes()))
    shares = [(operation, each / took.total()) for operation, each in took.most_common()]
    return "".join(f"\n  {share:6.1%}  {operation}" for operation, share in shares if share >= 0.01)


def by_operation(events: Iterable[Mapping[str, Any]]) -> Counter[str]:
    """Microseconds of the operations of a profile; what runs inside of attention is a part of its ``Scan``."""
    nodes = [each for each in events if each["name"].endswith("_kernel_time")]
    attending = [(each["ts"], each["ts"] + each["dur"]) for each in nodes if each["args"]["op_name"] == HEADS]
    took: Counter[str] = Counter()
    for each in nodes:
        operation = each["args"]["op_name"]
        if operation == HEADS or not any(start <= each["ts"] < end for start, end in attending):
            took[operation] += each["dur"]
    return took


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--only", default=",".join(TOWERS), help="names of towers")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--profile", action="store_true", help="say which operations take the time of int8")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    print("| ms | eager | fp32 | its floor | int8 | its floor | fp32 / int8 | eager / int8 | features off |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in options.only.split(","):
        title, make, size = TOWERS[name]
        print(measure(title, make(), size, options.rounds, options.profile), flush=True)


if __name__ == "__main__":
    main()
