"""Replay buffers in zarr with something wrong: chunks, metadata, codecs, names and links."""

import bz2
import gzip
import json
import lzma
import pickle
import random
import shutil
import zlib
from pathlib import Path
from typing import Any

import numcodecs

from tests.hostile.archives import write, write_hostile
from tests.hostile.mutate import changed, damaged, make_no_file
from tests.hostile.pickles import Runs

SIZES = (0, 1, 2, 4, 9, -1, 2**15, 2**24, 2**31, 2**40, 2**62, 2**63 - 1, 2**63, 2**64, 10**30, 1.5, True, None, "9")
DTYPES: tuple[Any, ...] = (
    "|O",
    "<U4",
    "<U1000000000",
    "|S8",
    "|V8",
    "|V0",
    "<M8[s]",
    "<M8[10000000000Y]",
    "<c16",
    ">f4",
    "<f2",
    "<f16",
    "|b1",
    "<i8",
    [["a", "<f4"], ["b", "|O"]],
    [["a", "<f4", [1000, 1000, 1000]]],
    "(1000,1000,1000)f4",
    "float32",
    "string",
    "fixed_length_utf32",
    "variable_length_bytes",
    "r16",
    "complex64",
    {"name": "fixed_length_utf32", "configuration": {"length_bytes": 2**31}},
    {"name": "structured", "configuration": {"fields": [["a", "float32"]]}},
    {"name": "numpy.datetime64", "configuration": {"unit": "s", "scale_factor": 2**31}},
)
FILLS: tuple[Any, ...] = (
    None,
    0,
    -1,
    10**400,
    "NaN",
    "Infinity",
    "-Infinity",
    "0x7fc00000",
    "AAAA",
    "x" * 5000,
    [0, 0],
    {},
    True,
    1e308,
)
CODECS: tuple[Any, ...] = (
    {"id": "pickle", "protocol": 5},
    {"id": "msgpack2"},
    {"id": "json2"},
    {"id": "categorize", "labels": ["a"], "dtype": "|O"},
    {"id": "astype", "encode_dtype": "|O", "decode_dtype": "<f4"},
    {"id": "delta", "dtype": "|O", "astype": "<i8"},
    {"id": "delta", "dtype": "<f8", "astype": "<i1"},
    {"id": "shuffle", "elementsize": 0},
    {"id": "shuffle", "elementsize": 2**31},
    {"id": "fixedscaleoffset", "offset": 0, "scale": 0, "dtype": "<f4"},
    {"id": "vlen-array", "dtype": "<f4"},
    {"id": "vlen-utf8"},
    {"id": "lzma", "format": 3, "filters": [{"id": 33, "dict_size": 2**31}], "preset": None, "check": -1},
    {"id": "lzma", "format": 2, "filters": None, "preset": 9},
    *({"id": name} for name in ("zlib", "gzip", "bz2", "lzma", "lz4", "zstd", "blosc", "packbits", "crc32", "no", "")),
)
CODECS_3: tuple[Any, ...] = (
    "bytes",
    {"name": "bytes", "configuration": {"endian": "big"}},
    {"name": "bytes", "configuration": {"endian": "middle"}},
    {"name": "transpose", "configuration": {"order": [0, 0]}},
    {"name": "sharding_indexed", "configuration": {"chunk_shape": [1, 1], "codecs": [{"name": "bytes"}]}},
    {"name": "numcodecs.pickle", "configuration": {"protocol": 5}},
    {"name": "numcodecs.delta", "configuration": {"dtype": "|O"}},
    {"name": "numcodecs.shuffle", "configuration": {"elementsize": 2**31}},
    {"name": "numcodecs.lzma"},
    {"name": "numcodecs.zlib", "configuration": {"level": 10**30}},
    {"name": "vlen-utf8"},
    {"name": "crc32c"},
    {"name": "gzip", "configuration": {"level": 5}},
    {"name": "zstd", "configuration": {"level": 10**30, "checksum": 1}},
    {"name": "blosc", "configuration": {"cname": "zstd", "clevel": 5, "shuffle": "shuffle", "typesize": 2**31}},
    {"name": "", "configuration": None},
    None,
)
NAMES = ("..", "../..", "a/../../b", "/etc", "state ", "\x7f", "a" * 200, "\u202e", "proc/self/fd", ".zarray", "c")


