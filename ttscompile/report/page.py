"""What a page is made of, and the page as HTML in which everything is escaped."""

import base64
import importlib
from dataclasses import dataclass
from importlib.resources import files

from ..errors import needing


@dataclass(frozen=True)
class Table:
    """Rows of text. A column of figures is set to the right, one with any words to the left; ``prose`` may wrap."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    prose: bool = False

    @property
    def text(self) -> tuple[bool, ...]:
        """Which columns hold words."""
        columns = [[row[i] for row in self.rows if row[i]] for i in range(len(self.head))]
        words = [any(not cell[0].isdigit() or cell.count(" ") > 1 for cell in cells) for cells in columns]
        return tuple(i == 0 or self.prose or of_words for i, of_words in enumerate(words))


@dataclass(frozen=True)
class Picture:
    """A PNG.

    Attributes:
        alt: what it shows, for who cannot see it; empty where the caption says it.
    """

    png: bytes
    caption: str
    alt: str = ""

    @property
    def data(self) -> str:
        """As a ``data:`` address."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")


@dataclass(frozen=True)
class Section:
    """A heading and what stands under it, in this order."""

    title: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    points: tuple[str, ...] = ()

    @property
    def anchor(self) -> str:
        """Of links to it."""
        return self.title.lower().replace(" ", "-")


@dataclass(frozen=True)
class Page:
    """A report.

    Attributes:
        figures: label and value of what matters most.
    """

    title: str
    lead: str
    figures: tuple[tuple[str, str], ...]
    sections: tuple[Section, ...]
    foot: str


def require_packages() -> None:
    """Raise before anything is measured for a page that could not be made."""
    with needing("the page", "compile", ", or read the figures with: ttscompile inspect DIR --json"):
        importlib.import_module("jinja2")
        importlib.import_module("matplotlib")


def render(page: Page) -> str:
    """The page as one HTML document without scripts, which refers to nothing outside of itself.

    Raises:
        RuntimeUnavailableError: Jinja2 is not installed.
    """
    require_packages()
    from jinja2 import Environment, StrictUndefined

    # Names in an artifact are a stranger's: nothing of the page is marked as safe.
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((files(__package__) / "page.html").read_text(encoding="utf-8"))
    return template.render(page=page)
