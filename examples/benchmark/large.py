"""A network of hundreds of millions of random weights: what it takes to compile it, and to run one call.

    python examples/benchmark/large.py [--layers 16] [--width 1024] [--output DIR]
    python examples/benchmark/large.py --unet 512,1024,2048 --horizon 64        # LeRobot's U-Net
    python examples/benchmark/large.py --unet 256,512,1024 --horizon 16         # Diffusion Policy's
    python examples/benchmark/large.py --smolvla                                # LeRobot's SmolVLA, whole
    python examples/benchmark/large.py --smolvla --threads 1,2                  # in one table
    python examples/benchmark/large.py --smolvla --precision int4 --only convert --output DIR     # what it is made of
    python examples/benchmark/large.py --pi0 --precision int4                   # LeRobot's pi0, whole; or --pi05
    python examples/benchmark/large.py --groot --precision int4                 # LeRobot's GR00T N1.7, whole
    python examples/benchmark/large.py --evo1                                   # LeRobot's evo1, whole
    python examples/benchmark/large.py --eo1                                    # LeRobot's eo1, whole; or --wall-x
    python examples/benchmark/large.py --vla-jepa                               # LeRobot's vla_jepa, whole
    python examples/benchmark/large.py --xvla                                   # LeRobot's xvla, whole
    python examples/benchmark/large.py --rdt                                    # RDT-170M, behind its encoders
    python examples/benchmark/large.py --octo                                   # Octo-small 1.5, whole
    python examples/benchmark/large.py --dita                                   # Dita, whole
    python examples/benchmark/large.py --clip                                   # its multi_task_dit with CLIP B/16

The transformer is an ordinary DiT with adaLN-Zero. Both have 14 actions and an observation vector of 64 numbers, and
four steps. Converting and running are two processes, so that each has its own peak of resident memory; of eo1, wall_x
and pi05, whose originals are timed before, they are three. Where there is no memory for all at once, ``--only eager``
and ``--only fp32`` time a part of any whole policy in ``--output``, and what they timed is not timed again.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import timeit
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from memory import watched

if TYPE_CHECKING:
    import large_threads
    from rate import Clock
    from torch import nn

STEPS = 4

WHOLE = {
    "smolvla": "LeRobot's SmolVLA",
    "pi0": "LeRobot's pi0",
    "pi05": "LeRobot's pi05",
    "groot": "LeRobot's groot, GR00T N1.7",
    "evo1": "LeRobot's evo1",
    "eo1": "LeRobot's eo1",
    "wall_x": "LeRobot's wall_x",
    "vla_jepa": "LeRobot's vla_jepa",
    "xvla": "LeRobot's xvla",
    "rdt": "RDT-170M",
    "octo": "Octo-small 1.5",
    "dita": "Dita",
}
"""Policies that are compiled from what is saved of them, in place of the transformer; LeRobot's are whole."""

ALONE = ("eo1", "wall_x", "pi05")
"""Of these the original is timed before, in a process of its own: 24 GiB do not hold it and the artifact in fp32."""

TOLD = ("evo1", "eo1", "wall_x", "groot", "vla_jepa")
"""Into these an instruction is compiled."""

MOST_FILES = 3
"""Whose sizes are printed by name."""

MOST_NOTES = 8
"""Of a stage, that are printed."""


class Stages:
    """Prints what each stage of a conversion took, and the most memory so far, and of that what no file backs."""

    def __init__(self, most: list[int]) -> None:
        self._start = self._last = time.perf_counter()
        self._most = most

    def __call__(self, stage: str, notes: tuple[str, ...]) -> None:
        """A stage has ended."""
        now = time.perf_counter()
        print(f"{now - self._last:7.1f} s  {self._memory()}  {stage}: {'; '.join(notes[:MOST_NOTES])}", flush=True)
        self._last = now

    def end(self) -> None:
        """All have."""
        print(f"{time.perf_counter() - self._start:7.1f} s  {self._memory()}  in all")

    def _memory(self) -> str:
        return f"{peak():5.2f} GiB, {self._most[0] / 2**30:.2f} anonymous"


