"""The options of commands that run an artifact in a control loop, on an ``AsyncExecutor``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

_OPTIONS = (
    click.option(
        "--control-hz", type=click.FloatRange(min=0, min_open=True), required=True, help="Of the control loop."
    ),
    click.option(
        "--policy-hz",
        type=click.FloatRange(min=0, min_open=True),
        help="Of frames and actions in training; the control rate if not given.",
    ),
    click.option(
        "--horizon",
        type=click.IntRange(min=1),
        help="Actions from one call to the next; as many as the policy executes, if not given.",
    ),
    click.option(
        "--reserve",
        type=click.IntRange(min=0),
        help="Actions after these that may be played; all predicted, if not given.",
    ),
    click.option(
        "--margin-ticks",
        type=click.IntRange(min=0),
        default=1,
        show_default=True,
        help="That a chunk is to be early by.",
    ),
    click.option("--threads", type=click.IntRange(min=1), default=1, show_default=True, help="Of the policy."),
)


def loop_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options, with the meanings of ``ExecutorSettings``, in this order."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command
