"""Whether saved weights are those of a network; said in the same words, whoever saved them."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..errors import CheckpointError

SHOWN = 6
"""Names that a message holds; it counts the others."""


def names_of(keys: Sequence[str]) -> str:
    """A few names and how many more there are."""
    more = f" and {len(keys) - SHOWN} more" if len(keys) > SHOWN else ""
    return ", ".join(keys[:SHOWN]) + more


def unwrapped(name: str) -> str:
    """The name of a weight without the levels that ``torch.compile`` and ``DistributedDataParallel`` put around it."""
    return ".".join(part for part in name.split(".") if part not in ("_orig_mod", "module"))


def require_names(missing: Sequence[str], extra: Sequence[str], what: str, remedy: str) -> None:
    """Refuse weights some of which are missing, or of something else.

    Args:
        missing: names that the network has and the file has not.
        extra: names that the file has and the network has not.
        what: is wrong then; begins the message.
        remedy: ends it.

    Raises:
        CheckpointError: there are such names.
    """
    if missing or extra:
        parts = [f"missing {names_of(missing)}"] * bool(missing) + [f"unexpected {names_of(extra)}"] * bool(extra)
        raise CheckpointError(f"{what}: {'; '.join(parts)}. {remedy}")


def require_shape(name: str, value: torch.Tensor, shape: torch.Size, source: str) -> None:
    """Refuse a weight of another shape than ``source`` asks for.

    Raises:
        CheckpointError: names both.
    """
    if value.shape != shape:
        raise CheckpointError(f"weight {name} has shape {tuple(value.shape)}; expected {tuple(shape)} from {source}.")


def require_finite(name: str, value: torch.Tensor) -> None:
    """Refuse a weight with NaN or infinity.

    Raises:
        CheckpointError: counts them.
    """
    if not torch.isfinite(value).all():
        count = int((~torch.isfinite(value)).sum())
        raise CheckpointError(f"weight {name} holds {count} values that are not finite; training diverged.")
