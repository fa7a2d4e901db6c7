"""Arguments and options that several commands have."""

from collections.abc import Callable, Sequence
from typing import Any

import click

from ttscompile.cli.types import ANY_TEXT, FOLDER, PATH, PATH_OR_HUB, RATE, TEXT, NumberOption
from ttscompile.runtimes.open import RUNTIMES

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

MOST = 1_000_000
"""Of whatever is counted: none of it is of use beyond, and all of it fits a machine."""

MOST_THREADS = 1024
"""onnxruntime makes as many as it is told."""
MOST_SEED = 2**63 - 1
"""torch takes no larger one."""

OFFERED = tuple(name for name, kind in RUNTIMES.items() if not kind.slow)
"""Runtimes that a command offers."""

artifact_argument = click.argument("directory", type=PATH)
json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document on standard output, and nothing else."
)


def count_option(name: str, help: str, *, default: int | None = 1, least: int = 1, most: int = MOST) -> Decorator:
    """An option that takes a whole number from ``least`` to ``most``."""
    return number_option(name, click.IntRange(least, most), help, default=default)


def number_option(name: str, kind: click.ParamType[Any], help: str, **settings: Any) -> Decorator:
    """An option that takes a number of this kind; see ``click.option`` for the settings."""
    return click.option(name, cls=NumberOption, type=kind, metavar="NUMBER", help=help, **settings)


def threads_option(help: str) -> Decorator:
    """``--threads``."""
    return count_option("--threads", help, most=MOST_THREADS)


def several_threads_option(help: str) -> Decorator:
    """``--threads``, one number or several with commas between, as ``tuple[int, ...]`` without repetitions."""
    number = click.IntRange(1, MOST_THREADS)

    def parsed(context: click.Context, option: click.Parameter, value: str) -> tuple[int, ...]:
        return tuple(dict.fromkeys(number(part.strip(), option, context) for part in value.split(",")))

    return click.option("--threads", type=ANY_TEXT, default="1", callback=parsed, help=help)


def together(*options: Decorator) -> Decorator:
    """All of these options, in this order."""

    def with_options(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return with_options


encoders_option = click.option(
    "--encoders",
    type=FOLDER,
    help="Find what the checkpoint names and does not hold (CLIP, SigLIP, or the language model's config.json and"
    " tokenizer.json) in this folder, if it is not in or beside the checkpoint. Nothing is downloaded.",
)

lerobot_options = together(
    click.option(
        "--task", type=ANY_TEXT, help="Compile this instruction in; without it, its tokens are an observation."
    ),
    encoders_option,
    click.option(
        "--without-camera",
        "without_cameras",
        type=ANY_TEXT,
        multiple=True,
        callback=lambda context, option, given: given or None,
        help="Leave out a camera of a vision-language-action model that the robot lacks; may be repeated.",
    ),
    click.option("--base", type=PATH_OR_HUB, help="Merge the adapter into this policy, not that of its configuration."),
)
"""Of commands that read a checkpoint, for policies of LeRobot."""

runtime_options = together(
    click.option(
        "--runtime",
        type=click.Choice(OFFERED),
        default="onnxruntime",
        help="Execute the policy with this runtime; torch needs the extra 'compile'.",
    ),
    click.option(
        "--device", type=TEXT, help="Have --runtime torch compute on this device, as torch calls it: cpu, cuda."
    ),
)
"""Of commands that run an artifact in a runtime of choice."""


def seed_option(help: str) -> Decorator:
    """``--seed``."""
    return count_option("--seed", help, default=0, least=0, most=MOST_SEED)


ray_option = click.option(
    "--ray",
    type=ANY_TEXT,
    metavar="ADDRESS|local",
    help="Work on the machines of this Ray cluster, or of one with this machine's cores; the outcome is the same.",
)


def names_option(name: str, known: Sequence[str], *, default: str, help: str) -> Decorator:
    """An option that takes known names with commas between, as ``tuple[str, ...]`` without repetitions."""

    def parsed(_: click.Context, __: click.Parameter, value: str) -> tuple[str, ...]:
        names = tuple(dict.fromkeys(part.strip() for part in value.split(",") if part.strip()))
        if unknown := [each for each in names if each not in known]:
            raise click.BadParameter(f"{unknown[0]!r} is not one of {', '.join(known)}.")
        return names

    return click.option(name, type=ANY_TEXT, default=default, callback=parsed, help=help)


policy_hz_option = number_option(
    "--policy-hz",
    RATE,
    "Play actions at this rate in Hz, that of the frames and actions of the training. Without this option it is what"
    " the recordings say, or that of --control-hz.",
)
loop_options = together(
    policy_hz_option,
    count_option("--margin-ticks", "Have each chunk come so many control ticks before it is needed.", least=0),
)
LOOP_OPTIONS = ("policy_hz", "margin_ticks")
"""Of commands that run an artifact in a control loop, and their parameters, which ``ExecutorSettings`` has too."""
