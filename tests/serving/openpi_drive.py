"""Drive a server with the published client of openpi, in the environment that has it; see ``test_openpi_client.py``.

    build/openpi-venv/bin/python tests/serving/openpi_drive.py ws://127.0.0.1:8765/ [TOKEN]

Prints one JSON document.
"""

from __future__ import annotations

import json
import sys

import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy


def main() -> None:
    """Two answers, an error, and one more answer."""
    url, *token = sys.argv[1:]
    policy = WebsocketClientPolicy(host=url, api_key=token[0] if token else None)
    obs = {"obs": np.array([1.0, 2.0], np.float32)}
    answers = [policy.infer(obs), policy.infer(obs)]
    told = ""
    try:
        policy.infer({"obs": np.array([1.0, np.nan], np.float32), "step": np.float32(1)})
    except RuntimeError as error:
        told = str(error)
    answers.append(policy.infer(obs))
    actions = [answer["actions"] for answer in answers]
    print(
        json.dumps(
            {
                "metadata": policy.get_server_metadata(),
                "actions": [each.tolist() for each in actions],
                "dtypes": sorted({str(each.dtype) for each in actions}),
                "infer_ms": [answer["server_timing"]["infer_ms"] for answer in answers],
                "error": told,
            }
        )
    )


if __name__ == "__main__":
    main()
