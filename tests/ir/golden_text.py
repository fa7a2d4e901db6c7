"""Compare the text of a graph with a golden text, whatever its values are called."""

import difflib
import re

from ttscompile.ir.graph import Graph


def canonical(text: str) -> list[str]:
    """Lines with the values renamed %0, %1, ... in the order in which they appear, and blank lines dropped."""
    names: dict[str, str] = {}

    def rename(match: re.Match[str]) -> str:
        return names.setdefault(match.group(0), f"%{len(names)}")

    lines = [" ".join(line.split()) for line in text.strip().splitlines()]
    return [re.sub(r"%[\w.]+", rename, line) for line in lines if line]


def assert_text(graph: Graph, golden: str) -> None:
    """Raise AssertionError with a diff unless the graph reads like the golden text."""
    found, expected = canonical(str(graph)), canonical(golden)
    if found != expected:
        diff = "\n".join(difflib.unified_diff(expected, found, "golden", "found", lineterm=""))
        raise AssertionError(f"the graph differs from its golden text:\n{diff}")
