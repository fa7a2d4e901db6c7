"""``${...}`` in a configuration: resolved by a small safe language, or refused by the key's name."""

from typing import Any

import pytest
from hypothesis import given, strategies as st

from ttscompile.errors import CheckpointError
from ttscompile.policies.diffusion_policy.interpolation import Config, evaluate_expression


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2 if True else 20 + 2", 2),
        ("2 if False else 20 + 2", 22),
        (" 3 * (4 - 1) // 2 ", 4),
        ("7 % 4 == 3 and not False", True),
        ("-1 < 0 < 1", True),
        ("1 < 0 < 5", False),
        ("'a' if 'x' == 'x' else 'b'", "a"),
        ("None", None),
        ("0 or 5", 5),
        ("0 and 5", 0),
        ("1 and 5", 5),
        ("+2.5", 2.5),
    ],
)
def test_expressions(text: str, value: Any) -> None:
    """The language, by example; the type counts."""
    found = evaluate_expression(text)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "open('x')",
        "(1).__class__",
        "[1, 2]",
        "[x for x in (1, 2)]",
        "lambda: 1",
        "a",
        "2 ** 9",
        "1 << 60",
        "'a' * 1000000000",
        "'a' + 'b'",
        "1 / 0",
        "1 if",
        "",
        "f'{1}'",
        "(x := 3)",
        "1 < 'a'",
        "1 in (1, 2)",
        "1 is 1",
        "1e300 * 1e300",
        "9999999999 * 9999999999",
        "b'x'",
        "...",
        "1j",
        "~1",
        "-'a'",
        "1;2",
        "1" + " + 1" * 1000,
        "(" * 400 + "1" + ")" * 400,
    ],
)
def test_everything_else_is_refused(text: str) -> None:
    """Names, calls, attributes, containers, powers, and numbers that grow."""
    with pytest.raises(CheckpointError, match="expected numbers"):
        evaluate_expression(text)


numbers = st.integers(-50, 50).map(str) | st.floats(-9, 9, allow_nan=False).map(lambda x: f"{x:.3f}")
expressions = st.recursive(
    numbers,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from(["+", "-", "*", "<", ">=", "==", "and", "or"]), inner).map(
            lambda parts: f"({' '.join(parts)})"
        ),
        st.tuples(inner, inner, inner).map(lambda parts: f"({parts[0]} if {parts[1]} else {parts[2]})"),
        inner.map(lambda part: f"(not {part})"),
    ),
    max_leaves=8,
)


@given(expressions)
def test_means_what_python_means(text: str) -> None:
    """Within the language, Python is the reference."""
    assert evaluate_expression(text) == eval(text)


ORIGINAL = {
    "obs_dim": 20,
    "action_dim": 2,
    "obs_as_cond": True,
    "name": "pusht",
    "sizes": [4, {"deep": 7}],
    "policy": {
        "input_dim": "${eval:'${action_dim} if ${obs_as_cond} else ${obs_dim} + ${action_dim}'}",
        "output_dim": "${policy.input_dim}",
        "cond_dim": '${eval:"${obs_dim} if ${obs_as_cond} else 0"}',
        "bare": "${eval:${obs_dim} * 2}",
        "obs_as_cond": "${obs_as_cond}",
        "title": "${name}_of_${action_dim}",
        "size": "${sizes.0}",
        "deep": "${sizes[1].deep}",
        "list": ["${obs_dim}", 1],
    },
    "logging": {"name": "${now:%Y}_${name}"},
}


def test_configuration_of_the_original() -> None:
    """The expressions that the published configurations hold, nested, with their types."""
    assert Config(ORIGINAL).get("policy") == {
        "input_dim": 2,
        "output_dim": 2,
        "cond_dim": 20,
        "bare": 40,
        "obs_as_cond": True,
        "title": "pusht_of_2",
        "size": 4,
        "deep": 7,
        "list": [20, 1],
    }
    assert Config(ORIGINAL | {"obs_as_cond": False}).get("policy.input_dim") == 22
    assert Config(ORIGINAL).get("policy.obs_as_cond") is True


def test_absent_keys() -> None:
    """``get`` has a default, ``require`` names the key."""
    assert Config(ORIGINAL).get("policy.absent", 5) == 5
    with pytest.raises(CheckpointError, match=r"cfg\.policy\.absent is missing"):
        Config(ORIGINAL).require("policy.absent")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("${nowhere}", "no key 'nowhere'"),
        ("${eval:'${nowhere} + 1'}", "no key 'nowhere'"),
        ("${a}", "refers to itself"),
        ("${b}", "refers to itself: a -> b -> a"),
        ("${now:%Y}", "only the training code can resolve"),
        ("${eval:'1 + '}", "has no value"),
        ("${eval:'__import__(1)'}", "is not allowed"),
        ("x${eval:'1'}", "only the training code can resolve"),
        ("${.obs_dim}", "only the training code can resolve"),
        ("${obs_dim", "only the training code can resolve"),
        ("???", "never given"),
    ],
)
def test_unresolvable_values_are_refused_by_name(value: str, message: str) -> None:
    """The message names the key, also when it is met inside a larger request; other keys are untouched by it."""
    config = Config({"a": value, "b": "${a}", "obs_dim": 3})
    assert config.get("obs_dim") == 3
    with pytest.raises(CheckpointError, match=r"cfg\.(a|b)\b") as caught:
        config.get("a")
    assert message in str(caught.value)
