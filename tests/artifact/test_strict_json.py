import pytest

from ttscompile.artifact.strict_json import Value, dump, parse
from ttscompile.core.untrusted_json import MAX_DEPTH
from ttscompile.errors import ArtifactError


def nested(depth: int) -> bytes:
    return b"[" * depth + b"]" * depth


def test_a_document_comes_back() -> None:
    data = {"a": [1, 2.5, None, True, "ü"], "b": {}}
    assert parse(dump(data), "f").data == data
    assert list(parse(b'{"z": 1, "a": 2}', "f").data) == ["z", "a"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected a JSON document"),
        (b'{"a": 1', "expected a JSON document"),
        (b'{"a": 1} x', "expected a JSON document"),
        (b'{"a": 1, "b": 2, "a": 3}', "'a' is twice"),
        (b'{"a": NaN}', "number NaN"),
        (b"[-Infinity]", "number -Infinity"),
        (b"\xff\xfe", "expected a JSON document"),
        (b"9" * 5000, "expected a JSON document"),
        (nested(MAX_DEPTH + 2), "levels deep"),
        (nested(200_000), "levels deep"),
    ],
)
def test_what_is_refused(content: bytes, message: str) -> None:
    with pytest.raises(ArtifactError, match=message):
        parse(content, "file.json")


def test_depth_and_size_at_the_limit() -> None:
    parse(nested(MAX_DEPTH + 1), "f")  # the root itself is level 0
    parse(b"[1]", "f", limit=3)
    with pytest.raises(ArtifactError, match="more than 2 bytes"):
        parse(b"[1]", "f", limit=2)


def test_errors_name_path_expected_and_found() -> None:
    value = parse(b'{"spec": {"sampler": [1, "two"]}}', "manifest.json")
    item = value.keys("spec")["spec"].members()["sampler"].items()[1]
    with pytest.raises(ArtifactError, match=r"manifest.json.spec.sampler\[1\]: expected an integer; found 'two'"):
        item.integer()
    with pytest.raises(ArtifactError, match=r"missing: \['other'\], unknown: \['spec'\]"):
        value.keys("other")


@pytest.mark.parametrize("data", [True, 1.0, "1", None, 2**63, -1])
def test_integer_refuses(data: object) -> None:
    with pytest.raises(ArtifactError, match="integer"):
        Value(data, "x").integer()


@pytest.mark.parametrize("data", [True, "1", None, 10**400, float("inf")])
def test_number_refuses(data: object) -> None:
    with pytest.raises(ArtifactError, match="number"):
        Value(data, "x").number()
