"""What makes the sequence of a scene reads an embedding, and has it in the precision of the scene."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

import ttscompile
from tests.families.scenes import Rows, act, observation, policy
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.plan import DENSE, FULL, TokenReuse
from ttscompile.ir.pieces import BLOCKS, SCENE, part_of, pixels_name, tokens_name
from ttscompile.lower import precision as lowering
from ttscompile.runtimes.load import open_policy

pytestmark = pytest.mark.slow


def test_the_words_of_a_sequence_are_in_eight_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a copy without fp32 keeps the embedding in fp32: 2.1 GB of pi0's for the sake of the rows that changed."""
    monkeypatch.setattr(lowering, "LEAST_TABLE", 1)
    ttscompile.compile_denoiser(*policy(tower=Rows), tmp_path / "rows", precision="int8")
    artifact = load_artifact(tmp_path / "rows")
    views = [view_of(artifact, artifact.plan(name)) for name in (FULL, f"{DENSE}@fp32")]

    def tables(piece: str) -> list[set[tuple[str, int]]]:
        """Of each view: what the model gathers rows of, and the type of its numbers."""
        found = []
        for view in views:
            graph = onnx.load(artifact.files / view.onnx_file(piece), load_external_data=False).graph
            types = {tensor.name: tensor.data_type for tensor in graph.initializer}
            read = (node.input[0] for node in graph.node if node.op_type == "Gather" and node.input[0] in types)
            found.append({(name, types[name]) for name in read})
        return found

    eight, exact = tables(pixels_name(SCENE))
    assert {kind for _, kind in eight} == {onnx.TensorProto.INT8, onnx.TensorProto.FLOAT}, "integers and their scales"
    assert {kind for _, kind in exact} == {onnx.TensorProto.FLOAT}
    assert not eight & exact
    assert [eight, exact] == tables(SCENE), "the same rows as those of the whole scene"
    plan = artifact.plan(FULL)
    whole, some = (
        open_policy(artifact, seed=0, plan=one)
        for one in (plan, replace(plan, tokens=TokenReuse(0.0, 1000, scene=0.03)))
    )
    np.testing.assert_allclose(act(some, observation()), act(whole, observation()), rtol=0, atol=1e-5)


def test_what_patches_of_a_picture_are_cut_from_is_in_fp32() -> None:
    """Pixels are compared, and eight bits of a resized picture would differ where it does not."""
    assert part_of(pixels_name("frame_00")) is None
    assert part_of(tokens_name("frame_00")) == "frame_00"
    assert part_of(pixels_name(SCENE)) == part_of(tokens_name(SCENE)) == SCENE
    assert part_of("block_00") == BLOCKS
