"""Capture one evaluation of a denoiser as a graph: ``torch.export``, ATen level, weights lifted, batch symbolic.

It is captured with a batch size that is rare among numbers, and ``batch`` finds the batch.
"""

import inspect
import logging
import operator
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch._subclasses import FakeTensor
from torch.export import _trace, exported_program as decompose
from torch.export.graph_signature import InputKind, OutputKind

from ..core.coercion import Array
from ..core.spec import PolicySpec
from ..errors import CaptureError
from ..frontends.encoded import sharing_copy
from ..ir.evaluate import evaluator
from ..ir.graph import GETITEM, Argument, Enum, Graph, Node, Ref, TensorType
from .batch import BATCHES, REMEDY, with_batch
from .causes import KEEPS, ON_VALUES, cause_of, innermost, sentence

_RESHAPE = "aten.reshape.default"
_VIEWS = (torch.ops.aten.view.default, torch.ops.aten._unsafe_view.default)
_SPLITS = (torch.ops.aten.split.Tensor, torch.ops.aten.split_with_sizes.default)

Weights = dict[str, Array]


def capture(module: nn.Module, spec: PolicySpec) -> tuple[Graph, Weights]:
    """Capture ``module(sample, timestep, **observations)``, one denoising step, for any number of streams.

    A copy is captured, on the CPU, in eval mode and float32; the module itself is not touched. Constants share memory
    with its parameters where these are so already.

    Args:
        module: takes ``spec.sample_argument`` float32 ``[B, T, D]``, ``spec.timestep_argument`` ``[B]`` of the dtype of
            ``spec.sampler.timesteps`` and every observation ``[B, ...]`` as the keyword that ``spec.arguments`` says;
            returns one tensor ``[B, T, D]``.

    Returns:
        The graph, whose inputs are sample, timestep and the observations in this order, and the value of each constant.

    Raises:
        CaptureError: torch.export failed; the graph uses what the compiler cannot express, of which it names the node;
            or what the module computes for a stream depends on the others, or on how many there are.
    """
    module, (first, second) = sharing_copy(module), BATCHES
    _require_arguments(module, spec)
    traced = _Converter(*_traced(module, spec, first)).convert()  # what fails here fails with any batch
    with suppress(CaptureError):  # a number of the network may be a multiple of this batch
        return _for_any_batch(module, spec, *traced, first)
    return _for_any_batch(module, spec, *_Converter(*_traced(module, spec, second)).convert(), second)


def _for_any_batch(
    module: nn.Module, spec: PolicySpec, graph: Graph, weights: Weights, batch: int
) -> tuple[Graph, Weights]:
    graph = with_batch(graph, batch)
    found, expected = graph.types()[graph.outputs[0]], graph.inputs[spec.sample_argument]
    if found != expected:
        raise CaptureError(f"the module returns {found}; expected the type of its sample, {expected}.")
    _require_streams_alike(module, spec, graph, weights)
    return graph, weights


def _require_streams_alike(module: nn.Module, spec: PolicySpec, graph: Graph, weights: Weights) -> None:
    """Refuse a module that branches below the batches of the capture, or whose streams depend on each other.

    It is run with two streams, and with the second alone.
    """
    run, both, made = evaluator(graph, weights), _examples(spec, 2), list[torch.Tensor]()

    def problem(called: nn.Module, streams: int) -> str:
        inputs = {name: value[2 - streams :] for name, value in both.items()}
        try:
            with torch.no_grad():
                (found,), expected = run(inputs), called(**_as_arguments(inputs, spec))
        except Exception as error:  # whatever the user's code raises
            return f"fails for a batch of {streams}: {sentence(error)}"
        made.append(expected)
        return "" if _close(found, expected) else f"computes for a batch of {streams} something else than for more."

    called = sharing_copy(module)
    for streams in (1, 2):
        if told := problem(called, streams):
            remedy = REMEDY if problem(sharing_copy(module), streams) else KEEPS  # one that was never called
            raise CaptureError(f"the module {told}{remedy}")
    if not _close(made[1][1:], made[0]):
        raise CaptureError(f"the module computes for a stream beside another something else than alone.{REMEDY}")


