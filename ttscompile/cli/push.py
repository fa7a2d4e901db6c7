"""``ttscompile push``: an artifact and its model card go to the hub."""

from pathlib import Path

import click

import ttscompile
from ttscompile.cli.options import artifact_argument
from ttscompile.cli.output import only_results_on_stdout, progress, results, say
from ttscompile.cli.types import FILE, TEXT


@click.command()
@artifact_argument
@click.argument("repository", type=TEXT)
@click.option(
    "--evaluation",
    "evaluations",
    type=FILE,
    multiple=True,
    help="Put the success figures on the card that examples/evaluation/evaluate.py --json printed of this artifact into"
    " this file. May be repeated.",
)
@click.option(
    "--license",
    "licence",
    type=TEXT,
    help="Name this licence of the base, as the hub writes it (apache-2.0), where the base did not say one to convert.",
)
@click.option("--private", is_flag=True, help="Make the repository private, if it is made now.")
@click.option("--dry-run", is_flag=True, help="Print the card, and upload nothing.")
def push(
    directory: Path, repository: str, evaluations: tuple[Path, ...], licence: str | None, private: bool, dry_run: bool
) -> None:
    """Upload the artifact DIRECTORY to REPOSITORY (org/name) on the Hugging Face hub, with a model card.

    The card is made of what the artifact says of itself: base model and licence, sampler, plan, errors, commands; and
    of calls that are timed now. Log in with 'hf auth login' first.
    """
    console = progress()
    with only_results_on_stdout(), console.status("loading") as status:
        made = ttscompile.push(
            directory,
            repository,
            evaluations=evaluations,
            licence=licence,
            private=private,
            dry_run=dry_run,
            progress=status.update,
        )
    if dry_run:
        click.echo(made, nl=False)
    else:
        say(results(), f"pushed {made}")
