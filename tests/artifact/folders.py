"""What is in a folder, for comparing before and after."""

import zipfile
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def flip(path: Path, position: int, bit: int = 0) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= 1 << bit
    path.write_bytes(content)


def failing(original: Callable[..., Any], at: int, error: type[BaseException]) -> Callable[..., Any]:
    """What does as ``original`` does, but for call number ``at``, from 0, which fails."""
    numbers = count()

    def call(*args: Any, **kwargs: Any) -> Any:
        if next(numbers) == at:
            raise error("no space left on device")
        return original(*args, **kwargs)

    return call


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
