"""An artifact, with a card made of what it says of itself, into a repository of the hub."""

import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..artifact.load import Artifact, load_artifact
from ..artifact.manifest import MANIFEST, Manifest
from ..core.paths import HUB
from ..core.plan import DENSE, SCHEDULE
from ..core.spec import WITHOUT
from ..core.untrusted_json import parse_json
from ..errors import ReportError
from ..hub import upload
from ..hub.repository import HubName, read_name, require_repository
from ..measure.machine import one_line
from ..measure.units import share
from ..runtimes.open import open_runtime
from ..runtimes.policy import CompiledPolicy
from . import facts
from .page import Section, Table
from .timing import Measurement, latency, measure_plans

BASE, BASE_LICENCE = "base", "base_licence"
"""Entries of ``PolicySpec.source`` that ``convert`` writes of a checkpoint from the hub."""
_MOST_BYTES = 64 << 20
_WORDS = "It is told its task in words: an observation has the text `task`, which takes the package `tokenizers`{}."
_ELSEWHERE = (
    ", and the base's tokenizer, which is not in this repository: give `load` its folder, `tokenizer=DIR`. Without it,"
    " give the tokens and their mask yourself"
)
_SPECIAL = re.compile(r"([\\`*_\[\]<>|#~])")


@dataclass(frozen=True)
class Success:
    """How one plan of the artifact did on a task.

    Attributes:
        variant: artifact and plan, as the evaluation calls them.
        figures: mean and 95 % interval by name: ``success`` and ``score``.
    """

    environment: str
    variant: str
    episodes: int
    figures: Mapping[str, tuple[float, float, float]]
    machine: str


def read_success(path: Path, identity: str) -> list[Success]:
    """Of a document of ``examples/evaluation/evaluate.py --json``, what is of this artifact.

    Raises:
        ReportError: it is no such document, or not of this artifact.
    """
    expected = "expected what examples/evaluation/evaluate.py --json printed"
    try:
        document = parse_json(path.read_bytes(), _MOST_BYTES)
        machine = one_line(document["machine"])
        own = [each for each in document["variants"] if each["identity"] == identity]
        found = [
            Success(
                environment=str(document["environment"]),
                variant=Path(str(each["label"])).name,
                episodes=len(each["episodes"]),
                figures={name: _interval(each[name]) for name in ("success", "score")},
                machine=machine,
            )
            for each in own
        ]
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise ReportError(f"{path}: {expected}; found {type(error).__name__}: {error!s:.200}.") from error
    if not found:
        raise ReportError(f"{path}: no variant in it has the identity {identity[:12]}. Evaluate this artifact again.")
    return found


def _interval(value: Mapping[str, Any]) -> tuple[float, float, float]:
    return float(value["mean"]), float(value["low"]), float(value["high"])


def licence_of(manifest: Manifest, given: str | None) -> str | None:
    """The licence of the base, which the artifact is under too; of a base that says none the one that was given.

    Raises:
        ReportError: both say one, and not the same.
    """
    own = manifest.spec.source.get(BASE_LICENCE)
    if own is not None and given is not None and own.lower() != given.lower():
        raise ReportError(f"the base is under the licence {own}, which was passed on; found {given}. Leave it out.")
    return own or given


