import numpy as np
import pytest
from support.made_up_archives import LATTICE, State, field_at, mask_of

from learning.markers.displacement import FieldReader, Matcher, Spline, fields_of_presses
from learning.translation.translator import SensorView, shows_discs
from recorder.markers import HEIGHT, WIDTH, draw_discs, marker_centres, pack, place_discs, unpack

CENTRE, WIDTH_PX = (300.0, 230.0), 90.0
STATES = [
    State(CENTRE, WIDTH_PX, 1.4 * min(step, 5) / 5, (0.08 * max(step - 5, 0), 0.04))
    for step in range(9)
]
NO_CONTACT = State(CENTRE, WIDTH_PX, 0.0)
DEEP = STATES[-1]
# Part of the lattice inside the image.
INSIDE = (slice(4, 53), slice(4, 69))


@pytest.fixture(scope="module")
def presses() -> dict[str, np.ndarray]:
    names = ("dots", "grid", "dense")
    return {name: np.stack([mask_of(name, each) for each in STATES]) for name in names}


@pytest.fixture(scope="module")
def no_contact() -> dict[str, np.ndarray]:
    return {name: mask_of(name, NO_CONTACT) for name in ("dots", "grid", "dense")}


def truth(state: State) -> np.ndarray:
    moved = field_at(state, LATTICE.columns[None, :], LATTICE.rows[:, None])
    return np.stack(moved, axis=-1)


def error(field: np.ndarray, state: State) -> np.ndarray:
    return np.linalg.norm(field - truth(state), axis=-1)[INSIDE]


@pytest.mark.parametrize("name", ["dots", "grid", "dense"])
def test_the_field_of_a_followed_press_is_found_to_part_of_a_pixel(presses, no_contact, name):
    fields = FieldReader(no_contact[name]).displacement(presses[name], ordered=True)
    wrong = error(fields[-1], DEEP)
    assert np.median(wrong) < 0.3
    assert np.quantile(wrong, 0.95) < 2.0
    assert np.linalg.norm(truth(DEEP), axis=-1).max() > 20


def test_a_frame_without_contact_has_no_displacement_and_no_growth(no_contact):
    reader = FieldReader(no_contact["dots"])
    assert np.abs(reader.displacement(no_contact["dots"][None], ordered=False)).max() < 1e-6
    assert np.abs(reader.maps(no_contact["dots"][None], ordered=True)).max() < 1e-6


def slid(mask: np.ndarray, step_px: int, steps: int) -> np.ndarray:
    """Return frames of a mask that moves to the right, out of the image; nothing comes in."""
    frames = np.zeros((steps, HEIGHT, WIDTH), np.bool_)
    for step in range(steps):
        frames[step, :, step_px * step :] = mask[:, : WIDTH - step_px * step]
    return frames


def test_markers_that_moved_by_more_than_a_pitch_are_known_along_the_press_alone(no_contact):
    frames = slid(no_contact["dense"], 8, 8)
    reader = FieldReader(no_contact["dense"])
    followed = reader.displacement(frames, ordered=True)[-1]
    alone = reader.displacement(frames[-1:], ordered=False)[0]
    assert np.abs(followed[INSIDE] - [56, 0]).max() < 1  # the pitch is 40 px
    assert np.median(np.abs(alone[INSIDE][..., 0] - 56)) > 30


def test_a_press_may_begin_in_the_middle(presses, no_contact):
    fields = FieldReader(no_contact["grid"]).displacement(presses["grid"][3:], ordered=True)
    assert np.median(error(fields[-1], DEEP)) < 0.3


def test_lost_markers_and_specks_change_little(presses, no_contact):
    rng = np.random.default_rng(5)
    spoiled = presses["dots"].copy()
    for mask in spoiled:
        for column, row in rng.permutation(marker_centres(mask))[:4]:
            left, top = int(column) - 18, int(row) - 18
            mask[max(top, 0) : top + 36, max(left, 0) : left + 36] = False
        mask[rng.random(mask.shape) < 1e-3] = True
    fields = FieldReader(no_contact["dots"]).displacement(spoiled, ordered=True)
    assert np.median(error(fields[-1], DEEP)) < 0.5
    assert np.quantile(error(fields[-1], DEEP), 0.95) < 4.0


