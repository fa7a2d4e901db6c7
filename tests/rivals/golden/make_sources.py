"""Where the authors' own code of FastCache computes a block, and which tokens that of ToCa does, from random features.

    python -m tests.rivals.golden.make_sources path/to/FastCache-xDiT path/to/ToCa

``README.md`` beside this file says at which commits, and what is run. Nothing of that code is kept.
"""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from .make_rules import source
from .make_schedules import parts_of

FASTCACHE = "7d894fc0a3b930147db780e22b137ec66bfee1a2", "xfuser/model_executor/accelerator/fastcache.py"
TOCA = "e84096ffd85af4540a6a1f64e3334e428e1b7377", "DiT-ToCa/cache_functions"

STEPS, TOKENS, WIDTH = 30, 10, 16


class Block(torch.nn.Module):
    """In a block's place."""

    config = SimpleNamespace(hidden_size=WIDTH)

    def forward(self, hidden_states: torch.Tensor) -> torch.Tensor:
        """What it was given."""
        return hidden_states


def fastcache(clone: Path) -> dict[str, np.ndarray]:
    """At which steps a block is computed, wholly or for some tokens: where ``forward`` counts no hit."""
    told: dict[str, Any] = {"torch": torch, "nn": torch.nn, "math": math, "logger": SimpleNamespace()}
    said: list[str] = []
    told["logger"].info, told["logger"].debug = len, said.append
    parts_of("from __future__ import annotations\n" + source(clone, *FASTCACHE), ["FastCacheAccelerator"], told)
    theirs, draw = told["FastCacheAccelerator"](Block()), np.random.default_rng(6)
    moved = draw.standard_normal((STEPS, TOKENS, WIDTH)) * 0.05 * draw.uniform(0.1, 1.5, (STEPS, 1, 1))
    moved[0] = draw.standard_normal((TOKENS, WIDTH))
    features, computed = np.cumsum(moved, 0).astype(np.float32), []
    timesteps = np.linspace(999, 0, STEPS).astype(np.int64)
    for feature, timestep in zip(torch.from_numpy(features), timesteps.tolist(), strict=True):
        hits = theirs.cache_hits
        with torch.no_grad():
            theirs(feature[None], timestep)
        computed.append(theirs.cache_hits == hits)
    thresholds = {found for text in said for found in re.findall(r"Statistical: ([\d.]+)", text)}
    return {
        "fastcache.features": features,
        "fastcache.timesteps": timesteps,
        "fastcache.computed": np.array(computed),
        "fastcache.threshold": np.array([float(found) for found in thresholds]),
    }


def toca(clone: Path) -> dict[str, np.ndarray]:
    """Scores by similarity and by waiting, and the tokens of ``cache_cutfresh``, without the bonus for neighbours."""
    commit, folder = TOCA
    told: dict[str, Any] = {
        "torch": torch,
        "F": torch.nn.functional,
        "local_selection_with_bonus": lambda score, *_: score,
    }
    for name in ("scores", "score_evaluate", "fresh_ratio_scheduler", "cache_cutfresh"):
        wanted = {"scores": ["similarity_score"]}.get(name, [name])
        parts_of(source(clone, commit, f"{folder}/{name}.py"), wanted, told)
    draw, steps, batch = np.random.default_rng(7), 5, 2
    tokens, cached = draw.standard_normal((2, steps, batch, TOKENS, WIDTH)).astype(np.float32)
    cache: dict[str, Any] = {
        "cache_type": "similarity",
        "force_fresh": "global",
        "fresh_threshold": 4,
        "soft_fresh_weight": 0.25,
        "fresh_ratio": 0.3,
        "fresh_ratio_schedule": "constant",
        "cache_index": {-1: {0: {"mlp": torch.zeros(batch, TOKENS, dtype=torch.int)}}},
        "cache": {-1: {0: {}}},
    }
    current = {"step": 0, "num_steps": steps, "layer": 0, "module": "mlp"}
    scores, chosen = [], []
    for given, kept in zip(torch.from_numpy(tokens), torch.from_numpy(cached), strict=True):
        cache["cache"][-1][0]["mlp"] = kept
        scores.append(told["score_evaluate"](cache, given, current).numpy())
        chosen.append(told["cache_cutfresh"](cache, given, current)[0].numpy())
    return {
        "toca.tokens": tokens,
        "toca.cached": cached,
        "toca.score": np.stack(scores),
        "toca.chosen": np.stack(chosen),
    }


def main() -> None:
    """Write ``sources.npz``."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("fastcache", "toca"):
        parser.add_argument(name, type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).with_name("sources.npz"))
    given = parser.parse_args()
    arrays: dict[str, Any] = {**fastcache(given.fastcache), **toca(given.toca)}
    np.savez_compressed(given.output, **arrays)


if __name__ == "__main__":
    main()
