"""Checkpoints that are no policy."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from ttscompile.errors import CheckpointError, TtscompileError
from ttscompile.frontends import load_checkpoint_policy


def assert_not_read(
    path: Path, message: str, error: type[TtscompileError] = CheckpointError, names: Path | None = None, **asked: Any
) -> None:
    """A checkpoint is refused, in one line, and the message begins with the place.

    Args:
        path: of the checkpoint.
        message: regular expression.
        error: which.
        names: the place, where it is told.
        **asked: as of ``load_checkpoint_policy``.
    """
    with pytest.raises(error, match=message) as caught:
        load_checkpoint_policy(path, **asked)
    assert str(caught.value).startswith("" if names is None else str(names))
    assert "\n" not in str(caught.value)


Refusals = Mapping[str, Sequence[tuple[Mapping[str, object], str]]]
"""By the place of what is changed: changes, and the message."""


def refusals(table: Refusals) -> list[object]:
    """For ``parametrize``: what is changed at each place, and what is said of it."""
    return [
        pytest.param(place, changes, message, id=f"{place} {message}")
        for place, rows in table.items()
        for changes, message in rows
    ]
