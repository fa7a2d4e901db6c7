"""The report: one page that needs nothing else, says what was measured, and lets no name of the artifact's act."""

import base64
import json
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from PIL import Image

import ttscompile
from tests.plans import store_schedules
from ttscompile.artifact.load import load_artifact
from ttscompile.cli import main
from ttscompile.core.lattice import Source, uniform_plan
from ttscompile.errors import ReportError
from ttscompile.measure.units import plain
from ttscompile.report import Extras, build, facts, pictures, render, verified
from ttscompile.report.page import Table
from ttscompile.report.timing import Measurement
from ttscompile.report.usage import run_episode
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.trajectories import Episode
from ttscompile.verification import Rung, Verification
from ttscompile.verification.rung import ErrorMap

HOSTILE = """<script>alert(1)</script>"><img src=x onerror=alert(2)>'{{ 7 * 7 }}$\\frac{"""
VOID = {"meta", "img", "link", "br", "hr", "input"}
SCORE = {"distance": 0.2, "error": 1.5, "error_p90": 2.5, "sparsity": 0.6, "flops_saved": 0.5}


class Reader(HTMLParser):
    """Tags with their attributes, and the text; fails where tags are not closed in order."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.parents: dict[int, list[str]] = {}
        self.text = ""
        self._open: list[str] = []
        self.feed(page)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.parents[len(self.tags)] = list(self._open)
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def of(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def calibrated(toy_compiled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy with two schedules, one of which reads the call before, and a record."""
    directory = tmp_path_factory.mktemp("report") / "calibrated"
    shutil.copytree(toy_compiled, directory)
    rollout = np.full((5, 5), Source.ROLLOUT, np.int8)
    rollout[0] = Source.COMPUTE
    record = {"learned": ["schedule"], "plans": {"schedule": SCORE, "fast": {**SCORE, "error": 9.0}}, "steps": [0, 2]}
    store_schedules(directory, None, {"schedule": uniform_plan(5, 5, 2), "fast": rollout}, "schedule", record)
    return directory


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of four and three calls."""
    path = tmp_path_factory.mktemp("calls") / "calls.npz"
    obs = np.random.default_rng(0).standard_normal((7, 2)).astype(np.float32)
    np.savez(path, obs=obs, episode_ends=np.array([4, 7]))
    return path


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["inspect", *(str(a) for a in arguments)], catch_exceptions=False)


def pictures_of(reader: Reader) -> list[np.ndarray]:
    encoded = [image["src"].removeprefix("data:image/png;base64,") for image in reader.of("img")]
    return [np.asarray(Image.open(BytesIO(base64.b64decode(one))).convert("RGB")) for one in encoded]


@pytest.fixture(scope="module")
def page(calibrated: Path, calls: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    output = tmp_path_factory.mktemp("page") / "report.html"
    result = run(calibrated, "-o", output, "--trajectories", calls, "--verify")
    assert result.exit_code == 0, result.stderr
    assert load_artifact(calibrated).manifest.short_identity in result.stdout
    assert [path.name for path in output.parent.iterdir()] == ["report.html"], "nothing is left beside it"
    return output.read_text()


@pytest.mark.slow
def test_the_page_is_whole_and_needs_nothing_else(page: str) -> None:
    reader = Reader(page)
    assert page.startswith("<!doctype html>")
    assert not {"script", "link", "iframe", "object", "base", "form"} & {tag for tag, _ in reader.tags}
    assert all(image["src"].startswith("data:image/png;base64,") and image["alt"] for image in reader.of("img"))
    anchors = {attributes["id"] for _, attributes in reader.tags if "id" in attributes}
    assert {link["href"].removeprefix("#") for link in reader.of("a")} == anchors
    assert "url(" not in page
    assert "://" not in page
    policy = next(m["content"] for m in reader.of("meta") if m.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'")


@pytest.mark.slow
def test_the_page_can_be_read_on_a_phone_and_in_the_dark(page: str) -> None:
    reader = Reader(page)
    assert any("width=device-width" in m.get("content", "") for m in reader.of("meta"))
    assert "prefers-color-scheme: dark" in page
    assert "overflow-x: auto" in page
    for i, (tag, _) in enumerate(reader.tags):
        if tag == "table":
            assert reader.parents[i][-1] == "div", "a wide table scrolls by itself, not the page"
        if tag == "img":
            assert "div" not in reader.parents[i], "a picture fits, and can be enlarged as a whole"
    assert "figure img { display: block; max-width: 100%; height: auto; background: #ffffff" in page


def test_the_page_says_what_was_found(page: str, calibrated: Path) -> None:
    text = Reader(page).text
    manifest = load_artifact(calibrated).manifest
    for expected in (
        manifest.identity,
        "Hoisting",
        "once a call, 5 steps in one batch",
        "schedule (default)",
        "4 consecutive calls of calls.npz[0]",
        "ms a call",
        "on the frontier",
        "Could not be run",
        "Plan 'schedule' is",
        "calls.npz[",
        "in the middle",
        "K = 5 denoising steps",
        "at most 80.0% of the cells",
        "the first call after reset() falls back",
    ):
        assert expected in text, expected
    drawn = pictures_of(Reader(page))
    assert len(drawn) == 5, "frontier, 2 schedules, furthest calls, latency"
    assert all(len(set(map(tuple, picture[::3, ::3].reshape(-1, 3)))) > 3 for picture in drawn), "a picture is empty"


def test_words_are_set_to_the_left_and_figures_to_the_right() -> None:
    table = Table(
        ("", "made", "ms", "quartiles", "of it"), (("0", "schedule", "1", "1..2", ""), ("1", "", "2", "", ""))
    )
    assert table.text == (True, True, False, False, False)
    assert Table(("", ""), (("steps", "5"),), prose=True).text == (True, True)


def test_a_record_is_told_without_brackets() -> None:
    assert plain({"safe_plan": [0, 9], "b": {}}) == "safe plan 0, 9; b none"
    assert (plain(0.123456), plain([]), plain("a_b"), plain(None)) == ("0.1235", "none", "a_b", "None")


@pytest.mark.slow
def test_hostile_names_stay_text(calibrated: Path) -> None:
    artifact = load_artifact(calibrated)
    manifest = artifact.manifest
    spec = replace(manifest.spec, source={HOSTILE: HOSTILE}, sampler=replace(manifest.spec.sampler, name=HOSTILE))
    blocks = tuple(replace(block, kind=HOSTILE, reason=HOSTILE) for block in manifest.blocks)
    record: dict[str, Any] = {HOSTILE: HOSTILE, "plans": {HOSTILE: SCORE}, "skipped": {HOSTILE: HOSTILE}}
    record |= {"told": {HOSTILE: HOSTILE}, "learned": [HOSTILE, HOSTILE]}
    tried = {"name": HOSTILE, "told": HOSTILE, "distance": 0.1, "interval": [0.0, 0.2], "milliseconds": 1.0}
    record |= {"frontier": [{**tried, "worst": 2.0, "near": True}], "default_plan": HOSTILE}
    plans = {HOSTILE: manifest.plans["schedule"]}
    manifest = replace(manifest, spec=spec, blocks=blocks, plans=plans, default_plan=HOSTILE, calibration=record)
    artifact = replace(
        artifact, manifest=manifest, plans={HOSTILE: artifact.plans["schedule"], "dense": artifact.plans["dense"]}
    )
    policy = CompiledPolicy(artifact, open_runtime(artifact), seed=0)
    obs = {"obs": np.zeros((2, 2), np.float32)}
    rung = Rung(HOSTILE, "failed", HOSTILE, unit=HOSTILE, remedy=HOSTILE, step=3, blocks=(1, 2))
    errors = ErrorMap(np.arange(2), np.full((2, 5), 1e-3), 1e-5, (HOSTILE,) * 5, HOSTILE, np.eye(2, 5, dtype=np.bool_))
    found = Verification(HOSTILE, None, None, (rung,), 1.0, errors)
    given = Extras(Episode(HOSTILE, obs), verified(found), calls=1)
    page = render(build(artifact, policy, given))
    reader = Reader(page)
    assert "script" not in {tag for tag, _ in reader.tags}
    assert all(image["src"].startswith("data:") and "onerror" not in image for image in reader.of("img"))
    assert not any(name.startswith("on") for _, attributes in reader.tags for name in attributes)
    assert reader.text.count(HOSTILE) >= 10, "it is shown, as text"
    assert f"Crosses: cells of plan {HOSTILE!r}" in reader.text


def test_a_check_that_failed_is_told_and_is_the_exit_status(
    toy_compiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rung = Rung("one block", "failed", "block 2 differs", 0.5, 1e-4, "relative", "Convert it again.", 1, (2,))
    found = Verification("compiled", None, None, (rung,), 1.0)
    monkeypatch.setattr(ttscompile, "verify", lambda *_, **__: found, raising=False)
    result = run(toy_compiled, "-o", tmp_path / "r.html", "--verify")
    assert result.exit_code == 1
    text = Reader((tmp_path / "r.html").read_text()).text
    assert "FAILED at one block. Convert it again." in text
    assert "First at step 1, block 2." in text


@pytest.mark.slow
def test_arrays_of_other_names_reach_the_episode_and_the_checks(
    calibrated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = tmp_path / "frames.npz"
    state = np.random.default_rng(0).standard_normal((6, 3)).astype(np.float32)
    np.savez(frames, state=state, episode_ends=np.array([6]), meta=json.dumps({"frames": True}))
    given: list[Any] = []

    def verify(directory: Path, trajectories: Any, *, sources: Any, **_: Any) -> Verification:
        given.extend((directory, trajectories, sources))
        return Verification("compiled", None, None, (Rung("one block", "passed", "it holds"),), 1.0)

    monkeypatch.setattr(ttscompile, "verify", verify, raising=False)
    options = ("--trajectories", frames, "--observation", "obs=state:2", "--verify")
    result = run(calibrated, "-o", tmp_path / "r.html", *options)
    assert result.exit_code == 0, result.stderr
    assert given == [calibrated, (frames,), {"obs": ("state:2",)}]
    text = Reader((tmp_path / "r.html").read_text()).text
    assert "consecutive calls of frames.npz[0]" in text
    assert "All rungs hold" in text


def test_text_in_pictures_is_no_formula() -> None:
    assert pictures.plain("$\\frac{\x00\u202e") == "?\\frac{??"
    assert len(pictures.plain("x" * 1000)) == 60


def test_a_bar_is_as_long_as_the_call_that_is_written_beside_it() -> None:
    """What is no part of the prologue, the loop or the wait is grey: here half of a call."""
    parts = {"prologue": 1.0, "frames": 0.0, "pruner": 0.0, "wait_pruner": 0.0, "decode": 4.0}
    drawn = pictures.latency_picture([Measurement("a", "a", (10.0,), parts)])
    pixels = np.asarray(Image.open(BytesIO(drawn)).convert("RGB"))[:150]  # without the legend
    grey, orange = (int((pixels == of).all(-1).sum()) for of in ((0x99,) * 3, (0xD5, 0x5E, 0x00)))
    assert grey / orange == pytest.approx(5 / 4, rel=0.05)


def test_an_artifact_that_is_zipped_is_called_by_its_own_name(toy_compiled: Path, tmp_path: Path) -> None:
    path = shutil.make_archive(str(tmp_path / "zipped"), "zip", toy_compiled)
    assert json.loads(run(path, "--json").stdout)["path"] == path
    assert "ttscompile-" not in run(path).stdout


def test_an_artifact_that_is_not_calibrated(toy_compiled: Path, tmp_path: Path) -> None:
    assert run(toy_compiled, "-o", tmp_path / "r.html").exit_code == 0
    text = Reader((tmp_path / "r.html").read_text()).text
    assert "Not run for this page" in text
    assert "Not calibrated: every call is dense" in text
    assert "calibrate the artifact first" in text
    assert "in which a plan is furthest from the original: ttscompile inspect DIR -o page.html -t calls.npz" in text


def test_a_report_replaces_another_only_when_it_is_whole(
    calibrated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "r.html").write_text("old")

    def fail(*_: Any) -> Any:
        raise ReportError("in the middle")

    monkeypatch.setattr(facts, "provenance", fail)
    assert run(calibrated, "-o", tmp_path / "r.html").exit_code == 2
    assert (tmp_path / "r.html").read_text() == "old"


def test_bad_input_is_one_message(calibrated: Path, tmp_path: Path) -> None:
    result = run(calibrated, "-o", tmp_path / "no" / "r.html")
    assert (result.exit_code, "cannot be written" in result.stderr) == (2, True)
    result = run(tmp_path, "-o", tmp_path / "r.html")
    assert (result.exit_code, "not an artifact" in result.stderr) == (2, True)


def test_what_an_episode_executed_is_counted_by_hand(calibrated: Path) -> None:
    policy = ttscompile.load(calibrated, seed=0, plan="fast")
    course = run_episode(policy, Episode("one", {"obs": np.zeros((4, 2), np.float32)}))
    assert course.legalised == (20, 20, 20, 20), "nothing was ever computed there, so all fall back to TIMESTEP"
    np.testing.assert_allclose(course.sparsity, 0.8)


@pytest.mark.parametrize("package", ["jinja2", "matplotlib"])
def test_what_is_missing_is_named(
    package: str, calibrated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    result = run(calibrated, "-o", tmp_path / "r.html")
    assert result.exit_code == 2
    assert package in result.stderr
    assert "'ttscompile[compile]'" in result.stderr
