"""A calibration that is killed."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from ttscompile.calibration.state import StateFile


class Killed(Exception):
    """Stands for a kill: nothing of the package catches it."""


@contextmanager
def killed(saves: int = 1) -> Iterator[None]:
    """What calibrates in the block is killed when it has saved its state so often."""
    save, done = StateFile.save, 0

    def dying(self: StateFile, **progress: Any) -> None:
        nonlocal done
        save(self, **progress)
        done += 1
        if done == saves:
            raise Killed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StateFile, "save", dying)
        with pytest.raises(Killed):
            yield
