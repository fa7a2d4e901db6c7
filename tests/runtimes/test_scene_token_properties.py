"""Scenes of which some tokens are computed, whatever cameras show and words say, against their definition."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tests.families.cameras import CAMERAS, happened, moved, picture
from tests.families.scenes import compile_rows, observation, together
from tests.literal_tokens import LiteralSceneChoice, LiteralTokens
from tests.once import Once
from ttscompile import Plan, TokenReuse
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.coercion import Array
from ttscompile.core.plan import DENSE
from ttscompile.ir.pieces import INDEX, PLACES, ROWS, SCENE
from ttscompile.ir.tokens import find_sequence
from ttscompile.runtimes.frames import FramePieces
from ttscompile.runtimes.onnxruntime.backend import OnnxBackend
from ttscompile.runtimes.onnxruntime.sessions import Sessions
from ttscompile.runtimes.tokens import Lane, TokenTower, TokenWork

pytestmark = pytest.mark.slow

KINDS, SHARES, REFRESHES = ("rows", "grid"), ((0.0, 0.0), (0.0437, 0.031), (0.311, 0.2), (0.0, 50.0)), (1, 3, 32)
"""Of ``grid`` the towers have no tokens, and thresholds for patches say nothing. Then those for patches and rows."""
EVENTS = (
    *("still", "patch", "some", "light", "noise", "shifted", "cut", "frozen", "swapped", "back"),
    *("another word", "the word before", "alike", "reset"),
)
WORDS = range(72, 80)
"""After 36 rows of each picture."""


class Literally:
    """What scenes literally give, and which of their tokens are computed: beside the runtime, which is asked for both.

    Args:
        artifact: the policy.
        reuse: of its tokens.

    Attributes:
        works: what was done for each new scene.
    """

    def __init__(self, artifact: Artifact, reuse: TokenReuse) -> None:
        plan = Plan(cells=artifact.plan(f"{DENSE}@fp32").cells, tokens=reuse)
        with artifact.reading():
            self.frames: FramePieces = OnnxBackend(view_of(artifact, plan), Sessions(1), {}).frames
        self.works = list[TokenWork]()
        self._scene, self._reuse, self._weights = artifact.graph(SCENE), reuse, artifact.weights
        self._tower: TokenTower = self.frames._tokens[SCENE]
        self._compute, self._renew = self._tower.compute, self._tower._renew
        tower: Any = self._tower
        tower.compute, tower._renew = self.compute, self.renewed
        self.forget()

    def forget(self) -> None:
        """All that was seen."""
        self.frames.forget()
        self._given = dict[Any, tuple[Array, ...]]()
        self._literal, self._choice = dict[Lane, LiteralTokens](), dict[Lane, LiteralSceneChoice]()

    def renewed(self, piece: str, feed: Mapping[str, Array], kept: Any) -> Any:
        """In place of the piece for some tokens, which it asks."""
        self._fed = dict(feed)
        return self._renew(piece, feed, kept)

    def compute(self, lane: Lane, row: Mapping[str, Array]) -> tuple[tuple[Array, ...], TokenWork]:
        """In place of the tower's, which it asks."""
        self._fed = {}
        values, work = self._compute(lane, row)
        if lane not in self._literal:
            stream = find_sequence(self._scene)
            assert not isinstance(stream, str)
            self._literal[lane] = LiteralTokens(self._scene, self._weights, stream)
            self._choice[lane] = LiteralSceneChoice(self._reuse, WORDS)
        index = self._fed[INDEX].tolist() if self._fed else []
        if index:
            assert sorted(self._fed[PLACES].tolist()) == sorted(index), "no other token takes a row: no FORWARD"
            assert self._fed[INDEX][self._fed[ROWS]].tolist() == self._fed[PLACES].tolist()
        literal = self._literal[lane]
        (sequence,) = self._tower._run(self._tower._pixels, {name: row[name] for name in self._tower._cut})
        why = self._choice[lane].require(sequence[0, 0], row["tokens"].tobytes(), index)
        assert work == TokenWork(len(sequence[0, 0]), **why, camera=SCENE, stream=lane.stream)
        if index:
            self._given[lane, None] = tuple(literal(row, index))
        for found, wanted in zip(values, self._given[lane, None], strict=True):
            np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-5)
        self.works.append(work)
        return values, work

    def require(self, obs: Mapping[str, Array]) -> None:
        """Raise AssertionError unless each stream has the scene that was computed for what it sees, in its own lane."""
        done, streams = len(self.works), len(obs["state"])
        values = self.frames.values(obs)
        work, scene = self.frames.work, self.frames._scene
        assert scene is not None
        assert tuple(one for one in work.by_camera if one.camera == SCENE) == tuple(self.works[done:])
        assert (work.scenes, work.scenes + work.scenes_remembered) == (len(self.works) - done, streams)
        assert work.tokens == sum(one.computed for one in work.by_camera)
        assert work.of == sum(one.of for one in work.by_camera)
        _, known = self.frames._learned(obs, lambda: False)
        results = {name: self.frames._memory[name].results(own) for name, own in known.items()}
        for stream in range(streams):
            lane = Lane(b"%d" % streams, SCENE, stream)
            shown = [tuple(np.split(np.array(own, object), streams)[stream]) for own in results.values()]
            content = (lane, *shown, obs["tokens"][stream].tobytes())
            found = [values[name][stream : stream + 1] for name in scene.outputs]
            if stream in {one.stream for one in self.works[done:]}:
                self._given[content] = self._given[lane, None]
            for one, wanted in zip(found, self._given[content], strict=True):
                np.testing.assert_allclose(one, wanted, rtol=0, atol=1e-5)


