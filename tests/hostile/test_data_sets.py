"""Data sets of others: what the fuzzer found in their readers, and the process that they are read in."""

import gzip
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest

from tests.hostile.dataset_changes import declared_png
from tests.hostile.hdf5_changes import SECRET
from tests.trajectories.data_sets import LOW, SOURCES, as_hdf5, as_lerobot, as_zarr, read_here
from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import TrajectoryError
from ttscompile.trajectories import load_trajectories, sandbox

IMAGES = {"image": ObservationSpec((2, 3, 5, 4))}


@pytest.fixture
def _here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a process, which is what is tested where this is not asked for."""
    monkeypatch.setattr(sandbox, "reader", read_here)


@pytest.mark.parametrize("write", [as_zarr, as_hdf5, as_lerobot])
def test_a_process_reads_what_this_one_would(write: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, "\udcff"])
    found = load_trajectories([path], LOW, 3, SOURCES)
    monkeypatch.setattr(sandbox, "reader", read_here)
    expected = load_trajectories([path], LOW, 3, SOURCES)
    assert [episode.name for episode in found] == [episode.name for episode in expected]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.observations["obs"], other.observations["obs"])


def test_a_chunk_that_unpacks_to_more_than_the_limit(tmp_path: Path) -> None:
    """1.5 GiB in a chunk of 1.5 MiB; its size can only be compared once it is there."""
    store = as_zarr(tmp_path)
    document = json.loads((store / "data" / "state" / ".zarray").read_text())
    document["compressor"] = {"id": "gzip", "level": 1}
    (store / "data" / "state" / ".zarray").write_text(json.dumps(document))
    (store / "data" / "state" / "0.0").write_bytes(gzip.compress(bytes(2**24), 1) * 96)
    with pytest.raises(TrajectoryError, match="'data/state' is damaged"):
        load_trajectories([store], LOW, 3, SOURCES)


@pytest.mark.parametrize(
    ("name", "message"),
    [("SIGSEGV", "ended by SIGSEGV: it is damaged"), ("SIGXCPU", "ended by SIGXCPU, at its limit of time or memory")],
)
def test_a_library_that_crashes_is_an_error(
    name: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sandbox, "_CODE", f"import os, signal; os.kill(os.getpid(), signal.{name})")
    with pytest.raises(TrajectoryError, match=message):
        load_trajectories([as_hdf5(tmp_path)], LOW, 3, SOURCES)


def test_an_answer_that_is_cut_short_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line = json.dumps({"names": ["state"]}) + "\n" + json.dumps({"own": "ends", "dtype": "<i8", "shape": [2]}) + "\n"
    monkeypatch.setattr(sandbox, "_CODE", f"import sys; sys.stdin.read(); sys.stdout.write({line!r})")
    with pytest.raises(TrajectoryError, match="the process that read it ended"):
        load_trajectories([as_hdf5(tmp_path)], LOW, 3, SOURCES)


def test_the_limits_of_the_process_hold(tmp_path: Path) -> None:
    code = f"""
import resource
from ttscompile.core.limits import limit
limit(10, 2**30)
try:
    bytearray(3 << 29)
except MemoryError:
    print("memory")
try:
    with open({str(tmp_path / "x")!r}, "w") as file:
        file.write("x")
except OSError:
    print("files")
print(resource.getrlimit(resource.RLIMIT_CPU)[0] <= 12, resource.getrlimit(resource.RLIMIT_CORE))
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split("\n")[:3] == ["memory", "files", "True (0, 0)"]


@pytest.mark.usefixtures("_here")
@pytest.mark.parametrize("what", ["pipe", "/dev/zero", "/proc/self/environ", "/nothing", "."])
@pytest.mark.parametrize("write", [as_zarr, as_lerobot])
def test_pipes_devices_and_links_to_directories(write: Any, what: str, tmp_path: Path) -> None:
    path = write(tmp_path)
    victim = next(file for file in sorted((path / "data").rglob("*")) if file.is_file())
    victim.unlink()
    if what == "pipe":
        os.mkfifo(victim)
    else:
        victim.symlink_to(what)
    with pytest.raises(TrajectoryError, match="a link to a directory or to nothing, a pipe or a device"):
        load_trajectories([path], LOW, 3, SOURCES)


@pytest.mark.usefixtures("_here")
@pytest.mark.parametrize(("rows", "message"), [(0, "that are not empty"), (12, "differs in length")])
def test_arrays_of_several_lengths(rows: int, message: str, tmp_path: Path) -> None:
    store = as_zarr(tmp_path)
    document = json.loads((store / "data" / "state" / ".zarray").read_text())
    (store / "data" / "state" / ".zarray").write_text(json.dumps({**document, "shape": [rows, 5]}))
    with pytest.raises(TrajectoryError, match=message):
        load_trajectories([store], LOW, 3, SOURCES)