def write_bad(rng: random.Random, corpus: Path, folder: Path) -> Path:
    """Copy a good store and change it; a directory, or a zip."""
    path = Path(shutil.copytree(rng.choice(sorted(corpus.iterdir())), folder / "it.zarr"))
    for _ in range(rng.choice((1, 1, 1, 2))):
        _change(rng, path, sorted(file for file in path.rglob("*") if file.is_file()))
    if rng.random() < 0.3 and not any(file.is_symlink() or file.is_fifo() for file in path.rglob("*")):
        return _zip(rng, path)
    return path


def bomb(rng: random.Random, size: int) -> bytes:
    """So many zeros, compressed by one of the codecs."""
    numcodecs.blosc.use_threads = False  # they would be missing in a forked process
    content = bytes(size)
    return rng.choice(
        (
            lambda: zlib.compress(content),
            lambda: gzip.compress(content, 5),
            lambda: bz2.compress(content),
            lambda: lzma.compress(content, preset=0),
            lambda: bytes(numcodecs.Zstd(1).encode(content)),
            lambda: bytes(numcodecs.LZ4().encode(content)),
            lambda: bytes(numcodecs.Blosc("zstd", 1).encode(content)),
        )
    )()


def _change(rng: random.Random, path: Path, files: list[Path]) -> None:
    documents = [file for file in files if file.name.startswith(".z") or file.name == "zarr.json"]
    kind = rng.random()
    if kind < 0.5 and documents:
        used = [file for file in documents if "img" not in file.parts]
        _change_document(rng, rng.choice(used or documents))
    elif kind < 0.75:
        victim = rng.choice(files)
        victim.write_bytes(damaged(rng, victim.read_bytes()))
    elif kind < 0.9:
        _replace(rng, rng.choice(files))
    elif kind < 0.95:
        source = rng.choice([path / "data" / "state", path / "data", path / "meta"])
        if source.is_dir():
            shutil.copytree(
                source, source.parent / (Path(rng.choice(NAMES)).name.strip(".") or "x"), dirs_exist_ok=True
            )
    else:
        _consolidate(rng, path, documents)


def _replace(rng: random.Random, victim: Path) -> None:
    kind = rng.randrange(8)
    victim.unlink()
    if kind < 3:
        make_no_file(rng, victim, kind)
    elif kind == 3:
        victim.write_bytes(pickle.dumps(Runs()))
    elif kind == 4:
        victim.write_bytes(bomb(rng, 1 << rng.choice((10, 20, 25))))
    elif kind == 5:
        victim.write_bytes(rng.randbytes(rng.choice((0, 1, 16, 80, 5000))))
    elif kind == 6:
        victim.write_bytes(rng.choice((b"[" * 100_000, b"{", b"null", b"\xff\xfe", b'{"a":' * 5000, b"1" * 20_000)))


def _change_document(rng: random.Random, file: Path) -> None:
    try:
        document = json.loads(file.read_bytes())
    except (ValueError, RecursionError):
        return
    if rng.random() < 0.4 or not isinstance(document, dict) or "shape" not in document:
        document = changed(rng, document)
    else:
        for _ in range(rng.choice((1, 1, 2))):
            key, value = rng.choice(_changes_3(rng) if document.get("zarr_format") == 3 else _changes_2(rng))
            document[key] = value
    file.write_text(json.dumps(document))


def _sizes(rng: random.Random) -> list[Any]:
    return rng.choices(SIZES, k=rng.choice((0, 1, 2, 2, 2, 3, 40)))


