"""The command ``ttscompile``: one file a command.

Exit status: 0 done; 1 a check failed; 2 bad usage or bad input; 130 interrupted. Results go to standard output, as a
table or with ``--json`` as one JSON document and nothing else; progress and warnings go to standard error.
"""

from __future__ import annotations

import errno
from typing import Any

import click

from ttscompile import __version__
from ttscompile.cli.bench import bench
from ttscompile.cli.calibrate import calibrate
from ttscompile.cli.compare import compare
from ttscompile.cli.convert import convert
from ttscompile.cli.doctor import doctor
from ttscompile.cli.inspect import inspect
from ttscompile.cli.realtime import realtime
from ttscompile.cli.report import report
from ttscompile.cli.serve import serve
from ttscompile.cli.verify import verify
from ttscompile.errors import CalibrationFailedError, TtscompileError


class _Commands(click.Group):
    """Lists its commands as they follow each other; tells every error in one message, without a traceback."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except TtscompileError as error:
            failed_check = isinstance(error, CalibrationFailedError)
            click.echo(f"{'failed' if failed_check else 'error'}: {error}", err=True)
            ctx.exit(1 if failed_check else 2)
        except OSError as error:  # a full disk, a file that may not be read
            if error.errno == errno.EPIPE:
                raise  # nobody reads on: click ends without a word
            click.echo(f"error: {error}", err=True)
            ctx.exit(2)
        except KeyboardInterrupt:
            resumes = ctx.invoked_subcommand == "calibrate"
            click.echo("interrupted" + "; the same command with --resume goes on" * resumes, err=True)
            ctx.exit(130)


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="ttscompile")
def main() -> None:
    """Compile diffusion-transformer robot policies into artifacts that run in real time without PyTorch."""


# In the order in which they are used; a line each, short enough for a terminal of 80 columns.
for _command, _what in (
    (doctor, "What stands in the way on this machine."),
    (convert, "Compile a checkpoint into an artifact."),
    (calibrate, "Learn from recorded episodes what an artifact may leave out."),
    (inspect, "What is in an artifact; a picture of a plan."),
    (verify, "Does it do what the original did, and do its plans engage?"),
    (report, "All about an artifact on one page."),
    (bench, "Time calls, beside what they replace."),
    (compare, "Action error against latency, of plans and strategies."),
    (realtime, "Which plans keep up with a control loop on this machine."),
    (serve, "Drive a robot from another process, over a local WebSocket."),
):
    _command.short_help = _what
    main.add_command(_command)
