"""What onnxruntime does not open, and what helps."""

import pytest

from ttscompile.artifact import Artifact
from ttscompile.errors import ArtifactError
from ttscompile.runtimes.load import load


def test_weights_that_are_a_link_out_of_the_folder(own_artifact: Artifact, monkeypatch: pytest.MonkeyPatch) -> None:
    """onnxruntime refuses that from 1.24 on; what helps is another thing than for a graph that it cannot read."""
    import onnxruntime

    told = "External data path validation failed: External data path escapes model directory."

    def refuse(*_: object, **__: object) -> None:
        raise ValueError(told)

    monkeypatch.setattr(onnxruntime, "InferenceSession", refuse)
    with pytest.raises(ArtifactError, match=r"leads out of the artifact's folder\. Put the file there: cp -L\.$"):
        load(own_artifact.path)
    told = "no such operation"
    with pytest.raises(ArtifactError, match="cannot load this graph: no such operation"):
        load(own_artifact.path)
