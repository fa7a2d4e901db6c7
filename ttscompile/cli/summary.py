"""What an artifact is, as tables: for ``convert``, ``calibrate`` and ``inspect``; and what a ``build`` tried."""

from pathlib import Path

from rich.console import Console
from rich.padding import Padding

from ttscompile.artifact.ceiling import uncalibrated
from ttscompile.artifact.load import Artifact
from ttscompile.cli.output import print_identity, print_json, results, say, table
from ttscompile.core.plan import DENSE
from ttscompile.measure.machine import fingerprint, one_line
from ttscompile.measure.units import ms
from ttscompile.report import Table, facts, usage
from ttscompile.report.summary import document
from ttscompile.runtimes.instruct import instruct_of


def print_artifact(artifact: Artifact, as_json: bool, whole: bool = True) -> None:
    """What an artifact is: as tables, all or those of its plans alone, or as one JSON document."""
    if as_json:
        print_json(document(artifact))
    else:
        print_summary(artifact, results(), whole)


def print_summary(artifact: Artifact, console: Console, whole: bool = True) -> None:
    """What an artifact is, as the tables of its page: what it does first, then, if ``whole``, what it is made of."""
    manifest = artifact.manifest
    source = ", ".join(f"{k} {v}" for k, v in manifest.spec.source.items()) or "a module"
    rows = [("identity", manifest.short_identity), ("made from", source), *facts.policy(artifact).tables[0].rows]
    about = table("artifact", str(artifact.path), rows=rows)
    about.columns[1].justify = "left"
    if whole:
        console.print(about)
    print_facts(console, facts.plan_table(artifact))
    for line in facts.told_spare(manifest):
        console.print(Padding(line, (0, 0, 1, 2)))
    record = manifest.calibration
    if record is None:
        console.print(Padding(uncalibrated(manifest), (0, 0, 1, 2)))
    else:
        print_facts(console, facts.score_table(record, facts.spare(manifest)))
        for line in facts.remarks(record):
            console.print(Padding(line, (0, 0, 0, 2)))  # as a row it would squeeze the figures
    if not whole:
        say(console, "", f"All about it: ttscompile inspect {artifact.path}")
        return print_identity(manifest.identity, console)
    for made in (facts.block_table(manifest), *facts.hoisting(artifact).tables, usage.usage_table(artifact)):
        print_facts(console, made)
    console.print(Padding(usage.told_unused(artifact), (0, 0, 0, 2)))
    if record is not None:
        print_facts(console, facts.record_table(record, most=90))


def print_facts(console: Console, made: Table) -> None:
    """A table of the page; nothing if it has no rows."""
    if made.rows:
        shown = table(*made.head, rows=made.rows)
        for column, words in zip(shown.columns, made.text, strict=True):
            column.justify = "left" if words else "right"
        console.print(shown)


def print_frontier(
    artifact: Artifact, directory: Path, output: Console, threads: int, control_hz: float | None = None
) -> None:
    """The plans that were tried, the verdict on the default, and how to go on: in a control loop, if one was given."""
    record, default = artifact.manifest.calibration or {}, artifact.manifest.default_plan
    rows = record["frontier"]
    dense = next(row for row in rows if row["name"] == DENSE)
    made = table("plan", "what it does", "ms a call", "longest", "times faster", "MB", "distance", "95 %", "confirmed")
    for row in rows:
        again = [f"{round(row['confirmed']['distance'], 3) + 0:.3f}"] if "confirmed" in row else []
        made.add_row(
            f"{row['name']} (default)" if row["name"] == default else row["name"],
            row["told"],
            ms(row["milliseconds"], 4),
            ms(row["worst"], 4),
            f"{dense['milliseconds'] / row['milliseconds']:.1f} x",
            f"{row['weights'] / 1e6:.1f}",
            f"{round(row['distance'], 3) + 0:.3f}",  # + 0: never -0
            "..".join(f"{round(one, 3) + 0:.3f}" for one in row["interval"]),
            " ".join([*again, *["too far"] * (not row["near"])]),
        )
    made.columns[1].justify = "left"
    output.print(made)
    task = ["observation['task'] = 'pick up the cup'  # say"] if instruct_of(artifact) else []
    loop = ["policy.reset()  # a new episode", *task, "actions = policy.predict_action(observation)['action']"]
    if control_hz is not None:
        loop = [
            f"with ttscompile.AsyncExecutor(policy, control_hz={control_hz:g}) as executor:",
            "    executor.reset(seed=0)  # a new episode",
            "    while running:",
            *(f"        {line}" for line in (*task, "executor.observe(observation)  # one frame, by key")),
            "        if executor.ready:",
            "            robot.move(executor.action())",
            "        wait_for_the_next_tick()",
        ]
    say(
        output,
        "Times faster: than the same policy with every step computed, compiled too. MB: of weights that its models"
        " read; a process takes more. Distance: between the actions and"
        " the original's, in units of what other noise changes; 0 is the same. Held-out episodes:"
        f" {len(record['episodes']['validation'])}. Confirmed: on other calls of these, by which nothing was"
        f" chosen. One stream, {threads} thread{'s' * (threads > 1)}.",
        *facts.told_spare(artifact.manifest),
        *((*facts.chosen(record), *facts.learned(record)) if record.get("other_noise") else facts.remarks(record)),
        "",
        f"    policy = ttscompile.load({str(directory)!r}, threads={threads})",
        *(f"    {line}" for line in loop),
        "",
        one_line(fingerprint()),
    )
    print_identity(artifact.manifest.identity, output)
