"""Losses on translated images: the vision-aided discriminator, its augmentation, and LPIPS."""

import math

import pytest
import torch
from support.tiny_diffusion import CLIP, VGG, tiny_pretrained
from torch import nn
from torch.nn import functional

from learning.translation.diffusion.discriminator import (
    Blur,
    ClipFeatures,
    DiscriminatorHeads,
    augment,
    multilevel_sigmoid,
)
from learning.translation.diffusion.weights import PerceptualDistance


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_loss_is_the_sum_over_levels_of_mean_cross_entropies() -> None:
    raster = torch.tensor([[[[0.0, 2.0]]], [[[-1.0, 1.0]]]])
    vector = torch.tensor([[3.0], [-3.0]])

    def entropy(logit: float, wanted: float) -> float:
        message = 1 / (1 + math.exp(-logit))
        return -wanted * math.log(message) - (1 - wanted) * math.log(1 - message)

    for real, wanted in ((True, 0.8), (False, 0.0)):
        expected = sum(entropy(logit, wanted) for logit in (0.0, 2.0, -1.0, 1.0)) / 4
        expected += sum(entropy(logit, wanted) for logit in (3.0, -3.0)) / 2
        found = multilevel_sigmoid([raster, vector], real=real)
        assert float(found) == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
def test_judgements_are_a_raster_of_each_block_and_a_number() -> None:
    features = ClipFeatures(tiny_pretrained().clip)
    heads = DiscriminatorHeads(CLIP["hidden_size"], CLIP["projection_dim"], width=5)
    seen = features(torch.rand(2, 3, 20, 20) * 2 - 1)
    assert [tuple(each.shape) for each in seen] == [(2, 8, 4, 4), (2, 8, 4, 4), (2, 6)]
    assert [tuple(each.shape) for each in heads(seen)] == [(2, 1, 2, 2), (2, 1, 2, 2), (2, 1)]


@pytest.mark.slow
def test_features_are_those_behind_the_fourth_and_the_eighth_block() -> None:
    clip = tiny_pretrained().clip
    images = torch.rand(1, 3, 32, 32, generator=_generator()) * 2 - 1
    before = ClipFeatures(clip)(images)
    with torch.no_grad():
        for parameter in clip.vision_model.encoder.layers[4].parameters():
            parameter.add_(0.3)
    after = ClipFeatures(clip)(images)
    assert torch.equal(before[0], after[0])
    assert not torch.equal(before[1], after[1])


@pytest.mark.slow
def test_heads_cannot_grow_without_bound_and_clip_stays_in_evaluation() -> None:
    heads = DiscriminatorHeads(8, 6, width=5)
    for _ in range(20):
        heads([torch.randn(1, 8, 4, 4)] * 2 + [torch.randn(1, 6)])
    largest = torch.linalg.matrix_norm(heads.vector[0].weight.detach(), 2)
    assert float(largest) == pytest.approx(1, rel=0.05)
    assert not ClipFeatures(tiny_pretrained().clip).train().clip.training


@pytest.mark.slow
def test_blurring_keeps_the_size_and_spreads_one_pixel_binomially() -> None:
    point = torch.zeros(1, 2, 6, 6)
    point[0, 0, 3, 3] = 1
    seen = Blur(2)(point)
    line = torch.tensor([1.0, 3.0, 3.0, 1.0]) / 8
    assert seen.shape == point.shape
    torch.testing.assert_close(seen[0, 0, 1:5, 1:5], line[:, None] * line)
    assert float(seen[0, 1].abs().max()) == 0


def test_augmentation_depends_on_its_generator_alone_and_passes_gradients() -> None:
    images = (torch.rand(3, 3, 16, 16) * 2 - 1).requires_grad_()
    once, again = augment(images, _generator(3)), augment(images, _generator(3))
    assert torch.equal(once, again)
    assert not torch.equal(once, augment(images, _generator(4)))
    once.sum().backward()
    assert float(images.grad.abs().sum()) > 0


def test_augmentation_cuts_out_a_square_of_up_to_half_the_side() -> None:
    cut = augment(torch.full((64, 3, 16, 16), 7.0), _generator()) == 0
    fraction = cut.all(dim=1).float().mean(dim=(1, 2))
    # A square of at most 8 x 8, and up to 2 rows and columns that were shifted out.
    assert 0.05 < float(fraction.mean()) < 0.45
    assert float(fraction.max()) <= (64 + 2 * 32) / 256


def test_lpips_is_nothing_for_equal_images_and_grows_as_they_part() -> None:
    distance = PerceptualDistance(VGG)
    images = torch.rand(2, 3, 32, 32, generator=_generator()) * 2 - 1
    apart = torch.randn(2, 3, 32, 32, generator=_generator(1))
    found = [distance(images, images + by * apart) for by in (0.0, 0.1, 1.0)]
    assert torch.equal(found[0], torch.zeros(2))
    assert bool((found[1] > 0).all())
    assert bool((found[2] > found[1]).all())


def test_lpips_is_what_its_definition_says() -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        distance = PerceptualDistance(VGG)
    for layer in distance.features:
        # Large enough that no feature vanishes, as with VGG16's real weights.
        if isinstance(layer, nn.Conv2d):
            layer.weight.mul_(4)
    one, other = torch.rand(2, 1, 3, 32, 32, generator=_generator()) * 2 - 1

    def stages(image: torch.Tensor) -> list[torch.Tensor]:
        shift = torch.tensor([-0.030, -0.088, -0.188]).view(3, 1, 1)
        scale = torch.tensor([0.458, 0.448, 0.450]).view(3, 1, 1)
        seen, found = (image - shift) / scale, []
        for index in range(30):
            seen = distance.features[index](seen)
            if index in (3, 8, 15, 22, 29):
                found.append(functional.normalize(seen, dim=1))
        return found

    expected = sum(
        ((a - b) ** 2 * head).sum(dim=1).mean()
        for a, b, head in zip(stages(one), stages(other), distance.heads, strict=True)
    )
    torch.testing.assert_close(distance(one, other)[0], expected, rtol=1e-4, atol=1e-7)


def test_lpips_has_a_slope_where_features_vanish() -> None:
    distance = PerceptualDistance(VGG)
    for parameter in distance.parameters():
        parameter.zero_()
    images = torch.zeros(1, 3, 32, 32, requires_grad=True)
    distance(images, images.detach() + 1).sum().backward()
    assert bool(images.grad.isfinite().all())
