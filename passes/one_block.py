"""Make one residual block of a denoiser that has no residual stream, so that whole evaluations can be reused."""

from dataclasses import dataclass, replace

from ttscompile.ir.graph import Node, Ref, TensorType
from ttscompile.ir.program import Captured

from .base import Pass, PassResult

_PAD = "aten.constant_pad_nd.default"


@dataclass(frozen=True)
class OneBlock(Pass[Captured, Captured]):
    """Carry the sample beside the prediction, so that the prediction is a residual like any other.

    Before::

        %prediction = network(%sample)                     # [B, T, D]; no value a is updated as a + f(a)

    After::

        %stream = aten.constant_pad_nd(%sample, [0, D])    # [sample, 0]
        %taken  = aten.slice(%stream, -1, 0, D)
        %made   = network(%taken)
        %residual = aten.constant_pad_nd(%made, [D, 0])    # [0, prediction]: the one block
        %updated  = aten.add(%stream, %residual)
        %prediction = aten.slice(%updated, -1, D, 2 D)

    Nothing is computed but copies, and no number changes. A reused residual is the prediction of an earlier step.
    """

    reason: str

    def call(self, program: Captured) -> PassResult[Captured]:
        graph, sample = program.denoiser, program.spec.sample_argument
        (made,) = graph.outputs
        type_ = graph.inputs[sample]
        if graph.types()[made] != type_:
            raise self.fail(f"the prediction is {graph.types()[made]}, and the sample {type_}; expected the same.")
        *others, width = program.spec.sample
        wide, last = TensorType((type_.shape[0], *others, 2 * width), type_.dtype), len(others) + 1
        stream, taken, residual, updated, prediction = (
            f"{sample}.{name}" for name in ("stream", "taken", "residual", "updated", "prediction")
        )

        nodes = (
            Node(stream, _PAD, (Ref(sample), (0, width), 0.0), (), (wide,)),
            Node(taken, "aten.slice.Tensor", (Ref(stream), last, 0, width), (), (type_,)),
            *graph.renamed({sample: taken}).nodes,
            Node(residual, _PAD, (Ref(made if made != sample else taken), (width, 0), 0.0), (), (wide,)),
            Node(updated, "aten.add.Tensor", (Ref(stream), Ref(residual)), (), (wide,)),
            Node(prediction, "aten.slice.Tensor", (Ref(updated), last, width, 2 * width), (), (type_,)),
        )
        whole = replace(graph, nodes=nodes, outputs=(prediction,))
        note = f"the whole network is one block, whose residual is its prediction: {self.reason}"
        return PassResult(replace(program, denoiser=whole), (note,))
