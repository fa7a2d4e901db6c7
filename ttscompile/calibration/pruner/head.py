"""The pruner's head, as ``passes/insert_pruner`` makes it: what is learned are its constants."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

NAMES = frozenset(
    f"pruner.{n}" for n in ("hidden.weight", "hidden.bias", "code.weight", "code.bias", "step", "block", "base")
)


def has_head(constants: Mapping[str, Any]) -> bool:
    """Whether the pruner with these constants is the head that is known here."""
    return set(constants) >= NAMES
