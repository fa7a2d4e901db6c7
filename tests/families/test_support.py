"""The support table is what the record says, and the record is what the tests of the families found."""

from ttscompile.frontends.refusals import DIRECTORIES, POLICIES, STATES

from .support import PAGE, in_page, read_record, render


def test_the_page_holds_the_table() -> None:
    """As ``python -m tests.families.support`` writes it."""
    written = in_page(PAGE.read_text(encoding="utf-8"))
    assert written == render(read_record()), "run python -m tests.families.support"


def test_families_are_there_once() -> None:
    """The name is the key."""
    names = [row["family"] for rows in read_record().values() for row in rows]
    assert len(set(names)) == len(names)


def test_what_is_not_compiled_says_why() -> None:
    """And where its checkpoint is refused by name, the refusal is there; its message says what to do."""
    refused = {row.what for row in (*POLICIES, *DIRECTORIES, *STATES)}
    for row in read_record()["not_compiled"]:
        assert row["reason"]
        assert row.get("refused_as") in {None, *refused}, row["family"]
