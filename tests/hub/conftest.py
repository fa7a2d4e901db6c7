import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.once import Once
from tests.runtimes.toys import toy_program, written_artifact

from .served import Hub, serving


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Hub]:
    """A hub of the test's own, and an empty cache, as if ``HF_ENDPOINT`` and ``HF_HOME`` had said so."""
    if importlib.util.find_spec("huggingface_hub") is None:
        pytest.skip("NO HUB TESTS: huggingface_hub is not installed; pip install 'ttscompile[hub]'")
    from huggingface_hub import constants

    with serving() as made:
        template = made.url + "/{repo_id}/resolve/{revision}/{filename}"
        for name, value in (
            ("ENDPOINT", made.url),
            ("HUGGINGFACE_CO_URL_TEMPLATE", template),
            ("HF_HUB_CACHE", str(tmp_path / "cache")),
            ("HF_HUB_DISABLE_XET", True),
            ("HF_HUB_OFFLINE", False),
        ):
            old = getattr(constants, name)
            for module in [m for key, m in sys.modules.items() if key.startswith("huggingface_hub") and m is not None]:
                if getattr(module, name, None) == old:
                    monkeypatch.setattr(module, name, value)
        yield made


@pytest.fixture(scope="session")
def toy_artifact(once: Once) -> Path:
    """A small artifact that was not calibrated."""
    return once.folder("toy", lambda directory: written_artifact(toy_program(), directory))


@pytest.fixture
def toy_files(toy_artifact: Path) -> dict[str, bytes]:
    """Its files by name."""
    return {each.name: each.read_bytes() for each in toy_artifact.iterdir()}
