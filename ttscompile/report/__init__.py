"""``ttscompile inspect -o``: everything about an artifact on one page that needs nothing else to be read.

A document that is not what it should be is a ``ReportError``; without matplotlib and Jinja2 there is no page.
"""

from .build import Extras, build, verified
from .page import Page, Picture, Section, Table, render

__all__ = ["Extras", "Page", "Picture", "Section", "Table", "build", "render", "verified"]
