"""The weights of ``large.py --groot`` under the names of NVIDIA's release, which vla.cpp's converter reads.

    python examples/benchmark/released_groot.py DIR
    python convert_gr00t_n1_7_to_gguf.py --ckpt DIR/GR00T-N1.7-3B --out groot.gguf

``DIR`` is what ``large.py`` leaves. The base model's folder in it gets a copy of the weights: the same bytes, behind a
header with other names.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import click
from large_groot import BASE

_OWN = "_groot_model."
_TIED = {"backbone.model.lm_head.weight": "backbone.model.model.language_model.embed_tokens.weight"}
"""A release has the embedding of words, and lerobot the head that is tied to it."""
_SIZE = 8
"""Bytes of the length of the header, which is before it."""


def renamed(header: bytes) -> bytes:
    """A safetensors header with the names of the release, as long as it was."""
    entries = {name.removeprefix(_OWN): entry for name, entry in json.loads(header).items()}
    made = json.dumps({_TIED.get(name, name): entry for name, entry in entries.items()}).encode()
    assert len(made) <= len(header), "the names of a release are shorter"
    return made.ljust(len(header))


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(folder: Path) -> None:
    """Write the weights of FOLDER/groot into the folder of its base model."""
    path = folder / BASE / "model.safetensors"
    shutil.copyfile(folder / "groot" / path.name, path)
    with path.open("r+b") as file:
        header = renamed(file.read(int.from_bytes(file.read(_SIZE), "little")))
        file.seek(_SIZE)
        file.write(header)
    index = {"weight_map": dict.fromkeys(json.loads(header), path.name)}
    path.with_name(f"{path.name}.index.json").write_text(json.dumps(index), encoding="utf-8")


if __name__ == "__main__":
    main()
