"""What is in a folder, for comparing before and after."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def flip(path: Path, position: int, bit: int = 0) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= 1 << bit
    path.write_bytes(content)


Edit = Callable[[zipfile.ZipFile], object]


def packed(written: Path, prefix: str = "", edit: Edit | None = None, skip: str = "") -> Path:
    path = written.parent / "artifact.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for member in sorted(written.iterdir()):
            if member.name != skip:
                file.write(member, prefix + member.name)
        if edit is not None:
            edit(file)
    return path
