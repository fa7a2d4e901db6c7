"""What share of the core's lines the first cases of quick tests run, a row a room. ``make test`` ends with this table.

    python tests/covered.py

reads what ``pytest --cov`` left, and exits with 1 if the share of all rooms is below the floor.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import coverage

ROOT = Path(__file__).resolve().parents[1]
FLOOR = 90.0
"""Percent."""
Counts = tuple[int, int]
"""Statements, and those that ran."""


def room(path: Path) -> str:
    """``ttscompile/artifact/load.py`` -> ``artifact``; a module at the top is a room of its own."""
    top, *rest = path.relative_to(ROOT).parts
    return top if top != "ttscompile" else rest[0].removesuffix(".py")


def by_room(files: Mapping[Path, Counts]) -> dict[str, Counts]:
    """What the files of each room have together, the room with the smallest share first."""
    statements, ran = Counter[str](), Counter[str]()
    for path, (count, covered) in files.items():
        statements[room(path)] += count
        ran[room(path)] += covered
    rooms = {name: (count, ran[name]) for name, count in statements.items() if count}
    return dict(sorted(rooms.items(), key=lambda item: (item[1][1] / item[1][0], item[0])))


def table(rooms: Mapping[str, Counts], floor: float) -> tuple[str, bool]:
    """The rows as text, with the total, and whether that reaches the floor in percent."""
    total = (sum(count for count, _ in rooms.values()), sum(ran for _, ran in rooms.values()))
    lines = [f"{'room':<14}{'statements':>12}{'not run':>9}{'share':>8}"]
    for name, (count, ran) in [*rooms.items(), ("all", total)]:
        lines.append(f"{name:<14}{count:>12}{count - ran:>9}{100 * ran / count:>7.1f}%")
    reached = 100 * total[1] / total[0] >= floor
    return "\n".join([*lines, f"{'at least' if reached else 'BELOW'} {floor:g} %"]), reached


def measured() -> dict[Path, Counts]:
    """Statements of each file, and those that ran."""
    data = coverage.Coverage(config_file=str(ROOT / "pyproject.toml"))
    data.load()
    found = {}
    for file in data.get_data().measured_files():
        _, statements, _, missing, _ = data.analysis2(file)
        found[Path(file)] = (len(statements), len(statements) - len(missing))
    return found


def main() -> int:
    """Print the table."""
    files = measured()
    if not files:
        sys.exit("error: nothing was measured. Run make pytest, or pytest --cov.")
    text, reached = table(by_room(files), FLOOR)
    print(text)
    return 0 if reached else 1


if __name__ == "__main__":
    sys.exit(main())
