"""Torch's tracer runs once a run for modules of one structure: the values of weights change no graph."""

from __future__ import annotations

import io
import pickle
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from tempfile import NamedTemporaryFile
from types import FunctionType
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from ttscompile.capture import export
from ttscompile.core.spec import PolicySpec
from ttscompile.ir.graph import Graph

from .untraced import untraced


@contextmanager
def captured_once(directory: Path) -> Iterator[None]:
    """Keep the graphs of modules in ``directory``, which the workers of a run share.

    ``capture`` compares each with the module, as always. Traced every time are a module that nobody can pickle, for a
    lambda or a local class in it, those of processes that a test starts, and of a test that watches
    torch's own ``_export``.
    """
    directory.mkdir(parents=True, exist_ok=True)
    trace, convert, watched = export._traced, export._Converter, torch.export._trace._export

    class Converter:
        """In place of the compiler's; what is given to the tracer is given to it."""

        def __init__(self, module: nn.Module, spec: PolicySpec, streams: int) -> None:
            self.module, self.how = module, (spec, streams)

        def convert(self) -> tuple[Graph, export.Weights]:
            key = structure(self.module, *self.how) if torch.export._trace._export is watched else None
            if key is None:
                return convert(*trace(self.module, *self.how)).convert()
            held = registered(self.module)
            if (path := directory / key).exists():
                graph, values = pickle.loads(path.read_bytes())  # by a run of these tests
                return graph, {
                    name: numbers(held[one]) if isinstance(one, str) else one for name, one in values.items()
                }
            with untraced():
                traced = trace(self.module, *self.how)
            graph, weights = convert(*traced).convert()
            values = {name: name if name in held else one for name, one in weights.items()}
            with NamedTemporaryFile(dir=directory, delete=False) as unfinished:
                pickle.dump((graph, values), unfinished)
            Path(unfinished.name).rename(path)
            return graph, weights

    def given(module: nn.Module, spec: PolicySpec, streams: int) -> tuple[Any, ...]:
        return module, spec, streams

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "_traced", given)
        patch.setattr(export, "_Converter", Converter)
        yield


def registered(module: nn.Module) -> dict[str, Tensor]:
    """Parameters and buffers, of which the tracer sees shape and type alone."""
    return {
        **dict(module.named_parameters(remove_duplicate=False)),
        **dict(module.named_buffers(remove_duplicate=False)),
    }


def numbers(value: Tensor) -> Any:
    """As a constant of a graph, which shares memory with the module's."""
    return value.detach().cpu().contiguous().numpy()


def structure(module: nn.Module, spec: PolicySpec, streams: int) -> str | None:
    """A name for all that a graph depends on; None for a module that cannot be pickled."""
    file = io.BytesIO()
    pickler = _Structure(file, module)
    given = [(name, one.shape, str(one.dtype)) for name, one in export._examples(spec, streams).items()]
    modes = torch.get_default_dtype(), torch.is_grad_enabled(), torch.is_inference_mode_enabled()
    try:
        pickler.dump((module, given, dict(spec.arguments), spec.sample_argument, str(modes)))
    except Exception:  # whatever the classes of a module raise
        return None
    return sha256(repr(sorted(pickler.sources)).encode() + file.getvalue()).hexdigest()


class _Structure(pickle.Pickler):
    """Of weights what they are called, and of what they are made; of classes where they are written, and when."""

    def __init__(self, file: io.BytesIO, module: nn.Module) -> None:
        super().__init__(file)
        self.held = {id(one): name for name, one in registered(module).items()}
        self.sources: set[tuple[str, int, int]] = set()

    def persistent_id(self, thing: object) -> object:
        if not isinstance(thing, Tensor):
            return None
        form = str(thing.dtype), tuple(thing.shape), thing.stride(), str(thing.device), thing.requires_grad
        if (name := self.held.get(id(thing))) is not None:
            return name, *form
        return sha256(numbers(thing).tobytes()).hexdigest(), *form

    def reducer_override(self, thing: object) -> Any:
        for each in type.mro(thing) if isinstance(thing, type) else [thing] if isinstance(thing, FunctionType) else []:
            path = getattr(sys.modules.get(each.__module__), "__file__", None)
            if path is not None:
                known = Path(path).stat()
                self.sources.add((path, known.st_mtime_ns, known.st_size))
        return NotImplemented
