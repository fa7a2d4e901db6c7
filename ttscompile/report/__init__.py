"""``ttscompile inspect -o``: everything about an artifact on one page that needs nothing else to be read."""

from .build import Given, build
from .page import Page, Picture, Section, Table, render
from .verified import verified

__all__ = ["Given", "Page", "Picture", "Section", "Table", "build", "render", "verified"]
