"""What the authors' own code of three rivals decides and forecasts, on random features.

    python -m tests.rivals.golden.make_rules path/to/TeaCache path/to/cache-dit path/to/TaylorSeer

``README.md`` beside this file says at which commits, and what is run. Nothing of that code is kept.
"""

from __future__ import annotations

import argparse
import ast
import logging
import subprocess
import textwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

TEACACHE = "7c10efc4702c6b619f47805f7abe4a7a08085aa0", "TeaCache4FLUX/teacache_flux.py"
CACHE_DIT = "f86744af7daa0f569fe4324e73e3e50cebf70f4c", "src/cache_dit/caching/cache_contexts/cache_manager.py"
TAYLOR = "288776dfd0cbb6e201c654c31cd22139f848a6cf", "TaylorSeer-DiT"

STEPS, SIZE = 24, 32


def source(clone: Path, commit: str, path: str) -> str:
    """A file as it is at a commit."""
    return subprocess.run(
        ["git", "-C", str(clone), "show", f"{commit}:{path}"], check=True, capture_output=True, text=True
    ).stdout


def between(text: str, first: str, last: str) -> str:
    """The lines from one that holds ``first`` to the next that holds ``last``, moved to the left."""
    lines = text.splitlines()
    begin = next(i for i, line in enumerate(lines) if first in line)
    end = next(i for i, line in enumerate(lines) if i > begin and last in line)
    return textwrap.dedent("\n".join(lines[begin : end + 1]))


def walk(draw: np.random.Generator, change: float) -> np.ndarray:
    """A feature that changes from step to step by about this share, ``[K, SIZE]``."""
    moved = draw.standard_normal((STEPS, SIZE)) * change * draw.uniform(0.2, 2.0, (STEPS, 1))
    moved[0] = draw.standard_normal(SIZE)
    return np.cumsum(moved, 0).astype(np.float32)


def teacache(clone: Path) -> dict[str, np.ndarray]:
    """Which steps TeaCache computes: the lines that decide, as they stand."""
    text = source(clone, *TEACACHE)
    code = compile(between(text, "if self.cnt == 0 or", "self.cnt += 1"), "teacache", "exec")
    features, threshold = walk(np.random.default_rng(1), 0.2), 0.6
    own = SimpleNamespace(cnt=0, num_steps=STEPS, rel_l1_thresh=threshold, previous_modulated_input=None)
    computed, told = [], dict[str, Any]()
    for feature in torch.from_numpy(features):
        told = {"self": own, "np": np, "modulated_inp": feature}
        exec(code, told)
        computed.append(told["should_calc"])
    polynomial = between(text, "coefficients =", "rescale_func").split("=")[1].split("\n")[0]
    return {
        "teacache.features": features,
        "teacache.threshold": np.array(threshold),
        "teacache.polynomial": np.array(ast.literal_eval(polynomial.strip())),
        "teacache.computed": np.array(computed),
    }


def dbcache(clone: Path) -> dict[str, np.ndarray]:
    """Which steps DBCache computes after two of warm-up: its ``similarity`` against the last computed step."""
    tree = ast.parse(source(clone, *CACHE_DIT))
    found = next(n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == "similarity")
    told: dict[str, Any] = {"torch": torch, "logger": logging.getLogger("cache-dit"), "logging": logging}
    exec(compile(ast.Module([found], []), "similarity", "exec"), told)
    own = SimpleNamespace(
        add_residual_diff=lambda value: None,
        enable_separate_cfg=lambda: False,
        is_separate_cfg_step=lambda: False,
        cfg_diff_compute_separate=lambda: True,
        get_current_step_residual_diff=lambda: None,
        get_important_condition_threshold=lambda: 0.0,
    )
    features, threshold, warmup, computed = walk(np.random.default_rng(2), 0.05), 0.12, 2, []
    kept = None
    for k, feature in enumerate(torch.from_numpy(features)):
        similar = k >= warmup and told["similarity"](own, kept, feature, threshold=threshold)
        kept = kept if similar else feature
        computed.append(not similar)
    return {
        "dbcache.features": features,
        "dbcache.threshold": np.array(threshold),
        "dbcache.warmup": np.array(warmup),
        "dbcache.computed": np.array(computed),
    }


def taylorseer(clone: Path) -> dict[str, np.ndarray]:
    """Which of 51 steps TaylorSeer computes, and what it forecasts at the others, of first order."""
    commit, folder = TAYLOR
    told: dict[str, Any] = {}
    for name in ("cache_functions/cal_type.py", "taylor_utils/__init__.py"):
        exec(source(clone, commit, f"{folder}/{name}"), told)
    steps, interval, warmup = 51, 5, 2
    features = np.random.default_rng(3).standard_normal((steps, SIZE)).astype(np.float32)
    cache: dict[str, Any] = {
        "cache": {-1: {0: {}}},
        "max_order": 1,
        "interval": interval,
        "first_enhance": warmup,
        "cache_counter": 0,
    }
    current: dict[str, Any] = {"num_steps": steps, "activated_steps": [steps - 1], "layer": 0, "module": "mlp"}
    computed, given = [], []
    for k, feature in enumerate(torch.from_numpy(features)):
        current["step"] = steps - 1 - k  # theirs count down
        told["cal_type"](cache, current)
        computed.append(current["type"] == "full")
        if computed[-1]:
            told["taylor_cache_init"](cache, current)
            told["derivative_approximation"](cache, current, feature)
        given.append(told["taylor_formula"](cache, current).numpy())
    return {
        "taylorseer.features": features,
        "taylorseer.warmup": np.array(warmup),
        "taylorseer.computed": np.array(computed),
        "taylorseer.given": np.stack(given),
    }


def main() -> None:
    """Write ``rules.npz``."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("teacache", "cache_dit", "taylorseer"):
        parser.add_argument(name, type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).with_name("rules.npz"))
    given = parser.parse_args()
    arrays: dict[str, Any] = {**teacache(given.teacache), **dbcache(given.cache_dit), **taylorseer(given.taylorseer)}
    np.savez(given.output, **arrays)


if __name__ == "__main__":
    main()
