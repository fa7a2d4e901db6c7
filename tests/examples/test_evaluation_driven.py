"""What the pages say of driven plans is what the table of driven plans says; and how the table is written."""

import json
import re
from pathlib import Path
from typing import Any

import driven
import pytest
from click.testing import CliRunner
from driven import MARGINS, Row, read
from equivalence import EQUIVALENT, TOO_FEW, WORSE

from tests.claims import EQUIVALENT as CLAIM, PAGES, items
from tests.pages import ROOT, load
from ttscompile.artifact.ceiling import BOUND, FARTHEST
from ttscompile.report import facts

ROWS = read()
NAMED = {row.name: row for row in ROWS if row.name}
CITED = re.compile(r"<!-- driven: ([^>]*) -->")
COUNTS = re.compile(r"([\d,]+)(?: (to|and) ([\d,]+))? (?:paired )?episodes")
NUMBERS = "none one two three four five six seven eight nine ten eleven twelve".split()


def told(count: int) -> str:
    return NUMBERS[count] if count < len(NUMBERS) else str(count)


def section(page: Path, slug: str) -> str:
    """A section of a page, with those below it."""
    found, depth, fenced = list[str](), 0, False
    for line in page.read_text().splitlines():
        fenced ^= line.startswith("```")
        level = 0 if fenced else len(line) - len(line.lstrip("#"))
        if level and depth:
            if level <= depth:
                break
        elif level:
            title = re.sub(r"[^\w\- ]", "", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", line.lstrip("# ")))
            depth = level if title.strip().lower().replace(" ", "-") == slug else 0
        if depth:
            found.append(line)
    return "\n".join(found)


def episodes(item: str) -> list[tuple[int, int]]:
    """Numbers of episodes that an item names, each as the least and the most."""
    ranges = []
    for first, word, last in COUNTS.findall(item):
        one, other = (int(each.replace(",", "") or 0) for each in (first, last or first))
        ranges += [(one, other)] if word == "to" else [(one, one), (other, other)]
    return ranges


def mistakes(item: str) -> list[str]:
    """What is wrong with an item that calls plans equivalent."""
    names = [name for found in CITED.findall(item) for name in found.split()]
    wrong = [] if names else ["it cites no row"]
    text = CITED.sub("", item)
    for name in names:
        row = NAMED.get(name.partition(".")[0])
        if row is None:
            wrong.append(f"{name}: there is no such row")
            continue
        measures = [name.partition(".")[2]] if "." in name else [key for key in MARGINS if getattr(row, key)]
        if "." not in name and "of the score" in text and "score" not in measures:
            wrong.append(f"{name}: the table has no score of it")
        wrong += [f"{name}: {each} is {row.word(each)}" for each in measures if row.word(each) != EQUIVALENT]
        if not any(low <= row.episodes <= high for low, high in episodes(text)):
            wrong.append(f"{name}: it was driven in {row.episodes} episodes")
    return wrong


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_is_called_equivalent_is_so_in_the_table(page: Path) -> None:
    found = [one for one in items(page.read_text()) if CLAIM.search(one)]
    claims = [one for one in found if "| equivalent |" not in one]
    equivalent = [row.success for row in NAMED.values() if row.success and row.word("success") == EQUIVALENT]
    for row in set(found) - set(claims):  # of a table
        assert any(f"[{low:.1f}, {high:.1f}]" in row for _, low, high in equivalent), row
    assert {one[:90]: wrong for one in claims if (wrong := mistakes(one))} == {}


@pytest.mark.parametrize(
    ("item", "count"),
    [
        ("It is equivalent within 5 points, in 2,400 paired episodes. <!-- driven: flow-4 -->", 0),
        ("They are equivalent within 5 points, in 432 to 2,400 episodes. <!-- driven: flow-4 metaworld-12 -->", 0),
        ("It is equivalent within 5 points, in 2,400 paired episodes.", 1),
        ("It is equivalent within 5 points, in 200 paired episodes. <!-- driven: flow-4 -->", 1),
        ("It is equivalent within 5 points, in 640 paired episodes. <!-- driven: transformer-8 -->", 1),
        ("Its score is equivalent within 0.03, in 640 paired episodes. <!-- driven: transformer-8.score -->", 0),
        ("It is equivalent within 5 points and 0.03 of the score, in 800 episodes. <!-- driven: fetch-ddpm -->", 1),
        ("It is equivalent within 5 points, in 2,400 paired episodes. <!-- driven: nobody -->", 1),
    ],
)
def test_what_is_wrong_with_a_claim(item: str, count: int) -> None:
    assert len(mistakes(item)) == count


def test_a_row_says_what_its_interval_says() -> None:
    assert len(NAMED) == len([row for row in ROWS if row.name])
    for row in ROWS:
        assert all(row.word(measure) == word for measure, word in row.verdict.items()), row.plan
        assert not row.name or set(row.verdict) == {key for key in MARGINS if getattr(row, key)}, row.plan
        for measure in MARGINS:
            if getattr(row, measure) is not None:
                mean, low, high = row.interval(measure)
                assert low <= mean <= high, row.plan


@pytest.mark.parametrize("row", [row for row in ROWS if row.page], ids=lambda row: row.name or row.plan)
def test_a_row_stands_on_its_page_with_its_command(row: Row) -> None:
    page, _, slug = row.page.partition("#")
    text = section(ROOT / "docs" / page, slug)
    assert re.search(r"(?:evaluate|some_tokens)\.py", text), row.page
    for measure, form in (("success", ".1f"), ("score", ".3f")):
        if (interval := getattr(row, measure)) is not None:
            _, low, high = interval
            assert f"[{low:{form}}, {high:{form}}]" in text, (row.page, measure)


def test_what_the_pages_say_of_distances_is_what_was_driven() -> None:
    """The default's bound was chosen by these numbers, and calibration prints them."""
    picture = load(ROOT / "docs" / "pictures" / "distance.py", "docs_distance")
    edges = ((-1.0, BOUND), (BOUND, FARTHEST), (FARTHEST, 9.0))
    bands = [[row for row in picture.plans() if low < row.distance <= high] for low, high in edges]
    lost = [[-row.success[0] for row in band if row.success[0] < -MARGINS["success"]] for band in bands]
    (one, two, three), (few, some, many) = bands, lost
    said = (
        f"{told(len(few))} of {len(one)} plans{{}} lost more than 5 points of success, {max(few):.1f}; up to {{}}"
        f" {told(len(some))} of {len(two)}, {max(some):.1f} at most; beyond it {told(len(many))} of {len(three)},"
        f" {max(many):.1f} at most"
    )
    for page in ("design.md", "howto/calibrate.md", "howto/budget.md"):
        text = " ".join((ROOT / "docs" / page).read_text().split())
        assert f"Within 0.1 {said.format(' that were driven', '0.25')}" in text, page
    surely = [told(sum(row.success[2] < -MARGINS["success"] for row in band)) for band in bands]
    long = [[row.success[0] for row in band if row.episodes >= picture.FEW] for band in bands]
    lasting = [f"{told(sum(each < -MARGINS['success'] for each in band))} of {len(band)}" for band in long]
    results = " ".join((ROOT / "docs" / "evidence" / "results.md").read_text().split())
    assert f"Within a tenth {said.format('', 'a quarter')}" in results
    assert f"By their intervals {surely[0]}, {surely[1]} and {surely[2]} lost more than 5 points for sure" in results
    assert f"in {picture.FEW} episodes or more, {lasting[0]}, {lasting[1]} and {lasting[2]} lost more" in results
    assert f"the largest loss within a tenth was {-min(long[0]):.1f} points" in results
    assert f"for {len(picture.plans())} plans of eight policies" in results
    for distance, band, more in zip((0.05, 0.2, 0.3), bands, lost, strict=True):
        record = {"default_plan": "p", "plans": {"p": {"distance": distance, "sparsity": 0.5, "flops_saved": 0.5}}}
        (printed,) = facts.verdict(record)
        counted = f"Of {len(band)} such plans that were driven {len(more)} lost more than 5 points of success"
        assert f". {counted}, {max(more):.1f} at most (" in printed


def difference(mean: float, low: float, high: float) -> dict[str, float]:
    return {"mean": mean, "low": low, "high": high}


FIGURES: dict[str, Any] = {
    "command": "python examples/evaluation/evaluate.py D:dense D --looks 2 --json",
    "variants": [
        {"distance": None},
        {
            "distance": 0.05,
            "verdict": {
                "word": TOO_FEW,
                "score": {"word": EQUIVALENT, "difference": difference(0.001, -0.0123456, 0.01), "comparisons": 2},
                "success": {
                    "word": TOO_FEW,
                    "difference": difference(-0.02, -0.06, 0.03),
                    "comparisons": 2,
                    "episodes": 400,
                },
            },
        },
    ],
}


def test_a_row_is_what_the_harness_printed(tmp_path: Path) -> None:
    table, figures = tmp_path / "driven.json", tmp_path / "figures.json"
    table.write_text(json.dumps({"what": "rows", "plans": [{"policy": "a", "plan": "b", "episodes": 9}]}))
    figures.write_text(json.dumps(FIGURES))
    given = [
        str(figures),
        "--policy",
        "P",
        "--plan",
        "2 of 4 steps",
        "--page",
        "a.md#b",
        "--name",
        "p",
        "--table",
        str(table),
    ]
    assert CliRunner().invoke(driven.main, given).exit_code == 0
    old, new = read(table)
    assert (old.policy, old.comparisons, json.loads(table.read_text())["what"]) == ("a", 1, "rows")
    assert (new.success, new.score, new.distance, new.episodes) == (
        (-2.0, -6.0, 3.0),
        (0.001, -0.0123, 0.01),
        0.05,
        400,
    )
    assert (
        new.verdict == {measure: new.word(measure) for measure in MARGINS} == {"success": TOO_FEW, "score": EQUIVALENT}
    )
    assert new.command == FIGURES["command"] and new.interval("success") == new.success  # it counts both looks
    wrong = CliRunner().invoke(driven.main, [*given, "--plan", "another"])
    assert wrong.exit_code == 2 and "for each of the 1 variants" in wrong.output and len(read(table)) == 2


def test_an_interval_is_made_wider_for_what_it_does_not_count() -> None:
    """Of two comparisons by 2.2414 / 1.9600 standard deviations."""
    row = Row("p", "q", 1000, success=(-1.0, -4.92, 3.9), score=(0.0, -0.01, 0.01), comparisons=2)
    assert row.interval("success") == pytest.approx((-1.0, -1 - 3.92 * 1.14359, -1 + 4.9 * 1.14359), abs=1e-3)
    assert (row.word("success"), row.word("score")) == (TOO_FEW, "equivalent")
    assert Row("p", "q", 1000, success=(-9.0, -12.0, -6.0)).word("success") == WORSE
    assert Row("p", "q", 49, score=(0.0, -0.01, 0.01)).word("score") == TOO_FEW  # see equivalence.FEWEST
    with pytest.raises(ValueError, match="does not have its score"):
        Row("p", "q", 9, success=(0.0, -1.0, 1.0)).interval("score")