def test_a_marker_that_moves_against_all_others_is_let_go(no_contact):
    column, row = marker_centres(no_contact["dots"])[33].astype(int)
    around = (slice(row - 17, row + 18), slice(column - 17, column + 18))
    frame = no_contact["dots"].copy()
    frame[around] = False
    frame = np.roll(frame, (-10, -10), (0, 1))
    frame[row + 3 : row + 38, column + 3 : column + 38] |= no_contact["dots"][around]
    matcher = Matcher(no_contact["dots"])
    match = matcher.step(frame)
    here = int(np.linalg.norm(matcher.markers - [column, row], axis=1).argmin())
    assert not match.matched[here]
    assert np.abs(match.moved[here] + 10).max() < 1


def test_fields_stay_finite_when_markers_leave_the_image(no_contact):
    frames = slid(no_contact["dots"], 20, 8)
    field = FieldReader(no_contact["dots"]).displacement(frames, ordered=True)[-1]
    assert np.isfinite(field).all()
    assert np.abs(field[INSIDE] - [140, 0]).max() < 3


def test_growth_is_the_logarithm_of_how_areas_change(presses, no_contact):
    maps = FieldReader(no_contact["dots"]).maps(presses["dots"], ordered=True)
    assert maps.shape == (len(STATES), 3, 32, 32)
    assert maps.dtype == np.float32
    columns, rows = (np.arange(32) + 0.5) * WIDTH / 32 - 0.5, (np.arange(32) + 0.5) * HEIGHT / 32
    step = 0.5
    x, y = np.meshgrid(columns, rows - 0.5)
    right = [field_at(STATES[5], x + side * step, y) for side in (-1, 1)]
    down = [field_at(STATES[5], x, y + side * step) for side in (-1, 1)]
    (a, b), (c, d) = ((np.subtract(*pair[::-1])) for pair in (right, down))
    area = np.log((1 + a) * (1 + d) - b * c)
    middle = (slice(4, 28), slice(4, 28))
    assert np.corrcoef(maps[5, 2][middle].ravel(), area[middle].ravel())[0, 1] > 0.95


def discs(pressed: float, shear: float) -> np.ndarray:
    counts = np.zeros((16, 3))
    counts[:, 2] = pressed * np.exp(-(((np.arange(16) % 4) - 1.5) ** 2) / 4)
    counts[:, 0] = shear
    return counts


def test_sixteen_discs_are_followed_until_they_grow_together():
    counts = np.stack([discs(4500.0 * k, 150.0 * k) for k in range(7)])
    masks = draw_discs(counts)
    centres, radii = place_discs(counts)
    reader = FieldReader(masks[0])
    assert shows_discs(masks[0])
    assert 2 * radii[-1].max() > 96  # neighbours of a column overlap
    assert len(marker_centres(masks[-1])) < 16
    matches = reader.matches(masks, ordered=True)
    order = [int(np.linalg.norm(centres[0] - place, axis=1).argmin()) for place in reader.markers]
    for match, centre, radius in zip(matches, centres, radii, strict=True):
        moved = (centre - centres[0])[order]
        growth = 2 * np.log(radius / radii[0])[order]
        assert np.abs(match.moved - moved).max() < 3.0
        assert np.abs(match.growth - growth).max() < 0.1


def test_a_field_goes_over_to_another_scale_in_millimetres(presses, no_contact):
    near, far = SensorView("near", 0.03, 0.03), SensorView("far", 0.06, 0.045)
    reader = FieldReader(no_contact["dots"])
    field = reader.displacement(presses["dots"], ordered=True, source=near, target=far)[-1]
    middle = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    for target in (np.array([240.0, 200.0]), np.array([400.0, 300.0])):
        cell = ((target + LATTICE.margin_px) / LATTICE.step_px).astype(int)
        there = middle + (target - middle) * (2.0, 1.5)
        due = np.array(field_at(DEEP, *there)) / (2.0, 1.5)
        assert np.linalg.norm(field[cell[1], cell[0]] - due) < 0.5
    assert np.isfinite(field).all()


