"""Images as network inputs: exact area means, the authors' upscaling, arrays and tensors."""

import numpy as np
import torch
from PIL import Image
from support.made_up_archives import State, mask_of

from learning.data.images import enlarge_images, shrink, shrink_masks, unpack_masks
from recorder.markers import HEIGHT, WIDTH, pack


def _masks() -> np.ndarray:
    pressed = State((300.0, 250.0), 90.0, 1.0, (0.4, 0.2))
    noise = np.random.default_rng(0).random((HEIGHT, WIDTH)) < 0.5
    return np.stack([mask_of("dots", pressed), noise, np.zeros_like(noise), np.ones_like(noise)])


def _overlaps(pixels: int, images: int) -> np.ndarray:
    """Return the fraction of each pixel (images, pixels) that an image's pixel covers."""
    ends = np.arange(images + 1) * pixels / images
    low, high = np.arange(pixels), np.arange(pixels) + 1
    return np.clip(np.minimum(ends[1:, None], high) - np.maximum(ends[:-1, None], low), 0, None) / (
        pixels / images
    )


def test_a_pixel_is_the_mean_over_its_area() -> None:
    masks = _masks()
    mean = _overlaps(HEIGHT, 256) @ masks.astype(float) @ _overlaps(WIDTH, 256).T
    assert np.abs(shrink(pack(masks)).astype(float) - 255 * mean).max() < 0.5 + 1e-9


def test_arrays_and_tensors_shrink_alike() -> None:
    masks = _masks()
    assert np.array_equal(shrink_masks(torch.from_numpy(masks)).numpy(), shrink(pack(masks)))


def test_images_are_enlarged_as_pillow_does() -> None:
    images = shrink(pack(_masks()))
    size, lanczos = (WIDTH, HEIGHT), Image.Resampling.LANCZOS
    one = np.stack(
        [np.asarray(Image.fromarray(each).resize(size, lanczos)) > 128 for each in images]
    )
    other = enlarge_images(torch.from_numpy(images)).numpy()
    # Pillow uses integer arithmetic: a value at the threshold may round to the other side.
    assert (one != other).mean() < 1e-4


def test_markers_come_back_where_they_were() -> None:
    mask = _masks()[:1]
    back = enlarge_images(torch.from_numpy(shrink(pack(mask)))).numpy()
    assert 2 * (mask & back).sum() / (mask.sum() + back.sum()) > 0.985


def test_bits_become_masks() -> None:
    masks = _masks()
    assert torch.equal(unpack_masks(torch.from_numpy(pack(masks))), torch.from_numpy(masks))


def test_nothing_becomes_nothing() -> None:
    assert shrink(np.zeros((0, 38400), np.uint8)).shape == (0, 256, 256)
    assert enlarge_images(torch.zeros(0, 256, 256, dtype=torch.uint8)).shape == (0, 480, 640)
