import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp
from safetensors.numpy import load_file, save

from ttscompile.artifact import tensors
from ttscompile.errors import ArtifactChangedError, ArtifactError

DTYPES = [np.bool_, np.uint8, np.int8, np.int16, np.int32, np.int64, np.float32, np.float64]

arrays = st.dictionaries(
    # Other names are refused when they are read: tests/artifact/test_identity.py.
    st.text(st.characters(exclude_categories=("C", "Z")), min_size=1, max_size=8),
    st.sampled_from(DTYPES).flatmap(lambda d: hnp.arrays(d, hnp.array_shapes(min_dims=0, min_side=0, max_dims=3))),
    max_size=5,
)


@pytest.mark.slow
@given(arrays)
def test_what_is_written_is_read_by_us_and_by_the_library(values: dict[str, np.ndarray]) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "t.safetensors"
        tensors.write(path, values)
        assert path.read_bytes() == tensors.serialize(values) == save(values), "other bytes than the library's"
        found, theirs = tensors.read(path), load_file(path)
        assert set(found) == set(values) == set(theirs)
        for name, value in values.items():
            assert found[name].dtype == value.dtype
            assert found[name].shape == value.shape
            assert found[name].tobytes() == value.tobytes() == theirs[name].tobytes()
        raw = path.read_bytes()
        for name, entry in tensors.entries_of(path).items():
            assert raw[entry.offset : entry.offset + entry.length] == values[name].tobytes()


def test_strides_and_byte_order_do_not_matter(tmp_path: Path) -> None:
    value = np.arange(12, dtype=np.float32).reshape(3, 4)
    expected = tensors.serialize({"a": value, "b": value.T.copy()})
    assert tensors.serialize({"b": value.T, "a": np.asfortranarray(value).astype(">f4")}) == expected


def test_arrays_are_read_only_views(tmp_path: Path) -> None:
    path = tmp_path / "t.safetensors"
    path.write_bytes(tensors.serialize({"a": np.zeros(3, np.float32)}))
    with pytest.raises(ValueError, match="read-only"):
        tensors.read(path)["a"][0] = 1


def is_mapped(array: Any) -> bool:
    """Whether it is a view of a file."""
    while isinstance(array, np.ndarray) and not isinstance(array, np.memmap):
        array = array.base
    return isinstance(array, np.memmap)


