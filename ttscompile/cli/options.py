"""Arguments and options that several commands have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

PATH = click.Path(path_type=Path)
ABOVE_0 = click.FloatRange(min=0, min_open=True)

artifact_argument = click.argument("directory", type=PATH)
json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document on standard output, and nothing else."
)


def count_option(name: str, help: str, *, default: int | None = 1, least: int = 1) -> Decorator:
    """An option that takes a whole number of at least ``least``."""
    kind = click.IntRange(min=least)
    return click.option(name, type=kind, default=default, show_default=default is not None, help=help)


def names_option(name: str, known: Sequence[str], *, default: str, help: str) -> Decorator:
    """An option that takes known names with commas between, as ``tuple[str, ...]`` without repetitions."""

    def parsed(_: click.Context, __: click.Parameter, value: str) -> tuple[str, ...]:
        names = tuple(dict.fromkeys(part.strip() for part in value.split(",") if part.strip()))
        if unknown := [each for each in names if each not in known]:
            raise click.BadParameter(f"{unknown[0]!r} is not one of {', '.join(known)}.")
        return names

    return click.option(name, default=default, show_default=True, callback=parsed, help=help)


def together(*options: Decorator) -> Decorator:
    """All of these options, in this order."""

    def with_options(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return with_options


loop_options = together(
    click.option("--control-hz", type=ABOVE_0, required=True, help="Rate of the control loop in Hz."),
    click.option(
        "--policy-hz",
        type=ABOVE_0,
        help="Rate in Hz of the frames and actions that the policy was trained with. Without this option it is the"
        " control rate.",
    ),
    count_option(
        "--horizon",
        "Actions that are executed from one call to the next. Without this option it is as many as the policy executes"
        " of a chunk.",
        default=None,
    ),
    count_option(
        "--reserve",
        "Further actions of a chunk that may be executed while the next chunk is late. Without this option it is all"
        " that the policy predicts.",
        default=None,
        least=0,
    ),
    count_option("--margin-ticks", "Control ticks by which a chunk has to come before it is needed.", least=0),
    count_option("--threads", "Threads that the policy computes with."),
)
"""Of commands that run an artifact in a control loop; their meanings are those of ``ExecutorSettings``."""
