"""Torch's exporter runs once a run for graphs of one structure: its answer depends on nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from hashlib import sha256
from pathlib import Path
from tempfile import NamedTemporaryFile

import onnx
import pytest
import torch
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
    run, export = program._run_exporter, torch.onnx.export

    def once(graphs: list[Graph]) -> onnx.ModelProto:
        if torch.onnx.export is not export:
            return run(graphs)
        path = directory / sha256("\n\n".join(map(program.structural_key, graphs)).encode()).hexdigest()
        if not path.exists():
            with untraced():
                made = run(graphs).SerializeToString()
            with NamedTemporaryFile(dir=directory, delete=False) as unfinished:
                unfinished.write(made)
            Path(unfinished.name).rename(path)
        return onnx.ModelProto.FromString(path.read_bytes())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(program, "_run_exporter", once)
        patch.setattr(ONNXRegistry, "from_torchlib", staticmethod(cache(ONNXRegistry.from_torchlib)))
        yield
