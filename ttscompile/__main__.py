"""The script ``ttscompile``, and ``python -m ttscompile`` where that is not on the path."""

import gc
import sys


def main(prog_name: str | None = None) -> None:
    """Run the command line; interrupted while it is being imported, which takes a moment, it ends as it would later."""
    # A compiler's objects stay. To look among them for garbage after each 700 took a tenth of a conversion.
    gc.set_threshold(50_000, 20, 100)
    try:
        from ttscompile.cli import main as commands
    except KeyboardInterrupt:
        sys.exit(130)
    except (MemoryError, ImportError, SystemError, OSError) as error:  # SystemError: Python's own, without memory
        told = " ".join(str(error).split())  # numpy's own have ten lines
        sys.stderr.write(f"ttscompile cannot be loaded: {type(error).__name__}: {told:.200}. Is there memory for it?\n")
        sys.exit(2)
    commands(prog_name=prog_name)


if __name__ == "__main__":
    main("python -m ttscompile")
