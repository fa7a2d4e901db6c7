"""What a manifest says of tokens, of image encoders and of a scene, and what it may not say."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.families.scenes import compile_rows
from tests.once import Once
from ttscompile.artifact import codec
from ttscompile.artifact.codec import plan_fault
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.manifest import Manifest, PlanRecord
from ttscompile.artifact.strict_json import dump
from ttscompile.artifact.towers import TokensRecord
from ttscompile.artifact.write import update_plans
from ttscompile.core.plan import DENSE, TokenReuse
from ttscompile.errors import ArtifactError
from ttscompile.ir.graph import TensorType

pytestmark = pytest.mark.slow

WORDS = (72, 73, 74, 75, 76, 77, 78, 79)
"""After the rows of two pictures."""


@pytest.fixture(scope="module")
def compiled(once: Once) -> Path:
    return once.folder("scenes of rows", compile_rows)


@pytest.fixture
def artifact(compiled: Path) -> Artifact:
    """Its scene alone has tokens."""
    return load_artifact(compiled / "grid")


@pytest.fixture
def manifest(artifact: Artifact) -> Manifest:
    return artifact.manifest


def changed(manifest: Manifest, edit: Callable[[dict[str, Any]], object]) -> bytes:
    """With its checksum right, and something else wrong."""
    document = codec.to_json(manifest)
    edit(document)
    return dump({**document, "checksum": codec._checksum(document)})


def test_a_scene_has_a_record_of_its_tokens(compiled: Path, manifest: Manifest) -> None:
    """A row of the sequence is a patch; of an image encoder nothing is said of words."""
    (name,), record = manifest.tokens, manifest.tokens["scene"]
    assert (name, record.tokens, record.fixed, record.patch, record.words) == ("scene", 80, 0, (1, 192), WORDS)
    assert set(record.kept.values()) == {TensorType((80, 1, n), "float32") for n in (192, 384)}
    document = codec.to_json(load_artifact(compiled / "rows").manifest)["tokens"]
    assert {piece: one.get("words") for piece, one in document.items()} == {
        "frame_00": None,
        "frame_01": None,
        "scene": list(WORDS),
    }
    assert codec.decode(codec.encode(manifest)).tokens == manifest.tokens
    assert TokensRecord(4, 0, (1, 2), {}).words == ()


@pytest.mark.parametrize("share", [None, 0.0, 0.25])
def test_a_plan_comes_back_with_and_without_a_share_for_scenes(compiled: Path, tmp_path: Path, share: Any) -> None:
    """Without one its record is as it was before there was any, so that artifacts of that time are read."""
    folder = shutil.copytree(compiled / "grid", tmp_path / "own")
    plans = load_artifact(folder).plans
    reuse = TokenReuse(0.5, 8, share)
    made = update_plans(folder, {**plans, "some": replace(plans[DENSE], tokens=reuse)}, "some")
    stored = json.loads((folder / "manifest.json").read_bytes())["plans"]["some"]["tokens"]
    assert stored == {"threshold": 0.5, "refresh": 8, **({} if share is None else {"scene": share})}
    assert load_artifact(folder).plans["some"].tokens == reuse
    other = update_plans(folder, {**plans, "some": replace(plans[DENSE], tokens=replace(reuse, scene=0.5))}, "some")
    assert made.identity != other.identity, "actions depend on it"
    assert made.model_identity == other.model_identity


def test_a_plan_with_a_share_needs_a_scene_with_tokens(manifest: Manifest) -> None:
    plan = PlanRecord("all", tokens=TokenReuse(0.5, 8, 0.1))
    assert plan_fault(manifest, plan) is None
    kept = replace(manifest, tokens={"frame_00": manifest.tokens["scene"]})
    assert plan_fault(kept, replace(plan, tokens=TokenReuse(0.5, 8))) is None
    assert plan_fault(kept, plan) == "no reuse of a scene's tokens, because it has none"
    nothing = replace(manifest, tokens={})
    assert plan_fault(nothing, plan) == "no reuse of tokens, because no frame piece has tokens"


def refused(document: dict[str, Any], value: object) -> None:
    """A plan with this share for scenes."""
    some = {**document["plans"]["full"], "tokens": {"threshold": 0.1, "refresh": 8, "scene": value}}
    document["plans"]["full"] = some


PART = "what the pieces of its tokens read and give"
NUMBERS = r"tokens\.scene\.words: expected some of the numbers 0\.\.79, ascending"


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d["tokens"]["scene"].update(words=[72, 80]), NUMBERS),
        (lambda d: d["tokens"]["scene"].update(words=[-1]), r"tokens\.scene\.words\[0\]"),
        (lambda d: d["tokens"]["scene"].update(words=[72, 72]), NUMBERS),
        (lambda d: d["tokens"]["scene"].update(words=[73, 72]), NUMBERS),
        (lambda d: d["tokens"]["scene"].update(words=[1.5]), r"tokens\.scene\.words\[0\]"),
        (lambda d: d["tokens"]["scene"].update(words=72), r"tokens\.scene\.words"),
        (lambda d: d["tokens"]["scene"].update(tokens=10**15, words=[]), rf"tokens\.scene: expected {PART}"),
        (lambda d: d["tokens"]["scene"].update(fixed=80), rf"tokens\.scene: expected {PART}"),
        (lambda d: d["tokens"]["scene"].update(fixed=-1), r"tokens\.scene\.fixed"),
        (lambda d: d["tokens"]["scene"].update(patch=[1, 0]), r"tokens\.scene\.patch\[1\]"),
        (lambda d: d["tokens"]["scene"]["kept"].popitem(), rf"tokens\.scene: expected {PART}"),
        (lambda d: d["tokens"].update(condition=d["tokens"]["scene"]), r"some of the pieces \['frame_00', 'scene'\]"),
        (lambda d: d["tokens"].update(frame_00=d["tokens"]["scene"]), r"exactly \['pixels_00', 'pixels_scene', "),
        (lambda d: d["tokens"].pop("scene"), r"pieces: expected for the sake of tokens exactly \[\]"),
        (lambda d: d["pieces"]["pixels_scene"].update(inputs=["state"]), rf"tokens\.scene: expected {PART}"),
        (lambda d: d["pieces"]["pixels_scene"].update(outputs=["sequence"]), rf"tokens\.scene: expected {PART}"),
        (lambda d: d["pieces"]["tokens_scene"]["inputs"].append("state"), rf"tokens\.scene: expected {PART}"),
        (lambda d: d["pieces"]["tokens_scene"]["inputs"].remove("tokens.index"), rf"tokens\.scene: expected {PART}"),
        (lambda d: d["pieces"]["tokens_scene"]["outputs"].reverse(), rf"tokens\.scene: expected {PART}"),
        (lambda d: refused(d, -0.5), r"plans\.full\.tokens\.scene"),
        (lambda d: refused(d, "much"), r"plans\.full\.tokens\.scene"),
        (lambda d: refused(d, True), r"plans\.full\.tokens\.scene"),
    ],
)
def test_manifests_that_are_refused(manifest: Manifest, edit: Callable[[dict[str, Any]], object], message: str) -> None:
    """None of them takes memory for as many tokens as it names."""
    plain = replace(manifest, plans={"full": PlanRecord("all")}, default_plan="full")
    with pytest.raises(ArtifactError, match=message):
        codec.decode(changed(plain, edit))


def test_a_piece_may_read_less_than_its_scene(manifest: Manifest) -> None:
    """As where no mask depends on the words."""
    without = changed(manifest, lambda d: d["pieces"]["tokens_scene"]["inputs"].remove("tokens"))
    assert "tokens" not in codec.decode(without).pieces["tokens_scene"].inputs


def test_what_was_written_before_is_read(manifest: Manifest) -> None:
    """A plan has no share for scenes, and no tokens are words."""
    some = replace(manifest, plans={"full": PlanRecord("all", tokens=TokenReuse(0.5, 8))}, default_plan="full")
    assert codec.to_json(some)["plans"]["full"]["tokens"] == {"threshold": 0.5, "refresh": 8}
    read = codec.decode(changed(some, lambda d: d["tokens"]["scene"].pop("words")))
    assert (read.plans["full"].tokens, read.tokens["scene"].words) == (TokenReuse(0.5, 8), ())
