"""Of a scene whose sequence changed in some rows, some tokens are computed; without a share for scenes it is whole."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import pytest
import torch

import ttscompile
from tests.families.cameras import (
    ACTIONS,
    CAMERAS,
    HORIZON,
    STEPS,
    act as act_on,
    compiled_tokens,
    frame,
    moved,
    picture,
)
from tests.families.scenes import Obs, act, compile_rows, observation, scenes, together
from tests.lower.whole_call import Episode
from tests.once import Once
from ttscompile.artifact.load import Artifact, load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.artifact.write import update_plans
from ttscompile.core.plan import DENSE, Plan, TokenReuse
from ttscompile.errors import ArtifactError, IllegalPlanError, RuntimeUnavailableError
from ttscompile.ir.pieces import INDEX, SCENE, is_tokens
from ttscompile.lower.integer_convolution import DYNAMIC_PRODUCT
from ttscompile.runtimes.load import open_policy
from ttscompile.runtimes.onnxruntime.backend import OnnxBackend
from ttscompile.runtimes.onnxruntime.sessions import Sessions
from ttscompile.runtimes.policy import CompiledPolicy
from ttscompile.runtimes.tokens import Lane, TokenTower, TokenWork, sizes_of, token_towers
from ttscompile.verification import verify

pytestmark = pytest.mark.slow

Array = npt.NDArray[Any]
TOKENS, WORDS = 80, 8
LANE = Lane(b"", SCENE)
REUSE = TokenReuse(threshold=0.0, refresh=1000, scene=0.03)


@pytest.fixture(scope="module")
def compiled(once: Once) -> Path:
    return once.folder("scenes of rows", compile_rows)


@pytest.fixture
def artifact(compiled: Path) -> Artifact:
    return load_artifact(compiled / "rows")


@pytest.fixture
def grid(compiled: Path) -> Artifact:
    """Its towers have no tokens."""
    return load_artifact(compiled / "grid")


def reusing(artifact: Artifact, reuse: TokenReuse | None = REUSE) -> Plan:
    """All cells in fp32."""
    return replace(artifact.plan(f"{DENSE}@fp32"), tokens=reuse)


@pytest.fixture
def policy(artifact: Artifact) -> CompiledPolicy:
    return open_policy(artifact, seed=0, plan=reusing(artifact))


def backend_of(artifact: Artifact, reuse: TokenReuse | None = REUSE) -> OnnxBackend:
    with artifact.reading():
        return OnnxBackend(view_of(artifact, reusing(artifact, reuse)), Sessions(1), {})


def tower_of(artifact: Artifact, share: float = 0.0, refresh: int = 1000) -> TokenTower:
    """The scene's."""
    reuse, backend = TokenReuse(0.0, refresh, share), backend_of(artifact)
    return token_towers(backend._manifest, reuse, backend._run, backend._renew)[SCENE]


def given(rows: Array, word: int = 1) -> dict[str, Array]:
    """What the scene of ``grid`` reads: rows of its pictures ``[72, 192]``, and words."""
    return {"tokens": np.full((1, WORDS), word), "linear_1.frame": rows.reshape(2, 36, 192).astype(np.float32)}


def changed(obs: Obs, patches: int | list[int], by: float = 0.3, camera: str = "left") -> Obs:
    """The same with other patches in a camera's picture."""
    (image,) = obs[camera][:, 0]
    for patch in [patches] if isinstance(patches, int) else patches:
        image = moved(image, patch, by)
    return {**obs, camera: image[None, None]}


def of_scene(policy: CompiledPolicy) -> list[TokenWork]:
    """Of the last call."""
    assert policy.last_report is not None
    return [work for work in policy.last_report.frames.by_camera if work.camera == SCENE]


