"""What a call of a policy with cameras waits for, from its newest frame on: real sizes, random weights, one thread.

    python examples/benchmark/frames.py [--policies resnet,clip,smolvla] [--rounds 9] [--seconds 60]

Each policy has two cameras. ``resnet`` and ``clip`` have a window of two frames, and compute 2 of their 40 steps;
SmolVLA sees one frame, computes 2 of 10 steps, and is in int8. Calls take turns:

- ``all``: every frame and the instruction are computed in the call, as if none had been seen;
- ``newest``: the frame before was prepared when it came, where the window has one, and the instruction is known;
- ``one still``: the same, and one of the cameras shows what it showed before;
- ``still``: cameras show what they showed before, and so frames are known, but no call has seen them together;
- ``state alone``: the call before saw the same pictures and words, too.

Seconds are the processor's, since the machine may be busy; ratios are those of the medians. Then an executor runs in
real time, in turn with and without preparing and remembering frames, and the calls that it makes are timed. It controls
at 10 Hz, and the frames of a window are 0.1 s apart, those of ``clip`` 0.5 s: calls have to leave time between them.
SmolVLA has no frame before its newest, so there one camera shows what it did before; and then tokens are reused, and in
front of both cameras an arm moves.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from moving import REUSE, arm, picture
from torch import Tensor, nn

import ttscompile
from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.policies.diffusion_policy.images import Camera, MultiImageEncoder
from ttscompile.policies.networks.clip import TextConfig, VisionConfig
from ttscompile.policies.networks.multi_task_dit import DiffusionTransformer, DiTConfig, ObservationEncoder
from ttscompile.policies.networks.resnet import group_norm
from ttscompile.runtimes.executor import AsyncExecutor, ExecutorSettings
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.samplers.flow import flow_matching_table

Obs = dict[str, npt.NDArray[Any]]

TO, STEPS, HORIZON, EXECUTED, ACTIONS, STATE, WORDS = 2, 40, 32, 24, 14, 14, 77
CAMERAS = ("front", "wrist")
CONTROL_HZ = 10.0
POLICY_HZ = {"resnet": 10.0, "clip": 2.0, "smolvla": 10.0}
PLAN, REUSING = "two_steps", "two_steps_some_tokens"


class Clip(nn.Module):
    """LeRobot's multi-task DiT from observations on: CLIP B/16 on every image, and CLIP's text encoder."""

    def __init__(self) -> None:
        super().__init__()
        vision = VisionConfig(768, 3072, 12, 12, image_size=224, patch_size=16)
        text = TextConfig(512, 2048, 12, 8)
        self.encoder = ObservationEncoder(len(CAMERAS), vision, text, 512, False, TO)
        self.width = TO * (STATE + 768 * len(CAMERAS) + 512)

    def forward(self, obs: Mapping[str, Tensor]) -> Tensor:
        images = [obs[key].flatten(0, 1) for key in CAMERAS]
        return self.encoder(obs["state"], images, obs["tokens"], obs["mask"])


class ResNets(nn.Module):
    """Diffusion Policy's encoder: a ResNet-18 for each camera, at the size of its real robots' images."""

    def __init__(self) -> None:
        super().__init__()
        camera = Camera(240, 320, None, (216, 288), (2.0,) * 3, (-1.0,) * 3)
        cameras = dict.fromkeys(CAMERAS, camera)
        self.encoder = MultiImageEncoder(cameras, {"state": STATE}, "resnet18", group_norm, False)
        self.width = TO * self.encoder.width

    def forward(self, obs: Mapping[str, Tensor]) -> Tensor:
        return self.encoder(obs).flatten(1)


def compiled(name: str, folder: Path) -> None:
    """Compile a policy of this name, with a plan of two computed steps, and where it can be one that reuses tokens."""
    if name == "smolvla":
        import large_smolvla

        large_smolvla.save(folder.parent / "smolvla-checkpoint")
        program = ttscompile.convert(folder.parent / "smolvla-checkpoint", folder, precision="int8")
    else:
        program = ttscompile.compile_denoiser(*network(name), folder)
    steps, artifact = program.spec.sampler.steps, load_artifact(folder)
    cells = np.full((steps, len(program.blocks)), ttscompile.Source.TIMESTEP, np.int8)
    cells[0] = cells[steps // 2] = ttscompile.Source.COMPUTE
    plans = {**artifact.plans, PLAN: replace(artifact.default, cells=cells)}
    if artifact.manifest.tokens:
        plans[REUSING] = replace(plans[PLAN], tokens=REUSE)
    update_plans(folder, plans, PLAN, {})


def network(name: str) -> tuple[nn.Module, PolicySpec]:
    """The policy and its specification; both have the multi-task DiT's denoiser, 6 layers of width 512."""
    torch.manual_seed(0)
    encoder = Clip() if name == "clip" else ResNets()
    config = DiTConfig(ACTIONS, HORIZON, 512, 6, 8, 256, False, True, 1e4)
    size = (224, 224) if name == "clip" else (240, 320)
    observations = {key: ObservationSpec((TO, 3, *size), bounds=(0.0, 1.0)) for key in CAMERAS}
    observations["state"] = ObservationSpec((TO, STATE))
    if name == "clip":
        observations["tokens"] = ObservationSpec((WORDS,), dtype="int64", window=False, bounds=(0, 49407))
        observations["mask"] = ObservationSpec((WORDS,), dtype="bool", window=False, bounds=(0, 1))
    chunk = ChunkSpec(ACTIONS, TO - 1, TO - 1 + EXECUTED)
    spec = PolicySpec((HORIZON, ACTIONS), observations, flow_matching_table(STEPS), chunk)
    return EncodedDenoiser(encoder, DiffusionTransformer(config, encoder.width)).eval(), spec


