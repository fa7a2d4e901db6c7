"""``core.chunk.Relative.absolute`` in ONNX."""

from ..core.chunk import Relative
from ..core.poses import NUMBERS
from .graph_writer import GraphWriter


def write_absolute(main: GraphWriter, actions: str, reference: str, relative: Relative) -> str:
    """Actions of the robot ``[B, T, Da]``, of what the network gives and of what it is relative to, ``[B, 1, Da]``."""
    changed, parts, end = main.op("Add", actions, reference), [], 0
    for pose in sorted(relative.poses, key=lambda pose: pose.action):
        start = pose.action
        own = [_part(main, value, start, start + NUMBERS) for value in (reference, actions)]
        parts += [_part(main, changed, end, start), _composed(main, *own)]
        end = start + NUMBERS
    parts.append(_part(main, changed, end, len(relative.entries)))
    return main.op("Concat", *parts, axis=2) if relative.poses else changed


def _composed(main: GraphWriter, measured: str, pose: str) -> str:
    """``core.poses.composed``."""
    rotation, own = _matrix(main, measured), _matrix(main, pose)
    position = main.op("MatMul", rotation, main.op("Reshape", _part(main, pose, 0, 3), main.constant([0, 0, 3, 1])))
    position = main.op("Add", main.op("Reshape", position, main.constant([0, 0, 3])), _part(main, measured, 0, 3))
    rows = main.op("Reshape", main.op("MatMul", rotation, own), main.constant([0, 0, NUMBERS]))
    return main.op("Concat", position, _part(main, rows, 0, 6), axis=2)


def _matrix(main: GraphWriter, poses: str) -> str:
    """``[B, N, 3, 3]`` of ``[B, N, 9]``."""
    first, second = (_part(main, poses, start, start + 3) for start in (3, 6))
    first = _of_length_one(main, first)
    along = main.op("ReduceSum", main.op("Mul", first, second), main.constant([2]))
    second = _of_length_one(main, main.op("Sub", second, main.op("Mul", along, first)))
    ahead, behind = (main.constant(order) for order in ([1, 2, 0], [2, 0, 1]))
    plus, minus = (
        main.op("Mul", main.op("Gather", first, one, axis=2), main.op("Gather", second, other, axis=2))
        for one, other in ((ahead, behind), (behind, ahead))
    )
    third = main.op("Sub", plus, minus)
    return main.op("Reshape", main.op("Concat", first, second, third, axis=2), main.constant([0, 0, 3, 3]))


def _of_length_one(main: GraphWriter, row: str) -> str:
    return main.op("Div", row, main.op("ReduceL2", row, main.constant([2])))


def _part(main: GraphWriter, value: str, start: int, end: int) -> str:
    return main.op("Slice", value, *(main.constant([n]) for n in (start, end, 2)))
