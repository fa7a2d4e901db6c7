"""Several threads: all blocks in one session, the same results, and nothing running between calls."""

import time

import numpy as np
import onnxruntime
import pytest

from tests.rounding import bound
from ttscompile.artifact import Artifact
from ttscompile.artifact.view import view_of
from ttscompile.ir.pieces import DENSE_STEP, JOINT
from ttscompile.runtimes import open_runtime
from ttscompile.runtimes.onnxruntime.sessions import FIRST_STEP, SINGLE_THREADED, JointBlock, Sessions

from .agreement import call_terms, largest_difference
from .conftest import MakeArtifact
from .toys import toy_program


@pytest.mark.parametrize("sequence_first", [False, True])
def test_threads_give_the_same_as_the_reference(make_artifact: MakeArtifact, sequence_first: bool) -> None:
    artifact = make_artifact(toy_program(blocks=7, pruner=False, sequence_first=sequence_first))
    runtimes = open_runtime(artifact, "onnxruntime", threads=2), open_runtime(artifact, "reference")
    rng = np.random.default_rng(0)
    for streams in (1, 3, 2):  # the zeros that stand in for other blocks' contexts follow the number of streams
        assert largest_difference(artifact, *runtimes, rng, streams, calls=4) < bound(call_terms(artifact))


def test_one_thread_has_a_session_a_block_and_more_have_one_for_all(toy_artifact: Artifact) -> None:
    blocks = [f"block_{b:02d}" for b in range(len(toy_artifact.manifest.blocks))]
    alone, together = (Sessions(threads).of(view_of(toy_artifact)) for threads in (1, 2))
    assert alone.keys() == together.keys() == {*toy_artifact.manifest.pieces, FIRST_STEP} - {JOINT}
    assert all(sessions[FIRST_STEP] is sessions[DENSE_STEP] for sessions in (alone, together))
    assert not any(isinstance(session, JointBlock) for session in alone.values())
    joint = [together[name] for name in blocks]
    assert all(isinstance(block, JointBlock) and block.session is joint[0].session for block in joint)
    for name in SINGLE_THREADED & alone.keys():
        assert alone[name].get_session_options().intra_op_num_threads == 1


@pytest.mark.parametrize(("version", "found"), [("1.25.1", ("", "0")), ("1.26.0", ("50", "")), ("1.31.1", ("50", ""))])
def test_a_version_that_knows_no_time_does_not_look_for_work(
    toy_artifact: Artifact, monkeypatch: pytest.MonkeyPatch, version: str, found: tuple[str, str]
) -> None:
    monkeypatch.setattr(onnxruntime, "__version__", version)
    options = Sessions(2).of(view_of(toy_artifact))[DENSE_STEP].get_session_options()
    names = "session.intra_op.spin_duration_us", "session.intra_op.allow_spinning"
    told = []
    for name in names:
        try:
            told.append(options.get_session_config_entry(name))
        except RuntimeError:  # there is none
            told.append("")
    assert tuple(told) == found


def test_threads_sleep_between_calls(toy_artifact: Artifact) -> None:
    runtime = open_runtime(toy_artifact, "onnxruntime", threads=4)
    other = open_runtime(toy_artifact, "reference")
    found = largest_difference(toy_artifact, runtime, other, np.random.default_rng(0), streams=1, calls=2)
    assert found < bound(call_terms(toy_artifact))
    time.sleep(0.05)
    before = time.process_time()
    time.sleep(0.5)
    assert time.process_time() - before < 0.05  # three threads that spun would have taken 1.5 s
