"""The worked examples of ``docs/extending``: files, rows and tests as they stand on the pages, in their places."""

from __future__ import annotations

import re
import shutil
import sys
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tests.calibration import policies, tasks
from tests.once import Once
from tests.pages import EXTENDING, ROOT, examples, load
from ttscompile.calibration import proposers, sparse_loop
from ttscompile.calibration.pipeline import calibrate
from ttscompile.frontends import families
from ttscompile.frontends.settings import Settings
from ttscompile.policies.lerobot import vla
from ttscompile.runtimes import open as open_module
from ttscompile.runtimes.reference.sampler import through
from ttscompile.samplers import flow


def guide(page: str) -> list[str]:
    """The Python files that a worked example shows, in order."""
    shown = [block for block in examples.blocks(EXTENDING / f"{page}.md") if block.language == "python"]
    return ["\n".join(block.lines) + "\n" for block in shown]


def contributed(text: str, name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A file of the guide as a module, which is taken out again after the test."""
    monkeypatch.setitem(sys.modules, name, None)
    file = folder / f"{name}.py"
    file.write_text(text)
    return load(file, name)


def test_the_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both files as they stand in the guide, in the place that it gives them."""
    written, its_test = guide("pass")
    contributed(written, "ttscompile.passes.drop_unit_scale", tmp_path, monkeypatch)
    test = contributed(its_test, "contributed_test", tmp_path, monkeypatch)
    test.test_a_multiplication_by_one_is_gone_and_the_numbers_stay()
    near_misses = test.test_what_is_not_by_one_or_is_an_output_stays
    cases = near_misses.pytestmark[0].args[1]
    assert len(cases) == 2
    for graph in cases:
        near_misses(graph)


@pytest.mark.slow
def test_the_policy_family(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its module, its row and its test as they stand in the guide."""
    module, row, its_test = guide("family")
    rows = eval(f"({row})", vars(families).copy())
    monkeypatch.setattr(families, "FAMILIES", (*rows, *families.FAMILIES))
    contributed(module, "ttscompile.policies.action_dit", tmp_path, monkeypatch)
    test = contributed(its_test, "contributed_test", tmp_path, monkeypatch)
    for name in ("compiled", "options"):
        (tmp_path / name).mkdir()
    test.test_the_compiled_policy_is_the_network_that_was_saved(tmp_path / "compiled")
    test.test_options_of_other_families_are_refused(tmp_path / "options")
    refused = test.test_a_file_that_is_no_such_policy_is_refused
    cases = refused.pytestmark[0].args[1]
    assert len(cases) == 5
    for changes, message in cases:
        refused(tmp_path, changes, message)


@pytest.mark.slow
def test_the_rival(once: Once, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module, its row and its test as they stand in the guide."""
    written, row, its_test = guide("rival")
    contributed(written, "ttscompile.rivals.ends", tmp_path, monkeypatch)
    monkeypatch.setattr(proposers, "PROPOSERS", (eval(row, vars(proposers)), *proposers.PROPOSERS))
    test = contributed(its_test, "contributed_test", tmp_path, monkeypatch)
    make_task = partial(tasks.make_task, policies.compiled(once), policies.record(tmp_path / "calls.npz"))
    test.test_whole_steps_are_at_both_ends_where_the_calls_want_them(make_task)
    for budget in test.test_a_budget_of_one_step_leaves_step_0.pytestmark[0].args[1]:
        test.test_a_budget_of_one_step_leaves_step_0(make_task, budget)


@pytest.mark.slow
def test_the_proposer(once: Once, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module, its row and its test as they stand in the guide."""
    written, row, its_test = guide("proposer")
    contributed(written, "ttscompile.calibration.proposers.fewer", tmp_path, monkeypatch)
    monkeypatch.setattr(proposers, "PROPOSERS", (*proposers.PROPOSERS, eval(row, vars(proposers))))
    test = contributed(its_test, "contributed_test", tmp_path, monkeypatch)
    directory = shutil.copytree(policies.compiled(once), tmp_path / "compiled")
    recording = policies.record(tmp_path / "calls.npz")
    test.test_the_step_that_matters_least_is_left_out(directory, recording)
    test.test_of_step_0_alone_nothing_is_left_out(directory, recording)
    learned = ("schedule", "fewer")
    result = calibrate(directory, [recording], 0.6, learn=learned, max_distance=9.0, progress=False)
    assert result.default_plan == "fewer"
    assert result.plans["fewer"].sparsity == pytest.approx(result.plans["schedule"].sparsity + 0.1)
    assert result.told["fewer"].endswith("is left out")


def test_the_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module, its row and its test as they stand in the guide; and what ``--sampler`` makes of it."""
    written, row, its_test = guide("loop")
    module = contributed(written, "ttscompile.samplers.midpoint", tmp_path, monkeypatch)
    for name, method in eval(row, vars(flow) | vars(module)).items():
        monkeypatch.setitem(flow.METHODS, name, method)
    test = contributed(its_test, "contributed_test", tmp_path, monkeypatch)
    test.test_a_step_evaluates_the_network_twice()
    test.test_it_is_of_second_order()
    test.test_it_bounds_nothing()
    asked = vla._sampler(Settings({}, "config.json: "), families.LoadOptions("midpoint", 5))
    assert (asked.name, asked.steps) == ("midpoint", 10)


def test_the_term(once: Once, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module, its row and its test as they stand in the guide; a fitted correction has the term."""
    written, row, its_test = guide("term")
    module = contributed(written, "ttscompile.calibration.linear_term", tmp_path, monkeypatch)
    test = contributed(its_test, "contributed_test", tmp_path, monkeypatch)
    test.test_what_is_linear_is_found_in_the_form_of_a_jump()
    test.test_what_is_not_there_on_other_episodes_is_no_term()
    rows = eval(row, vars(sparse_loop) | vars(module))
    assert rows == (*sparse_loop.TERMS, module.fit_linear)

    def held(fit: Any, known: Any, missing: Any, episodes: Any) -> Any:
        layers = fit(known, missing)
        return layers, through(layers, known)

    monkeypatch.setattr(module, "on_other_episodes", held)  # this policy leaves nothing over that is linear
    monkeypatch.setattr(sparse_loop, "TERMS", rows[-1:])
    task = tasks.make_task(policies.compiled(once), policies.record(tmp_path / "calls.npz"), calls=60)
    some, others = (task.runner.select(task.calls, part) for part in (range(40), range(40, 60)))
    loop = sparse_loop.SparseLoop(task.runner, some, others, reads=True, whole=True)
    place = loop.ends(task.whole.plan([0, 6]))[1]
    correction = loop.correction(place)
    assert correction is not None and list(correction.landings) == [5]
    assert np.count_nonzero(correction.inner[0].any(0)) == 2 * 16  # of the numbers of a chunk, either sign
    ran = task.runner.corrected(correction).run(task.whole.plan([0, 6]), others)
    np.testing.assert_allclose(place.samples, ran, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_the_runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its module, how it is opened, its row and its test as they stand in the guide."""
    module, opening, row, its_test = guide("runtime")
    contributed(module, "ttscompile.runtimes.resolved", tmp_path, monkeypatch)
    names = vars(open_module).copy()
    exec(opening, names)
    for name, kind in eval(f"{{{row}}}", names).items():
        monkeypatch.setitem(open_module.RUNTIMES, name, kind)
    test = contributed(its_test, "contributed_test", tmp_path, monkeypatch)
    agrees = test.test_it_agrees_with_the_reference
    for streams in agrees.pytestmark[0].args[1]:
        agrees(tmp_path / str(streams), streams)
    test.test_the_pruners_plan_and_reuse_over_calls(tmp_path / "pruned")


MOST_FILES = {"pass": 2, "family": 3, "proposer": 2, "rival": 2, "loop": 2, "term": 3, "runtime": 3}
"""That a contributor changes beside tests and docs, where no package of its own is needed."""


def test_few_files_change_and_the_pages_name_them() -> None:
    rows = re.findall(r"^\| \[[^]]+\]\((\w+)\.md\) \| [^|]+ \| ([^|]+) \|$", (EXTENDING / "index.md").read_text(), re.M)
    assert {name for name, _ in rows} == MOST_FILES.keys()
    for name, files in rows:
        without, _, _ = files.partition("; with")  # a package of its own is told in further files
        named = [file for file in re.findall(r"`([^`]+)`", without) if file.endswith(".py")]
        assert all((ROOT / file).is_file() for file in named)
        assert 1 + len(named) <= MOST_FILES[name], "its module, and these"
        page = (EXTENDING / f"{name}.md").read_text()
        assert all(file in page for file in named), f"{name}.md says where its row goes"
