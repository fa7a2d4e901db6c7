"""Figures of an evaluation, against numbers worked out by hand."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Self

import click
import evaluate
import jobs
import numpy as np
import pytest
from bootstrap import estimate, paired_difference
from click.testing import CliRunner
from driven import rows_of
from evaluate import evaluation_table, summarise, task_table
from rollout import Episode, Rollout

from tests.examples.printed import printed


def rollout(best: Sequence[float], first_seed: int = 100, tasks: Sequence[str] = ("",)) -> Rollout:
    episodes = tuple(
        Episode(
            seed=first_seed + i,
            task=tasks[i % len(tasks)],
            windows={"obs": np.zeros((3, 2, 20), np.float32)},
            actions=np.zeros((1, 2)),
            scores=np.array([min(coverage / 0.95, 1.0)]),
            success=coverage > 0.95,
            measures={"best coverage": coverage},
            sparsity=(0.5, 0.7),
            flops=(1e9, 3e9),
            legalised=(0, int(i == 0)),
        )
        for i, coverage in enumerate(best)
    )
    return Rollout(episodes, call_ms=(1.0,))


def test_estimate_of_equal_values_has_no_width() -> None:
    result = estimate([0.25, 0.25, 0.25])
    assert (result.mean, result.low, result.high) == (0.25, 0.25, 0.25)


def test_interval_of_many_values_is_the_normal_one() -> None:
    values = np.random.default_rng(1).normal(2.0, 1.0, size=400)
    result = estimate(values)
    half = 1.96 * values.std() / np.sqrt(400)
    assert result.mean == pytest.approx(values.mean())
    assert result.low == pytest.approx(values.mean() - half, abs=0.02)
    assert result.high == pytest.approx(values.mean() + half, abs=0.02)
    assert estimate(values) == result


def test_paired_difference_is_narrower_than_what_it_is_the_difference_of() -> None:
    hard = np.random.default_rng(2).uniform(0, 1, size=60)
    difference = paired_difference(hard + 0.1, hard)
    assert difference.mean == pytest.approx(0.1)
    assert difference.high - difference.low < 1e-9 < estimate(hard).high - estimate(hard).low


def test_paired_values_must_have_the_same_length() -> None:
    with pytest.raises(ValueError, match="zip"):
        paired_difference([1.0], [1.0, 2.0])


def test_figures_of_a_variant() -> None:
    dense = rollout([0.97, 0.76, 0.19])  # scores 1, 0.8, 0.2
    sparse = rollout([0.96, 0.38, 0.19])  # scores 1, 0.4, 0.2
    base = summarise("dense", dense, dense)
    other = summarise("sparse", sparse, dense)
    assert base.score.mean == pytest.approx(2 / 3)
    assert base.success.mean == pytest.approx(1 / 3)
    assert base.measures["best coverage"].mean == pytest.approx(0.64)
    assert base.score_difference is None
    assert other.score_difference is not None
    assert other.success_difference is not None
    assert other.score_difference.mean == pytest.approx(-0.4 / 3)
    assert other.score_difference.high == pytest.approx(0.0)
    assert other.success_difference.mean == 0.0
    assert other.sparsity == pytest.approx(0.6)
    assert other.flops == pytest.approx(2e9)
    assert other.legalised == 1


def test_variants_whose_paths_differ_at_the_end_are_told_apart_in_a_narrow_table() -> None:
    dense = rollout([0.97, 0.76])
    names = ("build/pusht/compiled:dense", "build/pusht/compiled:safe")
    table = evaluation_table("Push-T", [summarise(name, dense, dense) for name in names], range(100, 102))
    rows = "".join(line.split("│")[1].strip() for line in printed(table, 100) if line[:1] == "│")
    assert rows == "".join(names)


def test_other_seeds_are_not_paired() -> None:
    with pytest.raises(ValueError, match="other seeds"):
        summarise("sparse", rollout([0.5], first_seed=7), rollout([0.5]))


def test_table_and_json_say_the_same() -> None:
    dense, sparse = rollout([0.97, 0.76]), rollout([0.96, 0.38])
    evaluations = [summarise("dense", dense, dense), summarise("sparse", sparse, dense)]
    text = "\n".join(printed(evaluation_table("Push-T", evaluations, range(100, 102))))
    assert "seeds 100..101" in text
    assert "0.700" in text
    assert "-0.200" in text
    document = json.loads(json.dumps([e.to_json() for e in evaluations]))
    assert document[1]["score"]["mean"] == pytest.approx(0.7)
    assert document[1]["score_difference"]["mean"] == pytest.approx(-0.2)
    assert [e["seed"] for e in document[1]["episodes"]] == [100, 101]
    assert document[0]["score_difference"] is None


def test_many_tasks_have_a_row_each() -> None:
    tasks = ("reach", "push")
    dense, sparse = rollout([0.97, 0.97, 0.97, 0.2], tasks=tasks), rollout([0.97, 0.2, 0.97, 0.97], tasks=tasks)
    one, other = summarise("dense", dense, dense), summarise("sparse", sparse, dense)
    assert list(one.tasks) == ["push", "reach"]
    assert one.tasks["reach"].success.mean == 1.0
    assert one.tasks["push"].success_difference is None
    assert (push := other.tasks["push"].success_difference) is not None
    assert push.mean == 0 and -1 < push.low < -0.5 and 0.5 < push.high < 1  # of two episodes each way
    assert (reach := other.tasks["reach"].score_difference) is not None and reach.mean == 0.0
    rows = [[c.strip() for c in line.split("│")[1:-1]] for line in printed(task_table([one, other]), 150)]
    assert ["push", "2", "0.500", f"0.500, {push}"] in rows
    assert ["reach", "2", "1.000", f"1.000, {other.tasks['reach'].success_difference}"] in rows
    document = json.loads(json.dumps(other.to_json()))
    assert document["tasks"]["push"]["episodes"] == 2
    assert document["tasks"]["push"]["success"]["mean"] == 0.5
    assert [e["task"] for e in document["episodes"]] == ["reach", "push", "reach", "push"]
    assert document["measures"]["best coverage"]["mean"] == pytest.approx(0.7775)


def test_one_task_has_no_table_of_its_own() -> None:
    dense = rollout([0.97, 0.76])
    assert summarise("dense", dense, dense).tasks == {}


class Cluster:
    """Stands for one of Ray's, which opens parts from what is sent."""

    count = 2
    asked: ClassVar[list[Any]] = []

    def __init__(self, address: str) -> None:
        Cluster.asked = [address]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        Cluster.asked.append("left")

    def map(self, work: Any, parts: Any) -> Iterator[Any]:
        run = work.elsewhere(*work.given)
        for part in parts:
            Cluster.asked.append(list(part[1]))
            yield run(part)


