"""The structure of the package, read from its imports: ``python tests/structure.py`` draws it.

A *room* is a folder, or a module, at the top of the package; a *door* of a room is another room that it imports,
wherever the import stands: in a function and under ``TYPE_CHECKING`` too. What a room loads *by name* is no door: there
is no import of it, and it may stand on a floor above. Design, section 4, says what is, and why.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))

from tests.imports import home, imports, imports_by_name, modules  # noqa: E402

FLOORS = (
    ("errors",),
    ("core", "measure"),
    ("hub", "ir", "plots", "samplers"),
    ("artifact", "frontends", "lower", "passes", "trajectories"),
    ("capture", "policies", "pool", "runtimes"),
    ("doctor", "verification"),
    ("calibration", "driver", "report"),
    ("builder", "rivals"),
    ("ttscompile",),
    ("cli",),
    ("serving",),
    ("__main__",),
)
"""The rooms from the ground up: each may import those on floors below its own. ``ttscompile`` is the package's own
module, which has the public names."""

Doors = Mapping[str, Mapping[str, int]]
"""Room -> the rooms that it imports, or loads by name, and in how many places."""


def room(module: str) -> str:
    """``ttscompile.ir.graph`` -> ``ir``; ``ttscompile`` itself is a room too."""
    return module.removeprefix("ttscompile").lstrip(".").partition(".")[0] or "ttscompile"


def doors_of(root: Path = ROOT) -> dict[str, dict[str, int]]:
    """The doors of every room."""
    return _edges(root, lambda name, path: [each.target for each in imports(name, path)])


def by_name_of(root: Path = ROOT) -> dict[str, dict[str, int]]:
    """What every room loads by name of other rooms."""
    return _edges(root, imports_by_name)


def _edges(root: Path, targets: Callable[[str, Path], list[str]]) -> dict[str, dict[str, int]]:
    known = modules(root)
    found: dict[str, dict[str, int]] = {room(name): {} for name in known}
    for name, path in known.items():
        for each in targets(name, path):
            target = home(each, known)
            if target is not None and room(target) != room(name):
                edges = found[room(name)]
                edges[room(target)] = edges.get(room(target), 0) + 1
    return found


def circles(doors: Doors) -> list[tuple[str, ...]]:
    """Sets of rooms that import each other, directly or through others; none in a house that can be read."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        pending = [start]
        while pending:
            for target in doors[pending.pop()]:
                if target not in seen:
                    seen.add(target)
                    pending.append(target)
        return seen

    reach = {name: reached(name) for name in doors}
    return sorted({tuple(sorted(b for b in reach[a] if a in reach[b])) for a in doors if a in reach[a]})


def arrows_up(doors: Doors) -> list[str]:
    """Imports that do not lead to a floor below, one line each."""
    floor = {name: i for i, rooms in enumerate(FLOORS) for name in rooms}
    pairs = ((a, b, n) for a, targets in doors.items() for b, n in targets.items())
    return [f"{a} -> {b} ({n} imports)" for a, b, n in pairs if floor[b] >= floor[a]]


def drawing(doors: Doors, by_name: Doors | None = None) -> str:
    """Floors from the top down; beside each room its doors and where they lead; at the end what is wrong."""
    lines = []
    for number in reversed(range(len(FLOORS))):
        lines.append(f"floor {number}")
        for name in FLOORS[number]:
            targets = ", ".join(f"{target} {n}" for target, n in sorted(doors[name].items(), key=lambda each: -each[1]))
            lines.append(f"  {name:<13}{len(doors[name]):>3} doors" + (f": {targets}" if targets else ""))
    named = [f"{a} -> {b} ({n})" for a, targets in (by_name or {}).items() for b, n in targets.items()]
    lines.append("by name: " + ("; ".join(named) or "none"))
    for what, found in (("circles", [" - ".join(c) for c in circles(doors)]), ("arrows up", arrows_up(doors))):
        lines.append(f"{what}: " + ("; ".join(found) or "none"))
    return "\n".join(lines)


if __name__ == "__main__":
    print(drawing(doors_of(), by_name_of()))
