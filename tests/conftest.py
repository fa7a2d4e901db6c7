"""Fixtures that several suites share: the team's golden files, the Push-T checkpoint and its artifact."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import ttscompile

if TYPE_CHECKING:
    from _pytest.terminal import TerminalReporter

ROOT = Path(__file__).resolve().parents[1]
NO_SHARED = "NO GOLDEN FILES: no folder 'shared' with DESIGN.md and golden/ beside the repository or an ancestor of it"


def pytest_configure() -> None:
    """One thread for each of torch's operations: those of the tests are small, and wait for each other otherwise."""
    if importlib.util.find_spec("torch") is not None:
        import torch

        torch.set_num_threads(1)


def pytest_terminal_summary(terminalreporter: TerminalReporter) -> None:
    """Say how much was not tested for want of the golden files: a green run without them proves less."""
    skipped = [r for r in terminalreporter.stats.get("skipped", []) if NO_SHARED in str(r.longrepr)]
    if skipped:
        terminalreporter.section("golden files are missing", sep="!", red=True, bold=True)
        terminalreporter.line(f"{len(skipped)} tests were skipped: {NO_SHARED}.", red=True)


def find_shared(start: Path) -> Path | None:
    """The folder ``shared`` beside ``start`` or beside one of its ancestors; None if there is none."""
    candidates = (folder.parent / "shared" for folder in (start, *start.parents))
    return next((c for c in candidates if (c / "DESIGN.md").is_file() and (c / "golden").is_dir()), None)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the golden files; without it the test is skipped, and the end of the run says so."""
    folder = find_shared(ROOT)
    if folder is None:
        pytest.skip(NO_SHARED)
    return folder


@pytest.fixture(scope="session")
def pusht_checkpoint() -> Path:
    """The Push-T policy of the example, as the original Diffusion Policy code saved it (half-precision weights)."""
    return ROOT / "examples" / "pusht" / "pusht_dpt_ema_fp16.ckpt"


@pytest.fixture(scope="session")
def compiled_pusht(pusht_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The artifact of the Push-T policy, not calibrated. Compiled once a run: copy it before changing it."""
    directory = tmp_path_factory.mktemp("pusht") / "compiled"
    ttscompile.convert(pusht_checkpoint, directory)
    return directory
