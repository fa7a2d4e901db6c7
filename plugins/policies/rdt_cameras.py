"""RDT's cameras: what makes the tokens of pictures that its network reads, SigLIP, compiled in where it is there.

SigLIP is in no checkpoint of RDT. It is read from a folder of its name.

Source: ``step`` of ``scripts/agilex_model.py`` and ``SiglipVisionTower`` of thu-ml/RoboticsDiffusionTransformer at
deb71d8.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from ttscompile.core.spec import ObservationSpec
from ttscompile.errors import CheckpointError
from ttscompile.frontends.families import LoadOptions
from ttscompile.frontends.saved_weights import as_float32, filled
from ttscompile.frontends.settings import Settings, read_json

from .instruction import NAME_FOLDER, encoder_folders, find_encoder, language_model_folder
from .networks.siglip import Siglip, SiglipConfig
from .shards import read_part

SIGLIP = "google/siglip-so400m-patch14-384"
"""What makes tokens of pictures."""
_VISION = {"hidden_size": 768, "num_attention_heads": 12, "patch_size": 16}
"""What transformers takes for entries that a SigLIP's file leaves out, where ``SiglipConfig`` has others."""
_CAMERAS = ("cam_high", "cam_right_wrist", "cam_left_wrist")
"""In the order of their tokens, by the names of the original's data sets; of another number they are counted."""
_BACKGROUND = 127 / 255
"""The colour of a picture that is not there: half, in whole steps of a byte."""


@dataclass(frozen=True)
class Cameras:
    """What pictures become tokens with.

    Attributes:
        tower: pixels in -1..1 to a token for each patch.
        side: pixels of a picture's height, and of its width.
        frames: of each camera.
        names: of all cameras that the policy was trained with, in the order of their tokens.
        absent: those of them that the robot lacks.
    """

    tower: Siglip
    side: int
    frames: int
    names: tuple[str, ...]
    absent: tuple[str, ...] = ()

    @property
    def observed(self) -> dict[str, ObservationSpec]:
        """The pictures of those that are there, of this size alone: no ``fit`` pads others as the original does."""
        picture = ObservationSpec((self.frames, 3, self.side, self.side), bounds=(0.0, 1.0))
        return {name: picture for name in self.names if name not in self.absent}


class Pictures(nn.Module):
    """Pictures of 0..1 by camera, ``[B, F, 3, H, W]`` each, to adapted tokens ``[B, F * cameras * P, width]``.

    All cameras of one frame follow each other. Those that are absent show the background, whose tokens are computed
    here, once and for all.
    """

    background: Tensor | None

    def __init__(self, cameras: Cameras, adaptor: nn.Module) -> None:
        super().__init__()
        self.tower, self.adaptor, self.names = cameras.tower, adaptor, cameras.names
        picture = torch.full((1, 1, 1, 3, cameras.side, cameras.side), _BACKGROUND)
        with torch.no_grad():
            background = self._tokens(picture)[:, :, 0] if cameras.absent else None
        self.register_buffer("background", background, persistent=False)

    def forward(self, observations: Mapping[str, Tensor]) -> Tensor:
        """See the class."""
        there = [name for name in self.names if name in observations]
        tokens = self._tokens(torch.stack([observations[name] for name in there], 2))
        if self.background is None:
            return tokens.flatten(1, 3)
        seen = dict(zip(there, tokens.unbind(2), strict=True))
        absent = self.background.expand(tokens.shape[0], tokens.shape[1], -1, -1)
        return torch.stack([seen.get(name, absent) for name in self.names], 2).flatten(1, 3)

    def _tokens(self, pictures: Tensor) -> Tensor:
        """``[B, F, cameras, 3, H, W]`` -> ``[B, F, cameras, P, width]``."""
        tokens = self.adaptor(self.tower(2 * pictures.flatten(0, 2) - 1))
        return tokens.unflatten(0, (-1, *pictures.shape[1:3]))  # type: ignore[no-any-return]


def find_cameras(directory: Path, settings: Settings, tokens: tuple[int, int], options: LoadOptions) -> Cameras | None:
    """What makes tokens of pictures; None, with a warning, where it is not there and nothing asks for it.

    Args:
        directory: of the policy.
        settings: its entries.
        tokens: how many the network reads of all pictures, and the numbers of one.
        options: may name a folder, and cameras that the robot lacks.

    Raises:
        CheckpointError: it is asked for and not there, is another one, or a camera cannot be left out.
    """
    folders, without = encoder_folders(options.encoders, directory), tuple(options.without_cameras or ())
    if find_encoder(SIGLIP, folders, "siglip") is None and options.encoders is None and not without:
        warnings.warn(
            f"{directory}: the image encoder {SIGLIP} is in no checkpoint of RDT, and not on this machine, so its"
            f" tokens are observed: img_tokens {list(tokens)}. To give the policy pictures: {NAME_FOLDER}",
            stacklevel=5,
        )
        return None
    frames, count, patches = _grid(settings, tokens[0])
    names = _CAMERAS if count == len(_CAMERAS) else tuple(f"camera_{i}" for i in range(count))
    unknown = [name for name in without if name not in names]
    if unknown or len(set(without)) == count:
        told = f"the cameras are {', '.join(names)}; {', '.join(unknown) or 'all'} cannot be left out"
        raise CheckpointError(f"{directory}: {told}. A policy needs a camera that it was trained with.")
    try:
        folder = language_model_folder(SIGLIP, folders, "siglip", "image encoder")
        config = folder / "config.json"
        vision = _vision(Settings(read_json(config), f"{config}: ", f"Give {SIGLIP}."))
        if (vision.side**2, vision.hidden_size) != (patches, tokens[1]):
            found = f"{vision.side**2} tokens of {vision.hidden_size} numbers"
            raise CheckpointError(
                f"the image encoder in {folder} makes {found} of a picture; expected {patches} of"
                f" {tokens[1]}, which the policy was trained with: {SIGLIP} makes 729 of 1152."
            )
        # Its pooled output and its text encoder are not read.
        read = {name: value for name, value in read_part(folder, "vision_model.").items() if value.is_floating_point()}
        weights = {name: value for name, value in read.items() if not name.startswith("head.")}
        tower = filled(lambda: Siglip(vision), as_float32(weights, f"{folder}: "), "its config.json", folder)
    except CheckpointError as error:
        raise CheckpointError(f"{directory}: {error}") from error
    return Cameras(tower, vision.image_size, frames, names, without)


def _vision(settings: Settings) -> SiglipConfig:
    """Sizes of the image encoder, which was saved alone or beside that of text."""
    alone = settings.choice("model_type", "siglip", "siglip_vision_model") == "siglip_vision_model"
    inner = settings if alone else settings.part("vision_config")
    names = SiglipConfig.__dataclass_fields__
    try:
        return SiglipConfig(**_VISION | {name: value for name, value in inner.values.items() if name in names})
    except CheckpointError as error:
        raise CheckpointError(f"{settings.where}{error}") from error


def _grid(settings: Settings, tokens: int) -> tuple[int, int, int]:
    """Frames, cameras and patches of a picture, of which the original made the first positions of its tokens."""
    match settings.values.get("img_pos_embed_config"):
        case [["image", [int(frames), int(cameras), int(patches)]]] if (
            min(frames, cameras, -patches) > 0 and -frames * cameras * patches == tokens
        ):
            return frames, cameras, -patches
    raise settings.refusal("img_pos_embed_config", f"[['image', [frames, cameras, -patches]]], {tokens} tokens in all")
