"""The command ``ttscompile``: one file a command, and ``commands`` with all of them.

Results go to standard output, as a table or with ``--json`` as one JSON document and nothing else; progress and
warnings go to standard error. ``ending`` has the exit statuses.
"""

import click


def __getattr__(name: str) -> click.Group:
    """``main``. Not made before it is asked for: a command that is attached needs what is here, and is made first."""
    if name != "main":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from ttscompile.cli.commands import main

    return main
