"""A diffusion transformer of 300 million random weights: what it takes to compile it, and to run one call.

    python examples/benchmark/large.py [--layers 16] [--width 1024] [--output DIR]

The network is an ordinary DiT with adaLN-Zero, 32 action tokens and an observation vector; nothing in it is made for
ttscompile. Converting and running are two processes, so that each has its own peak of resident memory.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HORIZON, ACTIONS, OBSERVED, STEPS = 32, 14, 64, 4


def convert(folder: Path, layers: int, width: int) -> None:
    """Make the network and compile it; print what each stage took."""
    import numpy as np
    import torch
    from torch import Tensor, nn
    from torch.nn import functional

    import ttscompile
    from ttscompile import ChunkSpec, ObservationSpec, PolicySpec
    from ttscompile.samplers.flow import flow_matching_table

    class Layer(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
            self.up, self.down = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)
            self.modulate = nn.Linear(width, 6 * width)

        def forward(self, x: Tensor, c: Tensor) -> Tensor:
            s1, c1, g1, s2, c2, g2 = self.modulate(functional.silu(c))[:, None].chunk(6, -1)
            n = functional.layer_norm(x, (width,)) * (1 + c1) + s1
            q, k, v = (part.unflatten(-1, (-1, 64)).transpose(1, 2) for part in self.qkv(n).chunk(3, -1))
            x = x + g1 * self.out(functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))
            n = functional.layer_norm(x, (width,)) * (1 + c2) + s2
            return x + g2 * self.down(functional.gelu(self.up(n), approximate="tanh"))

    class Network(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.embed, self.head = nn.Linear(ACTIONS, width), nn.Linear(width, ACTIONS)
            self.observe, self.time = nn.Linear(OBSERVED, width), nn.Linear(256, width)
            self.layers = nn.ModuleList(Layer() for _ in range(layers))

        def forward(self, sample: Tensor, timestep: Tensor, obs: Tensor) -> Tensor:
            angle = timestep[:, None] * torch.exp(-torch.arange(128) / 14)
            c = self.time(torch.cat([angle.sin(), angle.cos()], -1)) + self.observe(obs)
            x = self.embed(sample)
            for layer in self.layers:
                x = layer(x, c)
            return self.head(functional.layer_norm(x, (width,)))

    torch.manual_seed(0)
    network = Network().eval()
    count = sum(p.numel() for p in network.parameters())
    print(f"{count / 1e6:.0f} million weights, {count * 4 / 2**30:.2f} GiB; {peak()} GiB before compiling")
    spec = PolicySpec(
        sample=(HORIZON, ACTIONS),
        observations={"obs": ObservationSpec((OBSERVED,))},
        sampler=flow_matching_table(STEPS),
        chunk=ChunkSpec(ACTIONS, 0, HORIZON),
    )
    start = last = time.perf_counter()

    def explain(stage: str, notes: tuple[str, ...]) -> None:
        nonlocal last
        now = time.perf_counter()
        print(f"{now - last:7.1f} s  {peak():5.2f} GiB  {stage}: {notes[0] if notes else ''}", flush=True)
        last = now

    ttscompile.compile_denoiser(network, spec, folder / "compiled", explain=explain)
    print(f"{time.perf_counter() - start:7.1f} s  {peak():5.2f} GiB  in all")

    rng = np.random.default_rng(0)
    obs = rng.standard_normal((1, OBSERVED), dtype=np.float32)
    sample = rng.standard_normal((1, HORIZON, ACTIONS), dtype=np.float32)
    np.savez(folder / "call.npz", obs=obs, noise=sample)
    x = torch.from_numpy(sample)
    with torch.no_grad():
        for t in spec.sampler.timesteps:
            x = x + network(x, torch.full((1,), float(t)), torch.from_numpy(obs)) / STEPS
    np.save(folder / "expected.npy", x.numpy())


def run(folder: Path) -> None:
    """Load what was written and run one dense call."""
    import numpy as np

    import ttscompile

    start = time.perf_counter()
    policy = ttscompile.load(folder / "compiled")
    loaded = time.perf_counter()
    call = np.load(folder / "call.npz")
    out = policy.predict_action({"obs": call["obs"]}, noise=ttscompile.Noise(call["noise"]), plan="dense")
    done = time.perf_counter()
    error = np.abs(out["action_pred"] - np.load(folder / "expected.npy")).max()
    print(f"{loaded - start:7.1f} s  load")
    print(f"{done - loaded:7.1f} s  one call of {STEPS} steps on one thread, {error:.1e} from eager")
    size = sum(file.stat().st_size for file in (folder / "compiled").iterdir()) / 2**30
    print(f"{peak():7.2f} GiB at most while it ran; the artifact has {size:.2f} GiB")


def peak() -> float:
    """Largest resident memory of this process so far, GiB."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2)


def main() -> None:
    """Convert in one process, run in another."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--layers", type=int, default=16)
    parser.add_argument("--width", type=int, default=1024)
    parser.add_argument("--output", type=Path, help="a folder to keep the artifact in; a temporary one otherwise")
    parser.add_argument("--only", choices=["convert", "run"], help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only == "convert":
        convert(options.output, options.layers, options.width)
    elif options.only == "run":
        run(options.output)
    else:
        with tempfile.TemporaryDirectory() as temporary:
            folder = options.output or Path(temporary)
            folder.mkdir(parents=True, exist_ok=True)
            for part in ("convert", "run"):
                own = [f"--layers={options.layers}", f"--width={options.width}", f"--output={folder}"]
                subprocess.run([sys.executable, __file__, *own, f"--only={part}"], check=True)


if __name__ == "__main__":
    main()
