"""The table of ``docs/support.md``: a row a family, asserted by its own tests, rendered from ``docs/support.json``.

A test of a family compiles it and calls ``record``, which compares what it finds with the committed row. Where they
differ the message holds the row to paste. ``python -m tests.families.support`` writes the table into the page.
"""

import json
from collections import Counter
from pathlib import Path
from typing import Any

from tests.ir.meta import assert_types_of
from ttscompile.artifact.load import Artifact
from ttscompile.ir.flops import graph_flops, once_flops
from ttscompile.ir.graph import Graph
from ttscompile.ir.program import Block, Program

ROOT = Path(__file__).resolve().parents[2]
RECORD = ROOT / "docs" / "support.json"
PAGE = ROOT / "docs" / "support.md"
COLUMNS = (
    "Policy",
    "Compared with, and largest difference allowed",
    "Sampler and steps",
    "Residual blocks found",
    "Arithmetic not repeated at every step",
)
BEGIN, END = "<!-- support:begin -->", "<!-- support:end -->"

Row = dict[str, Any]


def record(family: str, verified_against: str, sampler: str, program: Program) -> None:
    """Assert that the committed table says of this family what was just found.

    Args:
        family: first column, and the key of the row; project and policy, ``LeRobot multi_task_dit, flow matching``.
        verified_against: what its outputs were compared with, and the tolerance.
        sampler: name and number of steps.
        program: the compiled family, as ``ttscompile.compile_denoiser`` and ``convert`` return it.

    Raises:
        AssertionError: the row is missing or says something else; the message holds the right one.
    """
    assert_types_of(program)
    found = row(family, verified_against, sampler, program)
    committed = next((each for each in read_record()["families"] if each["family"] == family), None)
    assert committed == found, (
        f"{RECORD.relative_to(ROOT)}, families: the row of {family!r} must be\n{json.dumps(found, indent=2)}\n"
        f"and is\n{json.dumps(committed, indent=2)}\nCorrect it, then run python -m tests.families.support."
    )


def row(family: str, verified_against: str, sampler: str, program: Program) -> Row:
    """The row of a compiled family.

    ``hoisted`` is the share of the K evaluations' FLOPs that are not computed for every step any more, and ``batched``
    what is, in one batch before the loop. What runs once a call, an observation encoder too, is not in the sum: the
    original does not compute an encoder for every step either.
    """
    pieces = program.pieces
    steps = program.spec.sampler.steps
    loop = sum(graph_flops(piece.graph) for piece in pieces.loop.values()) * steps
    batched = 0 if pieces.step is None else graph_flops(pieces.step) * steps
    evaluations = program.dense_flops - once_flops(pieces) or 1  # 0 where all of it runs once a call
    kinds = Counter(block.kind for block in program.blocks)
    return {
        "family": family,
        "verified_against": verified_against,
        "sampler": sampler,
        "blocks": dict(sorted(kinds.items())),
        "hoisted": round(1 - (loop + batched) / evaluations, 3),
        "batched": round(batched / evaluations, 3),
    }


def stored_program(artifact: Artifact) -> Program:
    """The program of an artifact, which does not keep the captured denoiser: its blocks name no values."""
    blocks = tuple(Block(i, b.kind, "", "", None, b.type, b.group) for i, b in enumerate(artifact.manifest.blocks))
    weights = {**artifact.weights, **artifact.pruner}
    empty, dense = Graph({}, {}, (), ()), artifact.manifest.flops.dense
    return Program(artifact.manifest.spec, empty, weights, blocks, artifact.pieces, dense_flops=dense)


def read_record() -> dict[str, list[Row]]:
    """``families`` and ``not_compiled``, the latter with a reason each."""
    content: dict[str, list[Row]] = json.loads(RECORD.read_text(encoding="utf-8"))
    return content


def render(content: dict[str, list[Row]]) -> str:
    """The table in Markdown, between its markers."""
    lines = [BEGIN, f"| {' | '.join(COLUMNS)} |", "| --- | --- | --- | --- | --- |"]
    lines += [
        f"| {each['family']} | {each['verified_against']} | {each['sampler']} | {_blocks(each)} | {_hoisted(each)} |"
        for each in content["families"]
    ]
    lines += ["", "| Not compiled | Why, and what you can do |", "| --- | --- |"]
    lines += [f"| {each['family']} | {each['reason']} |" for each in content["not_compiled"]]
    return "\n".join([*lines, END])


def _blocks(each: Row) -> str:
    """``24: 8 cross-attention, 8 feed-forward, 8 self-attention``; of one block, what it is."""
    kinds = each["blocks"]
    if kinds == {"network": 1}:
        return "1: the whole network"
    if sum(kinds.values()) == 1 and each["hoisted"] + each["batched"] >= 1:
        return "1: nothing to reuse"
    return f"{sum(kinds.values())}: " + ", ".join(f"{n} {kind.replace('_', '-')}" for kind, n in kinds.items())


def _hoisted(each: Row) -> str:
    """What left the loop, and what is still computed for every step, in one batch."""
    batched = f", and {each['batched']:.1%} done for all steps in one batch" if each["batched"] else ""
    return f"{each['hoisted']:.1%}{batched}"


def in_page(text: str) -> str:
    """The table as the page has it."""
    assert text.count(BEGIN) == text.count(END) == 1, f"{PAGE.name} needs {BEGIN} and {END}, once each"
    return BEGIN + text.partition(BEGIN)[2].partition(END)[0] + END


def main() -> None:
    """Write the table into the page."""
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(text.replace(in_page(text), render(read_record())), encoding="utf-8")


if __name__ == "__main__":
    main()
