"""Packed masks, uSkin discs and marker counting, shared by sim, rig and learning."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from recorder.markers import (
    HEIGHT,
    PACKED,
    WIDTH,
    DiscMap,
    Lattice,
    MarkerCheck,
    count_markers,
    draw_discs,
    find_blobs,
    marker_centres,
    pack,
    place_discs,
    unpack,
)

Mask = NDArray[np.bool_]


def squares(
    *,
    left: float = 30,
    top: float = 30,
    pitch: int = 48,
    side: int = 18,
    without: tuple[tuple[int, int], ...] = (),
) -> Mask:
    """Return a mask of squares, row by row; those at the border are cut."""
    mask = np.zeros((HEIGHT, WIDTH), np.bool_)
    for i in range(-1, 15):
        for j in range(-1, 15):
            if (i, j) not in without:
                row, column = round(top) + i * pitch, round(left) + j * pitch
                mask[max(row, 0) : max(row + side, 0), max(column, 0) : max(column + side, 0)] = 1
    return mask


# ------------------------------------------------------------------------------- packed masks


def test_packed_masks_keep_every_pixel() -> None:
    masks = np.random.default_rng(1).random((2, 3, HEIGHT, WIDTH)) < 0.3
    packed = pack(masks)
    assert (packed.dtype, packed.shape) == (np.uint8, (2, 3, PACKED))
    np.testing.assert_array_equal(unpack(packed), masks)
    np.testing.assert_array_equal(unpack(packed[1, 2]), masks[1, 2])


def test_the_first_pixel_is_the_highest_bit_and_rows_come_one_after_the_other() -> None:
    mask = np.zeros((HEIGHT, WIDTH), np.bool_)
    mask[0, 0] = mask[0, 7] = mask[1, 9] = True
    packed = pack(mask)
    assert packed[0] == 0b1000_0001
    assert packed[WIDTH // 8 + 1] == 0b0100_0000
    assert np.count_nonzero(packed) == 2


def test_the_lattice_reaches_beyond_the_image_on_every_side() -> None:
    lattice = Lattice()
    assert lattice.shape == (57, 73, 2)
    assert (lattice.columns[0], lattice.columns[-1]) == (-40, 680)
    assert (lattice.rows[0], lattice.rows[-1], lattice.rows[1]) == (-40, 520, -30)
    with pytest.raises(ValueError, match="found step_px 7"):
        Lattice(step_px=7)


# -------------------------------------------------------------------------------- uSkin discs


def coverage(centre: NDArray[np.float64], radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the fraction of each pixel that the discs cover, by 16 x 16 samples per pixel."""
    inside = np.zeros((HEIGHT, WIDTH))
    offset = (np.arange(16) + 0.5) / 16 - 0.5
    for (column, row), reach in zip(centre, radius, strict=True):
        top, left = int(row - reach) - 2, int(column - reach) - 2
        span = 2 * int(reach) + 6
        y = (top + np.arange(span))[:, None] + offset
        x = (left + np.arange(span))[:, None] + offset
        near = (y.ravel()[:, None] - row) ** 2 + (x.ravel()[None] - column) ** 2 <= reach**2
        fraction = near.reshape(span, 16, span, 16).mean(axis=(1, 3))
        rows, columns = np.arange(top, top + span), np.arange(left, left + span)
        kept = np.ix_((rows >= 0) & (rows < HEIGHT), (columns >= 0) & (columns < WIDTH))
        block = inside[np.clip(top, 0, None) :, np.clip(left, 0, None) :]
        block = block[: fraction[kept].shape[0], : fraction[kept].shape[1]]
        block[...] = np.maximum(block, fraction[kept])
    return inside


def test_a_sensor_without_contact_is_sixteen_discs_of_481_pixels_at_their_places() -> None:
    blobs = find_blobs(draw_discs(np.zeros((16, 3), np.int32))[None])
    assert len(blobs) == 16
    assert np.abs(blobs.area - 481).max() <= 2
    expected = {(column, row) for column in (128, 256, 384, 512) for row in (96, 192, 288, 384)}
    assert {(column, row) for column, row in blobs.centre.tolist()} == expected


@pytest.mark.slow
def test_a_pixel_is_set_where_a_disc_covers_more_than_50_of_255() -> None:
    generator = np.random.default_rng(3)
    counts = generator.normal(0, [1500, 1500, 0], (6, 16, 3))
    counts[..., 2] = generator.uniform(-2000, 40_000, (6, 16))
    for mask, centre, radius in zip(draw_discs(counts), *place_discs(counts), strict=True):
        fraction = coverage(centre, radius)
        sure = np.abs(fraction - 50 / 255) > 0.02
        np.testing.assert_array_equal(mask[sure], (fraction > 50 / 255)[sure])
        assert np.count_nonzero(~sure) < 200  # only few pixels are that close to the limit


