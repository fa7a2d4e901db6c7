"""What a plain GET of a server tells those who watch it, and whom it does not tell."""

from __future__ import annotations

import importlib.util
import time
from dataclasses import replace
from typing import Any

import pytest

from ttscompile.serving.lock import Lock, hashed
from ttscompile.serving.protocol import Metric, exposition

from .serving import LIMITS, Broken, ServerError, connected, serving
from .watching import figures, get

if importlib.util.find_spec("websockets") is None:
    pytest.skip(
        "NO METRICS TESTS: websockets is not installed; pip install 'ttscompile[serve]'", allow_module_level=True
    )

TOKEN = "a-token-of-these-tests-alone"


def test_the_executor_s_counts_and_the_server_s_are_shown(audit: Any) -> None:
    with serving() as url:
        with connected(url) as call:
            now = call("info")["time"]
            for t in (now - 0.05, now):
                call("observe", obs={"obs": [7.0, 0.0]}, t=t)
            call("action", timeout=2.0)
            with pytest.raises(ServerError):
                call("nothing")
            assert get(url, "/health") == (200, "ok\n")
            status, text = get(url, "/metrics")
        assert status == 200
        shown = figures(text)
        assert shown["ttscompile_clients"] == 1
        assert shown["ttscompile_frames_total"] == 2
        assert shown["ttscompile_ticks_total"] == 1
        assert shown['ttscompile_requests_total{method="observe",outcome="ok"}'] == 2
        assert shown['ttscompile_requests_total{method="unknown",outcome="ProtocolError"}'] == 1
        assert shown['ttscompile_latency_ms{quantile="0.99"}'] > 0
        told = [line["status"] for line in audit() if line["event"] == "told"]
        assert told == [200, 200]


def test_who_watches_often_is_not_cut_off() -> None:
    with serving(limits=replace(LIMITS, refusals_per_minute=2)) as url:
        assert [get(url, path)[0] for path in 3 * ["/health", "/metrics"]] == 6 * [200]


def test_a_policy_that_fails_is_no_health() -> None:
    with serving(Broken) as url, connected(url) as call:
        now = call("info")["time"]
        for t in (now - 0.05, now):
            call("observe", obs={"obs": [7.0, 0.0]}, t=t)
        for _ in range(200):
            status, body = get(url, "/health")
            if status != 200:
                break
            time.sleep(0.01)
        assert (status, body) == (
            503,
            "the thread that owns the policy has ended: a call raised ZeroDivisionError: scripted\n",
        )


def test_strangers_are_told_nothing() -> None:
    with serving(lock=Lock(hashed(TOKEN, "test"))) as url:
        for path in ("/health", "/metrics"):
            assert get(url, path)[0] == 401
            assert get(url, path, f"Authorization: Bearer {TOKEN}")[0] == 200


def test_texts_are_escaped_and_a_histogram_has_its_sum() -> None:
    text = exposition(
        [
            Metric("one", "gauge", "One.", [({"plan": 'a"b\\c\nd'}, 1)]),
            Metric("took", "histogram", "Seconds.", [({"le": "0.1"}, 2), ({"le": "+Inf"}, 3)], 0.5),
        ]
    )
    assert text.splitlines() == [
        "# HELP ttscompile_one One.",
        "# TYPE ttscompile_one gauge",
        r'ttscompile_one{plan="a\"b\\c\nd"} 1',
        "# HELP ttscompile_took Seconds.",
        "# TYPE ttscompile_took histogram",
        'ttscompile_took_bucket{le="0.1"} 2',
        'ttscompile_took_bucket{le="+Inf"} 3',
        "ttscompile_took_sum 0.5",
        "ttscompile_took_count 3",
    ]
