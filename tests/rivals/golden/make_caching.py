"""What the authors' own code of BAC and EVO does with the example's Push-T policy: its cells, and its actions.

    python -m tests.rivals.golden.make_caching path/to/diffusion_policy path/to/HAS path/to/EVO

``README.md`` beside this file says at which commits, and what is run. Nothing of that code is kept.
"""

from __future__ import annotations

import argparse
import pickle
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ttscompile.core.lattice import Source

ROOT = Path(__file__).parents[3]
sys.path.insert(0, str(ROOT / "examples" / "benchmark"))

from caching_beside import SEED, answered, bac_cells, bac_policies, evo_policy, noise_of, original_policy  # noqa: E402

CHECKPOINT = ROOT / "examples" / "pusht" / "pusht_dpt_ema_fp16.ckpt"
COMMITS = {
    "diffusion_policy": "5ba07ac6661db573af695b419a7947ecb704690f",
    "HAS": "2ddd2a6f0394be2ce00bcabbbccf5527c3a684eb",
    "EVO": "09e0fcbdba14ebf7d8180f434dd5a015aeb0a71e",
}
UPDATES = (3, 10)
"""Of each block, before the union; the second is the paper's."""

EVO_CELLS = 192
"""That EVO's code gets beside the first and the last step, as many as its own settings have."""


def require(clone: Path, name: str) -> None:
    """That a clone is at the commit whose outcome is kept."""
    found = subprocess.run(["git", "-C", str(clone), "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
    if found.stdout.strip() != COMMITS[name]:
        raise SystemExit(f"{clone}: expected {name} at {COMMITS[name]}; found {found.stdout.strip()}.")


def made(original: Path, has: Path, evo: Path) -> dict[str, Any]:
    """All arrays: of one call, of BAC's schedules and actions, and of EVO's actions with cells of chance."""

    def fresh() -> Any:
        return original_policy(original, CHECKPOINT)

    policy, draw = fresh(), np.random.default_rng(8)
    obs = {"obs": draw.uniform(100, 400, (1, 2, 20)).astype(np.float32)}
    noise = noise_of(policy, 1, SEED)
    assert noise.steps is not None
    found: dict[str, Any] = {
        "obs": obs["obs"],
        "initial": noise.initial,
        "noise": noise.steps,
        "updates": np.array(UPDATES),
        "dense": answered(policy, obs, SEED),
    }
    with tempfile.TemporaryDirectory() as where:
        policies = bac_policies(has, fresh, obs, UPDATES, Path(where))
        found["bac.cells"] = np.stack([bac_cells(policies[count]) for count in UPDATES])
        found["bac.actions"] = np.stack([answered(policies[count], obs, SEED) for count in UPDATES])
        found["bac.scheduled"] = np.stack(
            [scheduled(Path(where), count, found["bac.cells"][0].shape) for count in UPDATES]
        )
        cells = np.full_like(found["bac.cells"][0], Source.TIMESTEP)
        cells.reshape(-1)[draw.choice(cells.size, EVO_CELLS, replace=False)] = Source.COMPUTE
        cells[[0, -1]] = Source.COMPUTE
        found["evo.cells"] = cells
        found["evo.actions"] = answered(evo_policy(evo, fresh, cells, Path(where)), obs, SEED)
    return found


def scheduled(where: Path, count: int, shape: tuple[int, ...]) -> np.ndarray:
    """Where BAC's code computes each block before the union, bool ``[K, blocks]``: as its files say."""
    found: np.ndarray = np.zeros(shape, np.bool_)
    for block in range(shape[1]):
        name = f"decoder.layers.{block // 3}.dropout{1 + block % 3}"
        path = where / "original" / "optimal_steps" / "cosine" / name / f"optimal_steps_{name}_{count}_cosine.pkl"
        found[pickle.loads(path.read_bytes()), block] = True
    return found


def main() -> None:
    """Write ``caching.npz``."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("original", type=Path)
    parser.add_argument("has", type=Path)
    parser.add_argument("evo", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).with_name("caching.npz"))
    given = parser.parse_args()
    for clone, name in ((given.original, "diffusion_policy"), (given.has, "HAS"), (given.evo, "EVO")):
        require(clone, name)
    np.savez_compressed(given.output, **made(given.original, given.has, given.evo))


if __name__ == "__main__":
    main()
