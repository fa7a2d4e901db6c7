"""HDF5 files of robomimic with something wrong: bytes, shapes, dtypes, filters, links, data that lie elsewhere."""

import random
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tests.hostile.mutate import damaged

SECRET = 77777.0
"""Numbers of a file beside the recording, which must not be read."""
SIZES = (0, 1, 2, 5, 9, 2**15, 2**24, 2**31, 2**40, 2**62)
DEMOS = ("demo_2", "demo_10")


def make(folder: Path, write_file: Callable[[Path], Path]) -> None:
    """The good files: chunked and compressed, contiguous, compact, in the oldest format and in the newest."""
    folder.mkdir(parents=True)
    write_file(folder).rename(folder / "gzip.hdf5")
    for name, version in {"earliest": "earliest", "latest": "latest"}.items():
        with h5py.File(folder / f"{name}.hdf5", "w", libver=version) as file:
            for number, demo in enumerate(DEMOS):
                group = file.create_group(f"data/{demo}/obs")
                group["state"] = np.full((5, 5), number, np.float32)
                group.create_dataset("keypoint", (5, 3, 2), "f4", chunks=(2, 3, 2), shuffle=True, compression="lzf")
                group["keypoint"][:] = number
                file[f"data/{demo}"].attrs["num_samples"] = 5
            file["data"].attrs["env_args"] = "{}"


def write_bad(rng: random.Random, corpus: Path, folder: Path) -> Path:
    """Copy a good file and change it, with the library or without."""
    path = Path(shutil.copy(rng.choice(sorted(corpus.iterdir())), folder / "it.hdf5"))
    kind = rng.random()
    if kind < 0.55:
        secret = folder / "secret.hdf5"
        with h5py.File(secret, "w") as file:
            file["state"] = np.full((5, 5), SECRET, np.float32)
        try:
            with h5py.File(path, "r+") as file:
                for _ in range(rng.choice((1, 1, 2))):
                    rng.choice(CHANGES)(rng, file, secret)
        except (ValueError, OSError, RuntimeError, TypeError, KeyError, OverflowError):
            pass  # what the library does not write; the file is a bad one or as it was
    if kind > 0.45:
        content = path.read_bytes()
        path.write_bytes(_header_damaged(rng, content) if rng.random() < 0.6 else damaged(rng, content))
    return path


