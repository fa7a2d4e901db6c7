"""Which cells the authors' own code of BAC, Learning-to-Cache and DeepCache computes, from random features and scores.

    python -m tests.rivals.golden.make_schedules path/to/RDT-BAC path/to/learning-to-cache path/to/DeepCache

``README.md`` beside this file says at which commits, and what is run. Nothing of that code is kept.
"""

from __future__ import annotations

import argparse
import ast
import pickle
import re
import sys
import tempfile
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from .make_rules import source, walk

RDT_BAC = "fc9268c6aecc294408a30e5c43eb46bcbdae972e"
L2C = "d6cc7817842e1353b8d902af263bab030b8478da"
DEEPCACHE = "1691a3ab22308fe06685e4ff151a9ab175be2dc4", "DeepCache/extension/deepcache.py"

LAYERS, UPDATES, BUBBLING = 4, (3, 6), 5
"""Of BAC: layers of an attention and a feed-forward block, updates of each block, blocks that take over updates."""

STEPS, DEPTH = 10, 3
"""Of Learning-to-Cache: steps, and layers of two blocks each."""


def parts_of(text: str, names: Iterable[str], told: dict[str, Any]) -> dict[str, Any]:
    """Run the functions and classes of a file that have these names, in a namespace."""
    found = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef | ast.ClassDef) and n.name in names]
    exec(compile(ast.Module(list(found), []), "theirs", "exec"), told)
    return told


@contextmanager
def modules(*imported: ModuleType) -> Iterator[None]:
    """Modules that their code imports by name, and the packages around them."""
    added = {"models": ModuleType("models"), "models.activation_utils": ModuleType("models.activation_utils")}
    added |= {module.__name__: module for module in imported}
    sys.modules.update(added)
    try:
        yield
    finally:
        for name in added:
            del sys.modules[name]


def bac(clone: Path) -> dict[str, np.ndarray]:
    """Similarities, the schedule of each block, the blocks that change most, and the cells after the union."""
    draw = np.random.default_rng(4)
    features = np.stack([walk(draw, change) for change in draw.uniform(0.1, 0.6, 2 * LAYERS).tolist()])
    layers = [f"blocks.{layer}" for layer in range(LAYERS)]
    names = [f"{layer}.{part}" for layer in layers for part in ("attn", "ffn")]
    keys = [f"{layer}_{part}_block" for layer in layers for part in ("attn", "ffn")]
    activations = {name: list(torch.from_numpy(rows)) for name, rows in zip(names, features, strict=True)}
    told: dict[str, Any] = {"np": np, "torch": torch, "re": re, "logger": None, "List": list, "Dict": dict}
    for name, parts in {
        "activation_analysis": ["compute_similarity_matrix"],
        "bu_block_selection": ["compute_block_l1_errors", "select_top_error_blocks"],
    }.items():
        parts_of(source(clone, RDT_BAC, f"models/activation_utils/{name}.py"), parts, told)
    exec(source(clone, RDT_BAC, "models/activation_utils/optimal_cache_scheduler.py"), told)
    exec(source(clone, RDT_BAC, "models/acceleration/rdt_cache_wrapper.py"), told)
    similarity = {name: told["compute_similarity_matrix"](rows)["cosine"] for name, rows in activations.items()}
    chosen = dict(told["select_top_error_blocks"](told["compute_block_l1_errors"](activations), BUBBLING))
    imported = ModuleType("models.activation_utils.bu_block_selection")
    imported.__dict__.update(analyze_block_errors=None, get_analysis_output_dir=None)  # not called with files there
    best, cells = [], []
    with tempfile.TemporaryDirectory() as where, modules(imported):
        steps_dir, blocks_dir = Path(where, "optimal_steps"), Path(where, "original", "bu_block_selection")
        blocks_dir.mkdir(parents=True)
        (blocks_dir / f"top_{BUBBLING}_error_blocks.pkl").write_bytes(pickle.dumps(chosen))
        for count in UPDATES:
            scheduled = {name: told["compute_optimal_cache_steps"](one, count) for name, one in similarity.items()}
            for name, steps in scheduled.items():
                path = steps_dir / "cosine" / name / f"optimal_steps_{name}_{count}_cosine.pkl"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(pickle.dumps(steps))
            cache: dict[str, Any] = {"num_bu_blocks": BUBBLING}
            load = told["RDTCacheAccelerator"]._load_block_optimal_steps
            load(cache, [(layer, None) for layer in layers], str(steps_dir), count, "cosine")
            best.append([among(features.shape[1], scheduled[name]) for name in names])
            cells.append([among(features.shape[1], cache["block_steps"][key]) for key in keys])
    return {
        "bac.features": features,
        "bac.similarity": np.stack([similarity[name] for name in names]),
        "bac.updates": np.array(UPDATES),
        "bac.scheduled": np.array(best),
        "bac.bubbling": np.array([key in chosen for key in keys]),
        "bac.computed": np.array(cells),
    }


