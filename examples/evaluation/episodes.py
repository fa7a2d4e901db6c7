"""Episodes on disk, so that the dense policy need not run again to be compared with."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from rollout import Episode
from variants import OTHER, PINNED, Variant

from ttscompile.core.plan import DENSE, FULL

FORMAT = "2"
"""Part of every key: a changed environment or another way to draw noise needs another."""
PLAIN, WINDOWS = "plain", "windows/"
"""In a file: JSON of what is no array; before the keys of the observation."""


class Episodes:
    """Episodes of one variant in one environment, a file each.

    The key is the environment and what the variant computes: for the plans that a conversion makes weights, samplers
    and normalisers, which calibration does not touch; for any other plan, and where tokens are reused, the artifact's
    whole identity; and the runtime, whose sums are ordered differently.

    Args:
        root: folder of all variants.
        environment: its name.
        variant: whose episodes they are.
        runtime: that it runs on.
    """

    def __init__(self, root: Path, environment: str, variant: Variant, runtime: str) -> None:
        info = variant.policy.info
        plan = variant.plan or info.default_plan
        as_converted = plan in (DENSE, FULL) and not info.reuses_tokens and not info.follows
        identity = info.model_identity if as_converted else info.identity
        noise = (PINNED,) * variant.noise.pinned + (OTHER,) * variant.noise.other
        key = "\n".join((FORMAT, environment, identity, info.precision, plan, runtime, *noise))
        self._folder = root / hashlib.sha256(key.encode()).hexdigest()[:16]

    def read(self, seed: int) -> Episode | None:
        """The episode of a seed; None if it is not kept, or its file is damaged."""
        try:
            with (
                (self._folder / f"{seed}.npz").open("rb") as file,  # numpy leaves a damaged file open
                np.load(file, allow_pickle=False) as stored,
            ):
                plain = json.loads(str(stored[PLAIN]))
                arrays = {name: stored[name] for name in stored.files if name != PLAIN}
        except (OSError, KeyError, ValueError, zipfile.BadZipFile, zlib.error):
            return None
        figures: dict[str, Any] = {name: tuple(plain.pop(name)) for name in ("sparsity", "flops", "legalised")}
        actions, scores = arrays.pop("actions"), arrays.pop("scores")
        windows = {name.removeprefix(WINDOWS): array for name, array in arrays.items()}
        return Episode(**plain, **figures, actions=actions, scores=scores, windows=windows)

    def write(self, episode: Episode) -> None:
        """Keep an episode."""
        self._folder.mkdir(parents=True, exist_ok=True)
        beside = self._folder / f".{episode.seed}.{os.getpid()}.npz"
        plain = vars(episode).copy()
        arrays: dict[str, Any] = {name: plain.pop(name) for name in ("actions", "scores")}
        arrays |= {f"{WINDOWS}{key}": array for key, array in plain.pop("windows").items()}
        arrays[PLAIN] = np.array(json.dumps(plain))
        np.savez_compressed(beside, **arrays)  # images of simulators become a tenth
        beside.replace(self._folder / f"{episode.seed}.npz")
