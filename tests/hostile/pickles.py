"""Checkpoints and recordings that lie: pickles that would run code, sizes that are not so, bombs."""

import io
import json
import os
import pickle
import random
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.hostile.archives import write_hostile
from tests.hostile.mutate import NUMBERS, TEXTS, anything, damaged

CANARY = "canary"


class Runs:
    """Unpickling this would make a folder, which the guard sees."""

    def __init__(self, function: Callable[..., Any] = os.mkdir, argument: str = f"/dev/shm/{CANARY}") -> None:
        self.call = function, (argument,)

    def __reduce__(self) -> tuple[Any, ...]:
        return self.call


_GLOBALS = (
    b"cposix\nsystem\n",
    b"cbuiltins\neval\n",
    b"cbuiltins\ngetattr\n",
    b"cdill._dill\n_load_type\n",
    b"comegaconf.dictconfig\nDictConfig\n",
    b"ctyping\nAny\n",
    b"ccollections\nOrderedDict\n",
    b"ctorch._utils\n_rebuild_tensor_v2\n",
    b"ctorch._utils\n_rebuild_parameter\n",
    b"ctorch\nFloatStorage\n",
    b"ctorch.storage\nUntypedStorage\n",
    b"ctorch\nSize\n",
    b"c__builtin__\nbytearray\n",
    b"ccollections\ndefaultdict\n",
)
_OPCODES = (
    *(bytes([code]) for code in b"().0120]}NaeusRQtqbo\x81\x85\x86\x87\x88\x89\x8f\x90\x91\x94"),
    b"K\xff",
    b"J\xff\xff\xff\x7f",
    b"\x8a\x09" + b"\xff" * 8 + b"\x00",
    b"\x8b\xff\xff\xff\x7f",
    b"X\xff\xff\xff\x7f",
    b"X\x04\x00\x00\x00eval",
    b"\x8d" + b"\xff" * 8,
    b"r\xff\xff\xff\xff",
    b"q\x00",
    b"h\x00",
    b"h\x05",
    b"j\xff\xff\xff\x7f",
    b"I1000000000000000000000000000000\n",
    b"F1e999\n",
    b"B\xff\xff\xff\xff",
    b"\x8e" + b"\xff" * 8,
    b"\x95" + b"\xff" * 8,
    b"\x82\x01",
    b"U\xff",
    *_GLOBALS,
)


def write(rng: random.Random, corpus: Path, target: Path) -> None:
    """A checkpoint with something wrong."""
    golden = corpus / "golden.ckpt"
    own = [path for path in sorted(corpus.iterdir()) if path != golden]
    source = golden if golden.exists() and rng.random() < 0.1 else rng.choice(own)
    kind = rng.random()
    if kind < 0.25:
        target.write_bytes(damaged(rng, source.read_bytes()))
    elif kind < 0.55:
        entries = _entries(source)
        name = next(name for name in entries if name.endswith("data.pkl"))
        entries[name] = _changed_pickle(rng, entries[name])
        _store(target, entries)
    elif kind < 0.65:
        write_hostile(target, _entries(source), rng)
    else:
        _changed_payload(rng, own, target)