def frames(spec: PolicySpec, seed: int, still: Sequence[str] = ()) -> Iterator[Obs]:
    """Frames of one stream for ever, without the axes of batch and time; instruction and ``still`` cameras stay."""
    rng = np.random.default_rng(seed)
    words = {key: one.draw(rng)[0] for key, one in spec.observations.items() if one.dtype != "float32"}
    measured = {key: one.one_frame if one.frames else one for key, one in spec.observations.items() if key not in words}
    words |= {key: measured[key].draw(rng)[0] for key in still}
    while True:
        yield {key: one.draw(rng)[0] for key, one in measured.items()} | words


def arms(spec: PolicySpec, seed: int) -> Iterator[Obs]:
    """The same where cameras see an arm move in front of what stays."""
    rng = np.random.default_rng(seed)
    still = {key: picture(one.shape[-1], rng) for key, one in spec.observations.items() if one.image}
    for number, obs in enumerate(frames(spec, seed)):
        yield obs | {key: arm(each, 0.05 * number) for key, each in still.items()}


def window(spec: PolicySpec, before: Obs, newest: Obs) -> Obs:
    """What a call reads."""
    return {
        key: np.stack([before[key], newest[key]][-one.frames :])[None] if one.frames else newest[key][None]
        for key, one in spec.observations.items()
    }


def calls(policy: CompiledPolicy, spec: PolicySpec, rounds: int) -> None:
    """Time the calls, and print a table."""
    cameras = [key for key, one in spec.observations.items() if one.image]
    still = cameras[0]
    ways: dict[str, Callable[[Obs, Obs], Obs]] = {
        "all": lambda before, newest: newest,
        "newest": lambda before, newest: newest,
        "one still": lambda before, newest: newest | {still: before[still]},
        "still": lambda before, newest: before,
        "state alone": lambda before, newest: newest | {key: before[key] for key in cameras},
    }
    times: dict[str, list[tuple[float, float]]] = {way: [] for way in ways}
    stream = frames(spec, 0)
    policy.reset(seed=0)
    for _ in range(rounds + 1):
        for way, move in ways.items():
            before, newest = next(stream), next(stream)
            policy.forget_frames() if way == "all" else policy.prepare_frame({k: v[None] for k, v in before.items()})
            obs = window(spec, before, move(before, newest))
            if way == "state alone":
                policy.predict_action(window(spec, before, before))
            start = time.process_time()
            policy.predict_action(obs)
            took = time.process_time() - start
            report = policy.last_report
            assert report is not None
            times[way].append((took, took * report.timings.prologue / report.timings.total))
    whole = {way: statistics.median(took for took, _ in rows[1:]) for way, rows in times.items()}
    print("| a call in which | s | of it the prologue | of `all` |")
    print("| --- | --- | --- | --- |")
    for way, rows in times.items():
        prologue = statistics.median(part for _, part in rows[1:])
        print(f"| {way} | {whole[way]:.3f} | {prologue:.3f} | {whole[way] / whole['all']:.2f} |")


