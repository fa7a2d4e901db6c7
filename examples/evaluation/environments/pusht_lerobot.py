"""Push-T from keypoints, under the name that LeRobot's policies know: ``observation.state`` ``[20]``."""

from __future__ import annotations

from . import Frame
from .pusht import PushT, observation


class PushTLeRobot(PushT):
    """See ``PushT``."""

    def observe(self) -> Frame:
        """``observation.state``, float32 ``[20]``."""
        return {"observation.state": observation(self.state)}


ENVIRONMENT = PushTLeRobot
