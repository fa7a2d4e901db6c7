"""Counting and limiting by address, with a clock of the test's; ``test_locked`` has the same behind real sockets."""

from __future__ import annotations

import base64
import json
from typing import Any

import pytest

from ttscompile import ObservationSpec
from ttscompile.serving.admission import MOST_ADDRESSES, Admission, Pace, ServerLimits


def test_a_pace_lets_a_second_s_worth_through_at_once() -> None:
    pace = Pace(10, 100.0)
    assert [pace.wait(100.0) for _ in range(10)] == 10 * [0.0]
    assert pace.wait(100.0) == pytest.approx(0.1)
    assert pace.wait(100.0) == pytest.approx(0.2)
    assert pace.wait(150.0) == 0.0


def test_admission_forgets_refusals_after_a_minute_and_counts_networks(audit: Any) -> None:
    now = [0.0]
    admission = Admission(ServerLimits(refusals_per_minute=2), lambda: now[0])
    for port in (1, 2):
        assert admission.comes((f"2001:db8::{port}", port, 0, 0))
        admission.leaves((f"2001:db8::{port}", port, 0, 0))
        admission.leaves((f"2001:db8::{port}", port, 0, 0))  # once is enough
    assert not admission.comes(("2001:db8::77", 3, 0, 0))  # the same network
    assert admission.comes(("2001:db8:0:1::77", 4, 0, 0)) and admission.comes(("10.0.0.1", 5))
    now[0] = 59.0
    assert not admission.comes(("2001:db8::77", 6, 0, 0))
    now[0] = 60.0
    assert admission.comes(("2001:db8::77", 7, 0, 0))
    assert [line["event"] for line in audit()] == ["refused", "refused", "cut off"]
    assert audit()[0]["from"] == "[2001:db8::1]:1"


def test_a_message_has_room_for_an_observation_as_numbers_or_in_base64() -> None:
    small, seeing = ObservationSpec((2, 20)), ObservationSpec((480, 640, 3))
    assert ServerLimits.of({"obs": small}, 3) == ServerLimits(clients=3, message_bytes=1 << 20)
    found = ServerLimits.of({"obs": small, "front": seeing, "wrist": seeing}, 3).message_bytes
    assert found == 8 * (40 + 2 * 921_600) + 65_536
    assert found > len(json.dumps([255] * 921_600, separators=(",", ":"))) * 2
    assert found > 2 * len(base64.b64encode(bytes(4 * 921_600)))


def test_a_message_has_room_for_a_camera_s_picture_where_the_policy_resizes_it() -> None:
    seen = ObservationSpec((1, 3, 224, 224), bounds=(0.0, 1.0), fit="start")
    limits = ServerLimits.of({"front": seen, "wrist": seen}, 3)
    assert limits.message_bytes > 2 * len(base64.b64encode(bytes(4 * 3 * 720 * 1280)))
    assert limits.message_values == ServerLimits.of({"one": ObservationSpec((6, 224, 224))}, 3).message_values
    large = ObservationSpec((1, 3, 2000, 2000), bounds=(0.0, 1.0), fit="centre")
    assert ServerLimits.of({"front": large}, 3).message_bytes == 8 * 3 * 2000 * 2000 + 65_536


def test_a_full_server_is_no_fault_of_the_client() -> None:
    admission = Admission(ServerLimits(clients=1, refusals_per_minute=1), lambda: 0.0)
    assert admission.comes(("10.0.0.1", 1)) and admission.refusal(("10.0.0.1", 1)) == ""
    admission.answers(("10.0.0.1", 1), 101, None)
    for port in (2, 3):
        assert admission.comes(("10.0.0.1", port))
        assert "1 clients are connected" in admission.refusal(("10.0.0.1", port))
        admission.answers(("10.0.0.1", port), 503, None)
        admission.leaves(("10.0.0.1", port))
    admission.leaves(("10.0.0.1", 1))
    admission.requested(("10.0.0.1", 1))  # was read before, and is counted by nobody
    assert admission.comes(("10.0.0.1", 4)) and admission.refusal(("10.0.0.1", 4)) == ""


def test_connections_of_one_peer_to_two_addresses_of_the_server_are_two() -> None:
    admission = Admission(ServerLimits(clients=2, handshakes=2), lambda: 0.0)
    peer, one, other = ("10.0.0.9", 5000), ("10.0.0.1", 80), ("10.0.0.2", 80)
    for own in (one, other):
        assert admission.comes(peer, own)
        admission.answers(peer, 101, None, own)
    admission.requested(peer, other)
    admission.leaves(peer, one)
    assert [(each.number, each.requests) for each in admission._connections.values()] == [(2, 1)]
    admission.leaves(peer, other)
    assert not admission._connections


def test_admission_remembers_so_many_addresses() -> None:
    admission = Admission(ServerLimits(refusals_per_minute=1), lambda: 0.0)
    for number in range(MOST_ADDRESSES + 10):
        peer = (f"10.0.{number // 256}.{number % 256}", 1)
        assert admission.comes(peer)
        admission.leaves(peer)
        assert not admission.comes(peer)
    assert len(admission._refusals) == len(admission._told) == MOST_ADDRESSES
