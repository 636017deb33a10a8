"""Scores of the chain: forces with intervals over indenters, and patterns."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.paper.study import UNSEEN
from benchmarks.sums import r2_of, sums_by_indenter
from learning.data.images import unpack_masks
from learning.data.splits import Split
from learning.evaluation.translation import overlap
from learning.metrics import r_squared
from learning.training.run import generator
from learning.translation.translator import Translator
from recorder import MarkerArchive
from recorder.archive import ArchivedSensor, location_pairs
from recorder.markers import pack, unpack

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Packed = NDArray[np.uint8]
# Resamples of the test indenters, and the interval between their quantiles.
RESAMPLES, INTERVAL = 2000, (0.05, 0.95)


def force_scores(
    true: Floats, predicted: Floats, indenter: NDArray[np.str_], seed: int
) -> dict[str, float]:
    """Return R2 (mean of axes, with its 90 % interval over indenters), and MAE [N].

    Args:
        true: Labels (n, 3) N.
        predicted: Predictions (n, 3) N.
        indenter: Name of the indenter of each frame (n,).
        seed: Seed of the resamples.
    """
    sums = np.stack([*sums_by_indenter(true, predicted, indenter).values()])
    chosen = generator(seed, "indenters").integers(len(sums), size=(RESAMPLES, len(sums)))
    again = r2_of(sums[chosen].sum(axis=1))
    # Forces of one indenter may not vary.
    low, high = np.nanquantile(again, INTERVAL) if np.isfinite(again).any() else (np.nan, np.nan)
    scores = {"r2": r_squared(true, predicted).mean(), "r2_low": low, "r2_high": high}
    errors = np.abs(predicted - true).mean(axis=0)
    scores |= {"mae_shear_n": errors[:2].mean(), "mae_fz_n": errors[2]}
    return {name: round(float(value), 4) for name, value in scores.items()}


def pattern_rows(
    archive: MarkerArchive,
    split: Split,
    translator: Translator,
    most: int,
    device: torch.device,
) -> Iterator[dict[str, Any]]:
    """Yield scores of pairs of patterns at some locations, before and after translation."""
    locations = split.locations(UNSEEN)
    locations = locations[generator(0, "states").permutation(len(locations))[:most]]
    for source, target in permutations(archive, 2):
        sensors = archive[source], archive[target]
        pairs = location_pairs(sensors[0].table, sensors[1].table)
        some = np.isin(sensors[0].table["location"][pairs.source], locations)
        rows = pairs.source[some], pairs.target[some]
        before, real = (each.packed(own) for each, own in zip(sensors, rows, strict=True))
        after = translated(sensors, rows, translator, device)
        row: dict[str, Any] = {"source": source, "target": target, "states": len(real)}
        for when, packed in (("before", before), ("after", after)):
            dice = overlap(unpack(packed), unpack(real)).dice.mean()
            row[f"dice_{when}"] = round(float(dice), 4)
        yield row


def translated(
    sensors: tuple[ArchivedSensor, ArchivedSensor],
    rows: tuple[Ints, Ints],
    translator: Translator,
    device: torch.device,
) -> Packed:
    """Return packed frames (n, 38400) of a source, as a target would have shown them.

    Args:
        sensors: The source and the target.
        rows: Their rows of the same moments (n,), (n,).
        translator: Translator for this pair.
        device: Device of the translator.
    """
    frames = np.empty((len(rows[0]), 38400), np.uint8)
    ends = tuple(zip(sensors, rows, strict=True))
    stills = np.stack([end.table["reference"][own] for end, own in ends], axis=1)
    for numbers in np.unique(stills, axis=0).tolist():
        alike = np.flatnonzero((stills == numbers).all(axis=1))
        packed = [end.references[[number]] for (end, _), number in zip(ends, numbers, strict=True)]
        before, after = (_masks(each, device)[0] for each in packed)
        masks = _masks(sensors[0].packed(rows[0][alike]), device)
        frames[alike] = pack(translator.translate(masks, after, before).cpu().numpy())
    return frames


def _masks(packed: Packed, device: torch.device) -> torch.Tensor:
    return unpack_masks(torch.from_numpy(packed)).to(device)
