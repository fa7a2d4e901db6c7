"""LeRobot's ACT at its published size with random weights: LeRobot itself, eager PyTorch, and the artifact.

    python examples/benchmark/act.py [--rounds 11] [--cameras 2] [--backbone resnet18]

Two cameras of 480 x 640, one thread, every call with pictures of its own. There is nothing to reuse between steps in
such a policy; the last row has a call whose frames were computed before. Milliseconds are the processor's, medians of
calls in turn: the machine may be busy. Without lerobot, which needs torchvision, the first row is missing. The floor
is what the arithmetic takes alone (``rate.py``).
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np
import torch
from rate import rates, run_all
from safetensors.torch import save_file

import ttscompile
from ttscompile.core.spec import Noise
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.policies.lerobot.act import ACT, as_saved, read_config

STATE, IMAGE, SIZE = "observation.state", "observation.images.camera{}", (480, 640)
MODES = dict.fromkeys(("VISUAL", "STATE", "ACTION"), "MEAN_STD")

Observation = Mapping[str, np.ndarray]
Call = Callable[[Observation], np.ndarray]


def save(directory: Path, cameras: int, backbone: str) -> None:
    """Write a policy as lerobot does, all sizes its defaults: six joints, chunks of 100."""
    features: dict[str, Any] = {STATE: {"type": "STATE", "shape": [6]}}
    features |= {IMAGE.format(i): {"type": "VISUAL", "shape": [3, *SIZE]} for i in range(cameras)}
    config: dict[str, Any] = {"type": "act", "device": "cpu", "use_vae": False, "vision_backbone": backbone}
    config |= {"pretrained_backbone_weights": None, "normalization_mapping": MODES, "input_features": dict(features)}
    config["output_features"] = {"action": {"type": "ACTION", "shape": [6]}}
    features |= config["output_features"]
    tensors = dict[str, torch.Tensor]()
    for key, feature in features.items():
        shape, image = feature["shape"], feature["type"] == "VISUAL"
        mean, std, shape = (0.45, 0.25, (3, 1, 1)) if image else (10.0, 40.0, tuple(shape))
        tensors |= {f"{key}.mean": torch.full(shape, mean), f"{key}.std": torch.full(shape, std)}
    save_file(tensors, directory / "statistics.safetensors")
    settings = {"eps": 1e-8, "features": features, "norm_map": MODES}
    for name, step in (("preprocessor", "normalizer_processor"), ("postprocessor", "unnormalizer_processor")):
        steps = [{"registry_name": step, "config": settings, "state_file": "statistics.safetensors"}]
        content = {"name": f"policy_{name}", "steps": steps}
        (directory / f"policy_{name}.json").write_text(json.dumps(content), encoding="utf-8")
    (directory / "config.json").write_text(json.dumps(config), encoding="utf-8")
    torch.manual_seed(0)
    network = ACT(read_config(directory, config)[1])
    for name, weight in network.named_parameters():
        if weight.ndim > 1:
            torch.nn.init.normal_(weight, 0, math.sqrt((2 if weight.ndim == 4 else 1) / weight[0].numel()))
        elif "bn2" in name and name.endswith("weight"):
            torch.nn.init.constant_(weight, 0.3)  # or residuals of a network that was not trained grow and grow
    saved = {name: value.detach().clone() for name, value in as_saved(network).items()}
    save_file(saved, directory / "model.safetensors")


def contestants(directory: Path, artifact: Path) -> dict[str, Call]:
    """What is timed, by name: raw observation to actions in the robot's units."""
    found: dict[str, Call] = {}
    try:
        found["LeRobot, PyTorch"] = lerobot(directory)
    except ImportError as error:
        print(f"LeRobot is not timed: {error}")
    module, spec = load_checkpoint_policy(directory)
    eager, noise = eager_policy(module, spec), Noise(np.zeros((1, *spec.sample), np.float32))
    found["its network rebuilt, PyTorch"] = lambda obs: spec.chunk.unnormalized(
        eager({key: torch.from_numpy(value) for key, value in obs.items()}, noise).numpy()
    )
    for plan, title in (("dense", "compiled, fp32"), ("full", "compiled, int8")):
        policy = ttscompile.load(artifact, plan=plan, threads=1)
        found[title] = compiled(policy)
    found[f"{title}, frames known"] = compiled(ttscompile.load(artifact, plan="full", threads=1))
    return found


def compiled(policy: ttscompile.CompiledPolicy) -> Call:
    """A call of a compiled policy."""
    return lambda obs: policy.predict_action(obs)["action"]


def lerobot(directory: Path) -> Call:
    """The policy as lerobot loads and runs it. Raises ImportError: it is not there."""
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action

    policy = ACTPolicy.from_pretrained(directory).eval()
    read = PolicyProcessorPipeline.from_pretrained
    before = read(directory, config_filename="policy_preprocessor.json")
    ends = {"to_transition": policy_action_to_transition, "to_output": transition_to_policy_action}
    after = read(directory, config_filename="policy_postprocessor.json", **ends)

    def call(obs: Observation) -> np.ndarray:
        batch = before({key: torch.from_numpy(value[:, 0]) for key, value in obs.items()})
        batch = {key: value for key, value in batch.items() if key.startswith("observation.")}
        with torch.inference_mode():
            return after(policy.predict_action_chunk(batch)).numpy()

    return call


def main() -> None:
    """Compile the policy, time everything in turn, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--cameras", type=int, default=2)
    parser.add_argument("--backbone", default="resnet18", choices=["resnet18", "resnet34"])
    given = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        directory, artifact = Path(folder) / "policy", Path(folder) / "compiled"
        directory.mkdir()
        save(directory, given.cameras, given.backbone)
        ttscompile.convert(directory, artifact, precision="int8")
        calls = contestants(directory, artifact)
        info = ttscompile.load(artifact).info
        keys = info.observation
        draw, times, made = np.random.default_rng(0), {name: list[float]() for name in calls}, dict[str, np.ndarray]()
        products = rates()
        for number in range(given.rounds + 1):  # the first warms up
            run_all(products.values())
            obs = {key: draw.random((1, *one.shape), dtype=np.float32) for key, one in keys.items()}
            for name, call in calls.items():
                if "known" in name:
                    call(obs)
                begun = thread_time()
                made[name] = call(obs)
                times[name] += [1e3 * (thread_time() - begun)] * (number > 0)
    first = next(iter(calls))
    print(f"| {given.cameras} cameras, {given.backbone} | ms a call | quartiles | times faster | actions off |")
    print("| --- | --- | --- | --- | --- |")
    for name, taken in times.items():
        low, median, high = statistics.quantiles(taken, n=4)
        faster = statistics.median(times[first]) / median
        off = np.abs(made[name] - made[first]).max() / np.ptp(made[first])
        print(f"| {name} | {median:.0f} | {low:.0f}..{high:.0f} | {faster:.2f} | {off:.2g} of their range |")
    floors = " and ".join(f"{1e3 * one.seconds(info.dense_flops):.0f} ms in {name}" for name, one in products.items())
    print(f"The floor, {info.dense_flops / 1e9:.0f} GFLOP at the rate of one large product: {floors}.")
    print(one_line(fingerprint()))


if __name__ == "__main__":
    main()
