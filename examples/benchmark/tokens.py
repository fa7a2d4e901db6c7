"""New frames of a vision transformer when only an arm moves: real sizes, random weights, one thread.

    python examples/benchmark/tokens.py [--only clip,siglip] [--precision fp32,int8] [--rounds 12] [--alone]

An arm swings in front of a fixed picture. Three policies are shown frames in turn: one computes every frame whole, one
the tokens whose patches changed, and one that reuses tokens too, but whose pictures are noisy, so that every patch
changes in every frame. With ``--alone`` the encoders are timed for an eighth, a quarter, half and all of their tokens,
whatever they show, beside the encoder as it is. Milliseconds are the processor's, medians: the machine may be busy.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from moving import REUSE, arm, picture
from rate import session
from torch import Tensor, nn
from towers import SIGLIP, Seeing

import ttscompile
from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.artifact.load import load_artifact
from ttscompile.capture.export import capture
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.ir.graph import backward_slice
from ttscompile.ir.pieces import INDEX, NOT_KEPT, PIXELS, PLACES, ROWS, renewed_name
from ttscompile.ir.tokens import find_tokens
from ttscompile.lower.precision import LEAST_ROWS, quantize_model
from ttscompile.lower.program import lower_graphs
from ttscompile.passes.clean_up import clean_graph
from ttscompile.passes.reuse_tokens import for_tokens
from ttscompile.policies.networks.clip import ClipVision, VisionConfig
from ttscompile.policies.networks.multi_task_dit import DiffusionTransformer, DiTConfig
from ttscompile.policies.networks.siglip import Siglip
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.onnxruntime.sessions import Bound
from ttscompile.samplers.flow import flow_matching_table

Array = npt.NDArray[np.float32]

ACTIONS, HORIZON, STEPS, WIDTH = 4, 8, 4, 768
TOWERS = {"clip": ("CLIP B/16, 224 x 224", 224), "siglip": ("SigLIP of SmolVLA, 512 x 512", 512)}


class Eye(nn.Module):
    """One camera: ``[B, 3, size, size]`` in -1..1 to 768 features."""

    def __init__(self, name: str, size: int) -> None:
        super().__init__()
        self.pooled = name == "clip"
        self.tower = ClipVision(VisionConfig(patch_size=16)) if self.pooled else Siglip(SIGLIP, (size, size))
        for label, weight in self.named_parameters():
            if weight.ndim > 1:
                flat = weight.ndim == 2 and "embedding" in label
                nn.init.normal_(weight, 0, 0.02 if flat else weight[0].numel() ** -0.5)

    def forward(self, obs: Mapping[str, Tensor] | Tensor) -> Tensor:
        seen = self.tower(obs if isinstance(obs, Tensor) else 2 * obs["image"] - 1)
        return seen if self.pooled else seen.mean(1)


def compiled(name: str, precision: str, folder: Path) -> None:
    """A policy that sees with this encoder."""
    torch.manual_seed(0)
    size = TOWERS[name][1]
    network = DiffusionTransformer(DiTConfig(ACTIONS, HORIZON, 64, 2, 2, 64, False, True, 1e4), WIDTH)
    observations = {"image": ObservationSpec((3, size, size), window=False, bounds=(0.0, 1.0))}
    spec = PolicySpec((HORIZON, ACTIONS), observations, flow_matching_table(STEPS), ChunkSpec(ACTIONS, 0, HORIZON))
    ttscompile.compile_denoiser(EncodedDenoiser(Eye(name, size), network).eval(), spec, folder, precision=precision)


def measure(name: str, precision: str, rounds: int) -> str:
    """One row of the table."""
    title, size = TOWERS[name]
    with tempfile.TemporaryDirectory() as folder:
        compiled(name, precision, Path(folder))
        artifact = load_artifact(folder)
        whole, some = artifact.default, replace(artifact.default, tokens=REUSE)
        policies = [open_policy(artifact, seed=0, plan=each) for each in (whole, some, some)]
    rng = np.random.default_rng(0)
    still = picture(size, rng)
    times: list[list[float]] = [[], [], []]
    shares, off = list[float](), list[float]()
    noise = ttscompile.Noise(rng.standard_normal((1, HORIZON, ACTIONS), dtype=np.float32))
    for number in range(rounds + 2):
        image = arm(still, 0.05 * number)
        shaken = np.clip(image + 0.1 * rng.standard_normal(image.shape), 0, 1).astype(np.float32)
        works = []
        for policy, own, seen in zip(policies, times, (image, image, shaken), strict=True):
            start = time.process_time()
            works.append(policy.prepare_frame({"image": seen[None]}))
            own.append(1000 * (time.process_time() - start))
        if number > 1:  # the first is whole, and the second is the first of its size
            shares.append(works[1].tokens / works[1].of)
            assert works[2].tokens == works[2].of
            made = [policy.predict_action({"image": image[None]}, noise=noise)["action"] for policy in policies[:2]]
            off.append(float(np.abs(made[1] - made[0]).mean()))
    all_of_it, moving, shaking = (statistics.median(own[2:]) for own in times)
    figures = (f"{all_of_it:.1f}", f"{moving:.1f}", f"{statistics.mean(shares):.0%}", f"{all_of_it / moving:.1f}")
    return f"| {title}, {precision} | {' | '.join(figures)} | {shaking / all_of_it:.2f} | {statistics.mean(off):.2g} |"


def alone(name: str, precisions: Sequence[str], rounds: int) -> list[str]:
    """The rows of one encoder alone."""
    title, size = TOWERS[name]
    spec = PolicySpec(
        (4, 2), {"image": ObservationSpec((3, size, size), window=False)}, flow_matching_table(1), ChunkSpec(2, 0, 4)
    )
    graph, captured = capture(Seeing(Eye(name, size)).eval(), spec)
    weights = dict(captured)
    graph = clean_graph(graph, weights)
    last = next(node for node in reversed(graph.nodes) if node.op == "aten.slice.Tensor")
    tower = backward_slice(graph, (next(iter(last.refs())),), {})
    stream = find_tokens(tower, weights)
    assert not isinstance(stream, str)
    part = for_tokens(tower, stream)
    rng = np.random.default_rng(0)
    feed = {name: rng.standard_normal(type_.at(1), dtype=np.float32) for name, type_ in part.inputs.items()}
    image = {"image": feed[PIXELS]}
    kept = {renewed_name(name): array for name, array in feed.items() if name not in NOT_KEPT}
    given = {name: np.zeros(part.types()[name].at(1), np.float32) for name in tower.outputs} | kept
    rows = []
    for precision in precisions:
        models, more = list(lower_graphs({"whole": tower, "tokens": part}).values()), dict[str, Array]()
        if precision == "int8":
            models[0], _ = quantize_model(models[0], weights, LEAST_ROWS)
            models[1], more = quantize_model(models[1], weights, LEAST_ROWS, stream.tokens)  # as the product does
        whole, some = (session(model, {**weights, **more}) for model in models)
        times: dict[int, list[float]] = {
            count: [] for count in (0, stream.tokens, *(-(-stream.tokens // part) for part in (2, 4, 8)))
        }
        bound = {count: Bound(some, {**feed, **_numbers(count, stream.tokens)}, given) for count in times if count}
        for _ in range(rounds + 1):  # the first does not count
            for count, own in times.items():
                start = time.process_time()
                bound[count].run() if count else whole.run(None, image)
                own.append(1000 * (time.process_time() - start))
        figures = (f"{statistics.median(own[1:]):.0f}" for own in times.values())
        rows.append(f"| {title}, {precision} | {' | '.join(figures)} |")
    return rows


def _numbers(count: int, tokens: int) -> dict[str, Any]:
    """So many tokens, whose rows go to their own places: of some twice, as where others get as many."""
    own = np.arange(count)
    places = np.tile(own, 1 if count == tokens else 2)
    return {INDEX: own, PLACES: places, ROWS: places}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--only", default=",".join(TOWERS), help="names of encoders")
    parser.add_argument("--precision", default="fp32,int8")
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--alone", action="store_true", help="time encoders, not frames")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.alone:
        print("| ms | the encoder as it is | all tokens | half | a quarter | an eighth |")
        print("| --- | --- | --- | --- | --- | --- |")
        for name in options.only.split(","):
            print("\n".join(alone(name, options.precision.split(","), options.rounds)), flush=True)
        return
    print("| | Whole, ms | Arm moves, ms | Tokens computed | Times faster | All moves / whole | Actions off |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in options.only.split(","):
        for precision in options.precision.split(","):
            print(measure(name, precision, options.rounds), flush=True)


if __name__ == "__main__":
    main()
