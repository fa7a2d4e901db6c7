"""Proposers that take part in a comparison: what they find, what is kept of it, and that it can go on."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from searches import ComparisonState, Searches, Searching, plan_of

import ttscompile
from tests.artifact.folders import contents
from tests.calibration.pools import Elsewhere, needs_ray
from ttscompile.artifact.load import load_artifact
from ttscompile.calibration.calls import Calls
from ttscompile.calibration.compare import compare as measure
from ttscompile.calibration.runner import Runner
from ttscompile.calibration.task import Found, Task
from ttscompile.calibration.trials import DRAWS
from ttscompile.errors import CalibrationError, ClusterError
from ttscompile.measure.points import Comparison, MeasuredPoint
from ttscompile.pool import Here, RayPool

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def ray_pool() -> Iterator[RayPool]:
    with RayPool("local", cores=2) as pool:
        yield pool


def compare(
    path: Path,
    trajectories: Sequence[Path],
    learn: Sequence[str],
    sparsities: Sequence[float],
    calls: int = 8,
    seed: int = 0,
    **options: Any,
) -> Comparison:
    joining = Searching(path, learn, sparsities, **options)
    found = measure(path, trajectories, calls=calls, seed=seed, joining=joining)
    joining.forget()
    return found


@pytest.fixture(scope="module")
def frontier(planned: Path, recording: Path) -> Comparison:
    return compare(planned, [recording], ["interval", "schedule"], [0.5, 0.8], intervals=8)


def points(frontier: Comparison) -> dict[tuple[str, str], MeasuredPoint]:
    return {(point.series, point.name): point for point in frontier.points}


def test_proposers_take_part_on_the_same_calls(frontier: Comparison) -> None:
    found = points(frontier)
    assert list(found)[2:] == [("interval", "0.5"), ("interval", "0.8"), ("schedule", "0.5"), ("schedule", "0.8")]
    half, same = found["this artifact", "half"], found["interval", "0.5"]
    assert (half.error, half.distance) == (same.error, same.distance)  # one plan under two names
    assert half.sparsity == same.sparsity == 0.5
    assert found["interval", "0.8"].error != same.error
    own, interval = found["schedule", "0.8"], found["interval", "0.8"]
    assert (own.error or 1.0) < (interval.error or 0.0)  # its correction is there
    assert own.distance < interval.distance


def test_what_cannot_be_asked_for_is_refused(planned: Path, recording: Path) -> None:
    with pytest.raises(CalibrationError, match="'magic' proposes no schedules; expected one of schedule, tts"):
        compare(planned, [recording], ["magic"], [0.5])
    with pytest.raises(CalibrationError, match=r"at most 0\.9 of the 10 x 6"):
        compare(planned, [recording], ["schedule"], [0.95])


def test_rivals_take_part_with_a_correction_of_their_own(planned: Path, recording: Path) -> None:
    found = points(compare(planned, [recording], ["interval"], [0.5], calls=8, learned=400, correct=True))
    plain, corrected = found["interval", "0.5"], found["interval, corrected", "0.5"]
    assert corrected.sparsity == plain.sparsity
    assert (corrected.error or 1.0) < 0.7 * (plain.error or 0.0)
    assert corrected.distance < 0.7 * plain.distance


def test_a_plan_that_cannot_be_corrected_is_left_out_with_the_reason(
    planned: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Task, found: Found) -> Found:
        raise CalibrationError("reads residuals of earlier calls")

    monkeypatch.setattr(Task, "corrected", refuse)
    found = compare(planned, [recording], ["interval"], [0.5], calls=4, correct=True)
    assert found.skipped == {"interval, corrected 0.5": "reads residuals of earlier calls"}
    assert ("interval", "0.5") in points(found)


class Gone(Exception):
    """Stands for whatever ends a comparison: nothing of the package catches it."""


def interrupted_after(searches: int, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The next comparison ends when it begins another search; the names of all searches since."""
    begun = list[str]()

    def search(name: str, *arguments: Any) -> Any:
        if len(begun) == searches:
            raise Gone
        begun.append(name)
        return plan_of(name, *arguments)

    monkeypatch.setattr("searches.plan_of", search)
    return begun