def convert(folder: Path, network: nn.Module, horizon: int) -> None:
    """Compile the network; print what each stage took."""
    import numpy as np
    import torch
    from large_networks import ACTIONS, OBSERVED

    import ttscompile
    from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
    from ttscompile.samplers.flow import flow_matching_table

    count = sum(p.numel() for p in network.parameters())
    print(f"{count / 1e6:.0f} million weights, {count * 4 / 2**30:.2f} GiB; {peak()} GiB before compiling")
    spec = PolicySpec(
        sample=(horizon, ACTIONS),
        observations={"obs": ObservationSpec((OBSERVED,))},
        sampler=flow_matching_table(STEPS),
        chunk=ChunkSpec(ACTIONS, 0, horizon),
    )
    with watched() as most:
        stages = Stages(most)
        ttscompile.compile_denoiser(network, spec, folder / "compiled", explain=stages)
        stages.end()

    rng = np.random.default_rng(0)
    obs = rng.standard_normal((1, OBSERVED), dtype=np.float32)
    sample = rng.standard_normal((1, horizon, ACTIONS), dtype=np.float32)
    np.savez(folder / "call.npz", obs=obs, noise=sample)
    torch.set_num_threads(1)

    def eager() -> torch.Tensor:
        x = torch.from_numpy(sample)
        for t in spec.sampler.timesteps:
            x = x + network(x, torch.full((1,), float(t)), torch.from_numpy(obs)) / STEPS
        return x

    with torch.inference_mode():
        print(f"{seconds(eager):8.3f} s  a call of {STEPS} steps in eager PyTorch, on one thread")
        np.save(folder / "expected.npy", eager().numpy())


def convert_whole(folder: Path, name: str, precision: str = "int8") -> None:
    """Save a policy of its real size, as lerobot does, and convert it."""
    import ttscompile

    directory, task = saved(folder, name)
    print(f"{peak():5.2f} GiB before compiling")
    with watched() as most:
        stages = Stages(most)
        ttscompile.convert(directory, folder / "compiled", precision=precision, task=task, explain=stages)
        stages.end()
    tell_sizes(folder / "compiled")


def tell_sizes(directory: Path) -> None:
    """Print what an artifact is made of: its largest files, and the rest of them; and what a copy without fp32 has."""
    sizes = {path.name: path.stat().st_size / 1e6 for path in directory.iterdir()}
    largest = sorted(sizes, key=lambda name: -sizes[name])[:MOST_FILES]
    rest = sum(sizes.values()) - sum(sizes[name] for name in largest)
    told = ", ".join(f"{name} {sizes[name]:.1f}" for name in largest)
    whole, apart = sum(sizes.values()), sizes.get("weights_fp32.safetensors", 0.0)
    print(f"{whole:.1f} MB: {told}, others {rest:.1f}; a copy without fp32 has {whole - apart:.1f}")


def saved(folder: Path, name: str) -> tuple[Path, str | None]:
    """Where a whole policy is saved, which is written unless it is there; and the instruction that is compiled in."""
    import large_dita
    import large_eo1
    import large_evo1
    import large_groot
    import large_octo
    import large_pi0
    import large_rdt
    import large_smolvla
    import large_vla_jepa
    import large_wall_x
    import large_xvla

    directory = folder / name
    if not directory.exists():
        pi05 = partial(large_pi0.save, adaptive=True)
        others = [large_groot, large_evo1, large_eo1, large_wall_x, large_vla_jepa, large_xvla, large_rdt, large_octo]
        saves = [large_smolvla.save, large_pi0.save, pi05, *(each.save for each in (*others, large_dita))]
        dict(zip(WHOLE, saves, strict=True))[name](directory)
    path = directory / large_dita.CHECKPOINT if name == "dita" else directory
    return path, large_evo1.TASK if name in TOLD else None


