"""Scores of the chain: forces with intervals over indenters, and patterns."""

from collections.abc import Iterator
from itertools import permutations
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.paper.study import UNSEEN
from benchmarks.sums import interval, resampled, sums_by_indenter
from learning.data.splits import Split
from learning.evaluation.translation import overlap
from learning.metrics import r_squared
from learning.training.run import generator
from learning.translation.translator import Translator
from recorder import MarkerArchive
from recorder.archive import location_pairs
from recorder.markers import unpack

Floats = NDArray[np.float64]


def force_scores(
    true: Floats, predicted: Floats, indenter: NDArray[np.str_], seed: int
) -> dict[str, float]:
    """Return R2 (mean of axes, with its 90 % interval over indenters), and MAE [N].

    Labels and predictions are (n, 3) [N], of frames with one indenter's name each (n,).
    """
    sums = np.array([*sums_by_indenter(true, predicted, indenter).values()])
    again = resampled(sums, generator(seed, "indenters"))
    low, high = interval(again, (0.05, 0.95))
    scores = {"r2": r_squared(true, predicted).mean(), "r2_low": low, "r2_high": high}
    errors = np.abs(predicted - true).mean(axis=0)
    scores |= {"mae_shear_n": errors[:2].mean(), "mae_fz_n": errors[2]}
    return {name: round(float(value), 4) for name, value in scores.items()}


def pattern_rows(
    archive: MarkerArchive, split: Split, translator: Translator, most: int, device: torch.device
) -> Iterator[dict[str, Any]]:
    """Yield scores of pairs of patterns at some locations, before and after translation."""
    locations = split.locations(UNSEEN)
    locations = locations[generator(0, "states").permutation(len(locations))[:most]]
    for source, target in permutations(archive, 2):
        ends = archive[source], archive[target]
        pairs = location_pairs(ends[0].table, ends[1].table)
        some = np.isin(ends[0].table["location"][pairs.source], locations)
        before, real = ends[0].masks(pairs.source[some]), ends[1].masks(pairs.target[some])
        # Nothing drifts: each has one image without contact.
        still, there = (torch.from_numpy(unpack(each.references)[0]).to(device) for each in ends)
        frames = torch.from_numpy(before).to(device)
        after = translator.translate(frames, there, still).cpu().numpy()
        row: dict[str, Any] = {"source": source, "target": target, "states": len(real)}
        for when, masks in (("before", before), ("after", after)):
            row[f"dice_{when}"] = round(float(overlap(masks, real).dice.mean()), 4)
        yield row