def test_so_many_tokens_are_computed_that_there_are_few_shapes(grid: Artifact) -> None:
    """Rows that changed, all words, and the next most changed."""
    tower, rng, fed = tower_of(grid), np.random.default_rng(0), list[Array]()
    renew, rows = tower._renew, rng.standard_normal((72, 192))

    def heard(piece: str, feed: Any, kept: Any) -> Any:
        fed.append(feed[INDEX])
        return renew(piece, feed, kept)

    tower._renew = heard
    assert tower.compute(LANE, given(rows))[1] == TokenWork(TOKENS, first=TOKENS, camera=SCENE)
    assert sizes_of(TOKENS) == (10, 20, 30, 40, 60, 80)
    for count, size in ((0, 0), (1, 10), (2, 10), (3, 20), (12, 20), (13, 30), (32, 40), (52, 60), (53, 80), (72, 80)):
        before, chosen = len(fed), rng.choice(72, count, replace=False)
        rows[chosen] += rng.standard_normal((count, 192))
        _, work = tower.compute(LANE, given(rows))
        assert work == TokenWork(TOKENS, changed=count, filled=size - count, camera=SCENE)
        for index in fed[before:]:
            assert {*chosen, *range(72, 80)} <= {*index.tolist()}
            assert index.tolist() == sorted({*index.tolist()})
        assert len(fed) - before == (count > 0), "where no row changed nothing runs, and the last result stands"


def test_words_that_hold_a_state_are_computed_when_no_picture_changed(grid: Artifact) -> None:
    """They are others in every call, and what they say is not to be the state of a call before."""
    tower, rows = tower_of(grid, share=0.5), np.ones((72, 192))
    tower._told = False  # as where the instruction has a state
    first = tower.compute(LANE, given(rows))[0]
    found, work = tower.compute(LANE, given(rows, word=2))
    assert work == TokenWork(TOKENS, filled=10, camera=SCENE)
    assert max(np.abs(one - other)[:, -WORDS:].max() for one, other in zip(found, first, strict=True)) > 0.01
    assert tower.compute(LANE, given(rows, word=2))[1].computed == 0


def test_a_share_is_of_the_numbers_themselves(grid: Artifact) -> None:
    """Features have no unit: where all rows are a thousand times as large the same tokens are computed."""
    rng = np.random.default_rng(0)
    rows, much = rng.standard_normal((72, 192)), np.geomspace(1e-4, 1, 72)[:, None]
    other = rows + much * np.abs(rows) * rng.choice([-1, 1], rows.shape)  # by just this share of their size
    for share in (0.5, 0.05, 0.005):
        expected = int((much > share).sum())
        for scale in (1e-3, 1.0, 1e3):
            tower = tower_of(grid, share)
            tower.compute(LANE, given(scale * rows))
            assert tower.compute(LANE, given(scale * other))[1].changed == expected


def test_rows_of_zeros_are_rows(grid: Artifact) -> None:
    """A camera that is left out gives them; anything else is another row, by any share."""
    tower, rows = tower_of(grid, share=1e6), np.zeros((72, 192))
    tower.compute(LANE, given(rows))
    assert tower.compute(LANE, given(rows))[1].computed == 0
    rows[5] = 1e-3
    assert tower.compute(LANE, given(rows))[1].changed == 1
    assert tower.compute(LANE, given(rows))[1].computed == 0


def test_no_row_takes_what_another_one_has(grid: Artifact) -> None:
    """Keys are turned by their place. Two rows become what a computed one is; one of them fills up, the other stays."""
    tower, rows = tower_of(grid, share=1.2), np.ones((72, 192))
    rows[[5, 6]] = 2
    tower.compute(LANE, given(rows))
    rows[[3, 5, 6]] = 3
    assert tower.compute(LANE, given(rows))[1] == TokenWork(TOKENS, changed=1, filled=9, camera=SCENE)


def test_slow_changes_add_up(grid: Artifact) -> None:
    """A row is held against what its token was computed for, however many scenes ago that was."""
    tower, rows = tower_of(grid, share=0.1), np.ones((72, 192))
    counts = []
    for by in (0.0, 0.04, 0.08, 0.12, 0.16):
        rows[4] = 1 + by
        counts.append(tower.compute(LANE, given(rows))[1].computed)
    assert counts == [80, 0, 0, 10, 0]