def test_an_interrupted_comparison_goes_on_to_the_same_outcome(
    planned: Path, frontier: Comparison, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def again(**options: Any) -> Comparison:
        return compare(planned, [recording], ["interval", "schedule"], [0.5, 0.8], calls=8, intervals=8, **options)

    interrupted_after(3, monkeypatch)
    with pytest.raises(Gone):
        again()
    assert (planned / "comparison-state.safetensors").exists()
    assert ttscompile.load(planned).info.identity == load_artifact(planned).manifest.identity  # it is no part of it
    with pytest.raises(CalibrationError, match="the comparison that was interrupted had other settings: seed was 0"):
        again(seed=1, resume=True)

    answer, answered = Runner.run_dense, list[int]()

    def counting(self: Runner, calls: Calls) -> torch.Tensor:
        answered.append(calls.count)
        return answer(self, calls)

    monkeypatch.setattr(Runner, "run_dense", counting)
    begun = interrupted_after(9, monkeypatch)
    found, expected = points(again(resume=True)), points(frontier)
    assert begun == ["schedule"]
    assert sum(answered) == 8 * DRAWS, "what is learned from is known"
    for key, point in found.items():
        assert replace(point, latency_ms=0.0, quartiles_ms=(0.0, 0.0)) == replace(
            expected[key], latency_ms=0.0, quartiles_ms=(0.0, 0.0)
        )
    assert not (planned / "comparison-state.safetensors").exists()


def test_without_resume_it_begins_anew(planned: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(planned)
    interrupted_after(1, monkeypatch)
    with pytest.raises(Gone):
        compare(planned, [recording], ["interval"], [0.5, 0.8], calls=1)
    begun = interrupted_after(9, monkeypatch)
    compare(planned, [recording], ["interval"], [0.5, 0.8], calls=1)
    assert begun == ["interval", "interval"]
    assert contents(planned) == before, "a comparison that came to its end leaves nothing"


def test_why_there_is_no_plan_is_kept_too_and_a_damaged_state_is_refused(
    planned: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def again() -> Comparison:
        return compare(planned, [recording], ["deepcache", "interval"], [0.8], calls=1, resume=True)

    interrupted_after(1, monkeypatch)
    with pytest.raises(Gone):
        again()
    state = planned / "comparison-state.safetensors"
    content = state.read_bytes()
    state.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(CalibrationError, match="Compare again without --resume: that begins anew"):
        again()
    state.write_bytes(content)
    begun = interrupted_after(9, monkeypatch)
    found = again()
    assert {point.series for point in found.points} == {"this artifact", "interval"}
    assert "computes at least 24 of the 10 x 6 cells" in found.skipped["deepcache 0.8"]
    assert begun == ["interval"]


@pytest.mark.parametrize(
    "searches",
    [
        [],
        {"interval 12": []},
        {"interval 12": {"interval": 3}},
        {"interval 12": {"interval": {"notes": {}, "error": "x", "cut": 0}}},
    ],
)
def test_a_state_that_was_forged_is_refused(tmp_path: Path, searches: Any) -> None:
    def resumed() -> None:
        state = ComparisonState(tmp_path, {})
        assert state.load()
        Searches(state, (10, 6)).known("interval", 12)

    state = ComparisonState(tmp_path, {})
    state.save()
    resumed()
    state.progress = {"searches": searches}
    state.save()
    with pytest.raises(CalibrationError, match="does not fit this comparison .* Compare again without --resume"):
        resumed()


def test_a_zipped_artifact_is_compared_and_keeps_nothing(planned: Path, recording: Path, tmp_path: Path) -> None:
    zipped = Path(shutil.make_archive(str(tmp_path / "compiled"), "zip", planned))
    found = compare(zipped, [recording], ["interval"], [0.5], calls=1)
    assert "nothing was kept for --resume: its artifact is no directory." in found.warnings
    assert [path.name for path in tmp_path.iterdir()] == ["compiled.zip"]


def test_it_says_when_a_search_had_too_little_time_or_too_few_calls(planned: Path, recording: Path) -> None:
    found = compare(
        planned, [recording], ["schedule", "interval", "teacache"], [0.8], calls=1, learned=8, max_minutes=0
    )
    assert [point.series for point in found.points] == ["this artifact"] * 2 + ["schedule", "interval"]
    assert found.skipped["teacache 0.8"].startswith("the time limit ended the search for a threshold of 'teacache'")
    assert found.warnings[1] == "the limit of 0 minutes cut the search short of schedule 0.8: see --max-minutes."
    assert "schedule fits corrections of 48 features from at most 8 calls" in found.warnings[2]


def test_it_says_who_does_not_take_part_as_he_is(planned: Path, recording: Path) -> None:
    found = compare(planned, [recording], ["tts-paper"], [0.5], calls=1, learned=8, intervals=1)
    assert [point.series for point in found.points] == ["this artifact"] * 2 + ["tts-paper"]
    assert found.warnings[1].startswith("tts-paper: one plan for all calls takes part")
    found = compare(planned, [recording], ["interval"], [], calls=1)
    assert found.warnings[1] == "no proposer takes part: no share of the cells was given for K = 10."


def test_a_comparison_whose_cluster_goes_goes_on_in_this_process(
    artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four parts of the dense calls, then two of the four searches; the others come next, and the held-out calls."""

    def compared(pool: Elsewhere | Here, **options: Any) -> Any:
        monkeypatch.setattr("searches.opened_pool", lambda address: nullcontext(pool))
        options = {"calls": 4, "learned": 64, "intervals": 3, "ray": "an address", **options}
        return compare(artifact, [recording], ["schedule", "interval"], [0.6, 0.7], **options)

    with pytest.raises(ClusterError, match="is gone"):
        compared(Elsewhere(3, 6))
    rest = Elsewhere(1)
    found, expected = compared(rest, resume=True), compared(Here())
    assert rest.done == 2 + 2  # searches, and what the original answers: once to time it, and the rest
    here, there = (
        [(p.series, p.name, p.sparsity, p.error, p.distance) for p in one.points] for one in (found, expected)
    )
    assert len(here) == 5
    assert here == there


@needs_ray
@pytest.mark.filterwarnings("ignore")
def test_a_comparison_on_ray_finds_the_same_plans(
    ray_pool: RayPool, artifact: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextmanager
    def opened(address: str | None) -> Iterator[Any]:
        yield Here() if address is None else ray_pool

    monkeypatch.setattr("searches.opened_pool", opened)
    found = [
        compare(
            artifact, [recording], ["schedule", "interval"], [0.6, 0.7], calls=4, learned=64, intervals=3, ray=address
        )
        for address in (None, "an address")
    ]
    here, there = ([(p.series, p.name, p.sparsity, p.error) for p in one.points] for one in found)
    assert len(here) == 5
    assert here == there
    assert found[0].skipped == found[1].skipped
