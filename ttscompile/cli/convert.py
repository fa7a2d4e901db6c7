"""``ttscompile convert``: a trained policy becomes an artifact."""

from pathlib import Path
from typing import Any

import click

import ttscompile
from ttscompile.artifact.ceiling import few_steps
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.write import require_replaceable
from ttscompile.cli.options import count_option, json_option, lerobot_options
from ttscompile.cli.output import only_results_on_stdout, print_json, progress, results, say
from ttscompile.cli.sections import LEROBOT, Section, SectionedCommand
from ttscompile.cli.summary import print_summary
from ttscompile.cli.types import NEW_FILE, PATH, PATH_OR_HUB
from ttscompile.core.paths import on_hub, require_path
from ttscompile.core.spec import FP32, PRECISIONS
from ttscompile.errors import CheckpointError
from ttscompile.frontends.families import GIVE, SAMPLERS
from ttscompile.report.facts import precision as told_precision
from ttscompile.report.summary import document

SECTIONS = (Section("Another denoising loop", ("sampler", "steps")), LEROBOT)


@click.command(cls=SectionedCommand, sections=SECTIONS)
@click.argument("checkpoint", type=PATH_OR_HUB)
@click.option("-o", "--output", "directory", required=True, type=PATH, help="Write the artifact into this folder.")
@click.option(
    "--sampler",
    type=click.Choice(SAMPLERS),
    help="Replace the checkpoint's own sampler: by ddpm, ddim or dpmsolver++ in a diffusion policy, by euler or rk4 in"
    " one that was trained with flow matching.",
)
@count_option(
    "--steps",
    "Take so many denoising or integration steps, in place of the checkpoint's own. rk4 evaluates the network four"
    " times a step: K is four times this.",
    default=None,
)
@lerobot_options
@count_option(
    "--prediction-horizon",
    "Predict only the first so many steps of the policy's horizon, at least those that it executes: less to"
    " compute, the same actions. Refused where attention is not causal.",
    default=None,
)
@click.option(
    "--precision",
    type=click.Choice(PRECISIONS),
    default=FP32,
    help="Keep the weights of residual blocks and prologue in this precision. int8 is faster on processors with VNNI,"
    " int4 half as large and slower;"
    " 'ttscompile calibrate --learn precision' measures what it does, and leaves out the parts where that is much.",
)
@click.option(
    "--single-file",
    type=NEW_FILE,
    help="Write one ONNX file of the whole call too, for programs that have onnxruntime and no ttscompile.",
)
@click.option("--explain", is_flag=True, help="Say on standard error what each pass did.")
@json_option
def convert(
    checkpoint: Path | str,
    directory: Path,
    prediction_horizon: int | None,
    precision: str,
    single_file: Path | None,
    explain: bool,
    as_json: bool,
    **of_checkpoint: Any,  # the options of families: ttscompile.convert takes them by the same names
) -> None:
    """Compile CHECKPOINT, a trained policy of Diffusion Policy, LeRobot and others. Nothing in it is executed.

    It is a path, or hf://ORGANISATION/NAME[@REVISION][/PATH] on the Hugging Face hub.

    The artifact computes everything until 'ttscompile calibrate' gives it a plan.
    """
    # Told now: importing the compiler, and with it torch, takes seconds.
    if not on_hub(checkpoint):
        require_path(checkpoint, CheckpointError, GIVE)
    require_replaceable(directory)
    stages: list[dict[str, Any]] = []
    console = progress()
    with only_results_on_stdout(), console.status("compiling") as status:

        def on_stage(name: str, notes: tuple[str, ...]) -> None:
            stages.append({"stage": name, "notes": list(notes)})
            status.update(f"compiling: after {name}")
            if explain:
                first, *more = notes or ("nothing to do",)
                say(console, f"{name:<22}{first}", *(f"{'':<22}{note}" for note in more))

        ttscompile.convert(
            checkpoint,
            directory,
            prediction_horizon=prediction_horizon,
            precision=precision,
            single_file=single_file,
            explain=on_stage,
            **of_checkpoint,
        )
    artifact = load_artifact(directory)
    if (warning := few_steps(artifact.manifest)) is not None:
        say(console, f"warning: {warning}")
    for stage in stages:
        if stage["stage"] == "narrow" and prediction_horizon is None:
            say(console, " ".join(["hint:", *stage["notes"]]))
        if stage["stage"] == "tokenizer_of" and artifact.tokenizer is None:
            told = "an observation has tokens in place of text, since the artifact has no tokenizer"
            say(console, f"hint: {told}: {stage['notes'][0]}. Name its folder: --encoders DIR.")
        if stage["stage"] == "lower_precision":
            say(console, f"precision: {told_precision(artifact.manifest)}")
    if as_json:
        print_json(document(artifact) | {"stages": stages})
    else:
        console = results()
        print_summary(artifact, console)
        if single_file is not None:
            size, runs = stages[-1]["notes"]
            say(console, f"single file: {single_file}, {size}; {runs}")
