"""The text of a task in place of its tokens, in what a robot gives."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.families import scenes
from tests.once import Once
from tests.runtimes.executor.simulation import FakeClock, ScriptedPolicy
from tests.word_tokenizer import write_tokenizer
from ttscompile.core.coercion import Errors
from ttscompile.core.spec import Instruction, ObservationSpec
from ttscompile.core.tokenizer import StateInWords, Tokenizer
from ttscompile.errors import ArtifactChangedError, ObservationError
from ttscompile.runtimes.executor import AsyncExecutor
from ttscompile.runtimes.instruct import Instruct, instruct_of

WORDS = {"?": 0, "push": 1, "left": 2, "right": 3}
STATE = np.zeros((1, 5), np.float32)


@pytest.fixture
def spec() -> Any:
    language = {"tokens": ObservationSpec((3,), dtype="int64"), "mask": ObservationSpec((3,), dtype="bool")}
    told = Instruction("tokens", "mask", new_line=False)
    return SimpleNamespace(instruction=told, observations={"state": ObservationSpec((1, 5)), **language})


@pytest.fixture
def instruct(spec: Any, tmp_path: Path) -> Instruct:
    folder = write_tokenizer(tmp_path / "language", WORDS)
    return Instruct(spec, partial(Tokenizer, folder))


def test_every_stream_has_the_tokens_of_its_text(instruct: Instruct) -> None:
    states = np.zeros((2, 1, 5), np.float32)
    both, same = (["push", "push right"], [[1, 0, 0], [1, 3, 0]]), ("push left", [[1, 2, 0]] * 2)
    for task, rows in (same, both, (np.array(same[0]), same[1]), (np.array(both[0]), both[1])):  # as recordings have it
        made = instruct({"state": states, "task": task})
        assert made.keys() == {"state", "tokens", "mask"}
        assert made["tokens"].tolist() == rows
        np.testing.assert_array_equal(made["mask"], made["tokens"] > 0)
    with pytest.raises(ObservationError, match="the task is 3; expected a text, or one for each stream"):
        instruct({"state": states, "task": 3})


def test_an_artifacts_own_tokenizer_is_read_when_a_text_comes(spec: Any, tmp_path: Path) -> None:
    """Whoever gives tokens needs none; and one that was replaced since it was checked is not read."""
    folder, reads, refused = write_tokenizer(tmp_path / "own", WORDS), list[str](), ArtifactChangedError("replaced")

    def read(error: Errors) -> Tokenizer:
        reads.append("tokenizer.json")
        if len(reads) == 1:
            raise refused
        return Tokenizer(folder, error)

    own: Any = SimpleNamespace(manifest=SimpleNamespace(spec=spec), tokenizer=read)
    instruct = instruct_of(own)
    assert instruct is not None
    known = {"state": STATE, "tokens": np.ones((1, 3), np.int64)}
    assert instruct(known) is known and not reads
    with pytest.raises(ArtifactChangedError, match="replaced"):
        instruct({"state": STATE, "task": "left"})
    assert instruct({"state": STATE, "task": "left"})["tokens"].tolist() == [[2, 0, 0]]
    assert instruct({"state": STATE, "task": "right"})["tokens"].tolist() == [[3, 0, 0]] and len(reads) == 2
    given = instruct_of(own, write_tokenizer(tmp_path / "other", {"?": 0, "left": 1}))
    assert given is not None and given({"task": "left"})["tokens"].tolist() == [[1, 0, 0]] and len(reads) == 2


def test_a_policy_that_is_told_no_task_has_none(spec: Any, tmp_path: Path) -> None:
    silent: Any = SimpleNamespace(manifest=SimpleNamespace(spec=SimpleNamespace(instruction=None)), tokenizer=None)
    assert instruct_of(silent) is None
    assert instruct_of(SimpleNamespace(manifest=SimpleNamespace(spec=spec), tokenizer=None)) is None  # type: ignore[arg-type]
    with pytest.raises(ObservationError, match="this policy takes no text that alone would give its tokens"):
        instruct_of(silent, tmp_path)


def test_a_frame_has_no_axis_of_streams(instruct: Instruct) -> None:
    made = instruct.of_frame({"state": STATE, "task": "push right"})
    assert made["tokens"].tolist() == [1, 3, 0] and made["mask"].tolist() == [True, True, False]
    assert made["state"] is STATE
    with pytest.raises(ObservationError, match="the task of a frame is a list; expected a text"):
        instruct.of_frame({"state": STATE, "task": ["push"]})


def test_tokens_are_left_as_they_are_and_a_call_needs_them_or_a_text(instruct: Instruct) -> None:
    for frame in ({"state": STATE}, {"task": "push", "tokens": np.ones(3, np.int64)}):
        assert instruct.of_frame(frame) is frame
    assert instruct(frame) is frame
    with pytest.raises(
        ObservationError, match="has no 'task'; expected a text, .*, or its tokens, 'tokens' and 'mask'"
    ):
        instruct({"state": STATE})


def test_threads_get_the_tokens_of_their_own_text(instruct: Instruct) -> None:
    texts = ["push left", "push right", "left", "right"] * 500
    with ThreadPoolExecutor(4) as pool:
        made = list(pool.map(lambda text: instruct.of_frame({"task": text})["tokens"].tolist(), texts))
    assert made == [[*map(WORDS.__getitem__, text.split()), 0, 0][:3] for text in texts]


class Told(ScriptedPolicy):
    """A policy that makes numbers of words."""

    def with_tokens(self, frame: Any) -> Any:
        return {"obs": np.full(2, len(frame["task"]), np.float64)} if "task" in frame else frame


def test_an_executor_has_its_policy_make_tokens() -> None:
    clock = FakeClock()
    with AsyncExecutor(Told(clock), 10, latencies={"dense": 0.01}) as executor:
        executor.observe({"task": "push"})
        executor.observe({"obs": np.zeros(2)})
        assert executor.statistics().frames == 2
        with pytest.raises(ObservationError, match="unexpected: .'words'"):
            executor.observe({"words": "push"})


def test_where_words_hold_a_state_another_text_is_told_once(spec: Any, tmp_path: Path) -> None:
    """Tokens differ with every state, so they do not tell it; where they hold none, nobody has to ask."""
    folder, state = write_tokenizer(tmp_path / "language", WORDS), StateInWords("state", (0.0,) * 5, (1.0,) * 5, False)
    read = partial(Tokenizer, folder)
    spec.observations |= {key: ObservationSpec((9,), dtype=spec.observations[key].dtype) for key in ("tokens", "mask")}
    spec.instruction = replace(spec.instruction, around=("", " {state}"), state=state)
    instruct, asked = Instruct(spec, read), list[bool]()
    for text, moved in (("push left", 0.0), ("push left", 0.5), ("push right", 0.5), ("push right", 0.0)):
        instruct.of_frame({"state": STATE[0] + np.float32(moved), "task": text})
        asked.append(instruct.other_task())
    assert asked == [False, False, True, False]
    instruct({"state": np.zeros((2, 1, 5), np.float32), "task": ["push left", "push right"]})
    instruct({"state": np.ones((2, 1, 5), np.float32), "task": ["push left", "push left"]})
    assert instruct.other_task() and not instruct.other_task()
    spec.instruction = replace(spec.instruction, around=(), state=None)
    plain = Instruct(spec, read)
    for text in ("left", "right"):
        plain({"state": STATE, "task": text})
        assert not plain.other_task()


class Asked:
    """In place of ``Instruct``: tokens are given, and ``other`` says whether the task is another one."""

    other = False

    def __call__(self, obs: Any) -> Any:
        return obs

    def other_task(self) -> bool:
        return self.other


def test_a_policy_forgets_its_frames_where_it_is_told_so(once: Once, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, told = ttscompile.load(once.folder("scenes", scenes.compile_all) / "one", seed=0), Asked()
    monkeypatch.setattr(policy, "_instruct", told)
    for told.other, expected in ((False, (1, 0)), (False, (0, 1)), (True, (1, 0)), (False, (0, 1))):
        scenes.act(policy, scenes.observation())
        assert scenes.scenes(policy) == expected


@pytest.mark.slow
def test_so_do_all_plans_whichever_is_used(once: Once, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, told = once.folder("scenes of rows", scenes.compile_rows), Asked()
    policy = ttscompile.load(folder / "rows", seed=0, plan="dense")
    monkeypatch.setattr(policy, "_instruct", told)
    some = replace(policy.plans["dense"], tokens=ttscompile.TokenReuse(0.0, 1000, 0.03))
    calls = (False, some, 1), (False, some, 0), (False, None, 1), (True, None, 1), (False, some, 1)
    for told.other, plan, computed in calls:
        scenes.act(policy, scenes.observation(), plan)
        assert scenes.scenes(policy)[0] == computed
