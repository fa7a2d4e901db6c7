"""What the two programs of this folder share as commands."""

from __future__ import annotations

import click


def numbers(_: click.Context, __: click.Parameter, value: str | None) -> tuple[int, ...] | None:
    """``1,2,4`` of an option."""
    if value is None:
        return None
    parts = value.split(",")
    if not all(part.isdecimal() and int(part) for part in parts):
        raise click.BadParameter(f"{value!r}: expected positive whole numbers with commas between them.")
    return tuple(int(part) for part in parts)
