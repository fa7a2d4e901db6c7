"""Corrupted graphs and programs are found, and the message says where."""

from dataclasses import replace

import numpy as np
import pytest

from tests.passes.graphs import B, chain
from tests.passes.specs import toy_spec
from ttscompile.errors import PassError
from ttscompile.ir.graph import Graph, Node, Ref, TensorType
from ttscompile.ir.program import Captured
from ttscompile.ir.verify import verify, verify_graph


def program(graph: Graph) -> Captured:
    inputs = {"sample": graph.inputs["x"], "timestep": TensorType((B,), "int64"), "obs": TensorType((B, 3), "float32")}
    nodes = tuple(n.renamed(lambda name: "sample" if name == "x" else name) for n in graph.nodes)
    weights = {n: np.zeros(t.at(1), np.float32) for n, t in graph.constants.items()}
    return Captured(toy_spec(), replace(graph, inputs=inputs, nodes=nodes), weights)


def test_a_sound_program_passes() -> None:
    verify(program(chain(2)))


def test_use_before_definition_names_the_node_its_line_and_its_neighbours() -> None:
    graph = chain(2)
    broken = replace(graph, nodes=tuple(reversed(graph.nodes)))
    with pytest.raises(PassError, match=r"%head reads %a1, which is not defined there") as caught:
        verify_graph(broken, "denoiser")
    assert "> %head" in str(caught.value) and "toy.py:5" in str(caught.value) and "%a1 :" in str(caught.value)


def test_two_definitions_of_a_name() -> None:
    graph = chain(1)
    with pytest.raises(PassError, match="%a0 is defined twice"):
        verify_graph(replace(graph, nodes=(*graph.nodes, graph.producers()["a0"])), "denoiser")


def test_input_and_constant_of_one_name() -> None:
    graph = chain(1)
    with pytest.raises(PassError, match="%x is both an input and a constant"):
        verify_graph(replace(graph, constants={**graph.constants, "x": TensorType((1,), "float32")}), "denoiser")


def test_missing_output() -> None:
    with pytest.raises(PassError, match="output %nowhere is not defined"):
        verify_graph(replace(chain(1), outputs=("nowhere",)), "denoiser")


def test_a_node_without_result() -> None:
    node = Node("empty", "aten.neg.default", (Ref("x"),), (), ())
    with pytest.raises(PassError, match="%empty has no result"):
        verify_graph(replace(chain(1), nodes=(node,), outputs=("x",)), "denoiser")


def test_weight_of_another_shape_or_missing() -> None:
    sound = program(chain(1))
    with pytest.raises(PassError, match=r"constant %w_in is float32\[3\]; its type says float32\[8, 2\]"):
        verify(replace(sound, weights={**sound.weights, "w_in": np.zeros(3, np.float32)}))
    with pytest.raises(PassError, match="constant %w_out has no value"):
        verify(replace(sound, weights={n: w for n, w in sound.weights.items() if n != "w_out"}))


def test_inputs_in_another_order() -> None:
    sound = program(chain(1))
    swapped = replace(sound.denoiser, inputs=dict(reversed([*sound.denoiser.inputs.items()])))
    with pytest.raises(PassError, match="inputs .* expected"):
        verify(replace(sound, denoiser=swapped))
