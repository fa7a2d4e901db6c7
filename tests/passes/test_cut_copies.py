"""Copies of a doubled batch are cut by their number."""

import pytest
import torch

from tests.passes.graphs import B, Builder
from tests.passes.modules import HALVES, TWICE, Doubled
from tests.passes.specs import toy_spec
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.capture.export import capture
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Batch
from ttscompile.ir.program import Captured
from ttscompile.passes.cut_copies import CutCopies


@pytest.mark.slow
@pytest.mark.parametrize("halve", HALVES)
def test_copies_are_cut_by_their_number(halve: str) -> None:
    module = Doubled(lambda x: torch.cat([x, x]), HALVES[halve]).eval()
    graph, weights = capture(module, toy_spec())
    captured = Captured(toy_spec(), graph, weights)
    result = CutCopies()(captured)
    cut = result.program.denoiser
    assert result.program is not captured
    assert not any(
        isinstance(a, Batch) for n in cut.nodes if n.op.startswith(("aten.slice", "aten.split")) for a in n.args
    )
    inputs = {"sample": torch.randn(3, 4, 2), "timestep": torch.arange(3), "obs": torch.randn(3, 3)}
    with torch.no_grad(), Counted() as counted:
        expected = module(*inputs.values())
    found = evaluate(cut, {n: torch.from_numpy(w) for n, w in weights.items()}, inputs)[0]
    assert_equal_but_for_rounding(found, expected, counted.terms)


def test_boundaries_may_be_counted_from_the_end() -> None:
    b = Builder()
    x = b.input("sample", B, 4, 2)
    both = b.op("both", "cat.default", TWICE, (x, x), 0)
    given = b.op("given", "slice.Tensor", (B, 4, 2), both, 0, 0, Batch(-1))
    free = b.op("free", "slice.Tensor", (B, 4, 2), both, 0, Batch(-1), 2**63 - 1)
    cut = CutCopies()(Captured(toy_spec(), b.graph(given, free), {})).program.denoiser
    assert [n.args[2] for n in cut.nodes if n.op == "aten.select.int"] == [0, 1]