def among(steps: int, chosen: Iterable[int]) -> np.ndarray:
    """Of each step, whether it is one of these."""
    return np.isin(np.arange(steps), list(chosen))


class Counting(torch.nn.Module):
    """In a block's place: says which of its two parts are computed."""

    def forward(self, x: Any, c: Any, reuse_att: Any = None, reuse_mlp: Any = None) -> tuple[Any, tuple[Any, Any]]:
        """As theirs: the stream, and what both parts gave."""
        self.computed = [reuse_att is None, reuse_mlp is None]
        return x, (x, x)


def l2c(clone: Path) -> dict[str, np.ndarray]:
    """Which parts of a DiT are computed with random routers: its ``load_ranking`` and ``forward``."""
    routers = ModuleType("models.router_models")
    routers.__dict__.update(torch=torch, nn=torch.nn)
    parts_of(source(clone, L2C, "DiT/models/router_models.py"), ["STE", "Router"], routers.__dict__)
    told = parts_of(source(clone, L2C, "DiT/models/dynamic_models.py"), ["DiT"], {"torch": torch, "nn": torch.nn})
    theirs, timesteps, threshold = told["DiT"], list(range(0, 1000, 1000 // STEPS)), 0.6
    own = theirs.__new__(theirs)
    torch.nn.Module.__init__(own)
    own.depth, own.pos_embed, own.x_embedder = DEPTH, 0.0, torch.nn.Identity()
    own.t_embedder, own.final_layer = torch.nn.Identity(), lambda x, c: x
    own.y_embedder, own.unpatchify = lambda y, training: y, lambda x: x
    own.blocks = [Counting() for _ in range(DEPTH)]
    own.reset(STEPS)
    weights = np.random.default_rng(5).standard_normal((STEPS, 2 * DEPTH)).astype(np.float32)
    held = OrderedDict((f"{i}.prob", torch.from_numpy(row)) for i, row in enumerate(weights))
    with tempfile.TemporaryDirectory() as where, modules(routers):
        torch.save({"routers": held}, Path(where) / "routers.pt")
        own.load_ranking(Path(where) / "routers.pt", STEPS, timesteps, threshold)
    computed = []
    for timestep in reversed(timesteps):  # the noisiest first
        own(torch.zeros(1, 4, 2), torch.tensor([timestep]), 0)
        computed.append([part for block in own.blocks for part in block.computed])
    scores = torch.from_numpy(weights).sigmoid().numpy()[::-1]  # theirs are in order of the timestep
    return {"l2c.scores": scores, "l2c.threshold": np.array(threshold), "l2c.computed": np.array(computed)}


def deepcache(clone: Path) -> dict[str, np.ndarray]:
    """Which parts of a U-Net of three levels are computed, for each branch: ``is_skip_step``, at every third step.

    A level has two networks and the step to the next, or from it. The first convolution is outside of the levels, and
    always computed. Order: as they are evaluated.
    """
    told = parts_of(source(clone, *DEEPCACHE), ["DeepCacheSDHelper"], {})
    steps, interval, levels = 12, 3, 3
    down = [(level, layer, "down") for level in range(levels) for layer in range(3 if level < levels - 1 else 2)]
    up = [(level, layer, "up") for level in reversed(range(levels)) for layer in (2, 1, 0)]
    computed = []
    for branch in range(3 * levels - 1):
        helper = told["DeepCacheSDHelper"]()
        helper.reset_states()
        helper.set_params(cache_interval=interval, cache_branch_id=branch)
        cells = []
        for helper.cur_timestep in range(steps):
            cells.append([True, *(not helper.is_skip_step(*one) for one in [*down, (0, 0, "mid"), *up])])
        computed.append(cells)
    return {"deepcache.interval": np.array(interval), "deepcache.computed": np.array(computed)}


def main() -> None:
    """Write ``schedules.npz``."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("rdt_bac", "l2c", "deepcache"):
        parser.add_argument(name, type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).with_name("schedules.npz"))
    given = parser.parse_args()
    arrays: dict[str, Any] = {**bac(given.rdt_bac), **l2c(given.l2c), **deepcache(given.deepcache)}
    np.savez_compressed(given.output, **arrays)


if __name__ == "__main__":
    main()