def convert_clip(folder: Path) -> None:
    """Compile a ``multi_task_dit`` of its real size."""
    import large_clip

    import ttscompile

    module, spec = large_clip.policy()
    print(f"{peak():5.2f} GiB before compiling")
    with watched() as most:
        stages = Stages(most)
        ttscompile.compile_denoiser(module, spec, folder / "compiled", precision="int8", explain=stages)
        stages.end()


def run_whole(folder: Path, rounds: int, threads: tuple[int, ...], name: str) -> None:
    """See ``large_calls``; two steps are computed. No tokens can be reused of the encoders of xvla, Octo and RDT."""
    import large_calls
    import large_threads

    from ttscompile.artifact.load import load_artifact

    clock, before = large_threads.clock_of(threads), large_threads.known(folder, large_threads.EAGER)
    original = before or _original(folder, name, clock)
    spec = load_artifact(folder / "compiled").manifest.spec
    parts = f"{'words' if name == 'octo' else 'vision'}, prefix, loop"
    if len(threads) > 1:
        large_threads.compare(folder, parts, original, spec, 2, threads, rounds)
        return
    large_calls.compare(folder, parts, original, spec, 2, rounds, before is None, threads[0], clock)
    if name not in ("xvla", "rdt", "octo"):
        large_calls.reusing(folder, spec, 2, rounds + 2, threads[0], clock)


def time_alone(folder: Path, rounds: int, threads: tuple[int, ...], name: str, what: str) -> None:
    """Calls of the original alone, or of ours in fp32; ``run_whole`` reads what they took."""
    import large_threads

    clock = large_threads.clock_of(threads)
    if what == large_threads.EXACT:
        calls = large_threads.exact_calls(folder, clock)
    else:
        original = _original(folder, name, clock)

        def calls(_: int) -> large_threads.Call:
            return original

    large_threads.alone(folder, what, calls, threads, rounds)


def _original(folder: Path, name: str, clock: Clock) -> large_threads.Call:
    import large_smolvla

    from ttscompile.frontends import load_checkpoint_policy
    from ttscompile.frontends.families import LoadOptions

    directory, task = saved(folder, name)
    module, spec = load_checkpoint_policy(directory, options=LoadOptions(task=task))
    return large_smolvla.eager(module, _vision(module), spec, clock)


def _vision(module: nn.Module) -> nn.Module:
    """The image encoder of a vision-language-action model; of RDT the adaptor of its tokens, and of Octo its T5."""
    names = ("vision_model", "vision_tower", "visual", "encoder.image", "hf_model", "image_tokenizer.tokenizer")
    return next(one for name, one in module.named_modules() if name.endswith(names))


def run_clip(folder: Path, rounds: int, threads: tuple[int, ...]) -> None:
    """See ``large_calls``; five of a hundred steps are computed."""
    import large_calls
    import large_clip
    import large_threads

    module, spec = large_clip.policy()
    clock = large_threads.clock_of(threads)
    original = large_clip.eager(module, spec, clock)
    if len(threads) > 1:
        large_threads.compare(folder, "encoder, loop", original, spec, 5, threads, rounds)
        return
    large_calls.compare(folder, "encoder, loop", original, spec, 5, rounds, True, threads[0], clock)
    large_calls.reusing(folder, spec, 5, rounds + 2, threads[0], clock)


def run(folder: Path) -> None:
    """Load what was written and run one dense call."""
    import numpy as np
    from rate import ProductRate, run_all

    import ttscompile

    start = time.perf_counter()
    policy = ttscompile.load(folder / "compiled")
    print(f"{time.perf_counter() - start:8.2f} s  load")
    call = np.load(folder / "call.npz")
    noise = ttscompile.Noise(call["noise"])
    out = policy.predict_action({"obs": call["obs"]}, noise=noise, plan="dense")
    error = np.abs(out["action_pred"] - np.load(folder / "expected.npy")).max()
    product = ProductRate("fp32")
    run_all([product])
    taken = seconds(lambda: policy.predict_action({"obs": call["obs"]}, noise=noise, plan="dense"))
    run_all([product])
    print(f"{taken:8.3f} s  a dense call of {STEPS} steps, on one thread, {error:.1e} from eager")
    assert policy.last_report is not None
    print(f"{product.seconds(policy.last_report.flops[0]):8.3f} s  its arithmetic alone")
    size = sum(file.stat().st_size for file in (folder / "compiled").iterdir()) / 2**30
    print(f"{peak():8.2f} GiB at most while it ran; the artifact has {size:.2f} GiB")