@pytest.fixture(scope="module")
def folder(once: Once) -> Path:
    return once.folder("scenes of rows", compile_rows)


@pytest.fixture(scope="module")
def all_of_them(folder: Path) -> dict[Any, Literally]:
    """By policy, thresholds and refresh."""
    found = dict[Any, Literally]()
    for kind in KINDS:
        artifact = load_artifact(folder / kind)
        for patch, share in SHARES:
            for refresh in REFRESHES:
                found[kind, (patch, share), refresh] = Literally(artifact, TokenReuse(patch, refresh, share))
    return found


Story = st.lists(st.tuples(st.sampled_from(EVENTS), st.integers(0, 35), st.floats(0.0, 0.5, width=16)), max_size=8)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(st.sampled_from(KINDS), st.sampled_from(SHARES), st.sampled_from(REFRESHES), st.integers(1, 2), Story)
def test_scenes_have_what_the_definition_says(
    all_of_them: dict[Any, Literally],
    kind: str,
    shares: tuple[float, float],
    refresh: int,
    streams: int,
    story: list[tuple[str, int, float]],
) -> None:
    """Which tokens are computed and why, and what comes out, to rounding, for each of one or two streams.

    ``back`` is what was there before the last event; ``alike``, all streams see what one of them does.
    """
    literally = all_of_them[kind, shares, refresh]
    literally.forget()
    shown, words = [[picture(2 * s), picture(2 * s + 1)] for s in range(streams)], [1 + s for s in range(streams)]
    before, frozen, last_word = [list(pair) for pair in shown], False, words[0]
    for what, where, much in (("still", 0, 0.0), *story):
        stream = where % streams
        if what == "reset":
            literally.forget()
        frozen = what == "frozen" or (frozen and what != "cut")
        last = [list(pair) for pair in shown]
        if what == "another word":
            last_word, words[stream] = words[stream], where % 16
        elif what == "the word before":
            words[stream] = last_word
        elif what == "alike":
            shown, words = [list(shown[stream]) for _ in range(streams)], [words[stream]] * streams
        elif what == "back":
            shown = before
        elif not frozen:
            shown[stream] = happened(what, shown[stream], where, much)
        before = last
        obs = together(*(observation(word=word, state=where) for word in words))
        for i, key in enumerate(CAMERAS):
            obs[key] = np.stack([pair[i] for pair in shown])[:, None]
        literally.require(obs)


def test_every_reason_comes_about(all_of_them: dict[Any, Literally]) -> None:
    """Else the stories above would say little: whole scenes for each reason, some tokens, and none."""
    reasons = set[tuple[str, ...]]()
    for kind in KINDS:
        literally = all_of_them[kind, (0.0437, 0.031), 3]
        literally.forget()
        done = len(literally.works)
        for step, by in enumerate((0.0, 1e-4, *[0.3] * 5)):
            obs = observation(word=1 + step // 5)
            for camera in CAMERAS:
                obs[camera] = np.stack([moved(one, step, by) for one in obs[camera][:, 0]])[:, None]
            literally.require(obs)
        reasons |= {tuple(k for k, n in vars(work).items() if n and k != "of") for work in literally.works[done:]}
    assert reasons == {("first", "camera"), ("refresh", "camera"), ("changed", "filled", "camera"), ("camera",)}
