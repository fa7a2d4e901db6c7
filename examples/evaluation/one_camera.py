"""What it does to reuse the tokens of one camera alone, where a plan reuses those of all.

    python examples/evaluation/one_camera.py DIR observation.images.front --environment fetch-blocks --episodes 400

The frames of all other cameras are computed whole in every call. The options, seeds and tables are those of
``evaluate.py``; ``DIR:dense`` is what is compared with. At the end stands how many of the tokens of new frames were
computed, first frames of an episode left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import click
import evaluate
import numpy as np
import variants
from environments import Array

from ttscompile.runtimes.frames import FramePieces
from ttscompile.runtimes.tokens import Lane, TokenTower, TokenWork


class OneCamera:
    """In place of ``FramePieces.values`` and ``TokenTower.compute``: forgets the lanes of the other cameras.

    Attributes:
        computed: tokens of the camera's new frames that were computed; and how many there were.
    """

    def __init__(self, camera: str) -> None:
        self._camera, self.computed = camera, np.zeros(2, np.int64)
        self._lanes: dict[int, set[Lane]] = {}  # by number of streams
        self._values, self._compute = FramePieces.values, TokenTower.compute

    def patch(self, setattribute: Callable[[type, str, object], None]) -> None:
        """Take their place."""
        setattribute(FramePieces, "values", lambda frames, obs: self.values(frames, obs))
        setattribute(TokenTower, "compute", lambda tower, lane, row: self.compute(tower, lane, row))

    def values(self, frames: FramePieces, obs: Mapping[str, Array]) -> dict[str, Array]:
        """See ``FramePieces``."""
        streams = len(obs[self._camera])
        for name in frames._tokens:
            if streams not in self._lanes:
                self._lanes[streams] = self._of_camera(frames, name, obs)
        return self._values(frames, obs)

    def compute(self, tower: TokenTower, lane: Lane, row: Mapping[str, Array]) -> tuple[tuple[Array, ...], TokenWork]:
        """See ``TokenTower``."""
        own = any(lane in lanes for lanes in self._lanes.values())
        known = lane in tower._lanes
        if not own:
            tower._lanes.pop(lane, None)
        values, work = self._compute(tower, lane, row)
        if own and known:
            self.computed += work.computed, work.of
        return values, work

    def _of_camera(self, frames: FramePieces, name: str, obs: Mapping[str, Array]) -> set[Lane]:
        """The lanes whose rows change with the pictures of the camera."""
        lanes, (read, *_) = frames._lanes_of(name, obs), frames._pieces[name].inputs
        shown = {**obs, self._camera: 1 - obs[self._camera]}
        before, after = (frames._rows_of(each)[read].copy() for each in (obs, shown))
        changed = (before != after).reshape(len(before), -1).any(axis=1)
        return {lane for lane, one in zip(lanes, changed, strict=True) if one}


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("variant", metavar="DIR[:PLAN]")
@click.argument("camera")
@click.argument("options", nargs=-1, type=click.UNPROCESSED)
def main(variant: str, camera: str, options: tuple[str, ...]) -> None:
    """Evaluate DIR with the tokens of CAMERA reused; CAMERA is an observation of images."""
    policy = variants.open_variant(variant, "onnxruntime", 1).policy
    known = [key for key, one in policy.info.observation.items() if one.image]
    if camera not in known or not policy.info.reuses_tokens:
        raise click.BadParameter(f"{camera}: expected a plan that reuses tokens, and one of the cameras {known}.")
    one = OneCamera(camera)
    one.patch(setattr)
    directory = variant.partition(":")[0]
    evaluate.main([f"{directory}:dense", variant, *options, "--no-cache"], standalone_mode=False)
    computed, of = one.computed.tolist()
    click.echo(f"{camera}: {computed / of:.1%} of the {of:,} tokens of new frames were computed")


if __name__ == "__main__":
    variants.run(main)
