"""``python -m ttscompile.doctor [TARGET]``."""

from __future__ import annotations

import sys

from .diagnosis import main

sys.exit(main(sys.argv[1:]))