def _changes_2(rng: random.Random) -> list[tuple[str, Any]]:
    return [
        ("shape", _sizes(rng)),
        ("shape", [rng.choice((10**5, 10**7, 10**9)), 5]),
        ("chunks", _sizes(rng)),
        ("chunks", [rng.choice((1, 10**9)), rng.choice((1, 5, 10**9))]),
        ("dtype", rng.choice(DTYPES)),
        ("fill_value", rng.choice(FILLS)),
        ("compressor", rng.choice(CODECS)),
        ("filters", rng.choices(CODECS, k=rng.choice((0, 1, 2, 50)))),
        ("order", rng.choice(("F", "A", "", None, 3))),
        ("dimension_separator", rng.choice(("/", ".", "..", "../", "", None, "/../"))),
        ("zarr_format", rng.choice(SIZES)),
    ]


def _changes_3(rng: random.Random) -> list[tuple[str, Any]]:
    grid = rng.choice(("regular", "rectangular", ""))
    encoding = rng.choice(("default", "v2", ".."))
    separator = rng.choice(("/", ".", "..", "/../"))
    return [
        ("shape", _sizes(rng)),
        ("shape", [rng.choice((10**5, 10**7, 10**9)), 5]),
        ("chunk_grid", {"name": grid, "configuration": {"chunk_shape": _sizes(rng)}}),
        ("chunk_grid", {"name": "regular", "configuration": {"chunk_shape": [1, 1]}}),
        ("data_type", rng.choice(DTYPES)),
        ("fill_value", rng.choice(FILLS)),
        ("codecs", rng.choices(CODECS_3, k=rng.choice((0, 1, 2, 3)))),
        ("codecs", [{"name": "bytes", "configuration": {"endian": "little"}}, rng.choice(CODECS_3)]),
        ("chunk_key_encoding", {"name": encoding, "configuration": {"separator": separator}}),
        ("storage_transformers", rng.choice(([], [{"name": "x"}], None, {}))),
        ("dimension_names", rng.choice((None, ["a"], [None] * 40, 3))),
        ("node_type", rng.choice(("group", "array", "", None))),
    ]


def _consolidate(rng: random.Random, path: Path, documents: list[Path]) -> None:
    """Metadata in one place, which need not be what lies beside the chunks."""
    held = {}
    for file in documents:
        name = str(file.relative_to(path))
        name = f"{rng.choice(NAMES)}/{name}" if rng.random() < 0.1 else name
        try:
            document = json.loads(file.read_bytes())
        except (ValueError, RecursionError):
            continue
        held[name] = changed(rng, document) if rng.random() < 0.3 else document
    if (path / "zarr.json").is_file():
        held = {name.removesuffix("/zarr.json"): document for name, document in held.items() if "/" in name}
        inline = {"kind": "inline", "must_understand": False, "metadata": held}
        root = {"zarr_format": 3, "node_type": "group", "attributes": {}, "consolidated_metadata": inline}
        (path / "zarr.json").write_text(json.dumps(root))
    else:
        (path / ".zmetadata").write_text(json.dumps({"zarr_consolidated_format": 1, "metadata": held}))


def _zip(rng: random.Random, path: Path) -> Path:
    files = {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}
    target = path.parent / "zipped.zarr.zip"
    if not files or rng.random() < 0.4:
        write(target, files, rng)
    else:
        write_hostile(target, files, rng)
    if rng.random() < 0.3:
        target.write_bytes(damaged(rng, target.read_bytes()))
    return target


def make(folder: Path, write_store: Any) -> None:
    """The good stores: of either version of the format, with several codecs, one with many chunks."""
    for version, name, compressor in (
        (2, "blosc", numcodecs.Blosc("zstd")),
        (2, "zlib", numcodecs.Zlib()),
        (2, "bz2", numcodecs.BZ2()),
        (2, "lz4", numcodecs.LZ4()),
        (2, "plain", None),
        (3, "zstd", "auto"),
    ):
        (folder / "made").mkdir(parents=True)
        write_store(folder / "made", version, compressor).rename(folder / f"{name}{version}")
        (folder / "made").rmdir()
