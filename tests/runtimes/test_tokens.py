"""Tokens whose patches did not change keep what they gave."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import pytest

import ttscompile
from tests.families import cameras
from tests.families.cameras import act, counted, frame, moved, picture
from tests.literal_tokens import LiteralTokens
from tests.once import Once
from ttscompile.artifact.codec import decode, encode
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.manifest import PieceRecord
from ttscompile.artifact.requires import check_size
from ttscompile.artifact.view import view_of
from ttscompile.artifact.write import update_plans
from ttscompile.core.plan import DENSE, Plan, TokenReuse
from ttscompile.errors import ArtifactError, RuntimeUnavailableError
from ttscompile.ir.pieces import FRAMES, INDEX, PIXELS, PLACES, ROWS
from ttscompile.runtimes.frames import FramePieces
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.onnxruntime.backend import OnnxBackend
from ttscompile.runtimes.onnxruntime.sessions import Sessions
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.tokens import Lane, TokenTower, TokenWork, sizes_of, token_towers

pytestmark = pytest.mark.slow

Array = npt.NDArray[Any]
TOKENS = 37
LANE = Lane(b"")
REUSE = TokenReuse(threshold=0.0, refresh=1000)
FIRST, OTHER = frame((picture(0), picture(1))), frame((moved(picture(0), 7), picture(1)))
"""Of the second a patch of one camera is another."""


@pytest.fixture(scope="module")
def compiled(once: Once) -> Path:
    return cameras.compiled_tokens(once)


@pytest.fixture
def artifact(compiled: Path) -> Artifact:
    return load_artifact(compiled / "artifact")


def reusing(artifact: Artifact, reuse: TokenReuse = REUSE, **fields: Any) -> Plan:
    return replace(artifact.plans[DENSE], tokens=reuse, **fields)


@pytest.fixture
def policy(artifact: Artifact) -> CompiledPolicy:
    return open_policy(artifact, seed=0, plan=reusing(artifact))


def tower_of(artifact: Artifact, threshold: float = 0.0, refresh: int = 1000) -> TokenTower:
    reuse = TokenReuse(threshold, refresh)
    view = view_of(artifact, reusing(artifact, reuse))
    with view.artifact.reading():
        backend = OnnxBackend(view, Sessions(1), {})
    (tower,) = token_towers(backend._manifest, reuse, backend._run, backend._renew).values()
    return tower


def computed_literally(artifact: Artifact, changes: tuple[int, ...]) -> list[int]:
    """Tokens that are computed where so many patches change, once what they give is what they literally give."""
    literal = LiteralTokens(artifact.graph("frame_00"), artifact.weights)
    tower, rng, image = tower_of(artifact, refresh=6), np.random.default_rng(0), picture(0)
    (name,) = artifact.graph("frame_00").inputs
    seen, asked, similar, renew = [], list[Array](), dict[int, int](), tower._renew

    def heard(piece: str, feed: Any, kept: Any) -> Any:
        asked.append(feed[INDEX])
        sources = dict(zip(feed[PLACES].tolist(), feed[INDEX][feed[ROWS]].tolist(), strict=True))
        similar.clear()
        similar.update({place: source for place, source in sources.items() if place not in feed[INDEX]})
        return renew(piece, feed, kept)

    tower._renew = heard
    for change in changes:
        for patch in rng.choice(36, size=change, replace=False):
            image = moved(image, patch, rng.uniform(0.1, 1.0))
        (value, *_), work = tower.compute(LANE, {name: image[None]})
        count = work.computed
        assert work.forward == (len(similar) if count else 0)
        if count:
            np.testing.assert_allclose(value, literal(image[None], asked[-1], similar)[0], rtol=0, atol=1e-5)
            assert len(asked[-1]) == count
            assert literal.stream.fixed == 0 or asked[-1][0] == 0, "the class token is always computed"
        seen.append(count)
    return seen


def test_what_it_gives_is_what_the_tokens_literally_give(artifact: Artifact) -> None:
    seen = computed_literally(artifact, (0, 3, 12, 1, 6, 30, 0, 17, 2))
    # A frame is computed for one, two, three, four, six or all eighths of its tokens; every sixth new frame for all.
    assert seen == [37, 5, 14, 5, 10, 37, 0, 19, 5]
    assert sizes_of(37) == (5, 10, 14, 19, 28, 37)


def test_a_tower_of_windows_has_masks_that_go_with_its_tokens(tmp_path: Path) -> None:
    ttscompile.compile_denoiser(*cameras.policy("windows"), tmp_path / "artifact", precision="int8")
    artifact = load_artifact(tmp_path / "artifact")
    assert computed_literally(artifact, (0, 3, 12, 1, 0, 30, 2)) == [36, 5, 14, 5, 0, 36, 5]
    reused = replace(artifact.plan("dense@int8"), tokens=REUSE)
    some, whole = (open_policy(artifact, seed=0, plan=each) for each in (reused, replace(reused, tokens=None)))
    first, other = frame((picture(1), picture(2))), frame((moved(picture(1), 3), picture(2)))
    for newest in (first, other):
        found, expected = act(some, first, newest), act(whole, first, newest)
        assert np.abs(found - expected).max() < 0.05 * np.abs(expected).max()
    assert 0 < counted(some)[0] < counted(some)[1]


def test_what_is_seen_has_each_patch_as_it_was_computed_last(policy: CompiledPolicy) -> None:
    assert policy.seen() == ()
    left, right = picture(0), picture(1)
    act(policy, frame((left, right)), frame((left, right)))
    one, other = policy.seen()
    assert one.computed.all() and other.computed.all() and one.computed.shape == (6, 6) and one.patch == (4, 4)
    act(policy, frame((left, right)), frame((changed := moved(left, 7), right)))
    again, still = policy.seen()
    assert (again.number - one.number, still.number - other.number) == (1, 0)
    assert again.computed[1, 1], "patch 7 of rows of six"
    assert np.count_nonzero(again.computed) == 4, "an eighth of 37 tokens, without the class token"
    assert np.abs(again.pixels - one.pixels).max((0, 2)).nonzero()[0].tolist() == [4, 5, 6, 7]
    np.testing.assert_allclose(again.pixels - one.pixels, 2 * (changed - left), atol=1e-5)  # as CLIP reads them
    np.testing.assert_array_equal(still.pixels, other.pixels)
    again.pixels[:] = np.nan  # what was given is a copy
    assert np.isfinite(policy.seen()[0].pixels).all()
    policy.reset()
    assert policy.seen() == ()


def test_a_plan_says_whether_tokens_are_reused(compiled: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(compiled / "artifact", tmp_path / "own")

    def tokens(**options: Any) -> tuple[int, int]:
        policy = ttscompile.load(folder, **options)
        act(policy, FIRST, FIRST)
        act(policy, FIRST, OTHER)
        return counted(policy)

    artifact = load_artifact(folder)
    assert tokens() == (0, 0)
    manifest = update_plans(folder, {**artifact.plans, "some": reusing(artifact)}, "some")
    assert manifest.identity != artifact.manifest.identity
    assert manifest.model_identity == artifact.manifest.model_identity
    assert tokens() == tokens(plan="some") == (5, 37)
    assert tokens(plan="some@fp32") == tokens(plan="some@int8") == tokens(plan="dense") == (0, 0)
    for runtime in ("torch", "reference"):
        with pytest.raises(
            RuntimeUnavailableError, match=rf"{runtime}' computes all tokens .*Use runtime='onnxruntime'"
        ):
            ttscompile.load(folder, runtime)
        assert tokens(runtime=runtime, plan="some@fp32") == (0, 0)
    whole = open_policy(load_artifact(folder), "reference", plan="dense")
    with pytest.raises(RuntimeUnavailableError, match="the plan reuses some"):
        act(whole, FIRST, OTHER, whole.plans["some"])


def test_cameras_and_streams_share_nothing(policy: CompiledPolicy) -> None:
    """Two streams that see the same for a while act as each of them does alone."""
    same, one, other = (picture(0), picture(0)), (moved(picture(0), 3), picture(0)), (picture(5), picture(0))
    both = [frame(same, same), frame(one, other), frame((moved(picture(0), 9), picture(0)), one)]
    together = [act(policy, both[max(i - 1, 0)], both[i]) for i in range(3)]
    assert counted(policy) == (5 + 37, 74), "two patches, and a picture that changed as a whole"
    for stream in range(2):
        policy.reset()
        alone = [{key: value[stream : stream + 1] for key, value in each.items()} for each in both]
        for i in range(3):
            found = act(policy, alone[max(i - 1, 0)], alone[i])
            np.testing.assert_allclose(found, together[i][stream : stream + 1], rtol=0, atol=1e-5)


def test_a_frame_that_was_prepared_is_computed_the_same_way(policy: CompiledPolicy, artifact: Artifact) -> None:
    frames = [frame((moved(picture(0), i), picture(1))) for i in range(3)]
    found = [act(policy, frames[max(i - 1, 0)], frames[i]) for i in range(3)]
    other = open_policy(artifact, seed=0, plan=reusing(artifact))
    for i in range(3):
        work = other.prepare_frame(frames[i])
        assert (work.tokens, work.of) == ((74, 74) if i == 0 else (5, 37))
        np.testing.assert_array_equal(act(other, frames[max(i - 1, 0)], frames[i]), found[i])
        assert counted(other) == (0, 0)


def test_actions_depend_on_the_frames_before_and_on_nothing_else(artifact: Artifact) -> None:
    """Those that were prepared count; after ``reset`` there are none."""
    policy = open_policy(artifact, seed=0, plan=reusing(artifact))
    first, between, newest = (frame((moved(picture(0), i), picture(1))) for i in (0, 30, 2))
    made = []
    for prepared in ([], [between], [between], []):
        policy.reset()
        act(policy, first, first)
        for each in prepared:
            policy.prepare_frame(each)
        made.append(act(policy, first, newest))
    np.testing.assert_array_equal(made[0], made[3])
    np.testing.assert_array_equal(made[1], made[2])
    assert 0 < np.abs(made[0] - made[1]).max() < 0.1


@pytest.mark.parametrize("forget", ["reset", "forget_frames"])
def test_nothing_is_kept_afterwards(policy: CompiledPolicy, forget: str) -> None:
    act(policy, FIRST, FIRST)
    getattr(policy, forget)()
    act(policy, OTHER, OTHER)
    assert counted(policy) == (74, 74)


def test_after_a_failure_nothing_stale_is_read(policy: CompiledPolicy, artifact: Artifact) -> None:
    act(policy, FIRST, FIRST)
    frames: Any = policy._runtime._used.frames
    (tower,) = frames._tokens.values()
    plain = tower._renew

    def failing(name: str, feed: Any, kept: Any) -> Any:
        plain(name, feed, kept)
        raise ArtifactError("out of memory")

    tower._renew = failing
    with pytest.raises(ArtifactError, match="out of memory"):
        act(policy, FIRST, OTHER)
    tower._renew = plain
    found = act(policy, FIRST, OTHER)
    assert counted(policy) == (37, 37), "what was kept of this camera is gone; the other one is known"
    exact = open_policy(artifact, plan=DENSE)
    np.testing.assert_allclose(found, act(exact, FIRST, OTHER), rtol=0, atol=1e-5)


@pytest.mark.parametrize("wrong", [{"patch": (1000, 1000)}, {"patch": (2, 4)}, {"fixed": 0}, {"fixed": 3}])
def test_other_patches_than_there_are_tokens_are_refused(artifact: Artifact, wrong: dict[str, Any]) -> None:
    """Else tokens of other patches than those that changed would be computed, and nobody would see it."""
    manifest = artifact.manifest
    tokens = {name: replace(record, **wrong) for name, record in manifest.tokens.items()}
    with pytest.raises(ArtifactError, match=r"tokens: expected a patch for each of \d+ tokens; found \d+ by \d+"):
        open_policy(replace(artifact, manifest=replace(manifest, tokens=tokens)), plan=reusing(artifact))


def test_what_is_kept_counts_as_memory(artifact: Artifact) -> None:
    (record,) = artifact.manifest.tokens.values()
    name, kind = next(iter(record.kept.items()))
    huge = replace(record, kept={**record.kept, name: replace(kind, shape=(TOKENS, 10**12))})
    with pytest.raises(ArtifactError, match="values take at most"):
        check_size(replace(artifact.manifest, tokens={"frame_00": huge}), artifact.path)


@pytest.mark.parametrize("change", ["camera motion", "noise", "light"])
def test_where_everything_changes_nothing_is_reused(policy: CompiledPolicy, artifact: Artifact, change: str) -> None:
    exact, rng, image = open_policy(artifact, seed=0, plan=DENSE), np.random.default_rng(0), picture(0)
    act(policy, frame((image, image)), frame((image, image)))
    for _ in range(3):
        before = frame((image, image))
        if change == "camera motion":
            image = np.roll(image, 1, axis=2)
        else:
            image = image + np.float32(0.1 if change == "light" else rng.standard_normal(image.shape) * 0.02)
        newest = frame((image, image))
        np.testing.assert_allclose(act(policy, before, newest), act(exact, before, newest), rtol=0, atol=1e-5)
        assert counted(policy) == (74, 74)


def test_slow_changes_add_up(artifact: Artifact) -> None:
    """A patch is held against what its token was computed for, however many frames ago that was."""
    tower, (name,) = tower_of(artifact, threshold=0.1), artifact.graph("frame_00").inputs
    counts = [
        tower.compute(LANE, {name: moved(2 * picture(0) - 1, 4, by)[None]})[1].computed
        for by in (0.0, 0.02, 0.04, 0.06, 0.08)
    ]
    assert counts == [37, 0, 0, 5, 0], "pixels are read as 2 x - 1, so that 0.06 is 0.12"


def test_what_is_kept_is_written_where_it_is_and_nothing_else_is_moved(artifact: Artifact) -> None:
    """Copying it would take as long as an eighth of the tokens of a large tower takes."""
    tower, (name,) = tower_of(artifact), artifact.graph("frame_00").inputs
    tower.compute(LANE, {name: picture(0)[None]})
    before = tower._lanes[LANE].arrays
    old = {key: array.copy() for key, array in before.items()}
    assert tower.compute(LANE, {name: moved(picture(0), 3)[None]})[1].computed == 5
    for key, array in tower._lanes[LANE].arrays.items():
        assert array is before[key]
        assert 0 < (array != old[key]).reshape(TOKENS, -1).any(1).sum() <= 5
    nodes = {
        piece: onnx.load(artifact.files / artifact.manifest.pieces[piece].file).graph.node
        for piece in ("frame_00", "tokens_00")
    }
    moves = {piece: sum(node.op_type == "Transpose" for node in own) for piece, own in nodes.items()}
    assert moves["tokens_00"] == moves["frame_00"]


def test_in_eight_bits(compiled: Path) -> None:
    artifact = load_artifact(compiled / "artifact")
    record = artifact.manifest.precision
    assert record is not None
    assert {"frame_00", "tokens_00"} <= set(record.models)
    int8 = artifact.plan("dense@int8")
    whole, some = (open_policy(artifact, seed=0, plan=plan) for plan in (int8, replace(int8, tokens=REUSE)))
    np.testing.assert_allclose(act(some, FIRST, FIRST), act(whole, FIRST, FIRST), rtol=0, atol=1e-4)
    near, far = act(whole, FIRST, OTHER), act(whole, OTHER, frame((picture(8), picture(9))))
    assert np.abs(act(some, FIRST, OTHER) - near).max() < 0.2 * np.abs(far - near).max()
    assert counted(some) == (5, 37)


@pytest.mark.parametrize("streams", [2, 3, 128])
def test_cameras_share_no_lane_however_many_streams_there_are(streams: int) -> None:
    """128 streams of three cameras are more than the numbers of a picture in eight bits can tell apart."""
    kind = np.uint8 if streams == 128 else np.float32
    cameras_, shown = ("left", "right", "top"), np.zeros((streams, 4, 4), kind)
    pieces = {
        FRAMES: PieceRecord("frames.onnx", cameras_, None, (), ("rows",)),
        "frame_00": PieceRecord("frame_00.onnx", ("rows",), None, (), ("feature",)),
    }

    def run(name: str, feed: Any) -> tuple[npt.NDArray[Any], ...]:
        return (np.concatenate([feed[camera] for camera in cameras_]),)

    tower: Any = object()
    frames = FramePieces(pieces, run, {"frame_00": tower})
    lanes = frames._lanes_of("frame_00", dict.fromkeys(cameras_, shown))
    assert len(set(lanes)) == len(lanes) == 3 * streams
    fewer = frames._lanes_of("frame_00", dict.fromkeys(cameras_, shown[:1]))
    assert set(lanes).isdisjoint(fewer), "of another batch, which is prepared before its first call"


def test_a_token_that_is_not_computed_gets_what_a_similar_one_has(artifact: Artifact) -> None:
    """Four patches become something else. Of three that change less, two become the same as one of them."""
    tower, (name,) = tower_of(artifact, threshold=1.2), artifact.graph("frame_00").inputs
    literal, renew, fed = LiteralTokens(artifact.graph("frame_00"), artifact.weights), tower._renew, dict[str, Array]()

    def heard(piece: str, feed: Any, kept: Any) -> Any:
        fed.update(feed)
        return renew(piece, feed, kept)

    tower._renew = heard
    before = np.zeros((3, cameras.SIDE, cameras.SIDE), np.float32)
    after = before.copy()
    for patch, level in ((0, 0.9), (3, 0.7), (7, 0.8), (20, 1.0), (14, 0.5), (15, 0.45), (16, 0.1)):
        y, x = divmod(patch, 6)
        after[:, 4 * y : 4 * y + 4, 4 * x : 4 * x + 4] = level
    tower.compute(LANE, {name: before[None]})
    literal(before[None], range(TOKENS))
    (value, *_), work = tower.compute(LANE, {name: after[None]})
    assert work == TokenWork(TOKENS, changed=4, filled=1, forward=2)
    assert fed[INDEX].tolist() == [0, 1, 4, 8, 21]
    (seen,) = tower.seen([LANE])
    assert np.flatnonzero(seen.computed).tolist() == [0, 3, 7, 20]
    assert np.flatnonzero(seen.forward).tolist() == [14, 15]
    similar = {15: 4, 16: 4}
    written = dict(zip(fed[PLACES].tolist(), fed[INDEX][fed[ROWS]].tolist(), strict=True))
    assert written == {token: token for token in fed[INDEX].tolist()} | similar
    np.testing.assert_allclose(value, literal(after[None], fed[INDEX], similar)[0], rtol=0, atol=1e-5)


def test_an_artifact_from_before_keeps_what_it_does_not_compute(artifact: Artifact) -> None:
    """Its piece for some tokens reads no places, and writes each row to its own."""
    pieces, fed = dict(artifact.manifest.pieces), list[set[str]]()
    part = pieces["tokens_00"]
    pieces["tokens_00"] = replace(part, inputs=tuple(name for name in part.inputs if name not in (PLACES, ROWS)))
    before = replace(artifact.manifest, pieces=pieces)
    assert decode(encode(before)).pieces == pieces
    image, (name,) = picture(0), pieces["frame_00"].inputs

    def run(piece: str, feed: Any) -> tuple[Array, ...]:
        return tuple(feed.values())

    def renew(piece: str, feed: Any, kept: Any) -> tuple[Array, ...]:
        fed.append(set(feed))
        return (image,)

    for manifest in (before, artifact.manifest):
        (tower,) = token_towers(manifest, REUSE, run, renew).values()
        tower.compute(LANE, {name: image[None]})
    assert fed == [{PIXELS, INDEX}, {PIXELS, INDEX, PLACES, ROWS}]


def test_a_picture_of_integers_is_no_instruction(artifact: Artifact) -> None:
    """Another one is another frame of its lane, of which some tokens are computed; not the first one of another."""
    before, (name,) = picture(0), artifact.manifest.pieces["frame_00"].inputs
    shown = [(255 * image).astype(np.uint8)[None] for image in (before, moved(before, 3), moved(before, 3))]

    def run(piece: str, feed: Any) -> tuple[Array, ...]:
        return (feed[name] / np.float32(255),)

    (tower,) = token_towers(artifact.manifest, REUSE, run, lambda *_: (before,)).values()
    assert [tower.compute(LANE, {name: row})[1].computed for row in shown] == [TOKENS, 5, 0]
