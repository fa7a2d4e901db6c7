"""The artifact: what ``convert`` writes and the robot loads. ``docs/design.md`` section 5.

``load`` and ``manifest`` need numpy alone; ``write`` needs onnx, which it imports when it is called. What
does not fit is an ``ArtifactError`` of any function of this room; it says where, what was expected and what was found.
"""

from .load import Artifact, load_artifact
from .manifest import Manifest

__all__ = ["Artifact", "Manifest", "load_artifact"]