def _close(found: torch.Tensor, expected: torch.Tensor) -> bool:
    """Whether these are equal but for rounding; what is no number there is none here."""
    scale = float(expected.abs().nan_to_num(0, 0, 0).max())
    return found.shape == expected.shape and torch.allclose(found, expected, 1e-3, 1e-3 * scale, equal_nan=True)


def _traced(
    module: nn.Module, spec: PolicySpec, streams: int
) -> tuple[torch.export.ExportedProgram, dict[str, torch.Tensor]]:
    # Only types are traced, and memory that nobody writes to takes none.
    examples = {name: one.new_empty(streams, *one.shape[1:]) for name, one in _examples(spec, 1).items()}
    given = _as_arguments(examples, spec)
    fastpath = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)  # the fused encoder layer is opaque to every pass
    try:
        with warnings.catch_warnings(), _masks_as_given(), _one_message():
            # torch.export warns about its own use of a deprecated class
            warnings.filterwarnings("ignore", message=".*LeafSpec.*", category=FutureWarning)
            # and about recurrent layers, which list their weights anew when they are copied
            warnings.filterwarnings("ignore", message=".*_flat_weights.*", category=UserWarning)
            # and about what a module keeps of its call, which does harm only where the next call reads it
            warnings.filterwarnings("ignore", message=".*was assigned during export", category=UserWarning)
            # what torch.export.export and then run_decompositions give, which trace the module and trace it again
            table, _ = decompose._split_decomp_table_to_cia_and_python_decomp(dict(AS_CAT))
            with decompose._override_composite_implicit_decomp(table):
                # of a copy, since the module may keep something of its call
                return _trace._export(sharing_copy(module), (), given, strict=False), examples
    except Exception as error:  # torch.export raises whatever the user's code or its own machinery raises
        called = ", ".join(f"{name} {tuple(value.shape)} {value.dtype}" for name, value in examples.items())
        raise CaptureError(
            f"torch.export could not capture {type(module).__name__} {cause_of(error, called)}"
        ) from error
    finally:
        torch.backends.mha.set_fastpath_enabled(fastpath)


@contextmanager
def _one_message() -> Iterator[None]:
    """What fails is told by the error: torch.export logs its traceback too, and prints the graph as far as it came."""
    logger, names = logging.getLogger("torch"), vars(_trace)
    level = logger.level
    logger.setLevel(logging.CRITICAL)  # what TORCH_LOGS asks for has a level of its own
    names["print"] = lambda *_, **__: None
    try:
        yield
    finally:
        del names["print"]
        logger.setLevel(level)


@contextmanager
def _masks_as_given() -> Iterator[None]:
    """``nn.TransformerDecoder`` reads its mask's values to see whether it is causal; here the mask counts as given."""
    layers = torch.nn.modules.transformer
    detect = layers._detect_is_causal_mask
    layers._detect_is_causal_mask = lambda mask, is_causal=None, size=None: is_causal is True
    try:
        yield
    finally:
        layers._detect_is_causal_mask = detect


def _require_arguments(module: nn.Module, spec: PolicySpec) -> None:
    """Raise unless the module has the arguments that it will be called with."""
    given = [spec.sample_argument, spec.timestep_argument, *spec.arguments.values()]
    with suppress(ValueError):  # of a forward without a signature; torch.export says what it makes of it
        try:
            inspect.signature(module.forward).bind(**dict.fromkeys(given))
        except TypeError as error:
            raise CaptureError(
                f"{type(module).__name__} is called with the arguments {', '.join(given)}: {sentence(error)} The keys"
                " of PolicySpec.observations are names of arguments, with underscores for dots. Name the other two:"
                " PolicySpec(sample_argument=..., timestep_argument=...)."
            ) from error


def _as_arguments(inputs: Mapping[str, torch.Tensor], spec: PolicySpec) -> dict[str, torch.Tensor]:
    return {spec.arguments.get(name, name): value for name, value in inputs.items()}


