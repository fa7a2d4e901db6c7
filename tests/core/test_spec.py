"""What a policy observes: names that can be, and what an instruction needs of them."""

from dataclasses import replace

import numpy as np
import pytest

from ttscompile.core.spec import ChunkSpec, Instruction, ObservationSpec, PolicySpec
from ttscompile.core.tokenizer import StateInWords
from ttscompile.errors import SpecError
from ttscompile.samplers.flow import flow_matching_table


def policy(*keys: str, instruction: Instruction | None = None) -> PolicySpec:
    seen = {key: ObservationSpec((1, 2)) for key in keys}
    return PolicySpec((4, 2), seen, flow_matching_table(1), ChunkSpec(2, 0, 4), instruction=instruction)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (("images.a.b", "images.a_b"), "'images.a_b' is the argument 'images_a_b', and so is 'images.a.b'. Rename it"),
        (("sample",), "'sample' is the argument 'sample', and so is an input of the loop. Rename it"),
        (("a..b",), "'a..b': expected letters, digits and _, with single"),
    ],
)
def test_every_observation_has_an_argument_of_its_own(keys: tuple[str, ...], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        policy(*keys)


def test_what_an_instruction_is_made_of_is_observed() -> None:
    told = Instruction("tokens", "mask", False, state=StateInWords("state", (0.0,), (1.0,), ranged=True))
    with pytest.raises(SpecError, match=r"the instruction's keys \['mask', 'state'\] must be observations"):
        policy("tokens", instruction=told)
    two = replace(told, state=StateInWords("state", (0.0, 1.0), (1.0, 2.0), ranged=True))
    assert policy("tokens", "mask", "state", instruction=two).instruction == two
    for wrong in (
        told.state,
        StateInWords("state", (0.0, 1.0), (1.0,), True),
        StateInWords("state", (0, 1), (1, 0), True),
    ):
        with pytest.raises(SpecError, match="the state in the instruction must have as many numbers as widths"):
            policy("tokens", "mask", "state", instruction=replace(told, state=wrong))


def test_a_state_in_words_says_in_which_of_256_parts_it_is() -> None:
    """The ends of a range are edges: the upper one is in the last part, and what is outside is told, too."""
    state = StateInWords("state", first=(-1.0,) * 5, width=(2.0,) * 5, ranged=True)
    assert state(np.array([-1, 1, 0, -1.01, 9], np.float32)) == "0 255 128 -1 255"


def test_one_name_is_no_tuple_of_names() -> None:
    with pytest.raises(SpecError, match="recorded is a tuple of names of arrays; found 'keypoint'"):
        ObservationSpec((2, 8), recorded="keypoint")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("spec", "numbers"),
    [
        (ObservationSpec((4,), window=False), True),
        (ObservationSpec((2, 4)), True),
        (ObservationSpec((7, 4), window=False), False),
        (ObservationSpec((2, 3, 8, 8)), False),
        (ObservationSpec((9,), dtype="int64", window=False), False),
        (ObservationSpec((9,), dtype="bool", window=False), False),
    ],
    ids=["state", "window of states", "tokens of another model", "pictures", "words", "which words count"],
)
def test_rows_of_numbers_are_told_from_pictures_and_words(spec: ObservationSpec, numbers: bool) -> None:
    assert spec.numbers is numbers
