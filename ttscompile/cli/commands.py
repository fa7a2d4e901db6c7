"""All commands together, in the order in which they are used."""

from importlib import import_module

import click

from ttscompile import __version__
from ttscompile.cli.bench import bench
from ttscompile.cli.build import build
from ttscompile.cli.calibrate import calibrate
from ttscompile.cli.convert import convert
from ttscompile.cli.doctor import doctor
from ttscompile.cli.ending import TRACEBACK, Commands
from ttscompile.cli.inspect import inspect
from ttscompile.cli.predict import predict
from ttscompile.cli.push import push
from ttscompile.cli.verify import verify


@click.group(
    cls=Commands,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
    epilog="Exit status: 0 done; 1 a check failed; 2 bad usage or bad input; 70 a defect of ttscompile;"
    " 130 interrupted; 141 nobody reads the output; 143 ended by SIGTERM.",
)
@click.version_option(__version__, prog_name="ttscompile")
@click.option(TRACEBACK, is_flag=True, expose_value=False, help="Show where a defect of ttscompile is.")
def main() -> None:
    """Compile diffusion policies of robots into artifacts that run in real time without PyTorch."""


serve = import_module("ttscompile.serving.command").serve  # attached to the commands, and built on them

# In the order in which they are used; a line each, short enough for a terminal of 80 columns.
for _command, _what in (
    (doctor, "What stands in the way: machine, checkpoint, recordings."),
    (build, "From a checkpoint to a fast policy, in one command."),
    (convert, "Compile a checkpoint into an artifact."),
    (calibrate, "Learn from recorded episodes what an artifact may leave out."),
    (inspect, "What is in an artifact: tables, a picture, a page."),
    (verify, "Does it do what the original did, and do its plans engage?"),
    (predict, "What does it answer to one observation?"),
    (bench, "How fast are calls, do they keep up, how far are they off?"),
    (push, "Upload an artifact with a model card to the hub."),
    (serve, "Drive a robot, or answer many, over a WebSocket."),
):
    _command.short_help = _what
    main.add_command(_command)