def _header_damaged(rng: random.Random, content: bytes) -> bytes:
    """Bytes changed behind one of the signatures of the format, where its metadata are."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 4))):
        mark = rng.choice((b"TREE", b"SNOD", b"HEAP", b"OHDR", b"FRHP", b"FHDB", b"FHIB", b"BTHD", b"\x89HDF", b"GCOL"))
        places = [i for i in range(len(data) - 4) if data[i : i + len(mark)] == mark]
        place = (rng.choice(places) if places else rng.randrange(len(data))) + rng.randrange(4, 200)
        new = rng.choice((bytes([rng.randrange(256)]), b"\xff" * 8, bytes(8), b"\x00\x00\x00\x40", rng.randbytes(2)))
        data[place : place + len(new)] = new
    return bytes(data[: len(content)])


def _group(rng: random.Random, file: h5py.File) -> h5py.Group:
    group = file[f"data/{rng.choice(DEMOS)}/obs"]
    if not isinstance(group, h5py.Group):
        raise TypeError("changed before")  # to ask an array for a name would read all of it
    return group


def _without(rng: random.Random, file: h5py.File, name: str = "state") -> h5py.Group:
    group = _group(rng, file)
    if name in group:
        del group[name]
    return group


def _shape(rng: random.Random, file: h5py.File, secret: Path) -> None:
    """A shape that is not backed by data, in chunks that are tiny or huge."""
    shape = tuple(rng.choices(SIZES, k=rng.choice((0, 1, 2, 2, 3, 32))))
    if rng.random() < 0.4:
        shape = (rng.choice((10**6, 10**7, 10**9)), 5)
    chunks = rng.choice((None, True, tuple(min(size, rng.choice((1, 5, 2**20, 2**31))) or 1 for size in shape) or None))
    fill = rng.choice((None, 0.0, np.nan, 1e300))
    _without(rng, file).create_dataset("state", shape, "f4", chunks=chunks, fillvalue=fill)


def _dtype(rng: random.Random, file: h5py.File, secret: Path) -> None:
    dtypes = (
        h5py.string_dtype(),
        h5py.string_dtype("ascii", 2**20),
        h5py.vlen_dtype(np.float32),
        h5py.vlen_dtype(h5py.vlen_dtype(np.int8)),
        h5py.enum_dtype({"a": 1, "b": 2}),
        h5py.ref_dtype,
        h5py.regionref_dtype,
        h5py.opaque_dtype(np.dtype("M8[s]")),
        np.dtype([("a", "f4"), ("b", h5py.string_dtype())]),
        np.dtype(("f4", (1000, 1000, 100))),
        np.dtype("V100"),
        np.dtype("c8"),
        np.dtype(">f8"),
        np.dtype("f2"),
        np.dtype("?"),
        np.dtype("u8"),
        np.dtype("f16"),
    )
    dtype = rng.choice(dtypes)
    group = _without(rng, file)
    if rng.random() < 0.2:
        group["state"] = dtype  # a named type where an array is expected
    else:
        group.create_dataset("state", rng.choice(((5, 5), (5,), (), (2**20, 5))), dtype)


def _link(rng: random.Random, file: h5py.File, secret: Path) -> None:
    places = ("state", "/data", "/data/demo_2", "/data/demo_2/obs", "/data/demo_2/obs/state")
    place = rng.choice(places)
    group = _group(rng, file)
    if place in group:
        del group[place]
    elsewhere = rng.choice((str(secret), "secret.hdf5", "../secret.hdf5", "/etc/passwd", "/dev/zero", "it.hdf5", ""))
    file["away"] = h5py.ExternalLink(elsewhere, "/")
    targets = ("/away/state", "/away", "/", ".", "/data", "/nothing", place, "../../x", "a" * 60_000)
    group[place] = rng.choice(
        (
            h5py.ExternalLink(elsewhere, rng.choice(("/state", "/", "/data/demo_2/obs/state", "x"))),
            h5py.SoftLink(rng.choice(targets)),
            h5py.SoftLink("/away/state"),
            file["/"],
            file.get("data", file["/"]),
        )
    )


def _elsewhere(rng: random.Random, file: h5py.File, secret: Path) -> None:
    """Data of another file: external storage, or a virtual data set."""
    group = _without(rng, file)
    if rng.random() < 0.5:
        size = rng.choice((100, 1, 2**40, h5py.h5f.UNLIMITED))
        name = rng.choice((str(secret), "secret.hdf5", "/etc/passwd", "/dev/zero", "../" * 9 + "etc/passwd"))
        external = [(name, rng.choice((0, 8, 2**40)), size)] * rng.choice((1, 1, 30))
        group.create_dataset("state", rng.choice(((5, 5), (10**6, 5), (h5py.UNLIMITED, 5))), "f4", external=external)
    else:
        layout = h5py.VirtualLayout(rng.choice(((5, 5), (10**7, 5))), "f4")
        name = rng.choice((str(secret), ".", "%b", "/dev/zero"))
        layout[:5] = h5py.VirtualSource(name, rng.choice(("state", "data/demo_2/obs/state")), (5, 5))
        group.create_virtual_dataset("state", layout)


def _filters(rng: random.Random, file: h5py.File, secret: Path) -> None:
    """A filter with chunks that are bombs, noise, or longer and shorter than they should be."""
    compression = rng.choice(("gzip", "lzf", "szip", 32008, 32001, 305, None))
    more: dict[str, Any] = {"shuffle": rng.random() < 0.5, "fletcher32": rng.random() < 0.3}
    if rng.random() < 0.3:
        more, compression = {"scaleoffset": rng.choice((0, 2, 4))}, None
    if isinstance(compression, int):
        more["allow_unknown_filter"] = True
    group, dtype = _without(rng, file), rng.choice(("f4", "i4"))
    data = group.create_dataset("state", (5, 5), dtype, chunks=(rng.choice((1, 5)), 5), compression=compression, **more)
    if rng.random() < 0.4:
        data[:] = np.arange(25).reshape(5, 5)
    else:
        noise = rng.randbytes(rng.choice((0, 1, 20, 100, 1000)))
        content = rng.choice((noise, zlib.compress(bytes(1 << rng.choice((4, 20, 26)))), zlib.compress(noise) + noise))
        data.id.write_direct_chunk((0, 0), content, rng.choice((0, 1, 3, 2**31)))


def _names(rng: random.Random, file: h5py.File, secret: Path) -> None:
    name = rng.choice(("..", "../../x", ".", "demo_" + "9" * 4301, "\udcff", "demo_\u0663", "a" * 60_000, "demo_1\n"))
    group = rng.choice((file["data"], _group(rng, file)))
    encoded = name.encode("utf-8", "surrogateescape")
    h5py.h5g.create(group.id, encoded) if rng.random() < 0.5 else group.__setitem__(encoded, np.zeros((5, 5), "f4"))


def _other_kind(rng: random.Random, file: h5py.File, secret: Path) -> None:
    """An array where a group is expected, with rows without end, or a group where an array is."""
    place = rng.choice(("data", "data/demo_2", "data/demo_2/obs", "data/demo_2/obs/state"))
    if place in file:
        del file[place]
    if place.endswith("state") or rng.random() < 0.2:
        file.create_group(place)
    else:
        dtype = rng.choice(("f4", h5py.string_dtype()))
        file.create_dataset(place, (rng.choice((3, 10**6, 2**60)),), dtype, chunks=(1,))


def _many(rng: random.Random, file: h5py.File, secret: Path) -> None:
    for i in range(rng.choice((50, 1000))):
        file.create_group(f"data/demo_{i}x/obs")


def _attributes(rng: random.Random, file: h5py.File, secret: Path) -> None:
    item = rng.choice((file["data"], _group(rng, file), file))
    kind = rng.randrange(3)
    if kind == 0:
        item.attrs["big"] = np.zeros(8000, np.float64)
    elif kind == 1:
        for i in range(300):
            item.attrs[f"a{i}"] = "x" * 50
    else:
        item.attrs.create("texts", ["x" * rng.choice((1, 10**5))] * 20, dtype=h5py.string_dtype())


_TWICE = (_shape, _link, _elsewhere, _filters)
CHANGES = (*_TWICE, *_TWICE, _dtype, _names, _other_kind, _many, _attributes)
