"""What an unkind caller gives: every array is made plain, copied and judged before anything is executed."""

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

import ttscompile
from tests.lower.whole_call import every_way, make
from tests.rounding import assert_equal_but_for_rounding
from ttscompile import Affine, ChunkSpec, Noise, ObservationSpec, Source
from ttscompile.artifact import Artifact, load_artifact
from ttscompile.core.lattice import check_plan, legalize, uniform_plan
from ttscompile.core.spec import LARGEST
from ttscompile.core.values import check_numbers, check_values
from ttscompile.errors import IllegalPlanError, NonFiniteActionsError, ObservationError, TtscompileError
from ttscompile.runtimes.inpainting import check_prefix
from ttscompile.runtimes.load import load
from ttscompile.runtimes.policy import CompiledPolicy

from .agreement import call_terms
from .conftest import MakeArtifact
from .toys import pencil_program, some_noise, toy_program, written_artifact

OBS = np.array([[0.3, -1.2], [0.7, 0.1]], np.float32)
PLAN = uniform_plan(5, 5, 1)  # four steps in a row compute nothing
RUNTIMES = ["onnxruntime", "torch", "reference"]


@pytest.fixture(scope="module")
def normed(tmp_path_factory: pytest.TempPathFactory) -> Artifact:
    """A policy with a LayerNorm, whose idle steps are computed in numpy."""
    return written_artifact(toy_program(normed=True), tmp_path_factory.mktemp("normed") / "artifact")


@pytest.fixture(scope="module", params=RUNTIMES)
def policy(request: pytest.FixtureRequest, normed: Artifact) -> CompiledPolicy:
    return load(normed.path, runtime=request.param, seed=0)


def actions(policy: CompiledPolicy, obs: Any = OBS, noise: Any = None, plan: Any = PLAN) -> np.ndarray:
    policy.reset(seed=0)
    return policy.predict_action({"obs": obs}, noise=noise or some_noise(), plan=plan)["action_pred"]


def masked(array: Any, under: float = np.nan) -> np.ma.MaskedArray:
    """With its first number under the mask, and another one in its place."""
    data, mask = array.copy(), np.zeros(array.shape, np.bool_)
    data.flat[0], mask.flat[0] = under, True
    return np.ma.masked_array(data, mask=mask)


@pytest.mark.slow
def test_masked_arrays_come_through_nowhere(policy: CompiledPolicy) -> None:
    noise, obs = some_noise(), {"obs": OBS}
    for under in (np.nan, 651.0):
        for arguments in (
            {"obs_dict": {"obs": masked(OBS, under)}},
            {"obs_dict": obs, "noise": Noise(masked(noise.initial, under), noise.steps)},
            {"obs_dict": obs, "noise": Noise(noise.initial, masked(noise.steps, under))},
            {"obs_dict": obs, "prefix": masked(np.zeros((2, 1, 2), np.float32), under)},
        ):
            with pytest.raises(ObservationError, match="is a masked array"):
                policy.predict_action(**arguments)
        for call in (policy.select_action, policy.predict_action_chunk):
            with pytest.raises(ObservationError, match="is a masked array"):
                call({"obs": masked(OBS, under)})
    plan: Any
    for plan in (masked(PLAN, 0), [masked(row, 0) for row in PLAN]):
        with pytest.raises(IllegalPlanError, match="plan is a masked array"):
            policy.predict_action(obs, plan=plan)
        with pytest.raises(IllegalPlanError, match="plan is a masked array"):
            check_plan(plan, 5, 5, 1)
        with pytest.raises(IllegalPlanError, match="plan is a masked array"):
            legalize(plan, range(5), np.zeros((5, 5), np.bool_))
    with pytest.raises(ttscompile.TtscompileError, match="normaliser scale is a masked array"):
        Affine(masked(np.ones(2), 2.0), np.zeros(2, np.float32))


