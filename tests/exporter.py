"""Torch's exporter runs once a run for graphs of one structure: its answer depends on nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from hashlib import sha256
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import onnx
import onnx_ir as ir
import pytest
import torch
from onnxscript.rewriter._basics import MatchResult
from onnxscript.rewriter._matcher import SimplePatternMatcher
from torch.onnx._internal.exporter._registration import ONNXRegistry

from ttscompile.ir.graph import Graph
from ttscompile.lower import program

from .untraced import untraced


@contextmanager
def exported_once(directory: Path) -> Iterator[None]:
    """Keep what the exporter gives in ``directory``, which the workers of a run share, and what it lists of torch.

    Processes that a test starts have an exporter of their own, and so has a test that watches ``torch.onnx.export``.
    """
    directory.mkdir(parents=True, exist_ok=True)
    export, watched = program._export, torch.onnx.export

    def once(graphs: dict[str, Graph]) -> dict[str, onnx.ModelProto]:
        if torch.onnx.export is not watched:
            return export(graphs)
        paths = {
            name: directory / sha256(program.structural_key(graph).encode()).hexdigest()
            for name, graph in graphs.items()
        }
        if missing := {name: graph for name, graph in graphs.items() if not paths[name].exists()}:
            with untraced():
                made = {name: model.SerializeToString() for name, model in export(missing).items()}
            for name, content in made.items():
                with NamedTemporaryFile(dir=directory, delete=False) as unfinished:
                    unfinished.write(content)
                Path(unfinished.name).rename(paths[name])
        return {name: onnx.ModelProto.FromString(path.read_bytes()) for name, path in paths.items()}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(program, "_export", once)
        patch.setattr(ONNXRegistry, "from_torchlib", staticmethod(cache(ONNXRegistry.from_torchlib)))
        patch.setattr(SimplePatternMatcher, "match", looking_first(SimplePatternMatcher.match))
        yield


def looking_first(match: Callable[..., MatchResult]) -> Callable[..., MatchResult]:
    """onnxscript lists all nodes of a model, for each of them, before it sees that a rule is not about this one."""

    def own(matcher: SimplePatternMatcher, model: object, graph: object, node: ir.Node, **options: Any) -> MatchResult:
        wanted = matcher.pattern.output_nodes[0].op_identifier()
        if wanted not in (None, node.op_identifier()):
            return MatchResult().fail("another operation")
        return match(matcher, model, graph, node, **options)

    return own