def card(
    artifact: Artifact,
    repository: str,
    measured: Sequence[Measurement],
    success: Sequence[Success],
    licence: str | None,
) -> str:
    """The text of ``README.md``."""
    manifest = artifact.manifest
    base = None if (told := manifest.spec.source.get(BASE)) is None else read_name(told)
    head = {
        **({} if licence is None else {"license": licence}),
        **({} if base is None else {"base_model": base.repository, "base_model_relation": "quantized"}),
        "library_name": "ttscompile",
        "pipeline_tag": "robotics",
        "tags": ["robotics", "diffusion-policy", "ttscompile"],
    }
    lines = ["---", *(f"{key}: {json.dumps(value)}" for key, value in head.items()), "---", ""]
    lines += [f"# {_plain(repository.partition('/')[2])}", ""]
    of = "a policy" if base is None else f"[{base.repository}](https://huggingface.co/{base.repository})"
    lines += [f"This is {of}, compiled by ttscompile: it runs with numpy and onnxruntime alone.", ""]
    lines += ["```python", "import ttscompile", "", f'policy = ttscompile.load("hf://{repository}", threads=1)', "```"]
    calibrated, timed = facts.calibration(manifest), latency(measured, manifest.default_plan)
    if manifest.calibration is None:
        told_dense = "It was not calibrated: every call is dense, and does what the base does."
        calibrated = replace(calibrated, text=(told_dense,))
    if manifest.spec.instruction is not None:
        lines += ["", _WORDS.format(_ELSEWHERE if manifest.stores.tokenizer is None else "")]
    for section in (
        _what(artifact, base, licence),
        replace(calibrated, tables=calibrated.tables[:-1]),  # without the record
        _success(success),
        replace(timed, text=(*timed.text, "Yours is another machine.")),
        _made(manifest, base),
        facts.limits(artifact),
    ):
        lines += ["", *_markdown(section)]
    return "\n".join(lines) + "\n"


def _what(artifact: Artifact, base: HubName | None, licence: str | None) -> Section:
    manifest, spec = artifact.manifest, artifact.manifest.spec
    plan, sampler = facts.plans_of(manifest)[manifest.default_plan], spec.sampler
    first, last = sampler.timesteps[0], sampler.timesteps[-1]
    source = ", ".join(f"{k} {v}" for k, v in spec.source.items() if k not in (BASE, BASE_LICENCE))
    rows = (
        ("base model", "not from the hub" if base is None else f"{base.repository}, commit {base.revision}"),
        ("licence", licence or "not known: ask who trained the base"),
        ("policy", source or "a module"),
        ("sampler", f"{sampler.name}, K = {sampler.steps}, timesteps {first:g}..{last:g}"),
        ("default plan", f"{manifest.default_plan}, {plan.kind}"),
        ("sparsity", f"{share(plan.sparsity)} of the cells are reused, {share(plan.flops_sparsity)} of their FLOPs"),
        ("precision", facts.precision(manifest)),
        ("identity", manifest.identity),
    )
    return Section("What it is", (), (Table(("", ""), rows), facts.plan_table(artifact)))


def _success(found: Sequence[Success]) -> Section:
    if not found:
        none = "No success figures were given. Evaluate it on your own task before a robot moves."
        return Section("Success", (none,))
    rows = tuple(
        (
            *(each.environment, each.variant, str(each.episodes)),
            *("{:.3f} [{:.3f}, {:.3f}]".format(*each.figures[name]) for name in ("success", "score")),
        )
        for each in found
    )
    head = ("task", "plan", "episodes", "success [95 % interval]", "score [95 % interval]")
    text = f"Intervals are of the bootstrap over episodes. The episodes ran on {found[0].machine}."
    return Section("Success", (text,), (Table(head, rows),))


def _made(manifest: Manifest, base: HubName | None) -> Section:
    record, sampler = manifest.calibration, list(manifest.spec.all_loops.values())[-1]
    steps = sampler.steps // 4 if sampler.name == "rk4" else sampler.steps  # which evaluates four times a step
    checkpoint = "CHECKPOINT" if base is None else base.at(str(base.revision))
    precision = "" if manifest.precision is None else f" --precision {manifest.precision_name}"
    if manifest.precision is not None and (kept := [_word(part) for part in manifest.precision.asked]):
        precision += f"  # and in Python keep_fp32={kept}"
    spec = manifest.spec
    more = " --task TASK" * ("task" in spec.source)
    more += "".join(f" --without-camera {_word(name)}" for name in spec.source.get(WITHOUT, "").split())
    more += f" --prediction-horizon {spec.sample[0]}" * (spec.left_out > 0)
    lines = [f"ttscompile convert {checkpoint} -o DIR --sampler {sampler.name} --steps {steps}{more}{precision}"]
    if record is not None:
        budget = record.get("budget", {}) | {"seed": record.get("seed")}
        learned, made = record.get("learned", [SCHEDULE]), record.get("strategy", "tts")
        if made != "tts":  # of before: what made the schedule, where that was not this project's own search
            learned = [made if one == SCHEDULE else one for one in learned]
        goals = ("target_sparsity", "target_flops", "latency_ms", "max_action_error", "max_distance", "seed")
        asked = {key: budget[key] for key in goals if budget.get(key) is not None}
        words = " ".join(f"--{k.replace('_', '-')} {_word(v)}" for k, v in asked.items())
        if learned not in ([], [SCHEDULE]):
            words += f" --learn {','.join(map(_word, learned[:8]))}"
        lines.append(f"ttscompile calibrate DIR --trajectories CALLS {words}")
    lines.append("ttscompile verify DIR")
    text = (
        f"With ttscompile {manifest.ttscompile_version}, by commands like these, from what the artifact records;"
        " it keeps no paths."
    )
    return Section("How it was made", (text,), points=tuple(f"`{line}`" for line in lines))