def test_only_large_files_are_mapped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A mapped file that ends before it is read ends the process."""
    path, values = tmp_path / "t.safetensors", {"a": np.arange(6.0), "b": np.arange(4.0)}
    tensors.write(path, values)
    for limit, mapped in ((path.stat().st_size + 1, False), (path.stat().st_size, True)):
        monkeypatch.setattr(tensors, "MAPPED", limit)
        found = tensors.read(path)
        assert [is_mapped(found[name]) for name in values] == [mapped, mapped]
        for name, value in values.items():
            np.testing.assert_array_equal(found[name], value)


def test_a_file_that_ends_early_by_now_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "t.safetensors"
    tensors.write(path, {"a": np.zeros(100_000), "b": np.zeros(100_000)})
    header = tensors._header

    def shortened(*given: Any) -> Any:
        found = header(*given)
        path.write_bytes(b"")
        return found

    monkeypatch.setattr(tensors, "_header", shortened)
    with pytest.raises(ArtifactChangedError, match="the file was changed while it was being read"):
        tensors.read(path)


def test_a_dtype_that_numpy_lacks_is_not_written() -> None:
    with pytest.raises(ArtifactError, match="'a' has dtype complex64"):
        tensors.serialize({"a": np.zeros(3, np.complex64)})


def entry(dtype: object = "F32", shape: object = (2,), begin: object = 0, end: object = 8) -> dict[str, object]:
    return {"dtype": dtype, "shape": shape, "data_offsets": [begin, end]}


def file_of(tmp_path: Path, header: object, data: bytes = bytes(8), length: int | None = None) -> Path:
    content = header if isinstance(header, bytes) else json.dumps(header).encode()
    content += b" " * (-len(content) % 8)
    path = tmp_path / "t.safetensors"
    path.write_bytes((len(content) if length is None else length).to_bytes(8, "little") + content + data)
    return path


def test_the_hand_made_file_is_good(tmp_path: Path) -> None:
    path = file_of(tmp_path, {"__metadata__": {"format": "np"}, "a": entry()})
    assert tensors.read(path)["a"].tolist() == [0, 0]


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"a": entry(dtype="BF16", shape=(4,))}, "one of 'BOOL'"),
        ({"a": entry(dtype="F16", shape=(4,))}, "one of 'BOOL'"),
        ({"a": entry(dtype=3)}, "one of 'BOOL'"),
        ({"a": entry(shape=[3])}, r"\[begin, begin \+ 12\]"),
        ({"a": entry(shape=[-2])}, "at least 0"),
        ({"a": entry(shape=[2**62, 2**62])}, "begin, begin"),
        ({"a": entry(shape=[2**64])}, "64-bit"),
        ({"a": entry(shape=[1] * 17, end=4)}, "at most 16 items"),
        ({"a": entry(shape=[True, 2])}, "integer"),
        ({"a": entry(begin=8, end=16)}, "'a' at byte"),
        ({"a": entry(begin=8, end=0)}, "begin, begin"),
        ({"a": entry(begin=-8, end=0)}, "at least 0"),
        ({"a": entry(), "b": entry()}, "'b' at byte"),
        ({"a": entry(shape=[1], end=4), "b": entry(shape=[1], begin=3, end=7)}, "'b' at byte"),
        ({"a": entry(dtype="U8", shape=[1], end=1), "b": entry(dtype="I16", shape=[1], begin=1, end=3)}, "aligned"),
        ({"a": entry(shape=[1], end=4)}, "expected .* bytes; found"),
        ({"a": entry(shape=[4], end=16)}, "expected .* bytes; found"),
        ({"a": {"dtype": "F32", "shape": [2]}}, "missing"),
        ({"a": {**entry(), "more": 1}}, "unknown"),
        ({"__metadata__": {"a": 1}, "a": entry()}, "__metadata__.a"),
        ([], "an object"),
        (b'{"a": 1, "a": 2}', "twice"),
        (b"not json", "JSON document"),
    ],
)
def test_headers_that_are_refused(tmp_path: Path, header: object, message: str) -> None:
    with pytest.raises(ArtifactError, match=message):
        tensors.read(file_of(tmp_path, header))


@pytest.mark.parametrize("length", [2**63, 2**64 - 1, 1000])
def test_a_header_longer_than_the_file(tmp_path: Path, length: int) -> None:
    with pytest.raises(ArtifactError, match="inside the file"):
        tensors.read(file_of(tmp_path, {"a": entry()}, length=length))


def test_every_truncation_is_found(tmp_path: Path) -> None:
    path = tmp_path / "t.safetensors"
    content = tensors.serialize({"a": np.ones(3, np.float32), "b": np.ones((), np.int64)})
    for size in range(len(content)):
        path.write_bytes(content[:size])
        with pytest.raises(ArtifactError):
            tensors.read(path)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="cannot be read"):
        tensors.read(tmp_path / "none")


@pytest.mark.parametrize("code", ["BF16", "F16"])
def test_bytes_of_short_ones_are_counted_before_they_are_read(tmp_path: Path, code: str) -> None:
    assert np.asarray(tensors.read(file_of(tmp_path, {"a": entry(code, [4])}), short=True)["a"]).tolist() == [0] * 4
    for shape in ([2], [2**40]):
        with pytest.raises(ArtifactError, match=r"begin, begin \+ "):
            tensors.read(file_of(tmp_path, {"a": entry(code, shape)}), short=True)