@pytest.mark.usefixtures("_here")
def test_links_to_files_are_followed(tmp_path: Path) -> None:
    """As caches of downloads keep them."""
    root = as_lerobot(tmp_path)
    for number, file in enumerate(sorted((root / "data").rglob("*.parquet"))):
        shutil.move(file, tmp_path / f"blob{number}")
        file.symlink_to(tmp_path / f"blob{number}")
    assert len(load_trajectories([root], LOW, 3, SOURCES)) == 2


@pytest.mark.usefixtures("_here")
def test_a_link_inside_that_leads_through_one_outside(tmp_path: Path) -> None:
    path = as_hdf5(tmp_path)
    with h5py.File(tmp_path / "secret.hdf5", "w") as file:
        file["state"] = np.full((5, 5), SECRET, np.float32)
    with h5py.File(path, "r+") as file:
        file["away"] = h5py.ExternalLink("secret.hdf5", "/")
        del file["data/demo_2/obs/state"]
        file["data/demo_2/obs/state"] = h5py.SoftLink("/away/state")
        assert file["data/demo_2/obs/state"][0, 0] == SECRET
    with pytest.raises(TrajectoryError, match="is a link, maybe to another file"):
        load_trajectories([path], LOW, 3, SOURCES)


@pytest.mark.usefixtures("_here")
@pytest.mark.parametrize("place", ["data", "data/demo_2/obs"])
def test_an_array_of_rows_without_end_where_a_group_is_expected(place: str, tmp_path: Path) -> None:
    path = as_hdf5(tmp_path)
    with h5py.File(path, "r+") as file:
        del file[place]
        file.create_dataset(place, (2**60,), "f4", chunks=(1,))
    with pytest.raises(TrajectoryError, match="is an array; expected a group"):
        load_trajectories([path], LOW, 3, SOURCES)


@pytest.mark.usefixtures("_here")
def test_filters_that_are_libraries_of_their_own(tmp_path: Path) -> None:
    path = as_hdf5(tmp_path)
    with h5py.File(path, "r+") as file:
        del file["data/demo_2/obs/state"]
        file.create_dataset("data/demo_2/obs/state", (5, 5), "f4", chunks=True, scaleoffset=2)
    with pytest.raises(TrajectoryError, match="is compressed by scaleoffset; expected fletcher32, gzip, lzf, shuffle"):
        load_trajectories([path], LOW, 3, SOURCES)


def replaced(root: Path, name: str, column: Any) -> Path:
    """Another column in the first table, of five rows."""
    file = min((root / "data").rglob("*.parquet"))
    table = parquet.read_table(file)
    parquet.write_table(table.set_column(table.column_names.index(name), name, column), file)
    return root


@pytest.mark.usefixtures("_here")
@pytest.mark.parametrize(
    "column",
    [
        pa.array([None] * 5),
        pa.array([None, 1, 2, 3, 4]),
        pa.array(range(5), pa.timestamp("ns")),
        pa.array([[i] * 5 for i in range(5)]),
        pa.array([float(i) for i in range(5)]),
        pa.array(["a"] * 5),
    ],
    ids=str,
)
def test_numbers_of_episodes_that_are_none(column: Any, tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match="episode_index"):
        load_trajectories([replaced(as_lerobot(tmp_path), "episode_index", column)], LOW, 3, SOURCES)


@pytest.mark.usefixtures("_here")
def test_rows_of_several_lengths_that_would_reshape(tmp_path: Path) -> None:
    column = pa.array([[1.0] * n for n in (4, 6, 5, 5, 5)])
    with pytest.raises(TrajectoryError, match="column 'state' is damaged .*expected as many in every row"):
        load_trajectories([replaced(as_lerobot(tmp_path), "state", column)], LOW, 3, SOURCES)


@pytest.mark.slow
@pytest.mark.usefixtures("_here")
def test_rows_are_counted_while_they_are_decoded(tmp_path: Path) -> None:
    """A table of rows that are all the same: a quarter of a gigabyte in less than a megabyte."""
    root = as_lerobot(tmp_path)
    rows = pa.array(np.zeros(2**20, np.int64))
    with parquet.ParquetWriter(min((root / "data").rglob("*.parquet")), pa.schema({"episode_index": pa.int64()})) as to:
        for _ in range(2**5):
            to.write_table(pa.table({"episode_index": rows}))
    with pytest.raises(TrajectoryError, match="in proportion to a file of"):
        load_trajectories([root], LOW, 3, SOURCES)


@pytest.mark.usefixtures("_here")
@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")  # Pillow only warns
def test_an_image_that_says_it_is_huge(tmp_path: Path) -> None:
    column = pa.array([{"bytes": declared_png(12_000, 12_000), "path": None}] * 5)
    with pytest.raises(TrajectoryError, match="in proportion to a file of"):
        load_trajectories([replaced(as_lerobot(tmp_path), "img", column)], IMAGES, 2, {"image": ("img",)})