def _word(value: object) -> str:
    return re.sub(r"[^A-Za-z0-9._+-]", "", str(value))[:40]


def _markdown(section: Section) -> list[str]:
    lines = [f"## {section.title}", ""]
    for text in section.text:
        lines += [_plain(text), ""]
    for table in section.tables:
        rows = [table.head, tuple("---" for _ in table.head), *table.rows]
        lines += ["| " + " | ".join(cell if cell == "---" else _plain(cell) for cell in row) + " |" for row in rows]
        lines.append("")
    lines += [f"- {point if point.startswith('`') else _plain(point)}" for point in section.points]
    return lines if lines[-1] else lines[:-1]


def _plain(text: str) -> str:
    """Without what Markdown or HTML would take for a mark: names in an artifact are whoever made it's."""
    return _SPECIAL.sub(r"\\\1", " ".join(text.split()))


def push(
    directory: str | os.PathLike[str],
    repository: str,
    *,
    evaluations: Sequence[str | os.PathLike[str]] = (),
    licence: str | None = None,
    private: bool = False,
    runs: int = 10,
    dry_run: bool = False,
    progress: Callable[[str], None] = lambda what: None,
) -> str:
    """Upload an artifact with a model card.

    The card has the base model and its licence, sampler, plan, sparsity, the errors of the calibration, what was
    evaluated, times of calls measured now on this machine, and the commands. Nothing else than the artifact's files
    and the card is uploaded; a repository that holds something else than an artifact is left alone.

    Args:
        directory: the artifact, or the same zipped.
        repository: ``org/name``, or the same after ``hf://``.
        evaluations: documents of ``examples/evaluation/evaluate.py --json`` with success figures of this artifact.
        licence: of a base that did not say one, as the hub writes it (``apache-2.0``).
        private: whether a repository that is made now is nobody else's to see.
        runs: counted calls of each plan for the times.

    Returns:
        ``hf://org/name@commit``; with ``dry_run`` the card.

    Raises:
        ArtifactError: there is no artifact, or it changed meanwhile.
        ReportError: an evaluation is none, or of another artifact; the licence is not the base's.
        HubError: the repository cannot be written, or holds something else.
        RuntimeUnavailableError: ``huggingface_hub`` is not installed.
    """
    repository = repository.removeprefix(HUB)
    require_repository(repository, repository)
    artifact = load_artifact(Path(directory))
    manifest = artifact.manifest
    success = [one for path in evaluations for one in read_success(Path(path), manifest.identity)]
    licence = licence_of(manifest, licence)
    progress("timing calls")
    policy = CompiledPolicy(artifact, open_runtime(artifact), seed=0)
    plans = tuple(dict.fromkeys((DENSE, manifest.default_plan)))
    text = card(artifact, repository, measure_plans(policy, artifact.manifest.spec, plans, runs), success, licence)
    if dry_run:
        return text
    progress("uploading")
    with artifact.reading():  # what is uploaded is what was checked
        return upload(artifact.files, [MANIFEST, *manifest.files], repository, text, private=private)
