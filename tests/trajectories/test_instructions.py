"""Instructions of recordings, as the tokens that a policy observes."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest

from tests.word_tokenizer import write_tokenizer
from ttscompile.core.spec import Instruction, ObservationSpec
from ttscompile.core.tokenizer import StateInWords, Tokenizer
from ttscompile.errors import TrajectoryError
from ttscompile.trajectories import load_trajectories
from ttscompile.trajectories.fits import examine_recordings

from . import test_fits
from .data_sets import ENDS, arrays, read_here

TOKENS, MASK = "observation.language.tokens", "observation.language.attention_mask"
TOLD = Instruction(TOKENS, MASK, new_line=True)
WORDS = {"?": 0, "push": 1, "left": 2, "right": 3, "\n": 4}
LANGUAGE = {TOKENS: ObservationSpec((3,), dtype="int64", bounds=(0, 4)), MASK: ObservationSpec((3,), dtype="bool")}
OBSERVED = {"state": ObservationSpec((1, 5)), **LANGUAGE}
TEXTS = ["push left", "push right right right"]


@pytest.fixture(autouse=True)
def _read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ttscompile.trajectories.sandbox.reader", read_here)


@pytest.fixture
def tokenizer(tmp_path: Path) -> Path:
    return write_tokenizer(tmp_path / "language", WORDS)


def data_set(path: Path, version: int) -> Path:
    """Two episodes; the first is task 7, the second task 3."""
    root = path / "it"
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps({"features": {}}))
    if version == 2:
        lines = [json.dumps({"task_index": number, "task": text}) for number, text in zip((7, 3), TEXTS, strict=True)]
        (root / "meta" / "tasks.jsonl").write_text("\n".join(lines))
    else:
        named = {"task_index": [7, 3], "__index_level_0__": TEXTS}
        parquet.write_table(pa.table(named), root / "meta" / "tasks.parquet")
    (root / "data").mkdir()
    first = ENDS[0]
    table = {
        "state": arrays()["state"].tolist(),
        "episode_index": [int(i >= first) for i in range(ENDS[-1])],
        "frame_index": [i - first * (i >= first) for i in range(ENDS[-1])],
        "task_index": [3 if i >= first else 7 for i in range(ENDS[-1])],
    }
    parquet.write_table(pa.table(table), root / "data" / "file.parquet")
    return root


def require_told(path: Path, tokenizer: Path) -> None:
    """Both episodes have the tokens of their texts, at every call: by the user's tokenizer, and by the policy's own."""
    for asked, own in (({"task": (str(tokenizer),)}, None), (None, partial(Tokenizer, tokenizer))):
        first, second = load_trajectories([path], OBSERVED, 3, asked, TOLD, own)
        assert first.calls == second.calls == 2
        np.testing.assert_array_equal(first.observations[TOKENS], [[1, 2, 4]] * 2)
        np.testing.assert_array_equal(first.observations[MASK], [[True] * 3] * 2)
        np.testing.assert_array_equal(second.observations[TOKENS], [[1, 3, 3]] * 2)  # what is longer is cut
        np.testing.assert_array_equal(second.observations["state"][0], arrays()["state"][ENDS[0] :][:1])


@pytest.mark.parametrize("version", [2, 3])
def test_instructions_of_a_lerobot_data_set_become_tokens(version: int, tmp_path: Path, tokenizer: Path) -> None:
    require_told(data_set(tmp_path, version), tokenizer)


def test_texts_of_an_npz_become_tokens(tmp_path: Path, tokenizer: Path) -> None:
    texts = [TEXTS[int(i >= ENDS[0])] for i in range(ENDS[-1])]
    meta = np.array('{"frames": true}')
    path = tmp_path / "it.npz"
    np.savez(path, state=arrays()["state"], task=np.array(texts), episode_ends=np.array(ENDS), meta=meta)
    require_told(path, tokenizer)


def test_recorded_tokens_come_before_the_policys_own_tokenizer(tmp_path: Path, tokenizer: Path) -> None:
    """Whoever names a tokenizer has the texts read all the same; without texts nothing stands for absent tokens."""
    rows, path, meta = ENDS[-1], tmp_path / "it.npz", np.array('{"frames": true}')
    tokens: dict[str, Any] = {TOKENS: np.full((rows, 3), 2), MASK: np.ones((rows, 3), bool)}
    kept: dict[str, Any] = {"state": arrays()["state"], "episode_ends": np.array(ENDS), "meta": meta}
    np.savez(path, task=np.array(["push"] * rows), **tokens, **kept)
    with pytest.warns(UserWarning, match="arrays .'task'. are no keys of the observation"):
        recorded = load_trajectories([path], OBSERVED, 3, None, TOLD, partial(Tokenizer, tokenizer))
    asked = {"task": (str(tokenizer),)}
    with pytest.warns(UserWarning, match=f"arrays .'{MASK}', '{TOKENS}'. are no keys of the observation"):
        made = load_trajectories([path], OBSERVED, 3, asked, TOLD)
    assert recorded[0].observations[TOKENS].tolist() == [[2] * 3] * 2
    assert made[0].observations[TOKENS].tolist() == [[1, 4, 0]] * 2
    np.savez(path, **kept)
    with pytest.raises(TrajectoryError, match=f"no array '{TOKENS}'"):
        load_trajectories([path], OBSERVED, 3, None, TOLD, partial(Tokenizer, tokenizer))


def test_a_state_stands_in_the_instruction_of_each_row(tmp_path: Path) -> None:
    """As pi0.5 has it: a text that is the same has other tokens where the robot is elsewhere."""
    words = {"?": 0, "push": 1, "State:": 2, "128": 3, "255;": 4, "-1": 5}
    tokenizer = write_tokenizer(tmp_path / "language", words)
    state = StateInWords("state", first=(1.0, -1.0), width=(2.0, 0.5), ranged=False)
    told = Instruction(TOKENS, MASK, False, around=("", " State: {state};"), state=state)
    rows, meta = np.array([[1, 0], [-9, 0], [1, 0]], np.float32), np.array('{"frames": true}')
    observed = {"state": ObservationSpec((1, 2)), **LANGUAGE}
    observed |= {TOKENS: ObservationSpec((4,), dtype="int64"), MASK: ObservationSpec((4,), dtype="bool")}
    path = tmp_path / "it.npz"
    np.savez(path, state=rows, task=np.array(["push"] * 3), episode_ends=np.array([3]), meta=meta)
    (episode,) = load_trajectories([path], observed, 1, None, told, partial(Tokenizer, tokenizer))
    assert episode.observations[TOKENS].tolist() == [[1, 2, 3, 4], [1, 2, 5, 4], [1, 2, 3, 4]]
    one = replace(told, state=replace(state, first=(1.0,), width=(2.0,)))
    with pytest.raises(TrajectoryError, match=r"'state' is \[3, 2\]; expected \[3, 1\], a state for each text"):
        load_trajectories([path], observed, 1, None, one, partial(Tokenizer, tokenizer))


def test_short_texts_are_padded(tmp_path: Path, tokenizer: Path) -> None:
    longer = {**OBSERVED, TOKENS: ObservationSpec((5,), dtype="int64"), MASK: ObservationSpec((5,), dtype="bool")}
    told = Instruction(TOKENS, MASK, new_line=False)
    first, _ = load_trajectories([data_set(tmp_path, 3)], longer, 3, {"task": (str(tokenizer),)}, told)
    np.testing.assert_array_equal(first.observations[TOKENS][0], [1, 2, 0, 0, 0])
    np.testing.assert_array_equal(first.observations[MASK][0], [True, True, False, False, False])


def test_a_data_set_with_instructions_says_how_they_become_tokens(tmp_path: Path) -> None:
    told = "--encoders DIR makes tokens of its instructions; so does --observation task=DIR"
    with pytest.raises(TrajectoryError, match=f"no array 'observation.language.*{told}"):
        load_trajectories([data_set(tmp_path, 3)], OBSERVED, 3, None, TOLD)


def test_a_tokenizer_for_a_policy_without_text_is_refused(tmp_path: Path, tokenizer: Path) -> None:
    with pytest.raises(TrajectoryError, match="this policy takes no text"):
        load_trajectories([data_set(tmp_path, 3)], {"state": OBSERVED["state"]}, 3, {"task": (str(tokenizer),)})


def test_a_tokenizer_for_a_policy_of_tokens_alone_is_refused(tmp_path: Path, tokenizer: Path) -> None:
    """It observes tokens, which a data set has not: the tokenizer is told first, since it does not help."""
    with pytest.raises(TrajectoryError, match="this policy takes no text.*and record tokens if it observes any"):
        load_trajectories([data_set(tmp_path, 3)], OBSERVED, 3, {"task": (str(tokenizer),)})


def test_a_data_set_without_instructions_is_refused(tmp_path: Path, tokenizer: Path) -> None:
    root = data_set(tmp_path, 3)
    (root / "meta" / "tasks.parquet").unlink()
    with pytest.raises(TrajectoryError, match="has no array 'task'; it has state, task_index"):
        load_trajectories([root], OBSERVED, 3, {"task": (str(tokenizer),)}, TOLD)


def test_a_task_that_is_not_named_is_refused(tmp_path: Path, tokenizer: Path) -> None:
    root = data_set(tmp_path, 2)
    (root / "meta" / "tasks.jsonl").write_text(json.dumps({"task_index": 7, "task": "push"}))
    with pytest.raises(TrajectoryError, match="meta/tasks cannot be read .KeyError: 3., which says what each"):
        load_trajectories([root], OBSERVED, 3, {"task": (str(tokenizer),)}, TOLD)


def test_a_tokenizer_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match="no such file; expected the tokenizer.json"):
        load_trajectories([data_set(tmp_path, 3)], OBSERVED, 3, {"task": (str(tmp_path / "no"),)}, TOLD)


def test_the_doctor_looks_at_tokens_that_it_can_make(tmp_path: Path, tokenizer: Path) -> None:
    spec = test_fits.policy()
    held: dict[str, Any] = {test_fits.STATE: test_fits.states(), test_fits.FRONT: test_fits.pictures(0.2)}
    held |= {test_fits.WRIST: test_fits.pictures(0.7), "task": np.array(["push left"] * 40)}
    np.savez(tmp_path / "calls.npz", meta=np.array('{"frames": true}'), episode_ends=np.array([20, 40]), **held)
    told = type(spec)(spec.sample, {**spec.observations, **LANGUAGE}, spec.sampler, spec.chunk, instruction=TOLD)
    said = {one.what: one for one in examine_recordings([tmp_path / "calls.npz"], told, {"task": (str(tokenizer),)})}
    assert "instruction" not in said and said["calls"].found == "10 in 2 episodes"
