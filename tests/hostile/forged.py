"""Artifacts and states of somebody who knows the format: what was changed has hashes that are right again."""

import hashlib
import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.hostile.mutate import changed, damaged
from tests.hostile.onnx_changes import changed_model
from ttscompile.errors import TtscompileError

MOST_OBSERVED = 2**22
"""Numbers in an observation that the fuzzer makes; a policy that wants more is a large one, and legal."""


def artifact(rng: random.Random, path: Path) -> Callable[[], None]:
    """Forge an artifact's directory; then load it, and call the policy twice."""
    kind, runtime = rng.random(), "onnxruntime"
    document = json.loads((path / "manifest.json").read_text())
    if kind < 0.45:
        document = changed(rng, document)
        runtime = rng.choice(("onnxruntime", "onnxruntime", "reference"))
    elif kind < 0.55:
        _change_json(rng, path / "program.json")
        runtime = "reference"
    elif kind < 0.75:
        victim = rng.choice(sorted(path.glob("*.safetensors")))
        victim.write_bytes(changed_tensors(rng, victim.read_bytes()))
        runtime = rng.choice(("onnxruntime", "reference"))
    else:
        victim = rng.choice(sorted(path.glob("*.onnx")))
        victim.write_bytes(changed_model(rng, victim.read_bytes()))
    rehash(path, document)
    return lambda: use(path, runtime)


def forge(path: Path, change: Callable[[dict[str, Any]], object] = lambda document: None) -> None:
    """Change the manifest; its hashes are right afterwards."""
    document = json.loads((path / "manifest.json").read_text())
    change(document)
    rehash(path, document)


def rehash(path: Path, document: Any) -> None:
    """Write a manifest whose sizes, hashes, identities and checksum are right, as far as it can be read."""
    from ttscompile.artifact.codec import from_json, identities
    from ttscompile.artifact.strict_json import Value, dump_compact

    if isinstance(document, dict):
        files = document.get("files")
        for name, record in files.items() if isinstance(files, dict) else ():
            if name in {each.name for each in path.iterdir()} and isinstance(record, dict):
                content = (path / name).read_bytes()
                record.update(sha256=hashlib.sha256(content).hexdigest(), bytes=len(content))
        document.pop("checksum", None)
        try:
            document["identity"], document["model_identity"] = identities(from_json(Value(document, "forged")))
        except (TtscompileError, AssertionError):
            pass
        except Exception:  # the loader meets it too, and is what is tested
            pass
        try:
            document["checksum"] = hashlib.sha256(dump_compact(document)).hexdigest()
        except ValueError:
            document["checksum"] = "0" * 64
    (path / "manifest.json").write_text(json.dumps(document))


def use(path: Path, runtime: str = "onnxruntime") -> None:
    """What a user does with an artifact."""
    import ttscompile

    policy = ttscompile.load(path, runtime=runtime, seed=0)
    observation = policy.info.observation
    if sum(int(np.prod(spec.shape, dtype=object)) for spec in observation.values()) > MOST_OBSERVED:
        return
    obs = {key: np.zeros((1, *spec.shape), spec.dtype) for key, spec in observation.items()}
    for _ in range(2):
        action = policy.predict_action(obs)["action"]
        assert action.shape == (1, policy.info.action.stop - policy.info.action.start, policy.info.action.action_dim)
    policy.reset()


def changed_tensors(rng: random.Random, content: bytes) -> bytes:
    """A safetensors file with another header, or other data."""
    length = int.from_bytes(content[:8], "little")
    header, data = content[8 : 8 + length], content[8 + length :]
    kind = rng.randrange(5)
    if kind <= 2:
        header = json.dumps(changed(rng, json.loads(header))).encode()
    elif kind == 3:
        header = damaged(rng, header)
    else:
        values = np.frombuffer(data[: len(data) // 4 * 4], np.float32).copy()
        values[rng.randrange(len(values)) :] = rng.choice((np.nan, np.inf, -np.inf, 3e38, 0.0, 1e-45))
        data = values.tobytes() + data[len(data) // 4 * 4 :]
    header += b" " * (-len(header) % 8)
    size = rng.choice((0, 7, 2**31, 2**63, 2**64 - 1)) if rng.random() < 0.05 else len(header)
    return size.to_bytes(8, "little") + header + data


def state(rng: random.Random, content: bytes) -> bytes:
    """A calibration's state: another header, or other JSON inside with the right length."""
    from safetensors.numpy import load, save

    from ttscompile.calibration.state import _checksum

    if rng.random() < 0.5:
        return changed_tensors(rng, content)
    arrays = load(content)
    for name in [name for name in arrays if name.startswith("json/")]:
        if rng.random() < 0.6:
            try:
                text = json.dumps(changed(rng, json.loads(arrays[name].tobytes()))).encode()
            except ValueError:
                continue
            text = damaged(rng, text) if rng.random() < 0.2 else text
            arrays[name] = np.frombuffer(text or b" ", np.uint8)
    arrays.pop("sha256")
    arrays["sha256"] = np.frombuffer(_checksum(arrays), np.uint8)
    return bytes(save(arrays))


def _change_json(rng: random.Random, path: Path) -> None:
    path.write_text(json.dumps(changed(rng, json.loads(path.read_text()))))
