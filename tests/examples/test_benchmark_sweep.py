"""The sweep's quick run from end to end, its table and its picture."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from drawing import draw, main as draw_main
from sweep import COMPILED, QUICK, Row, main, networks, results_table

from tests.examples.printed import printed


def row(contestant: str, sparsity: float | None, ms: float, floor: float | None, threads: int = 1) -> Row:
    return Row("Push-T", 256, "DDPM 100", threads, contestant, sparsity, 1.0, floor, ms, 0.9 * ms, 1.1 * ms, (ms, ms))


ROWS = [
    row("eager PyTorch", None, 1200.0, None),
    row("dense onnxruntime", 0.0, 300.0, 240.0),
    row(COMPILED, 0.95, 24.0, 12.0),
    row("blocks back to back", None, 12.0, None),
]


def test_the_table_has_ratios_to_eager_and_to_the_floor() -> None:
    lines = printed(results_table(ROWS))
    sparse = next(line for line in lines if COMPILED in line)
    assert {"95%", "24", "21.6..26.4", "50.0", "12", "2.00"} <= set(sparse.split())
    alone = next(line for line in lines if "back to back" in line)
    assert "100.0" not in alone


@pytest.mark.soak
def test_a_quick_run_gives_a_document_and_a_picture(tmp_path: Path) -> None:
    picture = tmp_path / "sweep.png"
    result = CliRunner().invoke(main, ["--quick", "--runs", "1", "--json", "--plot", str(picture)])
    assert result.exit_code == 0, result.stderr
    document = json.loads(result.stdout)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert document["machine"]["cores"] >= 1
    assert document["left_out"] == ["torch.compile: it takes no part in a quick run"]
    rows = document["rows"]
    assert len(rows) == len(QUICK.threads) * (1 + len(QUICK.sparsities) + 1)
    for one in rows:
        assert len(one["times_ms"]) == QUICK.effort.passes
        assert 0 < one["p10_ms"] <= one["median_ms"] <= one["p90_ms"]
    floors = [one["floor_ms"] for one in rows if one["threads"] == 1 and one["sparsity"] is not None]
    assert floors == sorted(floors, reverse=True)
    assert floors[2] == pytest.approx(floors[0] * 0.1, rel=0.1)
    # A call computes at least what its floor says, and costs more FLOPs than its cells.
    dense = next(one for one in rows if one["sparsity"] == 0.0)
    sparse = next(one for one in rows if one["sparsity"] == 0.9)
    assert sparse["gflop"] < 0.2 * dense["gflop"]

    again = tmp_path / "again.svg"
    saved = tmp_path / "sweep.json"
    saved.write_text(result.stdout)
    assert CliRunner().invoke(draw_main, [str(saved), str(again)]).exit_code == 0
    assert again.read_text().count("<g id=") > 10


def test_the_picture_has_a_panel_for_each_width_and_loop(tmp_path: Path) -> None:
    wide = [replace(one, width=768, network="random weights", loop="DDIM 8") for one in ROWS]
    document = {
        "machine": {"processor": "none", "cores": 1},
        "rows": [vars(one) for one in [*ROWS, row(COMPILED, 0.95, 20.0, 10.0, threads=2), *wide]],
    }
    draw(document, tmp_path / "picture.svg")
    text = (tmp_path / "picture.svg").read_text()
    assert text.count('<g id="axes_') == 4


@pytest.mark.parametrize("bad", [("--loops", "ddpm"), ("--loops", "euler:4"), ("--threads", "0"), ("--widths", "a")])
def test_bad_options_are_refused(bad: tuple[str, str]) -> None:
    result = CliRunner().invoke(main, ["--quick", *bad])
    assert result.exit_code == 2
    assert "expected" in result.stderr


def test_pusht_is_the_network_of_its_width() -> None:
    first, second = networks([256, 64], [("ddim", 8)])
    assert (first.name, first.width, first.loop) == ("Push-T", 256, "DDIM 8")
    assert (second.name, second.width, second.loop) == ("random weights", 64, "DDIM 8")
    assert first.spec.observations["obs"].shape == second.spec.observations["obs"].shape
    assert first.spec.chunk.stop == second.spec.chunk.stop
