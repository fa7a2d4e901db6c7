"""A builder of small graphs, so that tests of passes read like the graphs they are about."""

from ttscompile.ir.graph import Argument, Batch, Graph, Node, Ref, Size, TensorType

B = Batch()


class Builder:
    """Collects inputs, constants and nodes; every method returns the ``Ref`` of the new value."""

    def __init__(self) -> None:
        self.inputs: dict[str, TensorType] = {}
        self.constants: dict[str, TensorType] = {}
        self.nodes: list[Node] = []

    def input(self, name: str, *shape: Size, dtype: str = "float32") -> Ref:
        self.inputs[name] = TensorType(shape, dtype)
        return Ref(name)

    def constant(self, name: str, *shape: int) -> Ref:
        self.constants[name] = TensorType(shape, "float32")
        return Ref(name)

    def op(self, name: str, op: str, shape: tuple[Size, ...], *args: Argument, **options: Argument) -> Ref:
        type_ = TensorType(shape, "float32")
        self.nodes.append(Node(name, f"aten.{op}", args, tuple(options.items()), (type_,), f"toy.py:{len(self.nodes)}"))
        return Ref(name)

    def graph(self, *outputs: Ref) -> Graph:
        return Graph(self.inputs, self.constants, tuple(self.nodes), tuple(o.name for o in outputs))

    def residual(self, name: str, stream: Ref, width: int = 8) -> Ref:
        """A feed-forward residual ``stream + linear(stream)``."""
        weight = self.constant(f"{name}.w", width, width)
        shape = (B, 4, width)
        return self.op(name, "add.Tensor", shape, stream, self.op(f"{name}.f", "linear.default", shape, stream, weight))


def chain(blocks: int) -> Graph:
    """sample -> linear -> ``blocks`` residuals -> linear."""
    b = Builder()
    h = b.op("embed", "linear.default", (B, 4, 8), b.input("x", B, 4, 2), b.constant("w_in", 8, 2))
    for i in range(blocks):
        h = b.residual(f"a{i}", h)
    return b.graph(b.op("head", "linear.default", (B, 4, 2), h, b.constant("w_out", 2, 8)))
