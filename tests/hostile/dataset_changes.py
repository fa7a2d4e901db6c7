"""LeRobot data sets with something wrong: tables, their footers, images, metadata, and files that are none."""

import io
import json
import random
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
from PIL import Image

from tests.hostile.mutate import changed, damaged, make_no_file

FEATURES = {
    "state": {"dtype": "float32", "shape": [5], "names": None},
    "img": {"dtype": "image", "shape": [5, 4, 3]},
    "top": {"dtype": "video", "shape": [3, 5, 4], "info": {"video.fps": 10}},
}
INFO = {
    "codebase_version": "v3.0",
    "total_episodes": 2,
    "total_frames": 9,
    "chunks_size": 1000,
    "fps": 10,
    "splits": {"train": "0:2"},
    "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    "features": FEATURES,
}
CODECS = ("snappy", "gzip", "zstd", "lz4", "brotli", "none")


def make(folder: Path, write_dataset: Callable[[Path], Path]) -> None:
    """The good data sets: with images, and with numbers alone in the codecs that there are."""
    for codec in CODECS[:5]:
        (folder / "made").mkdir(parents=True)
        path = write_dataset(folder / "made").rename(folder / codec)
        (folder / "made").rmdir()
        (path / "meta" / "info.json").write_text(json.dumps(INFO))
        for file in sorted(path.rglob("*.parquet")):
            table = parquet.read_table(file)
            parquet.write_table(table, file, compression=codec, use_dictionary=codec != "zstd")


def write_bad(rng: random.Random, corpus: Path, folder: Path) -> Path:
    """Copy a good data set and change one file, or two."""
    path = Path(shutil.copytree(rng.choice(sorted(corpus.iterdir())), folder / "it"))
    for _ in range(rng.choice((1, 1, 1, 2))):
        tables = sorted(path.rglob("*.parquet"))
        victim = rng.choice([*tables, *tables, path / "meta" / "info.json"])
        if not victim.is_file() or victim.is_symlink():
            continue
        kind = rng.random()
        if kind < 0.1:
            _replace(rng, victim)
        elif victim.suffix == ".json":
            _change_info(rng, victim)
        elif kind < 0.45:
            victim.write_bytes(_footer_damaged(rng, victim.read_bytes()))
        elif kind < 0.6:
            victim.write_bytes(damaged(rng, victim.read_bytes()))
        else:
            _change_table(rng, victim)
    return path


def _replace(rng: random.Random, victim: Path) -> None:
    kind = rng.randrange(6)
    victim.unlink()
    if kind < 3:
        make_no_file(rng, victim, kind)
    elif kind == 3:
        victim.write_bytes(rng.choice((b"PAR1", b"PAR1" * 3, b"PARE" * 9, b"ARROW1\0\0", b"", b"\xff" * 64)))
    elif kind == 4:
        victim.write_bytes(b"PAR1" + rng.randbytes(50) + struct.pack("<I", rng.choice((50, 0, 2**31, 51))) + b"PAR1")


def _change_info(rng: random.Random, file: Path) -> None:
    kind = rng.randrange(8)
    if kind == 0:
        file.write_bytes(damaged(rng, file.read_bytes()))
    elif kind == 1:
        file.write_bytes(rng.choice((b"[" * 100_000, b"{", b"null", b"[]", b"1" * 20_000, b'{"features": 1}', b"\xff")))
    else:
        try:
            document = changed(rng, json.loads(file.read_bytes()))
        except (ValueError, RecursionError):  # it was changed before
            return
        if kind == 2 and isinstance(document, dict):
            for key in ("data_path", "video_path"):
                document[key] = rng.choice(("/etc/{chunk_index}", "../../{file_index}.parquet", "{0.__class__}", 3))
        file.write_text(json.dumps(document))


def _footer_damaged(rng: random.Random, content: bytes) -> bytes:
    """The metadata of a table, which are at its end, or the header of a page."""
    length = int.from_bytes(content[-8:-4], "little")
    begin = max(4, len(content) - 8 - length)
    if rng.random() < 0.3:
        head = damaged(rng, content[4:60])
        return content[:4] + head + content[60:]
    footer = damaged(rng, content[begin:-8])
    size = rng.choice((len(footer), len(footer), len(footer), length, 2**31 - 1))
    return content[:begin] + footer + struct.pack("<I", size) + content[-4:]


def _change_table(rng: random.Random, file: Path) -> None:
    try:
        table = parquet.read_table(file)
    except Exception:  # it was changed before
        return
    if len(table) > 1000:
        return
    kind = rng.randrange(7)
    if kind == 0 and table.num_columns:
        table = table.drop_columns([rng.choice(table.column_names)])
    elif kind == 1:
        table = _many_rows(rng, table)
    elif kind <= 4:
        name = rng.choice(("state", "state", "episode_index", "frame_index", "img"))
        if name in table.column_names:
            at = table.column_names.index(name)
            new = _images(rng, len(table)) if name == "img" else _column(rng, len(table))
            table = table.set_column(at, name, new)
    elif kind == 5:
        table = table.replace_schema_metadata({b"ARROW:schema": rng.randbytes(40), b"pandas": b"{" * 999})
    else:
        column = pa.array([0] * len(table))
        names = ("state", "a.b", "", "x" * 9999, "top", "state.list.element")
        table = table.append_column(rng.choice(names), column)
    codec = rng.choice(CODECS)
    options: dict[str, Any] = {"use_dictionary": rng.random() < 0.5, "store_schema": rng.random() < 0.7}
    try:
        parquet.write_table(table, file, compression=codec, data_page_version=rng.choice(("1.0", "2.0")), **options)
    except (pa.ArrowException, ValueError):
        return
    if rng.random() < 0.3:
        file.write_bytes(_footer_damaged(rng, file.read_bytes()))


