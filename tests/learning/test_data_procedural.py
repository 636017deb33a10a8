import numpy as np
import torch

from learning.data.images import inverse, shrink_masks, warp
from learning.data.synthetic import pixel_grid, sample_patterns
from recorder.markers import HEIGHT, WIDTH

CPU = torch.device("cpu")


def _chance(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def _drawn(count: int, chance: np.random.Generator) -> torch.Tensor:
    return sample_patterns(count, chance, CPU).draw(pixel_grid(64, CPU))


def _pixels() -> torch.Tensor:
    """Return the pixel positions of the full image (1, 2, 480, 640)."""
    rows, columns = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return torch.stack([columns, rows])[None].float()


def test_the_same_chance_draws_the_same_patterns_and_another_draws_others() -> None:
    one = _drawn(4, _chance(3))
    assert torch.equal(one, _drawn(4, _chance(3)))
    assert not torch.equal(one, _drawn(4, _chance(4)))
    assert not torch.equal(one[0], one[1])


def test_patterns_are_grey_images_of_markers_on_nothing() -> None:
    images = _drawn(24, _chance())
    assert images.shape == (24, 1, 64, 64)
    assert 0 <= float(images.min()) <= float(images.max()) <= 1
    covered = images.mean(dim=(1, 2, 3))
    assert bool((covered > 0.003).all())
    assert bool((covered < 0.75).all())


def test_a_small_image_is_what_shrinking_a_mask_of_the_same_pattern_gives() -> None:
    patterns = sample_patterns(3, _chance(1), CPU)
    shrunk = shrink_masks(patterns.draw(_pixels())[:, 0] > 0.5).float() / 255
    assert float((patterns.draw(pixel_grid(256, CPU))[:, 0] - shrunk).abs().mean()) < 0.02


def test_some_of_the_patterns_are_drawn_as_they_are_among_all() -> None:
    patterns = sample_patterns(3, _chance(2), CPU)
    every = patterns.draw(pixel_grid(64, CPU))
    some = patterns[torch.tensor([2, 0])]
    assert len(some) == 2
    assert torch.equal(some.draw(pixel_grid(64, CPU)), every[[2, 0]])


def test_an_even_displacement_shifts_a_pattern_by_as_much() -> None:
    patterns = sample_patterns(2, _chance(5), CPU)
    field = torch.tensor([20.0, 15.0]).view(1, 2, 1, 1).expand(2, 2, 57, 73)
    # One pixel is 2.5 columns by 1.875 rows: 8 pixels each.
    moved = patterns.draw(pixel_grid(256, CPU) + inverse(field, *pixel_grid(256, CPU)[0]))
    rest = patterns.draw(pixel_grid(256, CPU))
    assert torch.allclose(moved[..., 8:, 8:], rest[..., :-8, :-8], atol=1e-3)


def test_a_deformed_pattern_is_its_image_warped() -> None:
    patterns = sample_patterns(2, _chance(6), CPU)
    rows, columns = torch.meshgrid(
        torch.linspace(0, 3, 57), torch.linspace(0, 4, 73), indexing="ij"
    )
    field = 12 * torch.stack([torch.sin(columns), torch.cos(rows)]).expand(2, 2, 57, 73)
    drawn = patterns.draw(pixel_grid(256, CPU) + inverse(field, *pixel_grid(256, CPU)[0]))
    warped = warp(patterns.draw(pixel_grid(256, CPU)), field)
    middle = (..., slice(32, -32), slice(32, -32))
    assert float((drawn - warped)[middle].abs().mean()) < 0.02
    assert float((drawn - patterns.draw(pixel_grid(256, CPU)))[middle].abs().mean()) > 0.05
