"""Figures of a server in the text format that Prometheus reads (version 0.0.4)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ttscompile.runtimes.executor.statistics import COUNTS, ExecutorStatistics, Summary

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

_ESCAPED = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n"})


@dataclass(frozen=True)
class Metric:
    """One figure, with a sample for each set of labels.

    Attributes:
        name: after ``ttscompile_``; of a counter it ends with ``_total``.
        kind: ``counter``, ``gauge`` or ``histogram``.
        samples: labels and value; of a histogram those of its buckets, the last of which has all.
    """

    name: str
    kind: str
    help: str
    samples: Sequence[tuple[Mapping[str, str], float]]
    sum: float | None = None


def exposition(metrics: Sequence[Metric]) -> str:
    """The text of figures."""
    lines = list[str]()
    for each in metrics:
        name = f"ttscompile_{each.name}"
        lines += [f"# HELP {name} {each.help}", f"# TYPE {name} {each.kind}"]
        of_samples = name if each.sum is None else f"{name}_bucket"
        for labels, value in each.samples:
            inside = ",".join(f'{key}="{text.translate(_ESCAPED)}"' for key, text in labels.items())
            lines.append(f"{of_samples}{{{inside}}} {value!r}" if inside else f"{of_samples} {value!r}")
        if each.sum is not None:
            lines += [f"{name}_sum {each.sum!r}", f"{name}_count {each.samples[-1][1]!r}"]
    return "\n".join(lines) + "\n"


def of_statistics(statistics: ExecutorStatistics) -> list[Metric]:
    """What an executor did so far: its counts, and percentiles of what it measured."""
    labels = {"plan": statistics.plan, "identity": statistics.identity}
    found = [Metric("plan_info", "gauge", "The plan that the next call runs, and the artifact.", [(labels, 1)])]
    for name in COUNTS:
        found.append(
            Metric(f"{name}_total", "counter", f"See {name} in ExecutorStatistics.", [({}, getattr(statistics, name))])
        )
    for name, value in vars(statistics).items():
        if isinstance(value, Summary):
            samples = [({"quantile": each}, getattr(value, f"p{each[2:]:0<2}")) for each in ("0.5", "0.95", "0.99")]
            what = f"Percentiles of the last measurements; see {name} in ExecutorStatistics."
            found.append(Metric(name, "gauge", what, samples))
    return found
