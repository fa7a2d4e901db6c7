"""The options of commands that run an artifact in a control loop, on an ``AsyncExecutor``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from ttscompile.cli.output import count_option

_OPTIONS = (
    click.option(
        "--control-hz",
        type=click.FloatRange(min=0, min_open=True),
        required=True,
        help="Rate of the control loop in Hz.",
    ),
    click.option(
        "--policy-hz",
        type=click.FloatRange(min=0, min_open=True),
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


def loop_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options, with the meanings of ``ExecutorSettings``, in this order."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command