def layouts(array: np.ndarray) -> dict[str, Any]:
    """The same numbers as memory may hold them, and with what numpy wraps around them."""
    locked, wide = array.copy(), np.zeros((*array.shape[:-1], 2 * array.shape[-1]), array.dtype)
    locked.flags.writeable = False
    wide[..., ::2] = array
    return {
        "negative strides": array[..., ::-1].copy()[..., ::-1],
        "every second": wide[..., ::2],
        "fortran": np.asfortranarray(array),
        "read-only": locked,
        "recarray": array.view(np.recarray),
        "tensor": torch.from_numpy(array),
        "tensor, transposed": torch.from_numpy(array.T.copy()).permute(*reversed(range(array.ndim))),
    }


@pytest.mark.parametrize("dtype", ["float64", "uint8"])
def test_what_is_normalised_is_float32_whatever_it_was(tmp_path: Path, dtype: str) -> None:
    program = toy_program(steps=3, blocks=2, noise=0.0, pruner=False)
    seen = {"obs": replace(program.spec.observations["obs"], dtype=dtype)}
    _, model = make(replace(program, spec=replace(program.spec, observations=seen)), tmp_path)
    noise = Noise(np.random.default_rng(0).standard_normal((2, 3, 2), dtype=np.float32), None)
    made = every_way(tmp_path / "artifact", model, {"obs": np.array([[3, 1], [0, 2]], dtype)}, noise)
    terms = 4 * call_terms(load_artifact(tmp_path / "artifact"))
    for found in made.values():
        assert_equal_but_for_rounding(found, made["reference"], terms)


@pytest.mark.slow
@pytest.mark.parametrize("layout", layouts(OBS))
def test_how_numbers_lie_in_memory_changes_nothing(policy: CompiledPolicy, layout: str) -> None:
    noise, expected = some_noise(), actions(policy)
    assert noise.steps is not None
    turned = Noise(layouts(noise.initial)[layout], layouts(noise.steps)[layout])
    found = actions(policy, layouts(OBS)[layout], turned, layouts(PLAN)[layout])
    np.testing.assert_array_equal(np.asarray(found), expected)


def test_of_the_noise_of_a_longer_loop_the_first_steps_are_taken_whatever_holds_it(policy: CompiledPolicy) -> None:
    noise, expected = some_noise(), actions(policy)
    assert noise.steps is not None
    longer = np.concatenate([noise.steps, noise.steps])
    held: list[Any] = [longer, torch.from_numpy(longer)]
    for steps in held:
        np.testing.assert_array_equal(actions(policy, noise=Noise(noise.initial, steps)), expected)


def test_streams_of_stride_zero_are_streams(policy: CompiledPolicy) -> None:
    same = np.broadcast_to(OBS[:1], (2, 2))
    np.testing.assert_array_equal(actions(policy, same), actions(policy, same.copy()))
    with pytest.raises(ObservationError, match="wrong shape"):
        actions(policy, np.broadcast_to(OBS[:1], (10**12, 2, 2)))  # refused before it is copied


@pytest.mark.parametrize("dtype", [">f4", "f2", "f8", "i4", "?", "O", "U3", "c8", "m8[s]", [("a", "f4"), ("b", "i2")]])
def test_other_dtypes_are_refused_whatever_they_are(policy: CompiledPolicy, dtype: Any) -> None:
    with pytest.raises(ObservationError, match=r"wrong dtype: expected float32 \[B, 2\]; found .*astype\(np.float32\)"):
        actions(policy, np.zeros((2, 2)).astype(dtype))
    with pytest.raises(ObservationError, match="noise.initial must be float32"):
        actions(policy, noise=Noise(np.zeros((2, 3, 2)).astype(dtype), some_noise().steps))


@pytest.mark.parametrize("dtype", ["i1", "u1", ">i4", "i8", "u8"])
def test_plans_of_any_integers_are_the_same_plan(policy: CompiledPolicy, dtype: str) -> None:
    np.testing.assert_array_equal(actions(policy, plan=PLAN.astype(dtype)), actions(policy))
    np.testing.assert_array_equal(actions(policy, plan=PLAN.astype(dtype).view(np.matrix)), actions(policy))
    legal, changed = legalize(PLAN.astype(dtype), range(5), np.zeros((5, 5), np.int64))
    assert (legal == PLAN).all() and changed == 0 and legal.dtype == np.int8


