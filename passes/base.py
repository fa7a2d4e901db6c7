"""What a pass is: a rewriting of the program with a contract that is checked every time it runs."""

from __future__ import annotations

import abc
from dataclasses import dataclass

from ttscompile.errors import PassError
from ttscompile.ir.program import Program


@dataclass(frozen=True)
class PassResult:
    """What a pass gives.

    Attributes:
        program: the new program; the argument itself if nothing changed.
        modified: whether it differs.
        notes: what was done, and every match that was declined with why and where; ``--explain`` prints them.
    """

    program: Program
    modified: bool
    notes: tuple[str, ...] = ()


class Pass(abc.ABC):
    """One rewriting. Subclasses implement ``call`` and may hold preconditions and postconditions."""

    @property
    def name(self) -> str:
        """The name that messages use."""
        return type(self).__name__

    def __call__(self, program: Program) -> PassResult:
        """Check ``requires``, rewrite, check ``ensures``.

        Raises:
            PassError: a condition does not hold; the message starts with the pass's name.
        """
        self.requires(program)
        result = self.call(program)
        if result.modified == (result.program is program):
            raise PassError(
                f"{self.name}: says modified={result.modified} and returned the "
                f"{'same' if result.program is program else 'new'} program."
            )
        self.ensures(result.program)
        return result

    @abc.abstractmethod
    def call(self, program: Program) -> PassResult:
        """Rewrite the program; never change the argument."""

    def requires(self, program: Program) -> None:  # noqa: B027  (optional hook)
        """Raise PassError if the pass cannot run on this program."""

    def ensures(self, program: Program) -> None:  # noqa: B027  (optional hook)
        """Raise PassError if the result is not what the pass promises."""

    def fail(self, what: str) -> PassError:
        """An error in the name of this pass."""
        return PassError(f"{self.name}: {what}")
