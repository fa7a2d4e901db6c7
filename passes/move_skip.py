"""Have the sampler's table add the sample to a prediction ``sample + f``, so that the blocks inside f are found."""

from dataclasses import replace

from ttscompile.ir.graph import Graph, Ref
from ttscompile.ir.program import Captured

from .base import Pass, PassResult

_ADD = "aten.add.Tensor"


def skips_network(graph: Graph, sample: str) -> bool:
    """Whether the prediction is ``sample + f`` or ``f + sample``, and nothing else is done to the sum."""
    return _network(graph, sample) is not None


class MoveSkip(Pass[Captured, Captured]):
    """Predict f alone where the network predicts ``sample + f``.

    Before::

        %f          = network(%sample)                        # its residual stream is inside
        %prediction = aten.add.Tensor(%sample, %f)            # a path around all of it

    After, with samplers whose tables add the sample (``SamplerTable.with_skip``), in every loop::

        %f          = network(%sample)                        # the prediction

    A sampler is linear in the prediction, so no sample changes by more than rounding.
    """

    def call(self, program: Captured) -> PassResult[Captured]:
        graph, spec = program.denoiser, program.spec
        inside = _network(graph, spec.sample_argument)
        if inside is None:
            raise self.fail("the prediction is not the sample plus something of its type.")
        nodes = tuple(node for node in graph.nodes if node.name not in graph.outputs)
        moved = replace(graph, nodes=nodes, outputs=(inside,))
        loops = {name: table.with_skip() for name, table in spec.loops.items()}
        added = replace(spec, sampler=spec.sampler.with_skip(), loops=loops)
        note = f"the sampler's table adds %{spec.sample_argument} to the prediction, which is %{inside} now"
        return PassResult(replace(program, denoiser=moved, spec=added, unmoved=spec), (note,))


def _network(graph: Graph, sample: str) -> str | None:
    (output,) = graph.outputs
    node, types = graph.producers().get(output), graph.types()
    if node is None or node.op != _ADD or node.kwargs:
        return None
    names = [argument.name for argument in node.args if isinstance(argument, Ref)]
    others = [name for name in names if name != sample]
    alone = len(names) == 2 and len(others) == 1
    return others[0] if alone and types[others[0]] == types[sample] == node.type else None
