from pathlib import Path

import numpy as np
import pytest
import torch
from support.made_up_archives import (
    LATTICE,
    State,
    archive_of,
    lattice_field,
    made_up_archive,
    mask_of,
)
from support.tiny_field import untrained
from torch import Tensor

from learning.data.splits import make_split
from learning.errors import LearningError
from learning.translation import SensorView
from learning.translation.field.data import (
    ExampleSettings,
    FieldFrames,
    PatternBank,
    draw_examples,
    gather_role,
    random_shifts,
)
from learning.translation.field.network import (
    CHANNELS,
    SIDE,
    from_displacement,
    render,
    signed_distance,
    transferred,
)
from learning.translation.field.translator import FieldTranslator
from recorder import MarkerArchive, SessionError
from recorder.markers import HEIGHT, WIDTH, draw_discs, place_discs

NO_CONTACT = State((320.0, 240.0), 90.0, 0.0)
PRESSED = State((300.0, 260.0), 90.0, 1.5, (0.4, -0.3))
CPU = torch.device("cpu")


def mask(name: str, state: State = NO_CONTACT) -> Tensor:
    return torch.from_numpy(mask_of(name, state))


def dice(one: Tensor, other: Tensor) -> float:
    return float(2 * (one & other).sum() / (one.sum() + other.sum()))


archive = archive_of(indenters=("sphere", "cone"), targets=3, frames_per_phase=1)


@pytest.fixture(scope="module")
def frames(archive: MarkerArchive) -> FieldFrames:
    found = gather_role(archive, make_split(archive), tuple(archive), "train")
    assert found is not None
    return found


def test_far_from_an_edge_a_signed_distance_is_to_the_nearest_pixel_of_the_other_kind() -> None:
    masks = torch.zeros(2, 24, 40, dtype=torch.bool)
    masks[0, 3:15, 4:17] = True
    masks[0, 20, 33] = True
    found = signed_distance(masks, reach=8)
    rows, columns = np.mgrid[:24, :40]
    for image, distance in zip(masks.numpy(), found[:, 0].numpy(), strict=True):
        assert np.array_equal(distance > 0, image)
        for row, column in np.ndindex(*image.shape):
            other = image != image[row, column]
            apart = np.hypot(rows[other] - row, columns[other] - column)
            nearest = min(apart.min(initial=np.inf), 8.0) - 0.5
            if nearest > 2.0:
                sign = 1 if image[row, column] else -1
                assert distance[row, column] == pytest.approx(sign * nearest)


def test_near_an_edge_a_signed_distance_tells_its_place_within_a_pixel() -> None:
    rows, columns = np.mgrid[:120, :120]
    true = 30.3 - np.hypot(rows - 59.4, columns - 60.7)
    found = signed_distance(torch.from_numpy(true > 0)[None])[0, 0].numpy()
    near = np.abs(true) < 1
    assert abs((found - true)[near].mean()) < 0.08
    assert (found - true)[near].std() < 0.2


def test_without_deformation_the_reference_stays_as_it_is() -> None:
    no_contact = mask("dots")[None]
    level = render(signed_distance(no_contact), torch.zeros(2, CHANNELS, SIDE, SIDE))
    assert torch.equal(level[:, 0] > 0, no_contact.expand(2, -1, -1))


def test_a_constant_shift_moves_every_marker_by_as_much() -> None:
    no_contact = mask("grid")
    deformation = torch.zeros(1, CHANNELS, SIDE, SIDE)
    deformation[:, 0], deformation[:, 1] = 6.0, -4.0
    moved = render(signed_distance(no_contact[None]), deformation)[0, 0] > 0
    inner = slice(30, HEIGHT - 30), slice(30, WIDTH - 30)
    assert torch.equal(moved[inner], no_contact.roll((-4, 6), dims=(0, 1))[inner])


def test_the_inverse_of_a_displacement_field_makes_the_frame_of_the_reference() -> None:
    field = torch.from_numpy(lattice_field(PRESSED).astype(np.float32)).permute(2, 0, 1)[None]
    deformation = torch.zeros(1, CHANNELS, SIDE, SIDE)
    deformation[:, :2] = from_displacement(field, LATTICE)
    # Markers 30 and 18 px across.
    for name, least in (("dots", 0.985), ("dense", 0.975)):
        made = render(signed_distance(mask(name)[None]), deformation)[0, 0] > 0
        pressed = mask(name, PRESSED)
        assert dice(made, pressed) > least
        assert dice(mask(name), pressed) < 0.7


def test_growth_makes_discs_of_a_uskin_as_large_as_pressed_ones() -> None:
    counts = np.zeros((16, 3))
    counts[5], counts[6], counts[9] = (800, -400, 9000), (0, 900, 4000), (-500, 0, 1500)
    centre, radius = place_discs(counts)
    rest_centre, rest_radius = place_discs(np.zeros((16, 3)))
    # Every cell follows the taxel whose disc is nearest.
    columns = (np.arange(SIDE) + 0.5) * WIDTH / SIDE - 0.5
    rows = (np.arange(SIDE) + 0.5) * HEIGHT / SIDE - 0.5
    across, down = np.meshgrid(columns, rows)
    apart = np.hypot(across[..., None] - centre[:, 0], down[..., None] - centre[:, 1])
    nearest = (apart - radius).argmin(axis=-1)
    moved = np.stack([*(centre - rest_centre).T, radius - rest_radius])[:, nearest]
    deformation = torch.from_numpy(moved.astype(np.float32))[None]
    no_contact = torch.from_numpy(draw_discs(np.zeros((16, 3))))
    made = render(signed_distance(no_contact[None]), deformation)[0, 0] > 0
    pressed = torch.from_numpy(draw_discs(counts))
    assert radius.max() > 2.5 * rest_radius.max()
    assert dice(made, pressed) > 0.98
    without = deformation.clone()
    without[:, 2] = 0
    assert dice(render(signed_distance(no_contact[None]), without)[0, 0] > 0, pressed) < 0.8