@pytest.mark.parametrize(("refresh", "expected"), [(1, [80, 80, 80, 80]), (3, [80, 10, 10, 80]), (9, [80, 10, 10, 10])])
def test_of_so_many_scenes_one_is_computed_whole(grid: Artifact, refresh: int, expected: list[int]) -> None:
    tower, rows = tower_of(grid, refresh=refresh), np.ones((72, 192))
    found = []
    for step in range(4):
        rows[step] *= 2
        found.append(tower.compute(LANE, given(rows))[1])
    assert [work.computed for work in found] == expected
    assert [work.refresh for work in found[1:]] == [count * (count == 80) for count in expected[1:]]


def test_another_instruction_is_computed_whole_and_keeps_no_old_row(policy: CompiledPolicy, artifact: Artifact) -> None:
    """All tokens may have seen the words; those of the word before are of no use when it comes back, either."""
    whole, made = open_policy(artifact, seed=0, plan=reusing(artifact, replace(REUSE, scene=None))), list[Array]()
    for patches, word in (([], 2), ([3], 5), ([3, 4], 2), ([3, 4, 5], 2)):
        obs = {**changed(observation(), patches), "tokens": observation(word=word)["tokens"]}
        made.append(act(policy, obs))
        (work,) = of_scene(policy)
        again = len(made) == 4
        assert (work.first, work.changed > 0) == (TOKENS * (not again), again)
        np.testing.assert_allclose(made[-1], act(whole, obs), rtol=0, atol=1e-2 if again else 1e-6)
    assert np.abs(made[1] - made[2]).max() > 1e-4, "the word is seen"


def test_without_a_share_the_scene_is_whole_to_the_bit(artifact: Artifact) -> None:
    """It is the piece ``scene`` that runs, as ever, on what towers give."""
    backend = backend_of(artifact, TokenReuse(0.0, 1000))
    assert SCENE in backend.sessions
    assert not {"pixels_scene", "tokens_scene"} & {*backend.sessions}
    obs = observation()
    for step in range(3):
        obs = changed(obs, step)
        values = backend.frames.values(obs)
        piece = artifact.manifest.pieces[SCENE]
        inputs = {name: values[name] if name in values else obs[name] for name in piece.inputs}
        for name, one in zip(piece.outputs, backend.sessions[SCENE].run(list(piece.outputs), inputs), strict=True):
            np.testing.assert_array_equal(values[name], one)
        work = backend.frames.work
        assert {one.camera for one in work.by_camera} <= {*CAMERAS}
        assert (work.scenes, work.of) == (1, 36 if step else 72)
    assert SCENE not in backend_of(artifact).sessions, "one session has the weights of all of its tokens, and of some"
    plain = backend_of(artifact, None)
    assert not [name for name in plain.sessions if is_tokens(name)]


def test_a_scene_that_is_known_costs_nothing(policy: CompiledPolicy) -> None:
    act(policy, observation())
    assert [work.first for work in of_scene(policy)] == [TOKENS]
    new = changed(observation(), 3)
    for obs, known in (
        (observation(), True),
        (observation(state=9), True),
        (new, False),
        ({**new, "state": observation(state=7)["state"]}, True),
        (observation(), True),
    ):
        act(policy, obs)
        assert scenes(policy) == ((0, 1) if known else (1, 0))
        assert len(of_scene(policy)) == (not known)


def test_where_no_row_has_changed_by_enough_the_last_result_stands(policy: CompiledPolicy, artifact: Artifact) -> None:
    """Towers that were computed anew may give rows that hardly differ."""
    plan = reusing(artifact, replace(REUSE, scene=1e6))
    first = act(policy, observation(), plan)
    found = act(policy, changed(observation(), 3), plan)
    assert of_scene(policy) == [TokenWork(TOKENS, camera=SCENE)]
    np.testing.assert_array_equal(found, first)
    assert np.abs(act(policy, changed(observation(), 3), reusing(artifact, None)) - first).max() > 1e-6


