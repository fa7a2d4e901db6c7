"""``ttscompile bench --choose``: the default of another machine, without another calibration."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

import ttscompile
from tests.calibration import policies
from tests.commands import as_json, done, refused, run
from tests.plans import store_schedules
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.write import choose_default
from ttscompile.cli.bench import NONE_KEEPS, choosable, choose_again
from ttscompile.core.lattice import uniform_plan
from ttscompile.errors import ArtifactError
from ttscompile.measure.points import fastest
from ttscompile.report import facts
from ttscompile.report.timing import Measurement

PLANS = {"schedule": 0.08, "safe": 0.03, "fast": 0.2, "uniform": 0.01, "far": 0.4}
"""How far each is from the original; ``far`` is beyond what is offered."""


def score(distance: float, most: float | None = None) -> dict[str, Any]:
    interval = [0.0, distance if most is None else most]
    return {"distance": distance, "interval": interval, "sparsity": 0.6, "flops_saved": 0.6}


@pytest.fixture
def built(toy_compiled: Path, tmp_path: Path) -> Path:
    return made(toy_compiled, tmp_path, {name: score(distance) for name, distance in PLANS.items()})


def made(toy: Path, folder: Path, scores: Mapping[str, Any], default: str = "schedule", **record: Any) -> Path:
    directory = shutil.copytree(toy, folder / "built")
    cells = {name: uniform_plan(5, 5, 1 + number % 4) for number, name in enumerate(scores)}
    store_schedules(directory, None, cells, default, {"learned": ["schedule"], "plans": scores, **record})
    return directory


def bench(directory: Path, *options: object) -> Result:
    return run("bench", directory, "--calls", 2, "--choose", *options)


def timed(**milliseconds: float | tuple[float, ...]) -> list[Measurement]:
    pairs = milliseconds.items()
    return [Measurement(name, name, took if isinstance(took, tuple) else (took,)) for name, took in pairs]


def again(directory: Path, measured: list[Measurement], deadline: float | None = None) -> tuple[str | None, Artifact]:
    told = choose_again(directory, load_artifact(directory), measured, deadline, 1)
    return told, load_artifact(directory)


def test_the_fastest_that_is_near_or_the_nearest_of_those_that_are_as_fast() -> None:
    distances = {"a": 0.09, "b": 0.05, "c": 0.01}
    assert fastest({"a": 10.0, "b": 11.9, "c": 12.1}, distances) == "b"
    assert fastest({"a": 10.0, "b": 12.1, "c": 12.2}, distances) == "a"


def test_of_those_that_are_as_near_the_fastest() -> None:
    """A plan that takes a sixth longer has to be nearer by more than a fifth; one below 0 is no nearer than 0."""
    times = {"a": 10.0, "b": 11.7}
    assert fastest(times, {"a": 0.067, "b": 0.057}) == "a"
    assert fastest(times, {"a": 0.070, "b": 0.057}) == "b"
    assert fastest(times, {"a": 0.0, "b": -0.02}) == "a"


def test_another_machine_has_another_default(built: Path) -> None:
    told, after = again(built, timed(dense=9.0, schedule=4.0, safe=2.0, fast=1.0, uniform=0.1, far=0.2))
    assert told == "The default was 'schedule', and is 'safe'. schedule 4 ms, safe 2 ms, fast 1 ms."
    assert after.manifest.default_plan == "safe"
    record = after.manifest.calibration
    assert record is not None
    assert record["default_plan"] == "safe"
    assert record["chosen_by"] == "schedule 4 ms, safe 2 ms, fast 1 ms"
    assert record["timed_on"].endswith(", 1 thread")


def test_spare_plans_are_chosen_among_and_told_of_once(toy_compiled: Path, tmp_path: Path) -> None:
    """What a build keeps for other machines is in no table, until it is the default."""
    scores = {name: score(PLANS[name]) for name in ("schedule", "fast")} | {"original.3": score(0.02)}
    tried = {
        "told": "3 of 5",
        "distance": 0.02,
        "interval": [0.0, 0.02],
        "milliseconds": 1.0,
        "worst": 2.0,
        "near": True,
    }
    rows = [{**tried, "name": name, "near": True, "spare": name == "original.3"} for name in scores]
    directory = made(toy_compiled, tmp_path, scores, frontier=rows)

    def tables() -> tuple[set[str], str]:
        artifact = load_artifact(directory)
        shown = " ".join(facts.told_spare(artifact.manifest))
        return {row[0] for row in facts.plan_table(artifact).rows}, shown

    assert tables()[0] == {"dense", "schedule (default)", "fast"} and "it has 'original.3': " in tables()[1]
    assert "table: correction of original.3" not in done("inspect", directory).stdout
    told, _ = again(directory, timed(**{"schedule": 4.0, "fast": 3.0, "original.3": 2.0}))
    assert told is not None and told.startswith("The default was 'schedule', and is 'original.3'.")
    assert "original.3 (default)" in tables()[0] and tables()[1] == ""
    assert ttscompile.load(directory).info.default_plan == "original.3"


def test_the_same_times_choose_the_same(built: Path) -> None:
    before = load_artifact(built).manifest
    told, after = again(built, timed(schedule=1.0, safe=2.0, fast=0.5))
    assert told is not None
    assert told.startswith("The default is 'schedule'.")
    assert (after.manifest.default_plan, after.manifest.identity) == ("schedule", before.identity)


def test_with_a_deadline_it_is_the_nearest_whose_longest_call_keeps_it(built: Path) -> None:
    times = timed(schedule=(2.0, 2.5), safe=(2.0, 3.5), fast=(1.0, 1.0))
    assert again(built, times, 3.0)[1].manifest.default_plan == "schedule"
    assert again(built, times, 4.0)[1].manifest.default_plan == "safe"
    hundred = timed(schedule=2.0, safe=(2.0,) * 198 + (9.0,) * 2)
    assert again(built, hundred, 3.0)[1].manifest.default_plan == "safe", "99 of 100 calls keep it"


def test_where_none_keeps_the_deadline_nothing_is_changed(built: Path) -> None:
    before = (built / "manifest.json").read_bytes()
    assert again(built, timed(schedule=2.0, safe=3.0, fast=1.0), 0.5)[0] is None
    assert (built / "manifest.json").read_bytes() == before


def test_the_deadline_of_the_build_holds(toy_compiled: Path, tmp_path: Path) -> None:
    scores = {name: score(PLANS[name]) for name in ("schedule", "safe")}
    directory = made(toy_compiled, tmp_path, scores, budget={"latency_ms": 3.0})
    assert again(directory, timed(schedule=2.0, safe=4.0))[1].manifest.default_plan == "schedule"
    assert again(directory, timed(schedule=2.0, safe=2.9))[1].manifest.default_plan == "safe"


def test_a_plan_of_this_name_in_another_artifact_or_with_more_threads_is_not_this_one(built: Path) -> None:
    others = timed(schedule=0.1, safe=8.0)
    told, after = again(built, timed(schedule=4.0, safe=2.0) + others)
    assert told == "The default was 'schedule', and is 'safe'. schedule 4 ms, safe 2 ms."
    assert after.manifest.default_plan == "safe"


def test_the_bound_of_the_build_holds(toy_compiled: Path, tmp_path: Path) -> None:
    scores = {"schedule": score(0.18), "safe": score(0.05), "fast": score(0.6)}
    directory = made(toy_compiled, tmp_path, scores, budget={"max_distance": 0.2})
    assert list(choosable(load_artifact(directory))) == ["schedule", "safe"]
    assert again(directory, timed(schedule=1.0, safe=2.0))[1].manifest.default_plan == "schedule"


def test_a_plan_that_is_not_near_for_sure_has_to_be_asked_for(toy_compiled: Path, tmp_path: Path) -> None:
    directory = made(toy_compiled, tmp_path, {"schedule": score(0.08, 0.25), "safe": score(0.095), "fast": score(0.2)})
    times = timed(schedule=2.0, safe=2.0, fast=1.0)
    assert again(directory, times, 3.0)[1].manifest.default_plan == "safe"
    assert again(directory, times, 1.5)[0] is None
    assert choose_again(directory, load_artifact(directory), times, 1.5, 1, asked=True)
    assert load_artifact(directory).manifest.default_plan == "fast"


def test_where_no_plan_is_near_for_sure_one_has_to_be_named(toy_compiled: Path, tmp_path: Path) -> None:
    directory = made(toy_compiled, tmp_path, {"schedule": score(0.08, 0.25), "fast": score(0.2)}, "dense")
    told = refused("bench", directory, "--choose")
    assert "no plan is surely within 0.1 of the original. Evaluate one, and name it with --plan: schedule" in told
    assert bench(directory, "--plan", "schedule").exit_code == 0
    assert load_artifact(directory).manifest.default_plan == "schedule"


def test_a_plan_that_becomes_fp32_is_no_longer_told_to_be_in_eight_bits(tmp_path: Path) -> None:
    directory, spec = tmp_path / "mixer", policies.spec()
    ttscompile.compile_denoiser(policies.Mixer(0).eval(), spec, directory, precision="int8")
    tried = [{"name": name, "told": "int8 in blocks"} for name in ("schedule", "safe")]
    record = {"learned": ["schedule"], "plans": {"schedule": score(0.05)}, "frontier": tried}
    cells = {"schedule": uniform_plan(spec.sampler.steps, 6, 2)}
    store_schedules(directory, None, cells, "schedule", record)
    assert "int8" in load_artifact(directory).default.in_words()
    told, after = again(directory, [*timed(schedule=2.0), Measurement("fp32", "schedule@fp32", (1.0,))])
    assert told == "The default is 'schedule', in fp32. schedule 2 ms, schedule@fp32 1 ms."
    assert not after.default.precision
    rows = {row["name"]: row["told"] for row in (after.manifest.calibration or {})["frontier"]}
    assert rows == {"schedule": after.default.in_words(), "safe": "int8 in blocks"}
    assert "int8" not in rows["schedule"]
    eight = "schedule@int8+blocks"
    assert list(choosable(after)) == ["schedule", eight], "another machine may be faster in eight bits"
    told, after = again(directory, [*timed(schedule=2.0), Measurement("int8", eight, (1.0,))])
    assert told == f"The default is 'schedule', in int8. schedule 2 ms, {eight} 1 ms."
    assert dict(after.default.precision) == {"blocks": "int8"}
    assert list(choosable(after)) == ["schedule", "schedule@fp32"]


def test_a_plan_whose_limit_is_far_is_not_near(toy_compiled: Path, tmp_path: Path) -> None:
    scores = {"schedule": score(0.08), "safe": score(0.05, 0.3)}
    directory = made(toy_compiled, tmp_path, scores)
    assert choosable(load_artifact(directory)) == {"schedule": 0.08, "safe": 0.05}
    assert again(directory, timed(schedule=2.0, safe=1.0))[1].manifest.default_plan == "schedule"


def test_the_command_times_what_can_be_chosen(built: Path) -> None:
    document = as_json("bench", built, "--calls", 2, "--choose")
    assert [one["plan"] for one in document["contestants"]] == ["dense", "schedule", "safe", "fast"]
    assert document["chosen"].split("'")[-2] == load_artifact(built).manifest.default_plan in ("schedule", "safe")
    assert "chosen by" in done("inspect", built).stdout
    assert ttscompile.load(built).info.identity == load_artifact(built).manifest.identity


def test_a_control_loop_that_no_plan_keeps_up_with_is_exit_status_1(built: Path) -> None:
    before = (built / "manifest.json").read_bytes()
    result = bench(built, "--control-hz", 20000)
    assert result.exit_code == 1
    assert NONE_KEEPS.format("schedule") in result.stderr
    assert (built / "manifest.json").read_bytes() == before


def test_a_deadline_of_the_build_that_no_plan_keeps_is_told(toy_compiled: Path, tmp_path: Path) -> None:
    result = bench(made(toy_compiled, tmp_path, {"schedule": score(0.08)}, budget={"latency_ms": 1e-6}))
    assert (result.exit_code, "near enough keeps the deadline" in result.stderr) == (1, True)


def test_what_cannot_be_chosen_is_told_before_anything_is_timed(built: Path) -> None:
    told = refused("bench", built, "--choose", "--plan", "dense", "--plan", "far")
    assert "no --plan may be the default; expected one of schedule, safe, fast." in told
    zipped = shutil.make_archive(str(built.parent / "zipped"), "zip", built)
    assert "Unzip it and give the directory" in refused("bench", zipped, "--choose")


def test_without_a_calibration_there_is_nothing_to_choose(toy_compiled: Path) -> None:
    told = refused("bench", toy_compiled, "--choose")
    assert "no plan was judged to be within 0.25. Run 'ttscompile build'" in told


def test_another_artifact_that_took_its_place_is_left_alone(built: Path) -> None:
    seen = load_artifact(built)
    again(built, timed(schedule=4.0, safe=2.0, fast=1.0))
    with pytest.raises(ArtifactError, match="was replaced meanwhile"):
        choose_default(built, "schedule", {}, None, seen)