def test_millimetres_stay_what_they_are_in_the_image_of_another_sensor() -> None:
    columns = torch.linspace(-1, 1, SIDE).expand(SIDE, SIDE)
    deformation = torch.stack([8 + 4 * columns, torch.full((SIDE, SIDE), -6.0), columns * 0 + 3])
    assert torch.allclose(
        transferred(deformation[None], torch.ones(1, 2))[0], deformation, atol=1e-5
    )
    halved = transferred(deformation[None], torch.tensor([[0.5, 0.5]]))[0]
    # A target pixel is half a source pixel: values double, and half of the view is visible.
    assert torch.allclose(halved[1], torch.full((SIDE, SIDE), -12.0))
    assert torch.allclose(halved[2], torch.full((SIDE, SIDE), 6.0))
    assert torch.allclose(halved[0, :, 1:-1], (16 + 4 * columns)[:, 1:-1], atol=0.1)


def test_random_shifts_fold_nothing() -> None:
    shift = random_shifts(64, np.random.default_rng(0), CPU)
    across = shift[:, 0].diff(dim=2) / (WIDTH / SIDE)
    down = shift[:, 1].diff(dim=1) / (HEIGHT / SIDE)
    assert float(across.max()) < 1
    assert float(down.max()) < 1
    assert float(shift.abs().amax(dim=(1, 2, 3)).median()) > 5


@pytest.mark.slow
def test_examples_are_the_same_for_the_same_numbers_and_show_what_they_say(
    frames: FieldFrames,
) -> None:
    settings = ExampleSettings(patterns=3, edge_px=0.0, missing=0.0)
    bank = PatternBank.drawn(3, np.random.default_rng(1), CPU)
    one, again = (
        draw_examples(frames, bank, settings, 6, np.random.default_rng(2)) for _ in range(2)
    )
    assert torch.equal(one.seen, again.seen)
    assert torch.equal(one.other, again.other)
    assert len(one.other) == 3
    deformation = torch.zeros(6, CHANNELS, SIDE, SIDE)
    deformation[:, :2] = one.shift
    made = render(one.distance, deformation)
    for level, shown in zip(made > 0, one.shown > 0.5, strict=True):
        assert dice(level[:, 20:-20, 20:-20], shown[:, 20:-20, 20:-20]) > 0.95
    other = render(one.other_distance, deformation[3:])
    for level, shown in zip(other > 0, one.other > 0.5, strict=True):
        assert dice(level[:, 20:-20, 20:-20], shown[:, 20:-20, 20:-20]) > 0.95


def test_frames_are_those_of_the_role_and_pairs_share_place_and_phase(
    archive: MarkerArchive, frames: FieldFrames
) -> None:
    split = make_split(archive)
    table = archive["dots"].table
    rows = split.rows(table, "train")
    assert len(frames) == 2 * len(rows)
    assert len(frames.pairs) == 2 * 4 * len(np.unique(table["location"][rows]))
    source, target = frames.pairs.unbind(dim=1)
    assert torch.equal(source % len(rows), target % len(rows))
    assert bool((frames.sensor[source] != frames.sensor[target]).all())
    assert frames.shift is not None
    assert torch.equal(frames.shift[source], frames.shift[target])


def test_frames_that_cannot_be_gathered_are_refused(
    archive: MarkerArchive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    split = make_split(archive)
    with pytest.raises(LearningError, match="no sensor 'none'; known: dots, grid"):
        gather_role(archive, split, ("none",), "train")
    begun = made_up_archive(
        tmp_path / "x.markers.zarr", indenters=("sphere",), frames_per_phase=1, finish=False
    )
    with pytest.raises(SessionError, match="still being written"):
        gather_role(begun, split, ("dots",), "train")
    monkeypatch.setattr("learning.translation.field.data.free_bytes", lambda device: 1_000_000)
    with pytest.raises(LearningError, match="frames: found"):
        gather_role(archive, split, tuple(archive), "train")


def test_an_untrained_model_gives_the_targets_reference_back() -> None:
    translator = FieldTranslator("untrained", untrained().eval())
    source, grid = mask("dots", PRESSED)[None], mask("grid")
    assert torch.equal(translator.translate(source, grid, mask("dots")), grid[None])
    view = SensorView("a", 0.03, 0.03), SensorView("b", 0.05, 0.06)
    assert torch.equal(
        translator.between_sensors(*view).translate(source, grid, mask("dots")), grid[None]
    )
    nothing = torch.zeros_like(grid)
    with pytest.raises(LearningError, match="target_reference: found no marker"):
        translator.translate(source, nothing, mask("dots"))
    with pytest.raises(LearningError, match="source_reference: found no marker"):
        translator.translate(source, grid, nothing)
