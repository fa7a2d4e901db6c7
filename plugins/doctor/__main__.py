"""``python -m ttscompile.doctor [TARGET]``."""

import sys

from .diagnosis import main

sys.exit(main(sys.argv[1:]))
