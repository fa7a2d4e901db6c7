"""What the words of a command line may be: every argument and option of every command has one of these types.

click's own ranges let ``nan`` through, its paths the empty one, and its strings bytes that are no text, which Python
carries as halves of characters that nothing can print.
"""

import ipaddress
import math
import os
from pathlib import Path
from typing import Any

import click

from ttscompile.core.paths import on_hub
from ttscompile.errors import OutputError
from ttscompile.plots.figure import FORMATS, require_picture_name


class NumberOption(click.Option):
    """Shows no range in the help: nobody has a use for its ends, and the message about a number beyond says it."""

    def get_help_extra(self, ctx: click.Context) -> Any:
        extra = super().get_help_extra(ctx)
        extra.pop("range", None)
        return extra


class Number(click.FloatRange):
    """A finite number between two others; ``above`` says whether ``least`` itself is refused."""

    name = "number"

    def __init__(self, least: float, most: float, *, above: bool = False) -> None:
        super().__init__(least, most, min_open=above)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        found: float = super().convert(value, param, ctx)
        if math.isnan(found):  # neither below nor above anything
            self.fail(f"{value} is not in the range {self._describe_range()}.", param, ctx)
        return found


RATE = Number(1e-3, 1e6)
"""Hz, from a call in a quarter of an hour to more than any clock of a robot."""
SHARE = Number(0, 1)
"""Its ends are refused where a budget is made of it, which says what they would ask for."""
MINUTES = Number(0, 1e6, above=True)
SECONDS = Number(1e-3, 3600)
MILLISECONDS = Number(1e-6, 1e9)
ERROR = Number(0, 1e30, above=True)
"""Of actions, in their units."""


class Words(click.ParamType[str]):
    """Text that can be printed, not empty unless that is said."""

    name = "text"

    def __init__(self, *, may_be_empty: bool = False) -> None:
        self.may_be_empty = may_be_empty

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        text = str(value)
        if not text and not self.may_be_empty:
            self.fail("nothing was given.", param, ctx)
        if not _is_text(text):
            self.fail(f"{os.fsencode(text)!r:.300} is no text in UTF-8.", param, ctx)
        return text


TEXT = Words()
ANY_TEXT = Words(may_be_empty=True)


class PathName(click.Path):
    """A path that can be printed and looked up; there may be nothing. The arguments are those of ``click.Path``."""

    def __init__(self, *, exists: bool = False, file_okay: bool = True, dir_okay: bool = True) -> None:
        super().__init__(exists, file_okay, dir_okay, path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        text = os.fspath(value)
        if not text:
            self.fail("nothing was given.", param, ctx)
        if not _is_text(text):
            why = "is no text in UTF-8, and onnxruntime takes no other names. Rename it, or name it by a link."
            self.fail(f"{os.fsencode(text)!r:.300} {why}", param, ctx)
        if on_hub(text):
            why = "is on the hub, and this takes what is on this machine: download it first (hf download)."
            self.fail(f"{text:.200} {why}", param, ctx)
        try:
            Path(text).stat()
        except (FileNotFoundError, NotADirectoryError):
            pass
        except (OSError, ValueError) as error:  # a name of more than 255 bytes, no permission, links in a circle
            self.fail(f"{_shortened(text)}: {getattr(error, 'strerror', None) or error}.", param, ctx)
        found: Path = super().convert(value, param, ctx)  # type: ignore[assignment]
        return found


class PathOrHub(PathName):
    """The same, or ``hf://org/name`` and what may follow, which stays text."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return TEXT.convert(value, param, ctx) if on_hub(value) else super().convert(value, param, ctx)


PATH = PathName()
PATH_OR_HUB = PathOrHub()
FILE = PathName(exists=True, dir_okay=False)
NEW_FILE = PathName(dir_okay=False)
FOLDER = PathName(file_okay=False)


class PictureName(PathName):
    """A file for a picture, told by the end of its name, in a folder that exists."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        path = super().convert(value, param, ctx)
        try:
            require_picture_name(path)
        except OutputError as error:
            self.fail(str(error), param, ctx)
        return path


PICTURE = PictureName(dir_okay=False)

PAGES = (".html", ".htm")
"""How the name of a page ends."""


class PageOrPictureName(PictureName):
    """A file for a page, or for a picture, told by the end of its name."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        path = PathName.convert(self, value, param, ctx)
        if path.suffix.lower() in PAGES:
            return path
        if path.suffix.lower() not in FORMATS:
            self.fail(f"expected a page (.html) or a picture ({', '.join(FORMATS)}); found {str(path)!r}.", param, ctx)
        return super().convert(value, param, ctx)


PAGE_OR_PICTURE = PageOrPictureName(dir_okay=False)


class Address(click.ParamType[str]):
    """An IP address, or ``localhost``. A name would be looked up in a network, and may be anything tomorrow."""

    name = "address"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        if value == "localhost":
            return "localhost"
        try:
            return str(ipaddress.ip_address(value))
        except ValueError:
            expected = "expected an IP address of this machine, such as 127.0.0.1, or localhost; 0.0.0.0 is all of them"
            self.fail(f"{expected}. Found {_shortened(os.fsencode(value).decode(errors='replace'))!r}.", param, ctx)


ADDRESS = Address()


def _is_text(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _shortened(text: str) -> str:
    return text if len(text) <= 100 else f"{text[:50]}...{text[-30:]}"
