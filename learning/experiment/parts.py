"""Parts of an archive that an experiment loads: presses for training and for prediction."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from learning.data.images import shrink_masks, unpack_masks
from learning.data.presses import Form, Presses, load_presses
from learning.data.splits import PressKey, Role, Split
from learning.errors import LearningError
from learning.experiment.settings import ExperimentSettings
from learning.experiment.translating import TargetView
from learning.training.run import generator
from learning.translation.archive import target_references
from learning.translation.translator import SensorView
from recorder import MarkerArchive
from recorder.archive import ArchivedSensor
from recorder.progress import ItemProgress

# Roles of presses whose forces are predicted.
TESTED: tuple[Role, ...] = ("new_press", "new_indenter")


@dataclass(frozen=True, slots=True)
class Pair:
    """Source and target sensor."""

    source: str
    target: str


@dataclass(frozen=True, slots=True, eq=False)
class Tested:
    """Frames of a target for which forces are predicted."""

    presses: Presses
    """Their images."""
    role: NDArray[np.str_]
    """Role of each frame (N,)."""


def pairs_of(archive: MarkerArchive, asked: Sequence[str] | None) -> tuple[Pair, ...]:
    """Return the requested pairs, SOURCE:TARGET; None: all directed pairs from labelled sensors."""
    labelled = labelled_sensors(archive)
    if asked is None:
        if not labelled:
            raise LearningError(
                f"{archive.name}: found no label of any sensor; allowed: one labelled source or "
                "more"
            )
        return tuple(
            Pair(one, other)
            for one in archive
            for other in archive
            if one in labelled and one != other
        )
    pairs = []
    for text in asked:
        source, _, target = text.partition(":")
        if source == target or not {source, target} <= set(archive):
            raise LearningError(
                f"--pairs: found {text!r}; allowed: SOURCE:TARGET, two of {', '.join(archive)}"
            )
        if source not in labelled:
            raise LearningError(
                f"--pairs: found {text!r}, and {source} has no labels; allowed sources: "
                f"{', '.join(name for name in archive if name in labelled) or 'none here'}"
            )
        pairs.append(Pair(source, target))
    return tuple(dict.fromkeys(pairs))


def labelled_sensors(archive: MarkerArchive, split: Split | None = None) -> frozenset[str]:
    """Return the sensors with a label of Fx, Fy or Fz in a located press.

    Args:
        archive: The archive.
        split: Only its training presses count; None: all located presses.
    """
    found = set()
    for name, sensor in archive.items():
        table = sensor.table
        rows = np.flatnonzero(table["valid"] & (table["location"] >= 0))
        if split is not None:
            rows = split.rows(table, "train")
        if np.isfinite(table["wrench"][rows, :3]).any():
            found.add(name)
    return frozenset(found)


def trained_on(
    sensor: ArchivedSensor,
    split: Split,
    role: Role,
    settings: ExperimentSettings,
    device: torch.device,
) -> Presses | None:
    """Load the training presses of a source, packed; None if there are none."""
    rows = _some(sensor, split, role, settings.train_presses, settings.seed)
    return _loaded(sensor, rows, device, packed=True) if len(rows) else None


def tested_on(
    sensor: ArchivedSensor, split: Split, settings: ExperimentSettings, device: torch.device
) -> Tested:
    """Load the presses of a target for which forces are predicted."""
    rows = np.concatenate(
        [_some(sensor, split, role, settings.test_presses, settings.seed) for role in TESTED]
    )
    if not len(rows):
        raise LearningError(f"{sensor.name}: found no presses of {', '.join(TESTED)} in the split")
    presses = _loaded(sensor, rows, device, packed=False)
    return Tested(presses, split.role(sensor.table["location"][presses.rows.numpy()]))


def as_images(presses: Presses) -> Presses:
    """Convert packed presses to images (N, 256, 256)."""
    images = torch.empty(presses.frames, 256, 256, dtype=torch.uint8, device=presses.device)
    for part in torch.arange(presses.frames, device=presses.device).split(256):
        images[part] = shrink_masks(unpack_masks(presses.images[part]))
    references = shrink_masks(unpack_masks(presses.references))
    return replace(presses, form="images", images=images, references=references)


def frames_of_a_press(archive: MarkerArchive) -> int:
    """Return the mean number of frames of a located press over all sensors; at least 1."""
    frames = presses = 0
    for sensor in archive.values():
        location = sensor.table["location"][sensor.table["valid"]]
        frames += int(np.count_nonzero(location >= 0))
        presses += len(np.unique(location[location >= 0]))
    return max(1, round(frames / max(1, presses)))


def look_of(target: ArchivedSensor, presses: Presses, device: torch.device) -> TargetView:
    """Return a target's references at the locations of a source's presses."""
    of_press = target_references(presses.location.numpy(), target.table).astype(np.int64)
    return TargetView(
        target.name,
        SensorView.of(target),
        torch.from_numpy(target.references).to(device),
        torch.from_numpy(of_press)[presses.of_frame],
    )


def thinned(split: Split, most: int, seed: int) -> Split:
    """Return a split with at most `most` presses of each tested role; others become validation."""
    presses: list[PressKey] = []
    for role in {press.role for press in split.presses}:
        of_role = [press for press in split.presses if press.role == role]
        if role not in TESTED:
            presses += of_role
            continue
        order = generator(seed, "experiment", "scored", role).permutation(len(of_role))
        kept = set(order[:most].tolist())
        presses += [
            press if number in kept else replace(press, role="validation")
            for number, press in enumerate(of_role)
        ]
    return replace(split, presses=tuple(sorted(presses, key=lambda press: press.location)))


def _some(
    sensor: ArchivedSensor, split: Split, role: Role, most: int | None, seed: int
) -> NDArray[np.int64]:
    """Return rows of at most `most` presses of a role, at the same locations for all sensors."""
    rows = split.rows(sensor.table, role)
    places = split.locations(role)
    if most is None or most >= len(places):
        return rows
    order = generator(seed, "experiment", "presses", role).permutation(len(places))
    return rows[np.isin(sensor.table["location"][rows], places[order[:most]])]


def _loaded(
    sensor: ArchivedSensor, rows: NDArray[np.int64], device: torch.device, *, packed: bool
) -> Presses:
    with ItemProgress(f"frames of {sensor.name}", sys.stderr) as progress:
        form: Form = "packed" if packed else "images"
        return load_presses(sensor, rows, device=device, form=form, progress=progress)
