"""A client of openpi, whose bytes are written by hand, and a server for it."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.serving.serving import LIMITS, listening
from ttscompile.artifact.load import load_artifact
from ttscompile.serving.admission import ServerLimits
from ttscompile.serving.lock import Lock
from ttscompile.serving.openpi import OpenPiServer

if any(importlib.util.find_spec(name) is None for name in ("websockets", "msgpack")):
    pytest.skip("NO TESTS OF OPENPI: websockets or msgpack is not installed; see CONTRIBUTING", allow_module_level=True)

import msgpack
from websockets.exceptions import ConnectionClosed as ConnectionClosed, InvalidStatus as InvalidStatus
from websockets.sync.client import ClientConnection, connect

GOOD = np.array([1.0, 2.0], np.float32)


def at_once(clients: int) -> ServerLimits:
    return replace(LIMITS, clients=clients, idle_timeout=30.0)


def as_map(array: Any) -> Any:
    """As the published client writes numpy's arrays and scalars."""
    if isinstance(array, np.ndarray):
        return raw_array(array.tobytes(), array.dtype.str, array.shape)
    return {b"__npgeneric__": True, b"data": array.item(), b"dtype": array.dtype.str}


def raw_array(data: Any, dtype: Any, shape: Any) -> dict[bytes, Any]:
    return {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape}


def packed(obs: Any) -> bytes:
    made: bytes = msgpack.packb(obs, default=as_map)
    return made


@contextmanager
def client(url: str, key: str | None = None, form: str = "Api-Key") -> Iterator[ClientConnection]:
    """A connection; the metadata is still to be received."""
    headers = {"Authorization": f"{form} {key}"} if key else None
    with connect(url, compression=None, max_size=None, additional_headers=headers, close_timeout=1) as connection:
        yield connection


def received(connection: ClientConnection) -> Any:
    """The metadata, or an answer; of an error its text."""
    found = connection.recv(10)
    return found if isinstance(found, str) else msgpack.unpackb(found)


def ask(connection: ClientConnection, message: bytes | str) -> Any:
    """The answer to a message."""
    connection.send(message)
    return received(connection)


def actions(answer: Any) -> Any:
    found = answer["actions"]
    assert found[b"__ndarray__"] is True
    return np.ndarray(found[b"shape"], found[b"dtype"], found[b"data"])


@contextmanager
def serving(planned: Path, limits: ServerLimits | None = LIMITS, lock: Lock | None = None) -> Iterator[str]:
    artifact = load_artifact(planned)
    with listening(lambda: OpenPiServer(artifact, ttscompile.load(planned, seed=5), limits, lock), lock) as url:
        yield url
