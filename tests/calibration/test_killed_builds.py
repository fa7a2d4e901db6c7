"""A build that is killed again and again, and gone on with, ends as one that was not: with the same bytes."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.artifact.folders import contents
from tests.families import cameras
from tests.once import Once
from ttscompile import builder
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration import trials
from ttscompile.calibration.clock import Clock
from ttscompile.calibration.proposers import tokens
from ttscompile.calibration.proposers.loops import Loops
from ttscompile.calibration.trials import Trials
from ttscompile.core.lattice import Source
from ttscompile.core.plan import Plan
from ttscompile.measure.timer import Times
from ttscompile.samplers.flow import flow_matching_table

from .killed import Killed
from .proposers.trying import recorded


class Counted:
    """A clock that counts how often somebody looks at it, and kills who looks too often; no time passes by it."""

    def __init__(self) -> None:
        self.looks, self.last = 0, float("inf")

    def elapsed(self) -> float:
        self.looks += 1
        if self.looks > self.last:
            raise Killed
        return 0.0

    @contextmanager
    def killing(self, looks: float) -> Iterator[None]:
        self.looks, self.last = 0, looks
        with pytest.raises(Killed):
            yield
        self.last = float("inf")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Counted:
    counted = Counted()
    monkeypatch.setattr(Clock, "elapsed", lambda _: counted.elapsed())
    return counted


def milliseconds(plan: Plan) -> float:
    assert plan.cells is not None
    steps = int((plan.cells == Source.COMPUTE).any(-1).sum())
    return (steps + 4.0 * (plan.tokens is None)) * (0.7 if plan.precision else 1.0)


def timed(entrants: Sequence[tuple[Trials, Plan]], *_: int) -> list[Times]:
    return [Times((milliseconds(plan),)) for _, plan in entrants]


@pytest.fixture
def building(once: Once, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What a checkpoint is converted to: two cameras, an encoder with tokens, two loops, two precisions."""
    module, spec = cameras.policy("clip")
    spec = replace(spec, sampler=flow_matching_table(6), loops={"euler-4": flow_matching_table(4)})
    made = once.folder(
        "tokens and loops", lambda folder: ttscompile.compile_denoiser(module, spec, folder, precision="int8")
    )

    def convert(checkpoint: object, directory: Path, read: Any, **how: Any) -> None:
        read(spec)
        shutil.copytree(made, directory, dirs_exist_ok=True)

    monkeypatch.setattr(builder, "convert", convert)
    monkeypatch.setattr(Loops, "_measured", lambda self, trials, loop: (1.0, 1.0))
    monkeypatch.setattr(tokens, "THRESHOLDS", (0.0, 0.4))
    monkeypatch.setattr(trials, "MANY_DRAWS", 2)
    for module_name in ("choose", "proposers.tokens"):
        monkeypatch.setattr(f"ttscompile.calibration.{module_name}.timed", timed)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("kills", [3, pytest.param(20, marks=pytest.mark.soak)])
def test_killed_at_random_moments_a_build_ends_with_the_same_bytes(
    building: Path, clock: Counted, tmp_path: Path, kills: int
) -> None:
    """Loops, eight bits and tokens; before the conversion has a state to go on from, it begins anew."""
    files = recorded(tmp_path / "calls.npz")
    how: dict[str, Any] = {"max_distance": 3.0, "progress": False}
    ttscompile.build("policy", tmp_path / "whole", files, **how)
    record = load_artifact(tmp_path / "whole").manifest.calibration or {}
    assert record["learned"] == ["loops", "precision", "tokens"] and "int8" in record["told"]["precision"]
    draw, few = np.random.default_rng(0), clock.looks // 4  # what is gone on with has fewer
    for _ in range(kills):
        with clock.killing(int(draw.integers(1, few))):
            ttscompile.build("policy", tmp_path / "killed", files, resume=True, **how)
        assert not (tmp_path / "killed").exists()
    ttscompile.build("policy", tmp_path / "killed", files, resume=True, **how)
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["calls.npz", "killed", "whole"]