BFLOAT = torch.zeros(5, 5, dtype=torch.bfloat16)
OTHER_TYPES = [PLAN.astype(dtype) for dtype in ("?", "f8", "O", "U1")]


@pytest.mark.parametrize("plan", [*OTHER_TYPES, PLAN + np.int16(300), [[0], [0, 1]], BFLOAT, BFLOAT.float(), object()])
def test_plans_of_anything_else_are_refused_everywhere(policy: CompiledPolicy, plan: Any) -> None:
    for call in (lambda: actions(policy, plan=plan), lambda: legalize(plan, range(5), np.zeros((5, 5), np.bool_))):
        with pytest.raises(IllegalPlanError, match=r"plan (has dtype|holds values 300\.\.302|is no array|is a tensor)"):
            call()


def test_a_plan_and_what_is_written_must_fit() -> None:
    wrong: tuple[tuple[Any, range, Any], ...] = (
        (PLAN, range(4), PLAN == 0),
        (PLAN, range(5), PLAN[:4] == 0),
        (PLAN[0], range(5), PLAN[0] == 0),
        (np.zeros(()), range(5), np.zeros(())),
    )
    for plan, groups, written in wrong:
        with pytest.raises(IllegalPlanError, match="expected plan and written of the same shape|dtype float64"):
            legalize(plan, groups, written)


class Shifting(Mapping[str, Any]):
    """Gives its value once, and then another one, or none at all."""

    def __init__(self, *values: Any) -> None:
        self._values = list(values)

    def __getitem__(self, key: str) -> Any:
        if key != "obs" or not self._values:
            raise KeyError(key)
        return self._values.pop(0)

    def __iter__(self) -> Iterator[str]:
        return iter(["obs"])

    def __len__(self) -> int:
        return 1


def test_a_mapping_is_read_once(policy: CompiledPolicy) -> None:
    expected = actions(policy)
    for second in ([np.zeros(7)], []):
        policy.reset(seed=0)
        found = policy.predict_action(Shifting(OBS, *second), noise=some_noise(), plan=PLAN)["action_pred"]
        np.testing.assert_array_equal(found, expected)
        for call in (policy.select_action, policy.predict_action_chunk):
            policy.reset(seed=0)
            call(Shifting(OBS, *second), noise=some_noise())
    with pytest.raises(ObservationError, match=r"missing: \['obs'\]"):
        policy.predict_action(Shifting())


