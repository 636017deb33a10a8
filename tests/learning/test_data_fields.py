"""Displacement fields: reading with gaps filled, inversion, and warping of images."""

import numpy as np
import pytest
import torch
from support.made_up_archives import State, lattice_field, mask_of

from learning.data.images import filled, inverse, sampled, shrink_masks, warp

PRESSED = State((320.0, 260.0), 90.0, 1.0, (0.3, -0.2))
NO_CONTACT = State((320.0, 260.0), 90.0, 0.0)


def _lattice_field(state: State = PRESSED) -> torch.Tensor:
    return torch.from_numpy(lattice_field(state).astype(np.float32)).permute(2, 0, 1)[None]


def _image(state: State) -> torch.Tensor:
    return shrink_masks(torch.from_numpy(mask_of("dots", state))[None])[:, None].float() / 255


def _dice(one: torch.Tensor, other: torch.Tensor) -> float:
    return 2 * (one & other).sum().item() / (one.sum() + other.sum()).item()


def test_a_reference_image_becomes_what_the_press_shows() -> None:
    moved = warp(_image(NO_CONTACT), _lattice_field())
    due = _image(PRESSED) > 0.5
    assert _dice(_image(NO_CONTACT) > 0.5, due) < 0.85
    # The edges of the downscaled binary mask are up to half a pixel off those of the pattern.
    assert _dice(moved > 0.5, due) > 0.975


def test_no_displacement_changes_nothing() -> None:
    image = _image(PRESSED)
    assert torch.allclose(warp(image, torch.zeros(1, 2, 57, 73)), image, atol=1e-3)


def test_markers_move_the_way_the_field_points() -> None:
    image = torch.zeros(1, 1, 480, 640)
    image[..., 239:242, 319:322] = 1.0
    field = torch.zeros(1, 2, 57, 73)
    field[:, 0], field[:, 1] = 30.0, -20.0
    rows, columns = torch.nonzero(warp(image, field)[0, 0] > 0.5, as_tuple=True)
    assert (columns.float().mean() - 320).item() == pytest.approx(30.0, abs=0.1)
    assert (rows.float().mean() - 240).item() == pytest.approx(-20.0, abs=0.1)


def test_the_inverse_leads_back() -> None:
    columns = ((torch.arange(64) + 0.5) * 10 - 0.5).expand(1, 48, 64)
    rows = ((torch.arange(48) + 0.5) * 10 - 0.5)[:, None].expand(1, 48, 64)
    back = inverse(_lattice_field(), columns, rows, steps=20)
    there = sampled(_lattice_field(), columns + back[:, 0], rows + back[:, 1])
    assert (there + back).abs().max() < 0.01
    assert (inverse(_lattice_field(), columns, rows) - back).abs().max() < 0.1


def test_gaps_are_filled_from_around_them_and_marked() -> None:
    field, known = torch.full((2, 2, 8, 8), 3.0), torch.ones(2, 8, 8, dtype=torch.bool)
    known[0, 2:6, 2:6], known[1] = False, False
    found = filled(torch.where(known[:, None], field, torch.nan), known)
    assert torch.allclose(found[0], torch.tensor(3.0))
    assert torch.equal(found[1], torch.zeros(2, 8, 8))