def _examples(spec: PolicySpec, streams: int) -> dict[str, torch.Tensor]:
    """Sample, timestep and observations, drawn at random, by the names of the graph's inputs."""
    sample = torch.randn(streams, *spec.sample, generator=torch.Generator().manual_seed(0))
    timestep, rng = torch.from_numpy(spec.sampler.timesteps)[:1].repeat(streams), np.random.default_rng(0)
    drawn = {key: torch.from_numpy(one.draw_normalized(rng, streams)) for key, one in spec.inputs.items()}
    return {spec.sample_argument: sample, spec.timestep_argument: timestep, **drawn}


class _Converter:
    """From an exported program to ``Graph``, all of whose sizes are numbers."""

    def __init__(self, exported: torch.export.ExportedProgram, examples: Mapping[str, torch.Tensor]) -> None:
        self.exported = exported
        self.examples = examples
        self.names: dict[torch.fx.Node, str] = {}
        self.taken: set[str] = set()

    def convert(self) -> tuple[Graph, Weights]:
        kinds = {s.arg.name: s for s in self.exported.graph_signature.input_specs}
        inputs: dict[str, TensorType] = {}
        constants: dict[str, TensorType] = {}
        weights: Weights = {}
        state = {**self.exported.state_dict, **self.exported.constants}
        placeholders = [n for n in self.exported.graph.nodes if n.op == "placeholder"]
        users = [n for n in placeholders if kinds[n.name].kind is InputKind.USER_INPUT]
        for fx_node, key in zip(users, self.examples, strict=True):
            self.names[fx_node] = key
            inputs[key] = self._type(fx_node, fx_node.meta["val"])
        for fx_node in placeholders:
            if fx_node in self.names or not fx_node.users:
                continue
            target = str(kinds[fx_node.name].target)
            if target in inputs:
                raise CaptureError(
                    f"the module has a weight called {target}, as an observation is. Rename one of them."
                )
            self.names[fx_node] = target
            constants[target] = self._type(fx_node, fx_node.meta["val"])
            if isinstance(state[target], FakeTensor):  # which has no values
                raise CaptureError(f"the module reads what it computed when it was called before.{KEEPS}")
            weights[target] = state[target].detach().cpu().contiguous().numpy()
        self.taken = {*inputs, *constants}
        made = [self._node(fx_node) for fx_node in self.exported.graph.nodes if fx_node.op == "call_function"]
        nodes = tuple(node for node in made if node is not None)
        return Graph(inputs, constants, nodes, (self._output(),)), weights

    def _size(self, fx_node: torch.fx.Node, size: Any) -> int:
        if isinstance(size, int):
            return size
        raise CaptureError(f"%{fx_node.name} ({_source(fx_node)}) has the size {size}: {ON_VALUES}")

    def _type(self, fx_node: torch.fx.Node, value: Any) -> TensorType:
        return TensorType(tuple(self._size(fx_node, n) for n in value.shape), str(value.dtype).removeprefix("torch."))

    def _node(self, fx_node: torch.fx.Node) -> Node | None:
        value, target = fx_node.meta.get("val"), fx_node.target
        if value is None or isinstance(value, torch.SymInt | torch.SymBool | int | bool):
            return None  # sizes are solved by _size; assertions on them hold by construction
        line = _source(fx_node)
        where = f"%{fx_node.name} ({line})"
        if isinstance(value, torch.SymFloat):
            raise CaptureError(f"{where}: {ON_VALUES}")
        source: Any = next(iter(fx_node.args), None)
        whole = source if target is operator.getitem else fx_node
        if whole.target in _SPLITS and len(whole.meta["val"]) == 1:  # one part is what was split
            self.names[fx_node] = self.names[source]
            return None
        if target is operator.getitem:
            op = GETITEM
        elif isinstance(target, torch._ops.OpOverload) and target.namespace == "aten":
            # Values have no strides here: a view of whatever layout is a reshape.
            op = _RESHAPE if target in _VIEWS else str(target).replace("lift_fresh_copy", "clone")  # of torch.tensor(1)
        else:
            remedy = "Replace the custom or higher-order operation (cond, scan, autocast region) by plain tensor code."
            raise CaptureError(f"{where} calls {target}, which is no ATen operation. {remedy}")
        values = value if isinstance(value, tuple | list) else (value,)
        if any(v.is_complex() for v in values):
            remedy = "the rotary embedding with cosine and sine: left * cos - right * sin, right * cos + left * sin."
            raise CaptureError(f"{where} computes with complex numbers, which an artifact cannot hold. Write {remedy}")
        if any(v.dtype is torch.bfloat16 for v in values):
            remedy = "Weights are captured as float32: cast to the dtype of a weight, or not at all."
            raise CaptureError(f"{where} computes in bfloat16, for which onnxruntime has no arithmetic. {remedy}")
        name = fx_node.name
        while name in self.taken:  # by a weight or an observation: a buffer ``cos`` beside the operation
            name += "_"
        self.taken.add(name)
        self.names[fx_node] = name
        return Node(
            name=name,
            op=op,
            args=tuple(self._argument(fx_node, a) for a in fx_node.args),
            kwargs=tuple((k, self._argument(fx_node, a)) for k, a in sorted(fx_node.kwargs.items())),
            types=tuple(self._type(fx_node, v) for v in values),
            source=line,
        )

    def _argument(self, fx_node: torch.fx.Node, argument: Any) -> Argument:
        if isinstance(argument, torch.fx.Node):
            if argument in self.names:
                return Ref(self.names[argument])
            return self._size(fx_node, argument.meta["val"])
        if isinstance(argument, torch.SymInt):
            return self._size(fx_node, argument)
        if isinstance(argument, list | tuple):
            return tuple(self._argument(fx_node, a) for a in argument)
        if argument is None or isinstance(argument, bool | int | float | str):
            return argument
        if isinstance(argument, torch.dtype | torch.memory_format | torch.layout):
            return Enum(type(argument).__name__, str(argument).removeprefix("torch."))
        if isinstance(argument, torch.device):
            return Enum("device", "cpu")  # the artifact runs where it is loaded
        raise CaptureError(f"%{fx_node.name} ({_source(fx_node)}) has an argument of type {type(argument).__name__}.")

    def _output(self) -> str:
        outputs = self.exported.graph_signature.output_specs
        if mutated := [o.target for o in outputs if o.kind is not OutputKind.USER_OUTPUT]:
            what = f"the module changes its own buffers or inputs {mutated} when called; a denoiser must be pure"
            raise CaptureError(f"{what}. Change a clone of them instead.")
        (output,) = [n for n in self.exported.graph.nodes if n.op == "output"]
        results = output.args[0]
        if len(results) != 1 or not isinstance(results[0], torch.fx.Node):
            raise CaptureError(f"the module returns {len(results)} values; expected one tensor, the prediction.")
        return self.names[results[0]]


def _source(fx_node: torch.fx.Node) -> str:
    return innermost(fx_node.meta.get("stack_trace") or "")


AS_CAT: Mapping[Any, Callable[[Sequence[Tensor]], Tensor]] = {
    torch.ops.aten.hstack.default: lambda some: torch.cat([*map(torch.atleast_1d, some)], int(some[0].ndim > 1)),
    torch.ops.aten.vstack.default: lambda some: torch.cat([*map(torch.atleast_2d, some)], 0),
    torch.ops.aten.dstack.default: lambda some: torch.cat([*map(torch.atleast_3d, some)], 2),
    torch.ops.aten.column_stack.default: lambda some: torch.cat(
        [one if one.ndim > 1 else one.reshape(-1, 1) for one in some], 1
    ),
}
"""Operations that put tensors beside each other, as the ``cat`` that they are: for ``run_decompositions``.

``hstack`` and its kind first give each tensor the axes that it lacks. torch's ONNX exporter makes of that a function
over a list of tensors, which no runtime here executes; passes see through ``cat``, and not through these.
Source: the definitions in torch's documentation.
"""
