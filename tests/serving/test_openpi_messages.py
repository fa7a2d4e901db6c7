"""What strangers may send to the server of openpi's clients: each of it is one error, told to whoever sent it."""

from __future__ import annotations

import asyncio
import random
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ttscompile
from tests.hostile.mutate import damaged
from tests.serving.serving import LIMITS
from ttscompile.artifact.load import load_artifact
from ttscompile.serving.openpi import OpenPiServer

from .openpi_clients import GOOD, actions, as_map, ask, client, packed, raw_array, serving


@pytest.fixture(scope="module")
def url(planned: Path) -> Iterator[str]:
    with serving(planned, replace(LIMITS, message_bytes=1 << 16, idle_timeout=30.0)) as address:
        yield address


@pytest.mark.parametrize(
    ("message", "told"),
    [
        (packed({"obs": np.array([np.nan, 0], np.float32)}), "ObservationError: observation 'obs' must be finite"),
        (packed({"obs": GOOD[:1]}), "ObservationError: observation 'obs' has the wrong shape"),
        (packed({"obs": GOOD.astype(np.float64)}), "has the wrong dtype: expected float32"),
        (packed({"obs": GOOD, "more": {"a": GOOD}}), "unexpected: ['more']"),
        (packed({"obs": GOOD, "more": [[1], [1, 2]]}), "unexpected: ['more']"),
        (packed({"obs": GOOD, 7: GOOD, b"x": None}), "unexpected: ['7', \"b'x'\"]"),
        (packed({}), "missing: ['obs']"),
        (packed({"obs": None}), "ProtocolError: observation 'obs'"),
        (packed({"obs": b"12345678"}), "ProtocolError: observation 'obs'"),
        (packed({"obs": "12"}), "ObservationError: observation 'obs' is a str"),
        (packed({"obs": {"a": 1}}), "ProtocolError: observation 'obs'"),
        (packed({"obs": [[1], [1, 2]]}), "ProtocolError: observation 'obs'"),
        (packed({"obs": [GOOD, GOOD[:1]]}), "ProtocolError: observation 'obs'"),
        (packed([1, 2]), "an observation is a map; found list"),
        (packed(GOOD), "an observation is a map; found ndarray"),
        ("{}", "binary message with msgpack in it; found a text"),
        (b"", "incomplete"),
        (packed({"obs": GOOD})[:-3], "incomplete"),
        (packed({"obs": GOOD}) + b"\0", "extra data"),
        (b"\xc1", "FormatError"),
        (b"\x81\xa3obs\xd4\x01a", "max_ext_len"),
        (b"\x81\xa3obs\xd6\xff\0\0\0\0", "max_ext_len"),
        (b"\x81\xa3obs\xc7\0\x01", "ProtocolError: observation 'obs'"),
        (b"\x81\x91\x01\x01", "unhashable"),
        (b"\x81\xa1\xff\x01", "utf-8"),
        (b"\x91" * 3000, "StackError"),
        (b"\xdc\x10\0" * 3000, "StackError"),
        (b"\x81\xa1a" * 1200, "StackError"),
        (b"\xdd\xff\xff\xff\xff", "max_array_len"),
        (b"\xdf\xff\xff\xff\xff", "max_map_len"),
        (b"\xc6\xff\xff\xff\xffab", "incomplete"),
        (packed({"obs": [{}] * 2000}), "at most 1024 maps and lists"),
        (packed({"obs": raw_array(b"", "<f4", [0])}), "ObservationError: observation 'obs' has the wrong shape"),
        (packed({"obs": raw_array(b"", "|O", [0])}), "an array has dtype (bool"),
        (packed({"obs": raw_array(bytes(8), "object", [1])}), "an array has dtype (bool"),
        (packed({"obs": raw_array(bytes(8), "(1000000000,)f4", [2])}), "an array has dtype (bool"),
        (packed({"obs": raw_array(bytes(8), ">f4", [2])}), "an array has dtype (bool"),
        (packed({"obs": raw_array(bytes(8), ["<f4"], [2])}), "an array has dtype (bool"),
        (packed({"obs": raw_array(bytes(8), "<f4", [2**62])}), "data of that size"),
        (packed({"obs": raw_array(bytes(8), "<f4", [2**31, 2**31])}), "data of that size"),
        (packed({"obs": raw_array(bytes(8), "<f4", [2**64 - 1, 2])}), "data of that size"),
        (packed({"obs": raw_array(bytes(8), "<f4", [1] * 100)}), "data of that size"),
        (packed({"obs": raw_array(bytes(8), "<f4", [3])}), "data of that size"),
        (packed({"obs": raw_array(bytes(7), "<f4", [2])}), "data of that size"),
        (packed({"obs": raw_array("12345678", "<f4", [2])}), "data of that size"),
        (packed({"obs": raw_array(bytes(8), "<f4", [2.0])}), "data of that size"),
        (packed({"obs": raw_array(bytes(8), "<f4", "2")}), "data of that size"),
        (packed({"obs": {b"__ndarray__": True}}), "KeyError(b'dtype')"),
        (packed({"obs": {b"__npgeneric__": True, b"data": [1, {}], b"dtype": "<f4"}}), "ProtocolError: observation"),
    ],
)
def test_what_is_wrong_is_told_at_once_and_the_connection_goes_on(url: str, message: bytes | str, told: str) -> None:
    with client(url) as connection, client(url) as other:
        for each in (connection, other):
            each.recv(10)
        start = time.monotonic()
        assert told in ask(connection, message)
        assert time.monotonic() - start < 1
        for each in (other, connection):
            assert np.isfinite(actions(ask(each, packed({"obs": GOOD})))).all()


def test_no_damaged_message_is_more_than_an_error_of_ours(planned: Path) -> None:
    """Bits, lengths and parts of the maps that stand for arrays are changed at random."""
    rng, artifact = random.Random(0), load_artifact(planned)
    server, outcomes = OpenPiServer(artifact, ttscompile.load(planned, seed=0)), Counter[str]()
    whole = packed({"obs": GOOD, "step": 3})
    parts: tuple[Any, ...] = (
        None,
        True,
        2,
        -1,
        2**64 - 1,
        2.5,
        "2",
        b"12345678",
        [],
        [2],
        [-1],
        [True],
        [None],
        {},
        [[2]],
        GOOD,
        "<f4",
    )
    for _ in range(1500):
        array = as_map(GOOD)
        for key in rng.sample(sorted(array), rng.randrange(3)):
            array[key] = rng.choice(parts)
        message = rng.choice((damaged(rng, whole), packed({"obs": array}), packed({"obs": rng.choice(parts)})))
        reply = asyncio.run(server._reply(message))
        assert isinstance(reply, bytes) or reply.startswith(("ProtocolError: ", "ObservationError: ")), (message, reply)
        outcomes[str(type(reply))] += 1
    server.end()
    assert min(outcomes.values()) > 100
