"""Success by phrasing, of what ``evaluate.py --json`` printed.

python examples/evaluation/evaluate.py DIR:dense DIR --environment fetch-blocks --episodes 400 --json > seen.json
python examples/evaluation/evaluate.py DIR:dense DIR --environment fetch-blocks:unseen --episodes 200 --json > new.json
python examples/policies/vla/phrasings.py seen.json new.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[2] / "evaluation"))

from environments.fetch_blocks import SEEN, UNSEEN, template

OF_WORLD = {"fetch-blocks": SEEN, "fetch-blocks:unseen": UNSEEN}


def by_phrasing(document: dict[str, Any]) -> dict[str, list[list[bool]]]:
    """By phrasing the successes of each variant's episodes.

    Args:
        document: of an evaluation in ``fetch-blocks`` or ``fetch-blocks:unseen``.
    """
    phrasings, found = OF_WORLD[document["environment"]], dict[str, list[list[bool]]]()
    for i, variant in enumerate(document["variants"]):
        for episode in variant["episodes"]:
            words = template(episode["task"], episode["seed"], phrasings)
            found.setdefault(words, [[] for _ in document["variants"]])[i].append(episode["success"])
    return dict(sorted(found.items()))


@click.command()
@click.argument("documents", nargs=-1, required=True, type=click.Path(exists=True, dir_okay=False, path_type=Path))
def main(documents: tuple[Path, ...]) -> None:
    """Print a row for each phrasing of DOCUMENTS: of how many episodes each variant solves how many."""
    for path in documents:
        document = json.loads(path.read_text())
        table = Table("phrasing", "episodes", *(f"variant {i + 1}" for i in range(len(document["variants"]))))
        for words, successes in by_phrasing(document).items():
            table.add_row(words, str(len(successes[0])), *(str(sum(one)) for one in successes))
        Console().print(f"{path}: {document['environment']}", table)


if __name__ == "__main__":
    main()
