"""What it costs to compute fewer tokens of image encoders, with rows of similar tokens and without.

    python examples/evaluation/some_tokens.py DIR --thresholds 0.1,0.3 --environment fetch-blocks --episodes 400

A token is computed where its patch differs by more than a threshold; the plan is dense otherwise. One that is not
computed may have the rows of a similar one of the same frame (``docs/design.md`` section 2); with ``--kept`` each keeps
its own. With ``--scenes 0.2`` a token of the scene is computed where its row differs by more than this share. The other
options, the seeds and the tables are those of ``evaluate.py``. At the end stands how many of the tokens of new frames
and scenes were computed, first ones of an episode left out.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import click
import evaluate
import numpy as np
import variants
from environments import Array

from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import update_plans
from ttscompile.core.plan import DENSE, TokenReuse
from ttscompile.ir.pieces import SCENE
from ttscompile.runtimes.tokens import Lane, TokenTower, TokenWork

REFRESH = 32
"""Of so many new frames one is whole: the most that calibration takes."""


class Counted:
    """In place of ``TokenTower.compute``, and of what finds similar tokens where ``kept``.

    Attributes:
        computed: by setting, and whether it is the scene, the tokens that were computed, and how many there were.
    """

    def __init__(self, kept: bool) -> None:
        self._kept, self.computed = kept, dict[tuple[TokenReuse, bool], Array]()
        self._compute = TokenTower.compute

    def patch(self, setattribute: Callable[[type, str, object], None]) -> None:
        """Take their place."""
        setattribute(TokenTower, "compute", lambda tower, lane, row: self.compute(tower, lane, row))
        if self._kept:
            setattribute(TokenTower, "_similar", lambda tower, old, new, index, off: (index[:0], index[:0]))

    def compute(self, tower: TokenTower, lane: Lane, row: Mapping[str, Array]) -> tuple[tuple[Array, ...], TokenWork]:
        """See ``TokenTower``."""
        known = lane in tower._lanes
        values, work = self._compute(tower, lane, row)
        if known:
            key = tower._reuse, lane.camera == SCENE
            self.computed.setdefault(key, np.zeros(2, np.int64))[:] += work.computed, work.of
        return values, work


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("directory", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--thresholds", required=True, help="Differences of patches, with commas between them.")
@click.option("--scenes", default="", help="Shares of a scene's rows, each with every threshold; none: whole scenes.")
@click.option("--kept", is_flag=True, help="No token has the rows of another one.")
@click.argument("options", nargs=-1, type=click.UNPROCESSED)
def main(directory: Path, thresholds: str, scenes: str, kept: bool, options: tuple[str, ...]) -> None:
    """Evaluate the policy of the artifact in DIRECTORY with fewer tokens."""
    counted = Counted(kept)
    counted.patch(setattr)
    with tempfile.TemporaryDirectory() as own:
        folder = Path(shutil.copytree(directory, Path(own) / directory.name))
        plans = load_artifact(folder).plans
        some = {
            f"over-{one}{f'-scene-{share}' * bool(share)}": replace(
                plans[DENSE], tokens=TokenReuse(float(one), REFRESH, float(share) if share else None)
            )
            for one in thresholds.split(",")
            for share in scenes.split(",")
        }
        update_plans(folder, {**plans, **some}, DENSE)
        driven = [f"{folder}:{name}" for name in (DENSE, *some)]
        evaluate.main([*driven, *options, "--no-cache"], standalone_mode=False)
    for (reuse, scene), (computed, of) in counted.computed.items():
        what = f"scenes over {reuse.scene:g}" if scene else "frames"
        click.echo(f"{reuse.threshold:g}: {computed / of:.1%} of the {of:,} tokens of new {what} were computed")


if __name__ == "__main__":
    variants.run(main)
