"""``artifact.graph_json``: graphs as JSON, and JSON that is not a graph."""

import copy
import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, strategies as st

from tests.lower.modules import ALL, captured
from ttscompile.artifact.graph_json import DTYPES, ENUM_KINDS, graph_from_json, graph_to_json
from ttscompile.artifact.strict_json import Value
from ttscompile.errors import ArtifactError
from ttscompile.ir.graph import GETITEM, Argument, Batch, Enum, Graph, Node, Ref, TensorType


def read(document: Any) -> Graph:
    return graph_from_json(Value(document, "program.json: graphs.stem"))


def through_text(graph: Graph) -> Graph:
    return read(json.loads(json.dumps(graph_to_json(graph), allow_nan=False)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_captured_graphs_survive(name: str) -> None:
    _, graph, _ = captured(name)
    assert any(node.source for node in graph.nodes)
    assert through_text(graph) == replace(graph, nodes=tuple(replace(n, source="") for n in graph.nodes))
    assert ".py" not in json.dumps(graph_to_json(graph))


sizes = st.integers(0, 2**40) | st.builds(Batch, st.integers(1, 2**40))
types = st.builds(TensorType, st.lists(sizes, max_size=6).map(tuple), st.sampled_from(sorted(DTYPES)))
names = st.text(st.characters(exclude_categories=("C", "Z")), min_size=1, max_size=8)
plain = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | st.text(max_size=8)
    | st.builds(Batch, st.integers(1, 99))
    | st.builds(Enum, st.sampled_from(sorted(ENUM_KINDS)), st.from_regex(r"[A-Za-z0-9_:]{1,9}", fullmatch=True))
)


@st.composite
def graphs(draw: st.DrawFn) -> Graph:
    values = draw(st.lists(names, min_size=2, max_size=9, unique=True))
    inputs = draw(st.integers(1, len(values) - 1))
    constants = draw(st.integers(inputs, len(values) - 1))
    typed = {name: draw(types) for name in values[:constants]}
    nodes = []
    for i in range(constants, len(values)):
        argument = plain | st.sampled_from(values[:i]).map(Ref)
        nested = argument | st.lists(argument | st.lists(argument, max_size=2).map(tuple), max_size=3).map(tuple)
        results = draw(st.lists(types, min_size=1, max_size=3))
        keywords = draw(st.dictionaries(st.sampled_from(["dim", "alpha", "dtype"]), nested))
        args: tuple[Argument, ...] = tuple(draw(st.lists(nested, max_size=4)))
        nodes.append(Node(values[i], "aten.any_thing.Out_1", args, tuple(sorted(keywords.items())), tuple(results)))
    outputs = draw(st.lists(st.sampled_from(values), max_size=3))
    first = {name: typed[name] for name in values[:inputs]}
    rest = {name: typed[name] for name in values[inputs:constants]}
    return Graph(first, rest, tuple(nodes), tuple(outputs))


@pytest.mark.slow
@given(graphs())
def test_round_trip_is_exact(graph: Graph) -> None:
    result = through_text(graph)
    # repr tells 1, 1.0 and True apart, and -0.0 from 0.0; equality does not.
    assert repr(result) == repr(graph)


def test_numbers_that_json_has_not() -> None:
    for value in (math.inf, -math.inf, math.nan):
        node = Node("y", "aten.full.default", ((2,), value), (), (TensorType((2,), "float32"),))
        assert repr(through_text(Graph({}, {}, (node,), ("y",))).nodes[0].args) == repr(((2,), value))


def document() -> dict[str, Any]:
    """A valid graph of every kind of thing."""
    type_ = TensorType((Batch(2), 3), "float32")
    nodes = (
        Node("s", "aten.split_with_sizes.default", (Ref("x"), (1, 2), 1), (), (type_, type_)),
        Node("g", GETITEM, (Ref("s"), 1), (), (type_,)),
        Node("y", "aten.add.Tensor", (Ref("g"), Ref("w")), (("alpha", Enum("dtype", "float32")),), (type_,)),
    )
    return graph_to_json(Graph({"x": type_}, {"w": type_}, nodes, ("y",)))


def setter(*path: Any, to: Any) -> Callable[[dict[str, Any]], None]:
    def change(doc: Any) -> None:
        for key in path[:-1]:
            doc = doc[key]
        doc[path[-1]] = to

    return change


HOSTILE: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "missing field": (
        lambda d: d.pop("outputs"),
        r"graphs\.stem: expected an object with the keys .*missing: \['outputs'\]",
    ),
    "unknown field": (setter("code", to="x"), r"graphs\.stem: .*unknown: \['code'\]"),
    "unknown node field": (
        setter("nodes", 0, "source", to="/home/me/x.py"),
        r"nodes\[0\]: .*the keys .*unknown: \['source'\]",
    ),
    "nodes not a list": (setter("nodes", to={}), "nodes: .*a list; found"),
    "node not an object": (setter("nodes", 0, to=[]), r"nodes\[0\]"),
    "python op": (setter("nodes", 0, "op", to="os.system"), r"nodes\[0\].op: .*found 'os.system'"),
    "dunder path": (setter("nodes", 0, "op", to="aten.add.Tensor.__globals__"), r"nodes\[0\].op"),
    "op with a line break": (setter("nodes", 0, "op", to="aten.add.Tensor\n"), r"nodes\[0\].op"),
    "op not text": (setter("nodes", 0, "op", to=7), r"nodes\[0\].op"),
    "unknown kind of argument": (setter("nodes", 0, "args", 2, to={"eval": "1"}), r"args\[2\]"),
    "two tags": (setter("nodes", 0, "args", 2, to={"ref": "x", "batch": 1}), r"args\[2\]"),
    "unknown value": (setter("nodes", 0, "args", 0, to={"ref": "q"}), r"nodes\[0\]: .*computed before .*%q"),
    "value from the future": (setter("nodes", 0, "args", 0, to={"ref": "y"}), r"nodes\[0\]: .*computed before .*%y"),
    "unknown output": (setter("outputs", 0, to="q"), r"outputs\[0\]: .*found 'q'"),
    "two values of a name": (setter("nodes", 1, "name", to="x"), r"nodes\[1\].name: .*no other value has; found 'x'"),
    "empty name": (setter("inputs", 0, "name", to=""), r"inputs\[0\].name"),
    "control character": (setter("inputs", 0, "name", to="a\x00b"), r"inputs\[0\].name"),
    "long name": (setter("inputs", 0, "name", to="a" * 513), r"inputs\[0\].name"),
    "getitem out of range": (setter("nodes", 1, "args", 1, to=2), r"nodes\[1\]: .*getitem of a value"),
    "getitem of what": (setter("nodes", 1, "args", to=[0, {"ref": "s"}]), r"nodes\[1\]: .*getitem of a value"),
    "dtype": (setter("inputs", 0, "type", "dtype", to="object"), r"inputs\[0\].type.dtype"),
    "dtype not text": (setter("inputs", 0, "type", "dtype", to=["float32"]), r"inputs\[0\].type.dtype"),
    "negative size": (setter("inputs", 0, "type", "shape", 1, to=-1), r"shape\[1\]"),
    "huge size": (setter("inputs", 0, "type", "shape", 1, to=2**41), r"shape\[1\]"),
    "true as a size": (setter("inputs", 0, "type", "shape", 1, to=True), r"shape\[1\]"),
    "zero batches": (setter("inputs", 0, "type", "shape", 0, to={"batch": 0}), r"shape\[0\].batch"),
    "rank": (setter("inputs", 0, "type", "shape", to=[1] * 17), r"type.shape: .*at most 16"),
    "no result": (setter("nodes", 2, "types", to=[]), r"nodes\[2\].types"),
    "huge integer": (setter("nodes", 0, "args", 2, to=2**63), r"args\[2\]: .*64-bit"),
    "not finite": (setter("nodes", 0, "args", 2, to=math.inf), r"args\[2\]: .*finite"),
    "strange float": (setter("nodes", 0, "args", 2, to={"float": "1e999"}), r"args\[2\]"),
    "deep list": (setter("nodes", 0, "args", 2, to=[[[[1]]]]), r"args\[2\].* 3 deep"),
    "long list": (setter("nodes", 0, "args", 1, to=[0] * 70_000), r"args\[1\]: .*at most 65536"),
    "long text": (setter("nodes", 0, "args", 2, to="a" * 513), r"args\[2\]"),
    "enum kind": (setter("nodes", 2, "kwargs", "alpha", "enum", 0, to="module"), "kwargs.alpha.enum"),
    "enum name": (setter("nodes", 2, "kwargs", "alpha", "enum", 1, to="a.b"), "kwargs.alpha.enum"),
    "enum shape": (setter("nodes", 2, "kwargs", "alpha", "enum", to="ab"), "kwargs.alpha.enum"),
    "keyword": (setter("nodes", 2, "kwargs", to={"not an identifier": 1}), "kwargs"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_what_is_no_graph_is_refused_with_its_place(case: str) -> None:
    change, message = HOSTILE[case]
    changed = copy.deepcopy(document())
    read(changed)
    change(changed)
    with pytest.raises(ArtifactError, match=message) as caught:
        read(changed)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("value", [None, [], "x", 3, {"inputs": []}])
def test_other_documents(value: object) -> None:
    with pytest.raises(ArtifactError, match="graphs.stem: expected an object"):
        read(value)


def test_arguments_that_cannot_be_written_name_the_node() -> None:
    node = Node("y", "aten.neg.default", (1j,), (), (TensorType((), "float32"),))  # type: ignore[arg-type]
    with pytest.raises(ArtifactError, match=r"node %y .*1j"):
        graph_to_json(Graph({}, {}, (node,), ("y",)))