def seconds(call: Callable[[], object]) -> float:
    """Median of five calls after one that does not count; the processor's, since the machine may be busy."""
    return statistics.median(timeit.repeat(call, timer=time.process_time, number=1, repeat=6)[1:])


def whole_numbers(text: str) -> tuple[int, ...]:
    """``1,2`` of an option."""
    return tuple(map(int, text.split(",")))


def peak() -> float:
    """Largest resident memory of this process so far, GiB."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2)


def main() -> None:
    """Convert in one process, run in another."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--layers", type=int, default=16)
    parser.add_argument("--width", type=int, default=1024)
    parser.add_argument("--unet", help="channels of the levels of a U-Net, in place of the transformer")
    for name, title in WHOLE.items():
        parser.add_argument(f"--{name.replace('_', '-')}", action="store_true", help=f"{title}, in place of it")
    parser.add_argument("--clip", action="store_true", help="LeRobot's multi_task_dit with CLIP B/16, in place of it")
    parser.add_argument("--horizon", type=int, default=32, help="actions of a chunk")
    parser.add_argument("--rounds", type=int, default=5, help="calls of each contestant that are counted")
    parser.add_argument("--output", type=Path, help="a folder to keep the artifact in; a temporary one otherwise")
    parser.add_argument("--precision", default="int8", choices=["int8", "int4"], help="of a whole policy")
    parser.add_argument("--threads", default="1", type=whole_numbers, help="of a whole policy: 1, or 1,2 for both")
    parser.add_argument("--only", choices=["convert", "eager", "fp32", "run"], help="one of the processes")
    options = parser.parse_args()
    convert_to = partial(convert_whole, precision=options.precision)
    policies = {name: (partial(convert_to, name=name), partial(run_whole, name=name)) for name in WHOLE}
    policies["clip"] = partial(convert_clip), partial(run_clip)
    name, asked = next(((name, own) for name, own in policies.items() if getattr(options, name)), ("", None))
    if asked is None and options.threads != (1,):
        parser.error("--threads is for whole policies; a transformer and a U-Net are timed on one thread.")
    if asked is not None and options.only == "convert":
        asked[0](options.output)
    elif options.only in ("eager", "fp32") and name in WHOLE:
        time_alone(options.output, options.rounds, options.threads, name, options.only)
    elif asked is not None and options.only == "run":
        asked[1](options.output, options.rounds, options.threads)
    elif options.only == "convert":
        from large_networks import transformer, unet

        levels = None if options.unet is None else [int(width) for width in options.unet.split(",")]
        network = transformer(options.layers, options.width) if levels is None else unet(levels)
        convert(options.output, network.eval(), options.horizon)
    elif options.only == "run":
        run(options.output)
    else:
        with tempfile.TemporaryDirectory() as temporary:
            folder = options.output or Path(temporary)
            folder.mkdir(parents=True, exist_ok=True)
            for part in ("convert", *["eager"] * (name in ALONE), "run"):
                own = [f"--layers={options.layers}", f"--width={options.width}", f"--horizon={options.horizon}"]
                own += [f"--{name.replace('_', '-')}" for name in policies if getattr(options, name)]
                own += [f"--rounds={options.rounds}", f"--precision={options.precision}"]
                own += [f"--threads={','.join(map(str, options.threads))}"]
                own += [] if options.unet is None else [f"--unet={options.unet}"]
                subprocess.run([sys.executable, __file__, *own, f"--output={folder}", f"--only={part}"], check=True)


if __name__ == "__main__":
    main()
