"""What torch's exporter wrote, simplified: as onnxscript's own ``optimize`` does it, with fewer rules to try."""

import onnx_ir as ir
import pytest
from onnxscript import optimizer
from onnxscript.rewriter import onnx_fusions

from tests.lower.modules import ALL, captured
from ttscompile.lower import program
from ttscompile.lower.layout import sink_layout
from ttscompile.lower.simplify import simplify


def serialised(model: ir.Model) -> bytes:
    return ir.to_proto(model).SerializeToString(deterministic=True)


@pytest.mark.slow
def test_it_is_what_all_rules_make_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one model that holds all networks of these tests, as a program's pieces are exported."""
    sizes = list[int]()

    def compared(model: ir.Model) -> None:
        own, all_rules = (ir.from_proto(ir.to_proto(model)) for _ in range(2))
        simplify(own)
        optimizer.optimize_ir(all_rules)
        onnx_fusions.fuse(all_rules)
        assert serialised(own) == serialised(all_rules)
        assert [value.name for value in own.graph.inputs] == [value.name for value in model.graph.inputs]
        sizes.extend((model.graph.num_nodes(), own.graph.num_nodes()))
        simplify(model)

    monkeypatch.setattr(program, "simplify", compared)
    program._run_exporter([sink_layout(captured(name)[1]) for name in ALL])
    before, after = sizes
    assert after < 0.7 * before