@pytest.mark.slow
def test_a_cluster_runs_the_episodes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tiny_artifact: Path) -> None:
    def evaluated(make: Any, opened: Any, seeds: Any, batch: Any, finished: Any, caches: Any) -> None:
        raise click.ClickException(f"kept: {[cache.read(seed).seed for cache in caches for seed in seeds]}")

    monkeypatch.setattr(evaluate, "RayPool", Cluster)
    monkeypatch.setattr(evaluate, "evaluate", evaluated)
    monkeypatch.setattr(jobs, "_run", lambda _, __, part: [rollout([0.5], seed).episodes[0] for seed in part[1]])
    words = [
        str(tiny_artifact),
        "--episodes",
        "4",
        "--first-seed",
        "7",
        "--cache",
        str(tmp_path),
        "--ray",
        "10.0.0.1:1",
    ]
    assert "kept: [7, 8, 9, 10]" in CliRunner().invoke(evaluate.main, words).output
    assert Cluster.asked == ["10.0.0.1:1", [7, 8], [9, 10], "left"]


@pytest.mark.parametrize("other", [("--jobs", "2"), ("--no-cache",)])
def test_a_cluster_and_what_it_cannot_have_beside_it_are_refused(tiny_artifact: Path, other: tuple[str, ...]) -> None:
    result = CliRunner().invoke(evaluate.main, [str(tiny_artifact), "--ray", "local", *other])
    assert result.exit_code == 2
    assert "--ray" in result.output.splitlines()[-1]


def test_looks_share_the_error_and_the_document_makes_rows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tiny_artifact: Path
) -> None:
    dense, sparse = rollout([0.97, 0.76] * 50), rollout([0.97, 0.75] * 50)

    def evaluated(*_: Any) -> Any:
        return [summarise("dense", dense, dense), summarise("sparse", sparse, dense)]

    judged = SimpleNamespace(default_plan="schedule", calibration={"plans": {"schedule": {"distance": 0.05}}})
    monkeypatch.setattr(evaluate, "evaluate", evaluated)
    monkeypatch.setattr(evaluate, "read_manifest", lambda _: judged)
    words = [f"{tiny_artifact}:dense", str(tiny_artifact), "--looks", "2", "--json", "--cache", str(tmp_path)]
    document = json.loads(CliRunner().invoke(evaluate.main, words).stdout)
    assert [one["distance"] for one in document["variants"]] == [None, 0.05]
    assert document["command"].startswith("python examples/evaluation/evaluate.py")
    (row,) = rows_of(document, "Push-T", ["2 of 4 steps"], "a.md#b", [])
    assert (row.distance, row.episodes, row.comparisons, row.counted) == (0.05, 100, 2, 2)
    assert row.score is not None and row.score[0] == pytest.approx(-0.01 / 0.95 / 2, abs=1e-4)
    assert row.verdict == {measure: row.word(measure) for measure in ("success", "score")}
    once = json.loads(CliRunner().invoke(evaluate.main, [*words[:2], "--json", "--cache", str(tmp_path)]).stdout)
    low, wider = (one["variants"][1]["verdict"]["success"]["difference"]["low"] for one in (once, document))
    assert wider < low < 0