@pytest.mark.parametrize("forget", ["reset", "forget_frames"])
def test_nothing_is_kept_afterwards(policy: CompiledPolicy, forget: str) -> None:
    act(policy, observation())
    getattr(policy, forget)()
    act(policy, changed(observation(), 3))
    assert [work.first for work in of_scene(policy)] == [TOKENS]


@pytest.mark.parametrize("name", ["rows", "grid"])
def test_streams_share_nothing(compiled: Path, name: str) -> None:
    """Two that see the same for a while, by other ways, act as each of them does alone."""
    artifact = load_artifact(compiled / name)
    one = [observation(), changed(observation(), [1, 2]), changed(observation(), [1, 2, 9]), observation(word=7)]
    other = [observation(left=5), changed(observation(), 9), changed(observation(), [1, 2, 9]), observation(word=7)]
    policy = open_policy(artifact, seed=0, plan=reusing(artifact))
    found = [act(policy, together(*pair)) for pair in zip(one, other, strict=True)]
    assert [work.stream for work in of_scene(policy)] == [0, 1], "each is a first one, of the same words"
    for stream, alone in enumerate((one, other)):
        policy.reset()
        for i, obs in enumerate(alone):
            np.testing.assert_allclose(act(policy, obs), found[i][stream : stream + 1], rtol=0, atol=1e-5)
    assert np.abs(found[2][0] - found[2][1]).max() > 1e-5, "what each has seen before is in its rows"


def test_a_batch_of_another_size_has_other_lanes(artifact: Artifact) -> None:
    frames = backend_of(artifact).frames
    for obs in (observation(), together(changed(observation(), 3), observation(left=4)), changed(observation(), 5)):
        frames.values(obs)
        works = [work for work in frames.work.by_camera if work.camera == SCENE]
        again = obs["left"].tobytes() == changed(observation(), 5)["left"].tobytes()
        assert [(work.first, work.stream) for work in works] == [
            (TOKENS * (not again), stream) for stream in range(len(obs["left"]))
        ]


def test_after_a_failure_nothing_stale_is_read(policy: CompiledPolicy, artifact: Artifact) -> None:
    act(policy, observation())
    frames: Any = policy._runtime._used.frames
    tower = frames._tokens[SCENE]
    plain = tower._renew

    def failing(name: str, feed: Any, kept: Any) -> Any:
        plain(name, feed, kept)
        raise ArtifactError("out of memory")

    tower._renew = failing
    with pytest.raises(ArtifactError, match="out of memory"):
        act(policy, changed(observation(), 3))
    tower._renew = plain
    act(policy, changed(observation(), 3))
    assert [work.first for work in of_scene(policy)] == [TOKENS]


def test_a_frame_prepared_ahead_computes_no_scene(policy: CompiledPolicy) -> None:
    act(policy, observation())
    newest = changed(observation(), 3)
    work = policy.prepare_frame({key: value[:, 0] if key in CAMERAS else value for key, value in newest.items()})
    assert [one.camera for one in work.by_camera] == ["left"]
    act(policy, newest)
    assert policy.last_report is not None
    assert [one.camera for one in policy.last_report.frames.by_camera] == [SCENE]


def test_in_eight_bits(artifact: Artifact) -> None:
    """As many rows are computed as there are tokens, whatever else the piece reads: words have one row."""
    full = artifact.plan("full")
    view = view_of(artifact, replace(full, tokens=REUSE))
    assert next(iter(artifact.manifest.pieces["tokens_scene"].inputs[4:])) == "tokens", "before what is kept"
    views = (view, view_of(artifact, reusing(artifact)))
    own, exact = (artifact.files / each.onnx_file("tokens_scene") for each in views)
    assert own != exact
    products = [
        sum(node.op_type == DYNAMIC_PRODUCT for node in onnx.load(file, load_external_data=False).graph.node)
        for file in (own, exact, artifact.files / view.onnx_file(SCENE))
    ]
    assert products[0] == products[2] > products[1] == 0
    whole, some = (open_policy(artifact, seed=0, plan=plan) for plan in (full, replace(full, tokens=REUSE)))
    first, other = observation(), changed(observation(), 3)
    np.testing.assert_allclose(act(some, first), act(whole, first), rtol=0, atol=1e-4)
    near, far = act(whole, other), act(whole, observation(left=8, right=9))
    assert np.abs(act(some, other) - near).max() < 0.5 * np.abs(far - near).max()
    (work,) = of_scene(some)
    assert 0 < work.changed < work.computed < TOKENS