def test_taxels_run_to_the_right_and_up_and_positive_y_counts_move_them_up() -> None:
    counts = np.zeros((16, 3))
    centre, _ = place_discs(counts)
    np.testing.assert_allclose(centre[0], (128, 384))  # taxel 0 at the lower left
    np.testing.assert_allclose(centre[3], (512, 384))
    np.testing.assert_allclose(centre[4], (128, 288))
    counts[5] = (1000, 2000, 0)  # 0.2 and 0.4 of a pitch
    moved, _ = place_discs(counts)
    np.testing.assert_allclose(moved[5] - centre[5], (0.2 * 128, -0.4 * 96))


def test_shifts_centres_and_sizes_keep_their_limits() -> None:
    counts = np.zeros((16, 3))
    counts[0], counts[5] = (-1e6, -1e6, -1e6), (1e6, 1e6, 1e6)
    centre, radius = place_discs(counts)
    np.testing.assert_allclose(centre[0], (128 * 0.4, 384 + 96 * 0.6))
    np.testing.assert_allclose(centre[5], (128 * 2.6, 288 - 96 * 0.6))
    np.testing.assert_allclose(2 * radius[[0, 5]], np.sqrt([300, 6000]) * 100 / 72)
    shifted, _ = place_discs(np.full((16, 3), 1e6), replace(DiscMap(), centre_max=3.2))
    assert shifted[:, 0].max() == pytest.approx((3.2 + 1) * 128)


def test_frames_are_drawn_alike_alone_and_together() -> None:
    counts = np.random.default_rng(4).normal(0, 2000, (70, 16, 3))
    batched = draw_discs(counts)
    assert batched.shape == (70, HEIGHT, WIDTH)
    for frame in (0, 63, 64, 69):
        np.testing.assert_array_equal(batched[frame], draw_discs(counts[frame]))
    np.testing.assert_array_equal(draw_discs(counts.reshape(7, 10, 16, 3))[6, 9], batched[69])
    assert draw_discs(counts[:0]).shape == (0, HEIGHT, WIDTH)


# ----------------------------------------------------------------------------------- counting


@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.55, 0.6, 0.9])
def test_patches_are_those_of_scipy(fraction: float) -> None:
    masks = np.random.default_rng(int(100 * fraction)).random((3, 90, 130)) < fraction
    blobs = find_blobs(masks)
    for frame, mask in enumerate(masks):
        label, count = ndimage.label(mask)
        ours = blobs.only(blobs.frame == frame)
        assert len(ours) == count
        numbers = np.arange(1, count + 1)
        area = ndimage.sum_labels(mask, label, numbers)
        centre = np.array(ndimage.center_of_mass(mask, label, numbers))[:, ::-1]
        border = np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])
        whole = ~np.isin(numbers, border)
        order, our_order = np.lexsort(centre.T), np.lexsort(ours.centre.T)
        np.testing.assert_array_equal(ours.area[our_order], area[order])
        np.testing.assert_allclose(ours.centre[our_order], centre[order])
        np.testing.assert_array_equal(ours.whole[our_order], whole[order])


def test_a_spiral_is_one_patch_and_frames_are_not_joined() -> None:
    spiral = np.zeros((61, 61), np.bool_)
    row, column, heading = 30, 30, (0, 1)
    spiral[row, column] = True
    for length in range(2, 60, 2):
        for _ in range(2):
            for _ in range(length):
                row, column = row + heading[0], column + heading[1]
                if 0 <= row < 61 and 0 <= column < 61:
                    spiral[row, column] = True
            heading = (heading[1], -heading[0])
    assert ndimage.label(spiral)[1] == 1
    assert count_markers(spiral) == 1
    assert len(find_blobs(np.ones((3, 4, 5), np.bool_))) == 3
    assert len(find_blobs(np.zeros((2, 4, 5), np.bool_))) == 0
    assert len(find_blobs(np.zeros((0, 4, 5), np.bool_))) == 0


def test_specks_are_not_counted_and_corners_do_not_join() -> None:
    mask = np.zeros((40, 40), np.bool_)
    mask[5:10, 5:10] = True
    mask[10:15, 10:15] = True  # touches the first at a corner
    mask[30, 30:34] = True
    assert count_markers(mask) == 2
    assert count_markers(mask, smallest_px=4) == 3
    assert marker_centres(mask).tolist() == [[7, 7], [12, 12]]


# ------------------------------------------------------------------------ the marker-count check


def test_markers_that_only_move_are_not_flagged() -> None:
    check = MarkerCheck(squares())
    frames = np.stack([squares(left=30 + dx, top=30 + dy) for dx, dy in ((0, 0), (9, -5), (-7, 8))])
    assert check.expected == 130
    assert check.flags(frames) == []


def test_one_marker_lost_in_the_middle_is_flagged_with_its_place() -> None:
    (flag,) = MarkerCheck(squares()).flags(
        np.stack([squares(), squares(without=((4, 5),))]), first_row=70
    )
    assert (flag.row, flag.found, flag.expected) == (71, 129, 130)
    assert flag.reason == "1 missing, 0 may have left the image; none near (278, 230)"
    assert str(flag).startswith("row 71: 129 markers, reference 130: 1 missing")


def filled(mask: Mask) -> Mask:
    mask[250:262, 300:312] = True  # in a gap of the squares
    return mask


