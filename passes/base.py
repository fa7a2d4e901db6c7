"""What a pass is: a rewriting of the program with a contract that is checked every time it runs."""

import abc
from dataclasses import dataclass
from typing import Generic, TypeVar, get_type_hints

from ttscompile.errors import PassError
from ttscompile.ir.program import Phase

Before = TypeVar("Before", bound=Phase)
After = TypeVar("After", bound=Phase)


@dataclass(frozen=True)
class PassResult(Generic[After]):
    """What a pass gives.

    Attributes:
        program: the new program; the argument itself if nothing changed.
        notes: what was done, and every match that was declined with why and where; ``--explain`` prints them.
    """

    program: After
    notes: tuple[str, ...] = ()


class Pass(abc.ABC, Generic[Before, After]):
    """One rewriting, from one phase of the program (``ir.program``) to the same or another.

    Subclasses implement ``call``, whose signature says what they take, and may hold a postcondition.
    """

    @property
    def name(self) -> str:
        """The name that messages use."""
        return type(self).__name__

    def __call__(self, program: Before) -> PassResult[After]:
        """Rewrite, and check ``ensures``.

        Raises:
            PassError: the program is in another phase, or a condition does not hold; the message starts with the
                pass's name.
        """
        takes = get_type_hints(type(self).call)["program"]
        takes = getattr(takes, "__bound__", takes)
        if not isinstance(program, takes):
            raise self.fail(f"takes a program that is {takes.__name__}; found {type(program).__name__}.")
        result = self.call(program)
        self.ensures(result.program)
        return result

    @abc.abstractmethod
    def call(self, program: Before) -> PassResult[After]:
        """Rewrite the program; never change the argument."""

    def ensures(self, program: After) -> None:
        """Raise PassError if the result is not what the pass promises."""

    def fail(self, what: str) -> PassError:
        """An error in the name of this pass."""
        return PassError(f"{self.name}: {what}")
