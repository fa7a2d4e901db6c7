"""``ttscompile predict``: observations of words, files and pictures; the chunk as a table, as JSON and as a picture."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from PIL import Image

import ttscompile
from tests.families import cameras
from tests.once import Once
from ttscompile import ObservationSpec
from ttscompile.cli import main
from ttscompile.cli.predict import _option, observed
from ttscompile.core.tokenizer import Instruction
from ttscompile.errors import ObservationError
from ttscompile.runtimes.policy import CompiledPolicy

FRONT, WRIST, STATE = "observation.images.front", "observation.images.wrist", "observation.state"
PICTURE = ObservationSpec((2, 3, 4, 5), bounds=(0.0, 1.0))
SPECS = {STATE: ObservationSpec((2, 3)), FRONT: PICTURE, WRIST: PICTURE}


def run(*words: object) -> Result:
    return CliRunner().invoke(main, ["predict", *map(str, words)], catch_exceptions=False)


def picture(path: Path, width: int = 5, height: int = 4, **more: Any) -> Path:
    pixels = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    Image.fromarray(pixels).save(path, **more)
    return path


def test_the_chunk_is_that_of_the_policy_with_the_same_seed(toy_compiled: Path, tmp_path: Path) -> None:
    told = json.loads(run(toy_compiled, "--state", "0.5,-1", "--seed", 3, "--plan", "dense", "--json").stdout)
    obs = {"obs": np.array([[0.5, -1]], np.float32)}
    expected = ttscompile.load(toy_compiled, seed=3, plan="dense").predict_action(obs)["action_pred"][0]
    assert np.array_equal(np.float32(told["actions"]), expected)
    assert (told["plan"], told["seed"], told["notes"]) == ("dense", 3, [])
    np.savez(tmp_path / "obs.npz", obs=obs["obs"].astype(np.float64))
    again = json.loads(run(toy_compiled, "--observation", tmp_path / "obs.npz", "--seed", 3, "--json").stdout)
    assert again["actions"] == told["actions"], "the default plan is dense"


def test_the_table_marks_what_is_executed_and_the_picture_is_drawn(toy_compiled: Path, tmp_path: Path) -> None:
    result = run(toy_compiled, "--state", "0.5,-1", "--plot", tmp_path / "chunk.png")
    start, stop = json.loads(run(toy_compiled, "--state", "0.5,-1", "--json").stdout)["executed"]
    rows = [line.split() for line in result.stdout.splitlines() if line.strip()[:1].isdigit()]
    assert [int(row[0]) for row in rows if "executed" in row] == list(range(start, stop))
    assert "seed 0: 3 steps of 2 numbers" in result.stdout and "identity " in result.stdout
    assert (tmp_path / "chunk.png").read_bytes().startswith(b"\x89PNG") and "wrote " in result.stderr


def test_numbers_of_the_table_never_touch(toy_compiled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = CompiledPolicy.predict_action

    def tiny(self: CompiledPolicy, obs: Any) -> Any:
        return {"action_pred": np.full_like(usual(self, obs)["action_pred"], -1.234e-4)}

    monkeypatch.setattr(CompiledPolicy, "predict_action", tiny)
    (first, *_) = [one for one in run(toy_compiled, "--state", "0.5,-1").stdout.splitlines() if one[:4].strip() == "0"]
    assert first.split() == ["0", "-0.0001234", "-0.0001234"]


def test_pictures_go_to_the_camera_whose_key_ends_so_and_one_frame_fills_the_window(tmp_path: Path) -> None:
    path = picture(tmp_path / "a.png")
    obs, repeated = observed(SPECS, {"front": path, WRIST: path}, np.array([1, 2, 3], np.float32), None)
    assert obs[FRONT].shape == (1, 2, 3, 4, 5) and obs[FRONT].dtype == np.float32
    pixels = np.asarray(Image.open(path), np.float32) / 255
    assert np.array_equal(obs[WRIST][0, 1], pixels.transpose(2, 0, 1))
    assert obs[STATE].tolist() == [[[1, 2, 3], [1, 2, 3]]]
    assert repeated == [FRONT, WRIST, STATE]


def test_a_whole_window_is_taken_as_it_is(tmp_path: Path) -> None:
    whole = np.arange(6, dtype=np.float32)
    obs, repeated = observed({"obs": ObservationSpec((2, 3))}, {}, whole, None)
    assert obs == {"obs": pytest.approx(whole.reshape(1, 2, 3))} and repeated == []
    np.savez(tmp_path / "a.npz", obs=whole.reshape(2, 3), tokens=np.array([1, 2]))
    specs = {"obs": ObservationSpec((2, 3)), "tokens": ObservationSpec((2,), dtype="int64", window=False)}
    obs, repeated = observed(specs, {}, None, tmp_path / "a.npz")
    assert (obs["obs"].shape, obs["tokens"].shape, repeated) == ((1, 2, 3), (1, 2), [])
    assert obs["tokens"].dtype == "int64"


def test_grey_jpegs_and_pictures_of_any_size(tmp_path: Path) -> None:
    grey = {"cam": ObservationSpec((1, 4, 5), bounds=(0.0, 1.0), window=False)}
    assert observed(grey, {"cam": picture(tmp_path / "a.jpg")}, None, None)[0]["cam"].shape == (1, 1, 4, 5)
    fits = {"cam": ObservationSpec((1, 3, 4, 4), bounds=(0.0, 1.0), fit="start")}
    obs, repeated = observed(fits, {"cam": picture(tmp_path / "b.png", 9, 6)}, None, None)
    assert (obs["cam"].shape, repeated) == ((1, 1, 3, 6, 9), [])


@pytest.mark.parametrize(
    ("names", "state", "message"),
    [
        (["side"], None, "--image side: no camera has this name; expected one of observation.images.front"),
        (["front", FRONT], None, "observation.images.front is given twice"),
        (["small"], None, "no camera"),
    ],
)
def test_what_does_not_fit_is_one_error(tmp_path: Path, names: list[str], state: Any, message: str) -> None:
    path = picture(tmp_path / "a.png")
    with pytest.raises(ObservationError, match=message):
        observed(SPECS, dict.fromkeys(names, path), state, None)


def test_names_that_several_cameras_end_with_are_refused(tmp_path: Path) -> None:
    specs = {"left.front": PICTURE, "right.front": PICTURE}
    with pytest.raises(ObservationError, match="several cameras have this name"):
        observed(specs, {"front": picture(tmp_path / "a.png")}, None, None)


def test_a_picture_of_another_size_or_none_at_all(tmp_path: Path) -> None:
    with pytest.raises(ObservationError, match=r"expected 5x4 pixels, as in training; found 6x4. Resize or crop"):
        observed(SPECS, {"front": picture(tmp_path / "a.png", 6)}, None, None)
    (tmp_path / "b.png").write_text("no picture")
    with pytest.raises(ObservationError, match=r"--image front=.*b.png: expected a picture in PNG or JPEG"):
        observed(SPECS, {"front": tmp_path / "b.png"}, None, None)
    with pytest.raises(ObservationError, match="expected a picture in PNG or JPEG"):
        observed(SPECS, {"front": picture(tmp_path / "c.gif")}, None, None)


def test_a_state_among_several_vectors_is_refused() -> None:
    specs = {"pose": ObservationSpec((2,)), "wrench": ObservationSpec((6,))}
    with pytest.raises(ObservationError, match=r"this one reads pose, wrench. Give all in an archive"):
        observed(specs, {}, np.zeros(2, np.float32), None)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--state", "1,2,3"], "observation 'obs' has the wrong shape: expected float32 [B, 2]"),
        (["--state", "1,x"], "expected numbers with commas between"),
        (["--state", "1,nan"], "must be finite"),
        ([], "the observation lacks obs (--state NUMBER,..). Give it so, or arrays by key: --observation FILE.npz."),
        (["--state", "1,2", "--image", "front"], "expected NAME=FILE"),
        (["--state", "1,2", "--image", "front=nowhere.png"], "nowhere.png"),
        (["--state", "1,2", "--task", "push"], "the policy reads no text; compiled in is 'none'"),
        (["--state", "1,2", "--plan", "none"], "none"),
        (["--state", "1,2", "--plot", "chunk.txt"], "no format of pictures"),
    ],
)
def test_bad_input_ends_with_2_and_one_error(toy_compiled: Path, words: list[str], message: str) -> None:
    result = run(toy_compiled, *words)
    assert result.exit_code == 2 and message in result.stderr and result.stdout == ""
    assert result.stderr.lower().count("error: ") == 1


def test_a_state_is_asked_for_only_where_it_is_the_one_that_is_given() -> None:
    """Of several vectors one may be called so; the others come in an archive."""
    spec = cameras.policy("shared", told=True)[1]
    more = replace(spec, observations={**spec.observations, "environment": ObservationSpec((2, 3))})
    told = replace(more, instruction=Instruction("tokens", "mask", new_line=False))
    for one in (more, told):
        assert _option("state", one) == "--state NUMBER,.."
        assert _option("environment", one) == "--observation FILE.npz"
    two = replace(spec, observations={"pose": ObservationSpec((2,)), "wrench": ObservationSpec((6,))})
    assert _option("pose", two) == _option("wrench", two) == "--observation FILE.npz"


def test_tokens_are_given_by_the_task_where_a_text_gives_them() -> None:
    spec = cameras.policy("shared", told=True)[1]
    assert _option("mask", spec) == "--observation FILE.npz"
    assert _option("mask", replace(spec, instruction=Instruction("tokens", "mask", new_line=False))) == "--task TEXT"


@pytest.mark.slow
def test_pictures_state_and_an_archive_together(once: Once, tmp_path: Path) -> None:
    artifact = once.folder("seeing", cameras.compile_seeing) / "artifact"
    shown = picture(tmp_path / "a.png", cameras.SIDE, cameras.SIDE)
    words = ["--image", f"left={shown}", "--image", f"right={shown}", "--state", "-0.1,0.2,0.3,0"]
    tokens = np.zeros((1, cameras.WORDS), np.int64)
    np.savez(tmp_path / "rest.npz", tokens=tokens, mask=tokens == 0)
    told = json.loads(run(artifact, *words, "--observation", tmp_path / "rest.npz", "--json").stdout)
    assert np.isfinite(told["actions"]).all()
    assert told["notes"][-1] == "state: one frame stands for all 2 that are read" and len(told["notes"]) == 3
    assert "the observation lacks tokens (--observation FILE.npz), mask (--obs" in run(artifact, *words).stderr
    assert "lacks left (--image left=FILE), right (--image right=FILE), state (--state" in run(artifact).stderr
