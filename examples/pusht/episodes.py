"""Episodes on disk, so that the dense policy need not run again to be compared with."""

from __future__ import annotations

import hashlib
import os
import zipfile
from dataclasses import fields
from pathlib import Path

import numpy as np
from rollout import Episode
from variants import Variant

FORMAT = "1"
"""Part of every key: another environment or another way to draw noise needs another."""


class Episodes:
    """Episodes of one variant, a file each.

    The key is what the variant computes: for the dense plan weights, sampler and normalisers, which calibration does
    not touch; for any other plan the artifact's whole identity; and the runtime, whose sums are ordered differently.

    Args:
        root: folder of all variants.
        variant: whose episodes they are.
        runtime: that it runs on.
    """

    def __init__(self, root: Path, variant: Variant, runtime: str) -> None:
        info = variant.policy.info
        plan = variant.plan or info.default_plan
        identity = info.model_identity if plan == "dense" else info.identity
        key = "\n".join((FORMAT, identity, info.precision, plan, runtime))
        self._folder = root / hashlib.sha256(key.encode()).hexdigest()[:16]

    def read(self, seed: int) -> Episode | None:
        """The episode of a seed; None if it is not kept, or its file is damaged."""
        try:
            with (
                (self._folder / f"{seed}.npz").open("rb") as file,  # numpy leaves a damaged file open
                np.load(file, allow_pickle=False) as stored,
            ):
                arrays = {field.name: stored[field.name] for field in fields(Episode)}
        except (OSError, KeyError, ValueError, zipfile.BadZipFile):
            return None
        figures = {name: tuple(arrays[name].tolist()) for name in ("sparsity", "flops", "legalised")}
        return Episode(**{**arrays, **figures, "seed": int(arrays["seed"])})

    def write(self, episode: Episode) -> None:
        """Keep an episode."""
        self._folder.mkdir(parents=True, exist_ok=True)
        beside = self._folder / f".{episode.seed}.{os.getpid()}.npz"
        np.savez(beside, **{field.name: np.asarray(getattr(episode, field.name)) for field in fields(Episode)})
        beside.replace(self._folder / f"{episode.seed}.npz")