def test_a_frame_without_markers_repeats_the_one_before(presses, no_contact):
    frames = presses["grid"][:5].copy()
    frames[4] = False
    fields = FieldReader(no_contact["grid"]).displacement(frames, ordered=True)
    assert np.isfinite(fields).all()
    assert np.linalg.norm(fields[4] - fields[3], axis=-1).max() < 6
    alone = FieldReader(no_contact["grid"]).displacement(frames[4:], ordered=False)
    assert not alone.any()


@pytest.mark.parametrize("count", [1, 2, 3, 5, 6, 40])
def test_a_spline_goes_through_its_markers_and_repeats_a_shift(count):
    knots = np.random.default_rng(count).uniform(0, 600, (count, 2))
    spline = Spline(knots)
    values = np.random.default_rng(1).normal(size=(count, 2))
    np.testing.assert_allclose(spline.at(knots) @ values, values, atol=1e-7)
    away = np.array([[-40.0, 500.0], [680.0, -40.0]])
    np.testing.assert_allclose(spline.at(away) @ np.full((count, 2), 3.0), 3.0, atol=1e-7)


def test_what_a_spline_says_of_a_lost_marker_is_what_the_others_say():
    knots = np.random.default_rng(0).uniform(0, 600, (30, 2))
    values = np.stack([np.sin(knots[:, 0] / 200), knots[:, 1] / 100], axis=1)
    known = np.arange(30) != 7
    filled = Spline(knots).filled(np.where(known[:, None], values, 99.0), known)
    others = Spline(knots[known]).at(knots[7:8]) @ values[known]
    np.testing.assert_allclose(filled[7], others[0], atol=1e-3)
    surprise = Spline(knots).surprise(values)[7]
    assert surprise == pytest.approx(np.linalg.norm(others[0] - values[7]), rel=1e-2)


def test_markers_on_one_line_give_a_finite_field():
    knots = np.stack([np.linspace(0, 600, 12), np.full(12, 100.0)], axis=1)
    field = Spline(knots).at(np.array([[300.0, 400.0]])) @ np.ones((12, 1))
    assert field == pytest.approx(1.0)


def _read(packed):
    return lambda first, end: packed[first:end]


def test_many_presses_at_once_are_the_presses_one_by_one(presses, no_contact):
    packed = pack(np.concatenate([presses["dots"][:3], presses["grid"][:4]]))
    references = pack(np.stack([no_contact["dots"], no_contact["grid"]]))
    many = (_read(packed), np.array([0, 3, 7]), references, np.array([0] * 3 + [1] * 4))
    fields = fields_of_presses(*many)
    assert fields.shape == (7, *LATTICE.shape)
    one = FieldReader(no_contact["grid"]).displacement(packed[3:], ordered=True)
    np.testing.assert_array_equal(fields[3:], one.astype(np.float16))
    reported: list[tuple[int, int]] = []
    maps = fields_of_presses(*many, "maps", progress=lambda *now: reported.append(now))
    assert reported[0] == (0, 7)
    assert reported[-1] == (7, 7)
    reader = FieldReader(unpack(references[0]))
    for frames in (packed[:3], presses["dots"][:3]):
        np.testing.assert_array_equal(maps[:3], reader.maps(frames, ordered=True))


@pytest.mark.slow
def test_two_processes_give_the_fields_of_one(presses, no_contact):
    count = 20
    packed = pack(np.concatenate([presses["dots"][:2]] * count))
    starts = 2 * np.arange(count + 1)
    zeros = np.zeros(2 * count, int)
    many = (_read(packed), starts, pack(no_contact["dots"][None]), zeros)
    np.testing.assert_array_equal(
        fields_of_presses(*many, processes=2), fields_of_presses(*many, processes=1)
    )