def _entries(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _store(path: Path, entries: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)


def _changed_pickle(rng: random.Random, content: bytes) -> bytes:
    kind = rng.randrange(4)
    if kind == 0:
        return damaged(rng, content)
    if kind == 1:
        return b"\x80\x02" + b"".join(rng.choices(_OPCODES, k=rng.randrange(1, 30))) + b"."
    if kind == 2:
        # Lists that hold the list before twice: small here, and 2^60 items for whoever walks through them.
        return b"\x80\x02]" + b"".join(b"q%c](h%ch%ce" % (i, i, i) for i in range(60)) + b"."
    place = rng.randrange(2, len(content))
    return content[:place] + b"".join(rng.choices(_OPCODES, k=rng.randrange(1, 4))) + content[place:]


def _changed_payload(rng: random.Random, sources: list[Path], target: Path) -> None:
    """Another configuration, other weights: all saved as torch saves them."""
    import torch

    payload = torch.load(rng.choice(sources), weights_only=True)
    config, weights = payload["cfg"], payload["state_dicts"]["ema_model"]
    kind = rng.randrange(6)
    if kind <= 2:
        for _ in range(rng.choice((1, 1, 2))):
            policy = config["policy"]
            parts = [part for part in (policy, policy.get("model"), policy.get("noise_scheduler")) if _is_part(part)]
            part = rng.choice(parts)
            part[rng.choice(list(part))] = _value(rng)
    elif kind == 3:
        name = rng.choice(list(weights))
        weights[name] = _tensor(rng, weights[name])
    elif kind == 4:
        part = rng.choice((payload, payload["state_dicts"], weights, config))
        part[rng.choice((*part, *TEXTS))] = rng.choice((anything(rng), Runs(), Runs(eval, "1"), {"a": {1, 2}}, b"x"))
    else:
        for name in list(weights):
            if rng.random() < 0.1:
                del weights[name]
    torch.save(payload, target)


def _is_part(value: Any) -> bool:
    return isinstance(value, dict) and bool(value)


def _value(rng: random.Random) -> Any:
    texts = (
        "${policy.model.n_emb}",
        "${eval:'2**99'}",
        "${eval:'1e15*1e15'}",
        "${eval:'" + "(" * 900 + "'}",
        "${",
        "???",
    )
    references = ("${policy.horizon}", "${policy}", "${policy.model}${policy.model}", "${eval:'-" + "-" * 900 + "1'}")
    return rng.choice((rng.choice(NUMBERS), rng.choice((10**5, 10**6, 10**9)), *texts, *references, anything(rng)))


def _tensor(rng: random.Random, tensor: Any) -> Any:
    import torch

    return rng.choice(
        (
            lambda: tensor * float("nan"),
            lambda: torch.zeros_like(tensor),
            lambda: torch.zeros(1).expand(2**31),
            lambda: torch.zeros(1).expand(*tensor.shape) if tensor.ndim else tensor,
            lambda: tensor.to(torch.complex64),
            lambda: tensor.to_sparse() if tensor.numel() else tensor,
            lambda: tensor.to("meta"),
            lambda: tensor.to(torch.float64) * 1e300,
            lambda: tensor[..., None],
            lambda: torch.nn.Parameter(tensor),
            lambda: tensor.to(torch.bfloat16),
            lambda: torch.quantize_per_tensor(tensor.flatten(), 0.1, 0, torch.qint8),
            lambda: torch.zeros(0, 2**40),
        )
    )()


def write_npz(rng: random.Random, corpus: Path, target: Path) -> None:
    """A recording with something wrong."""
    source = rng.choice(sorted(corpus.iterdir()))
    kind = rng.random()
    if kind < 0.2:
        target.write_bytes(damaged(rng, source.read_bytes()))
        return
    entries = _entries(source)
    name = rng.choice(list(entries))
    if kind < 0.35:
        write_hostile(target, entries, rng)
        return
    if kind < 0.6:
        entries[name] = _npy(rng, entries[name])
    elif kind < 0.65:
        entries[name] = damaged(rng, entries[name])
    elif kind < 0.7:
        entries[name] = entries[name][:128] + bytes(rng.choice((2**20, 2**26)))
        _store(target, entries, zipfile.ZIP_DEFLATED)
        return
    elif kind < 0.72:
        target.write_bytes(rng.choice((entries[name], pickle.dumps(Runs()), b"\x93NUMPY", b"")))
        return
    else:
        entries[name] = _saved(_array(rng))
    _store(target, entries)


def _saved(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def _npy(rng: random.Random, content: bytes) -> bytes:
    """An array's file with another header in front of the same data."""
    length = struct.unpack("<H", content[8:10])[0]
    sizes = (0, 1, 9, 2**31, 2**40, 2**62, 2**63, 2**64, -1, 10**30)
    shapes = (
        "()",
        "(2**9,)",
        "[3]",
        "3",
        "('a',)",
        "(1.5,)",
        "(True,)",
        str(tuple(rng.choices(sizes, k=rng.randrange(5)))),
    )
    dtypes = (
        "'|O'",
        "'<f4'",
        "'<U1000000000'",
        "'|V0'",
        "[('a','<f4'),('b','|O')]",
        "'(1000,1000,1000)f4'",
        "'<M8[s]'",
        "7",
    )
    descr = rng.choice((*dtypes, "'<f4'", "'<f4'"))
    order = rng.choice(("False", "True", "0", "__import__('os').system('id')"))
    shape = rng.choice((*shapes, shapes[-1], shapes[-1]))
    header = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}"
    if rng.random() < 0.1:
        header = rng.choice(("(" * 9000, "{" * 200, "-" * 9000 + "1", "[" * 99 + "]" * 99, "1" * 20000, ""))
    encoded = header.encode() + b"\n"
    return content[:8] + struct.pack("<H", len(encoded) % 65536) + encoded + content[10 + length :]


def _array(rng: random.Random) -> Any:
    shape = rng.choice(((), (0,), (9,), (9, 2), (9, 3), (0, 2), (9, 2, 0), (1, 1, 1, 1), (9, 0)))
    kind = rng.randrange(8)
    if kind == 0:
        return np.array([Runs()] * 9, dtype=object)
    if kind == 1:
        return np.full(shape, rng.choice((np.nan, np.inf, 1e300, -1)))
    if kind == 2:
        return np.full(shape, rng.choice((0, 1, 100)), rng.choice((np.int64, np.uint64, np.int8)))
    if kind == 3:
        return np.array(rng.choice((json.dumps(anything(rng)), "{" * 500, "[" * 100_000, *TEXTS[:-1])))
    if kind == 4:
        return np.array([rng.randrange(-2, 12) for _ in range(rng.randrange(5))], np.int64)
    if kind == 5:
        return np.zeros(shape, rng.choice(("S3", "M8[s]", "c8", "?", "f2", [("a", "f4")])))
    if kind == 6:
        return np.array([4, 9], rng.choice((np.uint8, np.uint64, np.float32, object)))
    return np.ones(shape, np.float32)
