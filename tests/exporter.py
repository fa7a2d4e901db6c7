"""Torch's exporter runs once a run for graphs of one structure: its answer depends on nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from hashlib import sha256
from pathlib import Path
from tempfile import NamedTemporaryFile

import onnx
import pytest
import torch
from torch._export import utils as export_utils
from torch.onnx._internal.exporter import _fx_passes
from torch.onnx._internal.exporter._registration import ONNXRegistry
from torch.onnx._internal.fx.passes.type_promotion import TypePromotionTable, get_type_promotion_rule
from torch.utils._pytree import tree_leaves

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
        operations = export_utils._materialize_cpp_cia_ops  # looks each up by its name, sixteen times a trace
        patch.setattr(export_utils, "_materialize_cpp_cia_ops", cache(operations))
        patch.setattr(_fx_passes, "insert_type_promotion_nodes", where_needed(_fx_passes.insert_type_promotion_nodes))
        yield


def where_needed(promote: Callable[[torch.fx.GraphModule], None]) -> Callable[[torch.fx.GraphModule], None]:
    """Torch's exporter computes all shapes once more to see whether types have to be promoted: a third of an export.

    None have to where what a node reads is of one type, no number of another kind is beside it, and it gives that type
    or truth values.
    """

    def alike(node: torch.fx.Node) -> bool:
        chooses = "where" in str(node.target)  # by truth values, which have no part in the type
        tensors = [one.meta["val"] for one in node.all_input_nodes if isinstance(one.meta.get("val"), torch.Tensor)]
        types = {value.dtype for value in tensors} - ({torch.bool} if chooses else set())
        numbers = [one for one in tree_leaves((node.args, node.kwargs)) if isinstance(one, bool | int | float)]
        given = node.meta["val"].dtype
        if chooses and not types:
            return given == torch.float32 and all(type(one) is float for one in numbers)
        if len(types) != 1 or given not in (*types, torch.bool):
            return False
        (type_,) = types
        return type_.is_floating_point or all(type_ != torch.bool and type(one) is int for one in numbers)

    def own(module: torch.fx.GraphModule) -> None:
        table = TypePromotionTable()
        ruled = (n for n in module.graph.nodes if n.op == "call_function" and get_type_promotion_rule(n, table))
        if not all(map(alike, ruled)):
            promote(module)

    return own