class _Timed:
    """The policy, with the seconds of the processor that its calls take; or as it was before: every call computes all.

    Args:
        policy: makes the calls.
        forgetful: whether frames are neither prepared nor remembered.
    """

    def __init__(self, policy: CompiledPolicy, forgetful: bool) -> None:
        self._policy, self._forgetful = policy, forgetful
        self.info, self.reset = replace(policy.info, frames=0) if forgetful else policy.info, policy.reset
        self.prepare_frame, self.follow = policy.prepare_frame, policy.follow
        self.took: list[float] = []

    def predict_action(self, obs_dict: Mapping[str, Any], *, plan: str) -> Mapping[str, Any]:
        if self._forgetful:
            self._policy.forget_frames()
        start = time.thread_time()
        made = self._policy.predict_action(obs_dict, plan=plan)
        self.took.append(time.thread_time() - start)
        return made


def drive(
    policy: CompiledPolicy, spec: PolicySpec, policy_hz: float, seconds: float, stream: Callable[[], Iterator[Obs]]
) -> None:
    """Run an executor in real time, twice in each way in turn, and print how long its calls took."""
    settings = ExecutorSettings(
        policy_hz=policy_hz,
        horizon=(spec.chunk.stop - spec.chunk.start) // 2,
        refuse_infeasible=False,
        warm_up=1,
        measured_calls=2,
        max_hold=10**6,
    )
    found: dict[str, list[float]] = {"all": [], "newest": []}
    for _ in range(2):
        for way in found:
            seen, timed = stream(), _Timed(policy, way == "all")
            with AsyncExecutor(timed, CONTROL_HZ, settings) as executor:
                timed.took.clear()
                until, tick = time.monotonic() + seconds / 4, 0
                while time.monotonic() < until:
                    start = time.monotonic()
                    if tick % round(CONTROL_HZ / policy_hz) == 0:  # the camera has the policy's rate
                        executor.observe(next(seen))
                    if executor.ready:
                        executor.action()
                    tick += 1
                    time.sleep(max(start + 1 / CONTROL_HZ - time.monotonic(), 0))
            found[way] += timed.took[1:]  # the first call of an episode has nothing before it
    before, now = (statistics.median(found[way]) for way in ("all", "newest"))
    what = f"In the executor at {CONTROL_HZ:g} Hz, policy {policy_hz:g} Hz, medians of {len(found['newest'])} calls:"
    print(f"{what} {before:.3f} s when frames are forgotten, {now:.3f} s when not ({now / before:.2f}).")


def measure(name: str, folder: Path, rounds: int, seconds: float) -> None:
    """Print what the calls of a policy take: alone, and in an executor."""
    artifact = load_artifact(folder)
    policy, spec, hz = ttscompile.load(folder), artifact.manifest.spec, POLICY_HZ[name]
    print(f"\n## {name}\n")
    calls(policy, spec, rounds)
    alone = [key for key, one in spec.observations.items() if one.image and one.frames == 1]
    if not seconds:
        return
    print(f"\n{alone[0]} shows what it did before." if alone else "")
    drive(policy, spec, hz, seconds, lambda: frames(spec, 1, alone[:1]))
    if alone:
        print("\nTokens are reused, and an arm moves in front of both cameras.")
        del policy  # half of the memory
        reusing = open_policy(artifact, seed=0, plan=REUSING)
        drive(reusing, spec, hz, seconds, lambda: arms(spec, 1))


def main() -> None:
    """Compile what was asked for, and measure it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--policies", default="resnet,clip")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each policy in the executor; 0 for none")
    parser.add_argument("--output", type=Path, help="a folder to keep the artifacts in; a temporary one otherwise")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.output or Path(temporary)
        for name in options.policies.split(","):
            if not (folder / name).is_dir():
                compiled(name, folder / name)
            measure(name, folder / name, options.rounds, options.seconds)


if __name__ == "__main__":
    main()