@pytest.mark.parametrize("runtime", ["torch", "reference"])
def test_other_runtimes_refuse(grid: Artifact, runtime: str) -> None:
    """Where the scene alone has tokens, too."""
    policy = open_policy(grid, runtime, plan=DENSE)
    with pytest.raises(RuntimeUnavailableError, match=f"runtime '{runtime}' computes all tokens .*Use runtime='onnx"):
        act(policy, observation(), reusing(grid))
    exact = open_policy(grid, seed=0, plan=DENSE)
    np.testing.assert_allclose(act(policy, observation()), act(exact, observation()), rtol=0, atol=1e-5)


def test_a_scene_without_tokens_is_refused(once: Once) -> None:
    artifact = load_artifact(compiled_tokens(once) / "artifact")
    told = r"the scene of this policy, if it has one, has no tokens .* Leave the scene out: TokenReuse\(threshold, ref"
    with pytest.raises(IllegalPlanError, match=told):
        open_policy(artifact, plan=reusing(artifact))
    policy, seen = open_policy(artifact, plan=DENSE), frame((picture(0), picture(1)))
    with pytest.raises(IllegalPlanError, match=told):
        act_on(policy, seen, seen, reusing(artifact))


def test_a_plan_that_would_reuse_nothing_is_refused(grid: Artifact) -> None:
    told = r"only the scene of this policy has tokens .* TokenReuse\(threshold, refresh, scene=0.2\)"
    with pytest.raises(IllegalPlanError, match=told):
        open_policy(grid, plan=replace(reusing(grid), tokens=TokenReuse(0.1, 8)))


def test_the_single_file_and_the_module_compute_all(compiled: Path, grid: Artifact) -> None:
    exact, obs = open_policy(grid, seed=0, plan=DENSE), observation()
    expected, cells = act(exact, obs), np.zeros((STEPS, len(exact.info.blocks)), np.int8)
    noise = ttscompile.Noise(np.ones((1, HORIZON, ACTIONS), np.float32))
    whole = Episode((compiled / "grid.onnx").read_bytes(), 1).call(obs, noise, cells)["action_pred"]
    np.testing.assert_allclose(whole, expected, rtol=0, atol=1e-5)
    with pytest.raises(IllegalPlanError, match="has reused tokens, and a module computes all tokens of all frames"):
        ttscompile.to_module(grid.path, reusing(grid))
    module, seen = (
        ttscompile.to_module(grid.path, reusing(grid).exact),
        {k: torch.from_numpy(v) for k, v in obs.items()},
    )
    np.testing.assert_allclose(module(seen, torch.from_numpy(noise.initial)), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ["rows", "grid"])
def test_every_rung_of_verify_holds_where_a_plan_computes_some(compiled: Path, name: str, tmp_path: Path) -> None:
    folder = shutil.copytree(compiled / name, tmp_path / "own")
    artifact = load_artifact(folder)
    update_plans(folder, {**artifact.plans, "some": reusing(artifact)}, "some")
    result = verify(folder)
    assert result.passed, result
    assert any(rung.name == "tokens" for rung in result.rungs)
    assert load_artifact(folder).plans["some"].tokens == REUSE
    act(policy := ttscompile.load(folder, seed=0), observation())
    act(policy, changed(observation(), 3))
    assert 0 < of_scene(policy)[0].changed < TOKENS