@pytest.mark.parametrize(
    ("before", "after", "one_more", "reasons"),
    [
        (
            4,
            -18,
            squares(left=-18, without=((4, 6),)),
            ["11 missing, 10 may have left the image; none near (300, 230)"],
        ),
        (-18, 2, filled(squares(left=2)), ["too many", "new at (306, 256)"]),
    ],
    ids=["leaves", "comes in"],
)
def test_a_column_that_crosses_the_border_is_explained_and_one_more_marker_is_not(
    before: float, after: float, one_more: Mask, reasons: list[str]
) -> None:
    check, moved = MarkerCheck(squares(left=before)), squares(left=after)
    assert (count_markers(moved) - count_markers(squares(left=before))) * (after - before) > 0
    assert check.flags(moved[None]) == []
    (flag,) = check.flags(one_more[None])
    assert all(reason in flag.reason for reason in reasons)


def test_markers_that_grow_together_and_frames_without_any_are_flagged_as_such() -> None:
    frame = squares()
    frame[240:244, 270:320] = True
    grown, empty = MarkerCheck(squares()).flags(np.stack([frame, np.zeros_like(frame)]))
    assert grown.found == 129
    assert "grown together at" in grown.reason
    assert (empty.found, empty.expected) == (0, 130)


def with_flank(mask: Mask) -> tuple[Mask, NDArray[np.float16]]:
    """Return the mask with columns 260 to 300 seen nearly edge-on, and the matching field."""
    knees, moved = np.array([-200, 260, 300, 600, 900]), np.array([0.0, 0, -39, 0, 0])
    no_contact = np.interp(np.arange(WIDTH), knees + moved, knees)
    column = np.round(no_contact).astype(int).clip(0, WIDTH - 1)
    field = np.zeros(Lattice().shape)
    field[..., 0] = np.interp(Lattice().columns, knees, moved)
    field[:2] = np.nan  # without material
    return mask[:, column], field.astype(np.float16)


def test_markers_on_a_steep_flank_may_hide_where_the_field_says_so_and_no_others() -> None:
    check = MarkerCheck(squares())
    hidden, field = with_flank(squares())
    (flag,) = check.flags(hidden[None])
    assert flag.reason.startswith("10 missing, 1 may have left the image; none near")
    assert check.flags(hidden[None], field_of=lambda frame: field) == []
    assert check.flags(hidden[None], field_of=lambda frame: field, lattice=Lattice()) == []
    lost, _ = with_flank(squares(without=((4, 9),)))
    (flag,) = check.flags(np.stack([hidden, lost]), field_of=lambda frame: field)
    message = (
        "11 missing, 1 may have left the image, 9 may be hidden on a flank; none near (470, 230)"
    )
    assert (flag.row, flag.reason) == (1, message)
    still = np.zeros(Lattice().shape, np.float16)
    assert len(check.flags(hidden[None], field_of=lambda frame: still)) == 1


def test_a_marker_on_a_steep_flank_may_be_torn_in_two() -> None:
    check = MarkerCheck(squares())
    _, field = with_flank(squares())
    torn = squares()
    torn[30 : 30 + 18, 278:280] = False  # the first square that the flank crosses
    (flag,) = check.flags(torn[None])
    assert flag.reason.startswith("1 too many, 0 may have come into the image; new at")
    assert check.flags(torn[None], field_of=lambda _: field) == []


def test_a_tolerance_lets_some_pass_and_specks_always_do() -> None:
    frame = squares(without=((4, 5), (6, 6)))
    frame[250:253, 300:303] = True
    assert len(MarkerCheck(squares(), tolerance=1).flags(frame[None])) == 1
    assert MarkerCheck(squares(), tolerance=2).flags(frame[None]) == []
    assert len(MarkerCheck(squares(), tolerance=2, smallest_px=5).flags(frame[None])) == 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: pack(np.zeros((480, 640), np.uint8)), "masks: found uint8"),
        (lambda: pack(np.zeros((640, 480), bool)), r"expected bool \(\.\.\., 480, 640\)"),
        (lambda: unpack(np.zeros(38401, np.uint8)), "expected uint8"),
        (lambda: unpack(np.zeros(38400, np.int64)), "expected uint8"),
        (lambda: draw_discs(np.zeros(48)), "counts: found"),
        (lambda: draw_discs(np.full((16, 3), np.nan)), "counts: found"),
        (lambda: DiscMap(size_min=7000.0), "found .*allowed"),
        (lambda: DiscMap(size_max=float("nan")), "found .*allowed"),
        (lambda: DiscMap(centre_max=-1.0), "found .*allowed"),
        (lambda: DiscMap(shift_max=-0.1), "found .*allowed"),
        (lambda: count_markers(np.zeros((2, 10, 10), np.bool_)), "expected one bool"),
        (lambda: find_blobs(np.zeros((10, 10), np.uint8)), "expected bool"),
        (lambda: MarkerCheck(squares(), tolerance=-1), "tolerance: found"),
        (lambda: MarkerCheck(np.zeros((HEIGHT, WIDTH), np.bool_)), "reference: found no patch"),
    ],
)
def test_what_means_nothing_is_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
