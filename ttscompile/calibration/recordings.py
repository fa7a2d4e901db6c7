"""What of the recorded episodes makes a calibration learn little: the user is warned before anything is learned."""

from collections.abc import Sequence

from ..artifact.ceiling import few_steps
from ..errors import CalibrationError
from .calls import window_of
from .judge import other_noise, other_observations
from .proposer import Row
from .targets import REPEATS
from .trials import Trials

UNHEARD = 0.9
"""Of what another observation changes, above which other noise changes suspiciously much. On Push-T it is a tenth, and
0.97 to 1 with data times 100, a hundredth of them, or random ones."""


def warn_of_recordings(trials: Trials, rows: Sequence[Row], corrects: bool) -> None:
    """Warn, before anything is learned, of what makes it learn little."""
    bar, fewest = trials.bar, trials.limits.fewest
    if (warning := few_steps(trials.runner.view.manifest)) is not None:
        bar.warn(warning)
    window = window_of(trials.episodes, trials.split)
    if any(row.consecutive for row in rows) and (short := sum(each.calls < window for each in trials.episodes)):
        bar.warn(
            f"{short} of {len(trials.episodes)} episodes have fewer than {window} calls, and are left out where"
            f" {window} consecutive ones are learned from."
        )
    warn_if_noisy(trials)
    rows_recorded = sum(trials.episodes[n].calls for n in trials.split.calibration)
    if corrects and (count := REPEATS * rows_recorded) < fewest:
        bar.warn(
            f"the recordings give {count} calls to learn from, and a correction needs {fewest}: it may do harm where"
            " nothing was recorded. Record more episodes."
        )


def require_two_calls(trials: Trials) -> None:
    """Raise CalibrationError where one call is held out: then no distance has limits, and no plan is near enough."""
    if sum(trials.episodes[number].calls for number in trials.split.validation) == 1:
        raise CalibrationError(
            "the recordings leave one call to judge plans on, of which nobody can say how far off they may be; expected"
            " two at least. Record more episodes, or longer ones: sixteen serve well."
        )


def warn_if_noisy(trials: Trials) -> None:
    """Warn where the original's answers depend on the noise about as much as on the observation."""
    noise, observed = other_noise(trials), other_observations(trials)
    if len(trials.held_out.answers) > 1 and not noise < UNHEARD * observed:  # of one there is no other
        trials.bar.warn(
            f"the original hardly heeds what was recorded: with other noise its actions change by {noise:.4g}, and with"
            f" another observation by {observed:.4g}. Look at the units of the recordings, and at the order of their"
            " columns. If these are right, the policy has learned little from what it observes: train it longer."
        )
