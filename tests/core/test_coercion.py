"""Numbers and arrays of callers: what comes through, and what is told about the rest."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from ttscompile.core.coercion import integer, listed, numbers, plain
from ttscompile.errors import ObservationError, SpecError, TtscompileError

VALUES = np.array([[1.0, 2.0], [3.0, 4.0]], np.float32)


@pytest.mark.parametrize(
    "value", [3, np.int64(3), np.uint8(3), np.array(3), np.array(3, ">i2"), torch.tensor(3), torch.tensor([3])]
)
def test_a_whole_number_is_whatever_says_that_it_is_one(value: Any) -> None:
    found = integer(value, "threads", SpecError, 3, 3)
    assert found == 3 and type(found) is int


@pytest.mark.parametrize(
    "value",
    [
        *(True, np.True_, np.array(True), torch.tensor(True)),
        *(3.0, np.float32(3), "3", None, np.array([3]), np.array("3"), torch.tensor(3.0)),
        torch.tensor(3, device="meta"),
        *(0, -1, 10**30),
    ],
)
def test_what_is_no_whole_number_or_outside_the_limits_is_refused(value: Any) -> None:
    with pytest.raises(SpecError, match=r"^threads must be an integer of at least 1 and at most 9, or none; found "):
        integer(value, "threads", SpecError, 1, 9, ", or none")


class Finalized(np.ndarray):
    """Keeps something of its own, and computes as numpy does."""

    def __array_finalize__(self, made_from: Any) -> None:
        self.label = getattr(made_from, "label", "none")


class Unit(np.ndarray):
    """Computes in its own way: its numbers are centimetres, say."""

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        raise AssertionError("nothing is computed with it")


@pytest.mark.parametrize("kind", [np.matrix, np.recarray, Finalized])
def test_a_class_that_changes_nothing_is_left_behind(kind: type) -> None:
    given: Any = VALUES.view(kind)
    found = plain(given, "x", ObservationError)
    assert type(found) is np.ndarray and np.array_equal(found, VALUES)
    assert np.shares_memory(found, given)
    assert plain(VALUES, "x", ObservationError) is VALUES


def tensors() -> dict[str, tuple[Callable[[], Any], str]]:
    x = torch.from_numpy(VALUES)

    def fake() -> Any:
        from torch._subclasses.fake_tensor import FakeTensorMode

        return FakeTensorMode(allow_non_fake_inputs=True).from_tensor(x)

    return {
        "meta": (lambda: x.to("meta"), r"on the device meta, where there are no numbers\. Give a plain"),
        "fake": (fake, r"of the class FakeTensor, whose numbers numpy cannot have\. Give a plain"),
        "nested": (
            lambda: torch.nested.nested_tensor([x, x[:1]], layout=torch.jagged),
            r"that is nested, whose rows differ in length\. Give a plain",
        ),
        "sparse": (x.to_sparse, r"of the layout torch\.sparse_coo; expected a dense one\. Use \.to_dense\(\)\.$"),
        "csr": (x.to_sparse_csr, r"of the layout torch\.sparse_csr; expected a dense one\. Use \.to_dense\(\)\.$"),
        "bfloat16": (x.bfloat16, r"of dtype torch\.bfloat16, which numpy does not have\..* \.to\(torch\.float32\)\.$"),
    }


@pytest.mark.filterwarnings("ignore:Sparse CSR")
@pytest.mark.filterwarnings("ignore:The PyTorch API of nested")
@pytest.mark.parametrize("name", tensors())
def test_a_tensor_without_numbers_for_numpy_says_what_it_is(name: str) -> None:
    make, message = tensors()[name]
    with pytest.raises(ObservationError, match=f"^observation 'obs' is a tensor .*{message}") as raised:
        plain(make(), "observation 'obs'", ObservationError)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("transform", [torch.vmap, lambda f: torch.func.grad(lambda x: f(x).sum())])
def test_tensors_of_torchs_transforms_are_refused(transform: Callable[[Any], Callable[[Any], Any]]) -> None:
    told: list[str] = []

    def inside(x: torch.Tensor) -> torch.Tensor:
        with pytest.raises(ObservationError) as raised:
            plain(x, "x", ObservationError)
        told.append(str(raised.value))
        return x

    transform(inside)(torch.ones(2, 2))
    assert [message.partition(" (")[0] for message in told] == ["x is a tensor whose numbers cannot be read here"]
    assert told[0].endswith("Call the policy outside of torch.vmap, torch.func and torch.compile.")


def test_views_of_torch_that_numpy_would_not_take_are_resolved() -> None:
    x = torch.from_numpy(VALUES)
    negated = torch.complex(x, -x).conj().imag
    assert negated.is_neg()
    assert np.array_equal(plain(negated, "x", ObservationError), VALUES)
    assert np.array_equal(plain(x.clone().requires_grad_(), "x", ObservationError), VALUES)


@pytest.mark.parametrize("function", [plain, listed])
@pytest.mark.parametrize("mask", [False, True])
def test_masked_arrays_and_those_that_compute_in_their_own_way_are_refused(function: Any, mask: bool) -> None:
    masked = np.ma.masked_array(VALUES, mask=mask)
    with pytest.raises(ObservationError, match=r"^x is a masked array, .*\.filled\("):
        function(masked, "x", ObservationError, "float32")
    with pytest.raises(ObservationError, match=r"^x is a Unit, .*expected a plain array\. Use np\.array"):
        function(VALUES.view(Unit), "x", ObservationError, "float32")
    with pytest.raises(ObservationError, match="^x is a masked array"):
        listed([masked, masked], "x", ObservationError, "float32")


@pytest.mark.parametrize("value", [[1.0, 2.0], memoryview(b"1234"), 1.0, np.float32(1), None, object()])
def test_what_is_neither_array_nor_tensor_is_refused(value: Any) -> None:
    expected = rf"^x is a {type(value).__name__}; expected a numpy array or a torch tensor\..*np\.int8"
    with pytest.raises(ObservationError, match=expected):
        plain(value, "x", ObservationError, "int8")


class Raises:
    def __array__(self, *_: object, **__: object) -> np.ndarray:
        raise ZeroDivisionError("of its own")


@pytest.mark.parametrize("value", [[[1], [1, 2]], Raises(), [[torch.ones(2, device="meta")]]])
def test_what_numpy_makes_no_array_of_is_refused(value: Any) -> None:
    with pytest.raises(SpecError, match=r"^x is (no array of numbers|a tensor on the device meta)"):
        listed(value, "x", SpecError, "int8")


def test_numbers_are_of_the_dtype_and_nothing_else_becomes_one() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert numbers([1, 1e300], "x", SpecError).tolist() == [1, np.inf]
        assert numbers((1, 2), "x", SpecError, "int64").dtype == np.int64
    for value in (["a"], [None], [1j], np.zeros(2, "m8[s]")):
        with pytest.raises(SpecError, match=r"^x has dtype .*; expected numbers, float32\."):
            numbers(value, "x", SpecError)


@pytest.mark.parametrize(
    ("make", "message"),
    [(lambda n: np.int64(2), None), (lambda n: n, r"must be an integer of at least 1.*; found 2\.5")],
)
def test_arguments_that_count_are_whole(make: Callable[[Any], Any], message: str | None) -> None:
    """At every place of the public interface that needs no artifact; those that do are tested with it."""
    from ttscompile import ChunkSpec, ExecutorSettings, ObservationSpec, flow_matching_table
    from ttscompile.calibration.budget import goal_of
    from ttscompile.frontends.families import LoadOptions
    from ttscompile.serving.admission import ServerLimits

    def settings(name: str, value: Any) -> ExecutorSettings:
        return ExecutorSettings(**{name: value})

    given = make(2.5)
    calls: list[Callable[[], Any]] = [
        lambda: ObservationSpec((given, 3)).shape[0],
        lambda: flow_matching_table(given).steps,
        lambda: LoadOptions(steps=given).steps,
        lambda: goal_of(threads=given).threads,
        lambda: ServerLimits(clients=given).clients,
        *(
            lambda name=name: getattr(settings(name, given), name)
            for name in ("n_obs_steps", "horizon", "measured_calls", "latency_window", "down_after", "up_after")
        ),
    ]
    for call in calls:
        if message is None:
            assert call() == 2 and type(call()) is int
        else:
            with pytest.raises(TtscompileError, match=message):
                call()
    for name in ("reserve", "blend_steps", "max_hold", "margin_ticks", "warm_up", "trace_events"):
        assert getattr(settings(name, np.int8(0)), name) == 0
        with pytest.raises(TtscompileError, match=f"{name} must be an integer of at least 0"):
            settings(name, True)
    with pytest.raises(TtscompileError, match="a processor in cores must be an integer"):
        ExecutorSettings(cores=(0.5,))  # type: ignore[arg-type]
    with pytest.raises(TtscompileError, match="a chunk's stop must be an integer of at least 0; found 1.5"):
        ChunkSpec(1, 0, 1.5)  # type: ignore[arg-type]
