"""Images of any size are resized as torch, openpi, Pillow and torchvision do it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn import functional

from ttscompile import ObservationSpec
from ttscompile.core.values import fitted
from ttscompile.errors import ObservationError, SpecError, TrajectoryError
from ttscompile.runtimes.arrays import check_observation, read_observation
from ttscompile.trajectories import load_trajectories


@pytest.mark.parametrize("size", [(30, 50), (50, 30), (7, 9), (16, 16), (1, 40)])
@pytest.mark.parametrize("fit", ["start", "centre"])
def test_it_is_torchs_bilinear_with_a_black_rest(size: tuple[int, int], fit: str) -> None:
    spec = ObservationSpec((1, 3, 20, 24), bounds=(0.0, 1.0), fit=fit)  # type: ignore[arg-type]
    image = np.random.RandomState(0).uniform(0, 1, (2, 1, 3, *size)).astype(np.float32)
    ratio = max(size[1] / 24, size[0] / 20)
    small = max(int(size[0] / ratio), 1), max(int(size[1] / ratio), 1)
    resized = functional.interpolate(torch.from_numpy(image[:, 0]), small, mode="bilinear", align_corners=False)
    up, left = 20 - small[0], 24 - small[1]
    before = (left, up) if fit == "start" else (left // 2, up // 2)
    expected = functional.pad(resized, (before[0], left - before[0], before[1], up - before[1]))[:, None]
    np.testing.assert_allclose(fitted(image, spec), expected.numpy(), atol=1e-5)


@pytest.mark.parametrize("size", [(30, 50), (40, 48), (3, 40), (480, 640), (11, 13), (20, 7)])
def test_in_bytes_it_is_pillows_bilinear_filter(size: tuple[int, int]) -> None:
    """To the bit, as openpi's client resizes what a camera gives; halves, of which (40, 48) has many, go up.

    Of these sizes Pillow 13 begins with the columns, too, as those before it do with any; openpi's is 11.
    """
    spec = ObservationSpec((1, 3, 20, 24), bounds=(0.0, 1.0), fit="bytes")
    image = np.random.RandomState(0).randint(0, 256, (*size, 3), np.uint8)
    ratio = max(size[1] / 24, size[0] / 20)
    small = max(int(size[0] / ratio), 1), max(int(size[1] / ratio), 1)
    resized = Image.fromarray(image).resize((small[1], small[0]), Image.Resampling.BILINEAR)
    whole = Image.new("RGB", (24, 20))
    whole.paste(resized, ((24 - small[1]) // 2, (20 - small[0]) // 2))
    found = fitted(np.moveaxis(image, -1, 0)[None, None] / np.float32(255), spec)
    np.testing.assert_array_equal(np.rint(found[0, 0] * 255), np.moveaxis(np.asarray(whole), -1, 0))


def test_the_rest_has_a_colour() -> None:
    spec = ObservationSpec((1, 3, 20, 24), bounds=(0.0, 1.0), fit="start", fill=(0.5, 0.25, 0.125))
    image = np.random.RandomState(0).uniform(0, 1, (2, 1, 3, 10, 24)).astype(np.float32)
    found = fitted(image, spec)
    np.testing.assert_array_equal(found[..., 10:, :], image)
    assert [set(found[:, :, c, :10].flat) for c in range(3)] == [{0.5}, {0.25}, {0.125}]


@pytest.mark.parametrize("changes", [{"fit": "stretch"}, {"fit": None}, {"fill": (0.5, 0.5)}])
def test_only_a_rest_of_as_many_channels_has_one(changes: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match="fill is one number for each channel, with fit start or centre; found"):
        ObservationSpec((1, 3, 4, 4), **{"bounds": (0.0, 1.0), "fit": "start", "fill": (0.5, 0.5, 0.5)} | changes)


@pytest.mark.parametrize("size", [(30, 50), (96, 17), (20, 20), (3, 40), (61, 61)])
def test_stretched_it_is_torchs_cubic_of_bytes(size: tuple[int, int]) -> None:
    """A sum at the middle between two steps may be rounded another way on another processor."""
    spec = ObservationSpec((1, 3, 20, 20), bounds=(0.0, 1.0), fit="stretch")
    image = np.random.RandomState(0).uniform(0, 1, (2, 1, 3, *size)).astype(np.float32)
    whole = torch.from_numpy(np.trunc(image[:, 0] * np.float32(255)))
    expected = functional.interpolate(whole, (20, 20), mode="bicubic", antialias=True, align_corners=False)
    expected = (expected if size != (20, 20) else whole).clamp(0, 255).round()[:, None] / 255
    found = fitted(image, spec)
    off = np.abs(found - expected.numpy())
    assert off.max() < 1.01 / 255
    assert np.count_nonzero(off > 1e-6) < 4
    np.testing.assert_array_equal(fitted(found, spec), found)


@pytest.mark.parametrize("size", [(30, 50), (96, 17), (20, 24), (3, 40), (61, 5)])
def test_averaged_it_is_torchs_area(size: tuple[int, int]) -> None:
    spec = ObservationSpec((1, 3, 20, 24), bounds=(0.0, 1.0), fit="average")
    image = np.random.RandomState(0).uniform(0, 1, (2, 1, 3, *size)).astype(np.float32)
    expected = functional.interpolate(torch.from_numpy(image[:, 0]), (20, 24), mode="area")[:, None]
    np.testing.assert_allclose(fitted(image, spec), expected.numpy(), atol=1e-6)


def test_random_images_of_a_policy_that_rounds_them_are_rounded() -> None:
    spec = ObservationSpec((1, 3, 8, 8), bounds=(0.0, 1.0), fit="stretch")
    drawn = spec.draw(np.random.default_rng(0))
    np.testing.assert_array_equal(fitted(np.asarray(drawn, np.float32), spec), drawn)
    assert len(np.unique(drawn)) > 50


def test_only_images_of_another_size_change() -> None:
    spec = ObservationSpec((1, 3, 4, 4), bounds=(0.0, 1.0), fit="start")
    whole, bytes_ = np.ones((1, 1, 3, 4, 4), np.float32), np.ones((1, 1, 3, 8, 8), np.uint8)
    last = np.ones((1, 1, 8, 8, 3), np.float32)
    for array in (whole, bytes_, last):
        assert fitted(array, spec) is array
    assert fitted(np.ones((1, 1, 3, 8, 8), np.float32), ObservationSpec((1, 3, 4, 4))).shape[-1] == 8


def test_only_images_fit() -> None:
    with pytest.raises(SpecError, match="fit is for images with bounds"):
        ObservationSpec((4,), fit="start")


@pytest.mark.parametrize(
    ("value", "message"), [(200.0, "Divide by 255"), (np.inf, "finite|infinity"), (np.nan, "NaN|nan")]
)
@pytest.mark.parametrize("size", [4, 8])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_recording_is_checked_before_it_is_resized(
    tmp_path: Path, value: float, message: str, size: int, kind: type[np.floating]
) -> None:
    spec = ObservationSpec((1, 3, 4, 4), bounds=(0.0, 1.0), fit="centre")
    images = np.random.RandomState(0).uniform(0, 1, (4, 1, 3, size, size)).astype(kind)
    file = tmp_path / "calls.npz"
    np.savez(file, top=images, episode_ends=np.array([2, 4]))
    assert [each.calls for each in load_trajectories([file], {"top": spec}, 1)] == [2, 2]
    images[1, 0, 2, 3, 3] = value
    np.savez(file, top=images, episode_ends=np.array([2, 4]))
    with pytest.raises(TrajectoryError, match=f"calls.npz: 'top' .*({message})"):
        load_trajectories([file], {"top": spec}, 1)


@pytest.mark.parametrize(
    ("shape", "advised"),
    [
        ((1, 48, 64, 3), True),  # of another size than the policy takes, too
        ((1, 8, 8, 3), True),
        ((1, 3, 48, 64), False),
        ((1, 48, 64, 4), False),
    ],
)
def test_channels_that_are_last_are_told_of(shape: tuple[int, ...], advised: bool) -> None:
    spec = ObservationSpec((3, 8, 8), window=False, bounds=(0.0, 1.0))
    with pytest.raises(ObservationError, match="wrong shape") as caught:
        check_observation({"top": np.zeros(shape, np.float32)}, {"top": spec})
    assert ("Its channels are last: use np.moveaxis(image, -1, -3)" in str(caught.value)) == advised


def test_a_text_without_a_tokenizer_is_told_of() -> None:
    tokens = ObservationSpec((4,), dtype="int64", window=False, bounds=(0.0, 9.0))
    for specs, advised in (({"state": ObservationSpec((2,)), "tokens": tokens}, True), ({"state": tokens}, False)):
        with pytest.raises(ObservationError, match=r"unexpected: \['task'\]") as caught:
            read_observation({"state": np.zeros((1, 2), np.float32), "task": "push"}, specs)
        assert ("load with tokenizer=PATH" in str(caught.value)) == advised
