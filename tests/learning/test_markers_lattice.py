"""Markers found again under a contact: painted ones, and those of a GelSlim marked by eye."""

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from learning.markers import preset
from learning.markers.fit import fit_preset, read_picture
from learning.markers.pattern import with_reference
from learning.markers.segment import CameraPreset, Segmenter
from recorder.markers import find_blobs
from tests.learning.test_markers_fit import iou, painted

# Folder of recordings of other people, whose licences do not allow passing them on.
RECORDINGS = Path(os.environ.get("REAL_RECORDINGS", Path(__file__).parents[2] / "data"))

# Dots under the contact of three pictures, and at its edge: column and row of the 640 x 480 view,
# marked by eye in enlarged pictures.
_1 = """295 199 325 196 353 202 293 227 322 226 353 230 293 256 319 256 348 258 380 231 377 260"""
_10 = """
265 169 294 170 322 169 353 169 385 170 235 198 265 200 294 201 322 200 352 198 381 196 415 200
236 229 265 230 293 230 321 230 350 229 381 226 413 228 235 257 264 257 293 258 320 258 348 257
381 256 413 257 233 286 263 285 291 285 320 285 349 285 381 284 412 289 231 316 261 315 290 315
320 315 352 315 385 317 413 322 292 348 323 348 354 348 381 351"""
_7 = """
165 251 161 282 201 221 199 250 197 281 295 165 326 165 355 166 386 166 420 166 457 166 494 166
265 193 298 192 327 193 357 194 386 197 420 199 456 200 492 201 232 222 262 224 291 224 322 224
353 226 385 228 419 230 453 233 488 235 231 251 263 251 293 252 323 255 351 257 382 259 414 263
447 265 231 281 262 281 291 282 322 284 351 286 379 292 411 294"""
# Largest distance of a found dot from its mark: 1 px of the enlargement is 2 to 4 px of the view.
NEAR_PX = 6.0


def marked(text: str) -> Any:
    return np.array(text.split(), float).reshape(-1, 2)


def centres(mask: Any) -> Any:
    return find_blobs(mask[None], 12).centre


def found(marks: Any, mask: Any) -> int:
    distance = np.linalg.norm(marks[:, None] - centres(mask)[None], axis=-1)
    return int((distance.min(axis=1) <= NEAR_PX).sum())


def test_dots_under_the_contact_of_a_gelslim_are_found_by_a_preset_of_its_reference() -> None:
    folder = RECORDINGS / "gelslim"
    if not (folder / "ref.jpg").is_file():
        pytest.skip(f"{folder}: no pictures of a GelSlim; REAL_RECORDINGS names their folder")
    reference = read_picture(folder / "ref.jpg")
    for chosen in (fit_preset([reference])[0], preset("gelslim")):
        assert isinstance(chosen, CameraPreset)
        segmenter = Segmenter(chosen)
        finder = with_reference(segmenter, segmenter.view(reference))
        without, again, count = 0, 0, 0
        for number, text in ((1, _1), (10, _10), (7, _7)):
            view = segmenter.view(read_picture(folder / f"reconstruct_{number}.jpg"))
            without += found(marked(text), segmenter.mask_of_view(view))
            again += found(marked(text), finder.mask_of_view(view))
            count += len(marked(text))
        assert count == 99
        assert without / count < 0.95 <= again / count


@pytest.mark.slow
def test_markers_in_dark_streaks_are_found_again_and_a_removed_one_is_not() -> None:
    no_contact, _ = painted(3)
    pressed, known = (one.copy() for one in painted(3, pressed=True))
    preset, _ = fit_preset([no_contact])
    segmenter = Segmenter(preset)
    finder = with_reference(segmenter, segmenter.view(no_contact))
    places = centres(known)
    order = np.argsort(np.linalg.norm(places - (330, 250), axis=1))
    streak = np.zeros(known.shape, np.float32)
    for place in places[order[1:6]]:
        column, row = place.astype(int).tolist()
        cv2.line(streak, (column - 8, row - 30), (column + 10, row + 30), 1.0, 10)
    light = 1 - 0.6 * cv2.GaussianBlur(streak, (0, 0), 1.5)
    pressed = np.round(pressed * light[..., None]).astype(np.uint8)
    column, row = places[order[0]].astype(int).tolist()
    square = (slice(row - 20, row + 20), slice(column - 20, column + 20))
    hidden = np.zeros(known.shape, np.uint8)
    hidden[square] = cv2.dilate(known[square].astype(np.uint8), np.ones((9, 9), np.uint8))
    pressed = cv2.inpaint(pressed, hidden, 5, cv2.INPAINT_TELEA)
    known[square] = False

    plain, again = segmenter.mask(pressed), finder.mask_of_view(segmenter.view(pressed))

    assert iou(plain, known) < 0.95
    assert iou(again, known) > 0.96
    assert len(centres(again)) == len(places) - 1
    assert not again[square].any()
    assert found(places[order[1:]], again) == len(places) - 1


@pytest.mark.slow
def test_a_picture_without_contact_and_one_whose_markers_are_seen_are_as_without() -> None:
    no_contact, _ = painted(4)
    preset, _ = fit_preset([no_contact])
    segmenter = Segmenter(preset)
    finder = with_reference(segmenter, segmenter.view(no_contact))
    for picture in (no_contact, np.roll(no_contact, 9, axis=1), np.full_like(no_contact, 90)):
        view = segmenter.view(picture)
        assert np.array_equal(finder.mask_of_view(view), segmenter.mask_of_view(view))


def test_pins_of_a_tactip_are_found_without_the_lamps_around_them() -> None:
    folder = RECORDINGS / "tactip"
    files = sorted(folder.glob("*.png"))
    if not files:
        pytest.skip(f"{folder}: no pictures of a TacTip; REAL_RECORDINGS names their folder")
    pictures = [read_picture(path) for path in files]
    fitted, _ = fit_preset(pictures[:1])
    for chosen, false in ((preset("bright-markers"), 1), (fitted, 3)):
        assert isinstance(chosen, CameraPreset)
        segmenter = Segmenter(chosen)
        # Counted by eye in enlarged pictures: 330 pins, and six holders of lamps around them.
        for picture in pictures:
            assert 329 <= len(centres(segmenter.mask(picture))) <= 330 + false
