"""Policies and artifacts in repositories of the Hugging Face hub, by the library ``huggingface_hub``.

Its cache keeps what was downloaded and serves it without a network; its login and its environment variables
(``HF_TOKEN``, ``HF_HOME``, ``HF_ENDPOINT``, ``HF_HUB_OFFLINE``) hold. Without the library there is a
``RuntimeUnavailableError``.
"""

from .repository import Fetched, fetch_artifact, fetch_checkpoint, fetch_recording, upload

__all__ = ["Fetched", "fetch_artifact", "fetch_checkpoint", "fetch_recording", "upload"]
