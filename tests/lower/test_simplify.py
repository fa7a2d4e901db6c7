"""What torch's exporter wrote, simplified: as onnxscript's own ``optimize`` does it, with fewer rules to try."""

import onnx_ir as ir
import pytest
import torch
from onnxscript import optimizer
from onnxscript.rewriter import onnx_fusions
from torch import nn

from tests.lower.modules import ALL, TOKENS, WIDTH, captured, spec
from ttscompile.capture.export import capture
from ttscompile.ir.graph import Graph
from ttscompile.lower import program, simplify
from ttscompile.lower.layout import sink_layout


class Detours(nn.Module):
    """What the other networks of these tests lack: a convolution without a bias, repeated heads, and a mean square."""

    def __init__(self) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(1, 1, 3, padding=1, bias=False)
        self.scale = nn.Parameter(torch.full((WIDTH,), 2.0))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        x = sample * torch.rsqrt(sample.pow(2).mean(-1, keepdim=True) + 1e-6) * self.scale
        x = self.convolution(x[:, None])[:, 0].repeat_interleave(2, dim=2)[..., :WIDTH]
        return sample + x.reshape(-1, WIDTH).reshape(-1, TOKENS * WIDTH).reshape(-1, TOKENS, WIDTH)


def graphs() -> list[Graph]:
    """Of all these networks, as the exporter gets them."""
    detours, _ = capture(Detours().eval(), spec())
    return [sink_layout(graph) for graph in (detours, *(captured(name)[1] for name in ALL))]


def serialised(model: ir.Model) -> bytes:
    return ir.to_proto(model).SerializeToString(deterministic=True)


@pytest.mark.slow
def test_it_is_what_all_rules_make_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one model that holds all networks, as a program's pieces are exported; and each rule has something to do."""
    models = list[ir.Model]()
    monkeypatch.setattr(program, "simplify", models.append)
    program._run_exporter(graphs())
    written = ir.to_proto(models[0])
    own, all_rules = ir.from_proto(written), ir.from_proto(written)
    simplify.simplify(own)
    optimizer.optimize_ir(all_rules)
    onnx_fusions.fuse(all_rules)
    assert serialised(own) == serialised(all_rules)
    assert [value.name for value in own.graph.inputs] == [value.name for value in models[0].graph.inputs]
    assert "RMSNormalization" in {node.op_type for node in own.graph}
    for rule in simplify.RULES:
        fewer = ir.from_proto(written)
        with monkeypatch.context() as patch:
            patch.setattr(simplify, "RULES", tuple(other for other in simplify.RULES if other is not rule))
            simplify.simplify(fewer)
        assert serialised(fewer) != serialised(own), f"{rule.name} changes nothing"