@pytest.mark.parametrize("spoiled", ["observation", "noise.initial", "noise.steps", "plan"])
def test_what_is_written_after_the_check_changes_nothing(
    policy: CompiledPolicy, spoiled: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As another thread of the caller's may: the numbers that were looked at are those that are computed with."""
    expected, obs, noise, plan = actions(policy), OBS.copy(), some_noise(), PLAN.copy()
    own: dict[str, Any] = {"observation": obs, "noise.initial": noise.initial, "noise.steps": noise.steps, "plan": plan}
    done = []

    def spoil(what: str) -> None:
        if what.startswith(spoiled):
            done.append(what)
            own[spoiled][:] = 99

    def checked(array: Any, normalizer: Any, what: str, *others: Any) -> Any:
        spoil(what)
        return check_numbers(array, normalizer, what, *others)

    def plan_checked(*arguments: Any) -> Any:
        made = check_plan(*arguments)
        spoil("plan")
        return made

    monkeypatch.setattr("ttscompile.core.values.check_numbers", checked)
    monkeypatch.setattr("ttscompile.runtimes.arrays.check_numbers", checked)
    monkeypatch.setattr("ttscompile.runtimes.runtime.check_plan", plan_checked)
    np.testing.assert_array_equal(actions(policy, obs, noise, plan), expected)
    assert done


@pytest.mark.parametrize("number", [1e30, -1e30, 3.4e38, 2 * LARGEST])
def test_numbers_that_no_training_has_seen_are_refused(policy: CompiledPolicy, number: float) -> None:
    """The toy's normaliser doubles the first number, so that half of the limit is too much of it."""
    obs, noise = OBS.copy(), some_noise()
    obs[1, 0] = number
    with pytest.raises(ObservationError, match=r"'obs' must be between -1e\+06 and 1e\+06 when normalised; found"):
        actions(policy, obs)
    for call in (policy.select_action, policy.predict_action_chunk):
        policy.reset()
        with pytest.raises(ObservationError, match=r"index \(1, 0\) \(\S+ when normalised\), 1 such values in all"):
            call({"obs": obs})
    for values in (noise.initial, noise.steps):
        assert values is not None
        kept, values.flat[0] = values.flat[0], number
        with pytest.raises(ObservationError, match=r"noise\.\w+ must be between -1e\+06 and 1e\+06; found"):
            actions(policy, noise=noise)
        values.flat[0] = kept
    with pytest.raises(ObservationError, match=r"prefix must be between .* when normalised"):
        check_prefix(np.full((1, 1, 2), min(10 * number, 3.4e38), np.float32), 1, policy._spec, None)


def test_the_limit_is_the_limit_in_every_entry(policy: CompiledPolicy) -> None:
    """x * [2, 0.5] + [0.1, -0.2] is held against 1e6, entry by entry."""
    scale, offset = np.array([2, 0.5]), np.array([0.1, -0.2])
    for sign in (-1, 1):
        most = ((sign * LARGEST - offset) / scale).astype(np.float32)
        inside, outside = (most * np.float32(factor) for factor in (0.999999, 1.000001))
        assert np.isfinite(actions(policy, np.stack([inside, inside]))).all()
        for entry in range(2):
            obs = np.zeros((2, 2), np.float32)
            obs[0, entry] = outside[entry]
            with pytest.raises(ObservationError, match="1 such values"):
                actions(policy, obs)
    normalizer = Affine(np.array([1e8, 1.0]), np.array([-5e8, 0.0]))  # the first was constant in training
    assert normalizer.reach < 0
    check_values(np.array([[5.0, 3.0]], np.float32), ObservationSpec((2,), normalizer), "x", ObservationError)
    with pytest.raises(ObservationError, match=r"found 5\.1 at index \(0, 0\)"):
        check_values(np.array([[5.1, 3.0]], np.float32), ObservationSpec((2,), normalizer), "x", ObservationError)


@pytest.fixture(scope="module")
def both(normed: Artifact) -> list[CompiledPolicy]:
    return [load(normed.path, runtime) for runtime in RUNTIMES]


FLOATS = st.floats(width=32, allow_nan=False, allow_infinity=False)
SIZES = st.sampled_from([1.0, 1e3, 1e6, 1e12, 1e19, 1e30, 3.4e38])


def refused_or_finite(both: list[CompiledPolicy], data: st.DataObject) -> None:
    """Finite numbers give finite actions without a warning in both runtimes, or are refused, if they are too large."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))

    def some(*shape: int) -> np.ndarray:
        array = (rng.uniform(-1, 1, shape) * min(data.draw(SIZES), 3.4e38)).astype(np.float32)
        array.flat[rng.integers(array.size)] = data.draw(FLOATS)
        return array

    obs, noise = some(2, 2), Noise(some(2, 3, 2), some(5, 2, 3, 2))
    plan: Any = data.draw(st.sampled_from([PLAN, uniform_plan(5, 5, 3), "dense"]))
    assert noise.steps is not None
    normalized = obs * np.array([2, 0.5]) + np.array([0.1, -0.2])
    seen = all(np.abs(each).max() < 0.99 * LARGEST for each in (normalized, noise.initial, noise.steps))
    made = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for one in both:
            one.reset()
            try:
                made.append(one.predict_action({"obs": obs}, noise=noise, plan=plan)["action_pred"])
            except ObservationError:
                assert not seen
    assert len(made) in ((len(both),) if seen else (0, len(both)))
    for found in made:
        assert np.isfinite(found).all()


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_no_finite_number_gives_a_warning_or_actions_that_are_none(
    both: list[CompiledPolicy], data: st.DataObject
) -> None:
    refused_or_finite(both, data)


@pytest.mark.soak
@settings(max_examples=10_000, deadline=None)
@given(data=st.data())
def test_ten_thousand_of_them(both: list[CompiledPolicy], data: st.DataObject) -> None:
    refused_or_finite(both, data)


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_actions_that_overflow_are_an_error_and_end_the_episode(make_artifact: MakeArtifact, runtime: str) -> None:
    """The normaliser of the actions divides by 1e-38: 44 is beyond float32, and 0 is not."""
    program = pencil_program()
    chunk = ChunkSpec(1, 0, 1, Affine(np.array([1e-38]), np.array([0.0])))
    policy = load(make_artifact(replace(program, spec=replace(program.spec, chunk=chunk))).path, runtime)

    def call(x: float, plan: list[int]) -> Any:
        noise, obs = Noise(np.full((1, 1, 1), x, np.float32)), {"obs": np.zeros((1, 1), np.float32)}
        return policy.predict_action(obs, noise=noise, plan=np.array(plan)[:, None])["action_pred"]

    assert call(0, [0, 0]).item() == 0
    assert call(0, [0, 3]).item() == 0
    with pytest.raises(NonFiniteActionsError, match=r"1 of 1 numbers of the actions are not finite.*plan 'given'"):
        call(44, [0, 0])
    assert policy.last_report is None
    with pytest.raises(IllegalPlanError, match="never computed"):
        call(0, [0, 3])
    assert call(0, [0, 0]).item() == 0


@pytest.mark.slow
def test_four_thousand_streams_are_each_what_they_are_alone(policy: CompiledPolicy, normed: Artifact) -> None:
    rng, count, rollout = np.random.default_rng(0), 4096, PLAN.copy()
    rollout[3] = Source.ROLLOUT
    obs = rng.standard_normal((count, 2), dtype=np.float32)
    noise = some_noise(count)
    assert noise.steps is not None

    def episode(obs: np.ndarray, noise: Noise) -> np.ndarray:
        policy.reset()
        policy.predict_action({"obs": obs}, noise=noise, plan="dense")
        return policy.predict_action({"obs": obs}, noise=noise, plan=rollout)["action_pred"]

    together = episode(obs, noise)
    for stream in (0, 1, 2048, 4095):
        own = slice(stream, stream + 1)
        alone = episode(obs[own], Noise(noise.initial[own], noise.steps[:, own]))
        assert_equal_but_for_rounding(together[own], alone, call_terms(normed))


def test_a_batch_that_changes_within_an_episode_is_refused_and_the_episode_goes_on(policy: CompiledPolicy) -> None:
    rollout = PLAN.copy()
    rollout[3] = Source.ROLLOUT
    policy.reset()
    policy.predict_action({"obs": OBS}, noise=some_noise(), plan="dense")
    for streams in (1, 3):
        with pytest.raises(ObservationError, match=rf"holds {streams} streams, and the episode under way 2.*reset\(\)"):
            policy.predict_action({"obs": OBS[np.zeros(streams, int)]}, plan=rollout)
    policy.predict_action({"obs": OBS}, noise=some_noise(), plan=rollout)  # its cache is still there
    policy.reset()
    with pytest.raises(IllegalPlanError, match="never computed"):  # and nobody else's
        policy.predict_action({"obs": OBS[:1]}, plan=rollout)
    assert policy.predict_action({"obs": OBS[:1]})["action"].shape == (1, 2, 2)


@pytest.mark.parametrize("value", [np.int64(1), np.array(1), torch.tensor(1)])
def test_threads_and_seeds_are_whatever_says_that_it_is_whole(normed: Artifact, value: Any) -> None:
    first = load(normed.path, threads=value, seed=value).predict_action({"obs": OBS})["action"]
    other = load(normed.path, seed=7)
    other.reset(seed=value)
    np.testing.assert_array_equal(other.predict_action({"obs": OBS})["action"], first)
    wrong: Any = value.astype(bool) if isinstance(value, np.ndarray) else True
    with pytest.raises(TtscompileError, match=r"threads must be an integer of at least 1 and at most 1024; found"):
        load(normed.path, threads=wrong)
