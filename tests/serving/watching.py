"""What those who watch a server ask it, and how they read the answer."""

from __future__ import annotations

import re

from .serving import raw, read_all

SAMPLE = re.compile(r'([a-z_]+)(?:\{((?:[a-z]+="(?:[^"\\]|\\.)*",?)+)\})? (\S+)')
"""A line of the format, as its specification has it."""


def get(url: str, path: str, *headers: str) -> tuple[int, str]:
    """Status and body."""
    with raw(url) as sock:
        lines = [f"GET {path} HTTP/1.1", "Host: x", *headers, "", ""]
        sock.sendall("\r\n".join(lines).encode())
        head, _, body = read_all(sock).decode().partition("\r\n\r\n")
    if path == "/metrics" and " 200 " in head:
        assert "Content-Type: text/plain; version=0.0.4; charset=utf-8" in head
    return int(head.split()[1]), body


def figures(text: str) -> dict[str, float]:
    """By name and labels; every figure has a type and a help."""
    found, typed = dict[str, float](), set[str]()
    for line in text.splitlines():
        if line.startswith("#"):
            typed.add(line.split()[2])
            continue
        matched = SAMPLE.fullmatch(line)
        assert matched is not None, line
        assert matched[1] in typed or re.sub("_(bucket|sum|count)$", "", matched[1]) in typed
        found[f"{matched[1]}{{{matched[2]}}}" if matched[2] else matched[1]] = float(matched[3])
    return found