def _many_rows(rng: random.Random, table: Any) -> Any:
    """Rows that are all the same take next to nothing in a file, and all their space in memory."""
    wide, rows = rng.choice((1, 64)), rng.choice((10**5, 2**22))
    index = pa.array(np.zeros(rows, np.int64))
    columns = {"episode_index": index, "frame_index": index}
    if wide > 1 or rng.random() < 0.5:
        rows = rows // wide
        index = index[:rows]
        columns = {"episode_index": index, "frame_index": index}
        columns["state"] = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(rows * wide, np.float64)), wide)
    else:
        few = min(rows, 2**16)
        columns = {name: column[:few] for name, column in columns.items()}
        columns["img"] = pa.DictionaryArray.from_arrays(pa.array(np.zeros(few, np.int32)), pa.array(["x" * 1000]))
    return pa.table(columns)


def _column(rng: random.Random, rows: int) -> Any:
    integers = list(range(rows))
    return rng.choice(
        (
            lambda: pa.array([None] * rows),
            lambda: pa.array([None, *integers[1:]], pa.int64()),
            lambda: pa.array([[float(i)] * 5 if i else None for i in integers]),
            lambda: pa.array([[float(i)] * (i % 4) for i in integers]),
            lambda: pa.array([[[1.0, 2.0], [3.0]]] * rows),
            lambda: pa.array([[[[[[[1.0] * 5]]]]]] * rows),
            lambda: pa.array([{"a": i} for i in integers]),
            lambda: pa.array([{"bytes": None, "path": "/etc/passwd"}] * rows),
            lambda: pa.array([[{"a": i}] for i in integers]),
            lambda: pa.array([[("k", i)] for i in integers], pa.map_(pa.string(), pa.int64())),
            lambda: pa.array([str(i) for i in integers]),
            lambda: pa.array([b"\x80\x04." for _ in integers]),
            lambda: pa.array(["a"] * rows).dictionary_encode(),
            lambda: pa.array([1.5] * rows).dictionary_encode(),
            lambda: pa.array([2**63 - 1 - i for i in integers]),
            lambda: pa.array([-(2**63) + i for i in integers]),
            lambda: pa.array([float("nan")] * rows),
            lambda: pa.array([1.5] * rows, pa.float16()),
            lambda: pa.array(integers, pa.decimal128(20, 2)),
            lambda: pa.array(integers, pa.timestamp("ns")),
            lambda: pa.array([b"\0" * 16] * rows, pa.uuid() if hasattr(pa, "uuid") else pa.binary(16)),
            lambda: pa.array([True] * rows),
            lambda: pa.array([[1.0] * 5] * rows, pa.large_list(pa.float64())),
            lambda: pa.array([[1.0] * 5] * rows, pa.list_(pa.float32(), 5)),
            lambda: pa.array([[]] * rows, pa.list_(pa.float32())),
            lambda: pa.array(np.full(rows, 1e300)),
        )
    )()


def _images(rng: random.Random, rows: int) -> Any:
    return pa.array([{"bytes": _image(rng), "path": rng.choice((None, "../x", "/etc/passwd"))} for _ in range(rows)])


def _image(rng: random.Random) -> bytes | None:
    kind = rng.randrange(8)
    if kind == 0:
        return None
    buffer = io.BytesIO()
    mode = rng.choice(("RGB", "L", "P", "1", "RGBA", "I;16"))
    size = rng.choice(((4, 5), (4, 5), (5, 4), (1, 1)))
    kind_of_file = rng.choice(("PNG", "PNG", "JPEG", "GIF", "TIFF", "BMP")) if mode in ("RGB", "L") else "PNG"
    Image.new(mode, size).save(buffer, kind_of_file)
    content = buffer.getvalue()
    if kind == 1:
        return damaged(rng, content)
    if kind == 2:
        return rng.randbytes(rng.choice((0, 1, 100)))
    if kind == 3 and content[:4] == b"\x89PNG":
        width, height = rng.choices((4, 9000, 60_000, 2**31 - 1), k=2)
        return declared_png(width, height, content)
    return content


def declared_png(width: int, height: int, content: bytes | None = None) -> bytes:
    """A PNG that declares another size than it has; without ``content``, of one pixel."""
    if content is None:
        buffer = io.BytesIO()
        Image.new("RGB", (1, 1)).save(buffer, "PNG")
        content = buffer.getvalue()
    header = b"IHDR" + struct.pack(">II", width, height) + content[24:29]
    return content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:]
