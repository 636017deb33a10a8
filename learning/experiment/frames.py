"""Frames of an experiment: presses of sensors, and presses translated in memory, many at once."""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
import torch
from torch import Tensor

from learning.data.images import shrink_masks, unpack_masks
from learning.data.presses import Form, Presses, load_presses
from learning.data.splits import PressKey, Role, Split
from learning.errors import LearningError
from learning.markers.displacement import fields_of_presses
from learning.training.run import generator
from learning.translation.archive import Pair, target_references
from learning.translation.flow import warp_masks
from learning.translation.translator import SensorView, Translator
from recorder.archive import ArchivedSensor, MarkerArchive
from recorder.progress import ItemProgress, ReportItems

# Roles of presses whose forces are predicted.
TESTED: tuple[Role, ...] = ("new_press", "new_indenter")


def pairs_of(archive: MarkerArchive, names: Sequence[str] | None) -> tuple[Pair, ...]:
    """Return the requested pairs, SOURCE:TARGET; None: all directed pairs from labelled sensors."""
    labelled = labelled_sensors(archive)
    if names is None:
        if not labelled:
            raise LearningError(
                f"{archive.name}: found no label of any sensor; allowed: one labelled source or "
                "more"
            )
        return tuple(Pair(*pair) for pair in permutations(archive, 2) if pair[0] in labelled)
    pairs = []
    for text in names:
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
    """Return the sensors with a label of Fx, Fy or Fz in a located, or training, press."""
    labelled = set()
    for name, sensor in archive.items():
        table = sensor.table
        rows = np.flatnonzero(table["valid"] & (table["location"] >= 0))
        if split is not None:
            rows = split.rows(table, "train")
        if np.isfinite(table["wrench"][rows, :3]).any():
            labelled.add(name)
    return frozenset(labelled)


def load_some(
    sensor: ArchivedSensor,
    split: Split,
    roles: Sequence[Role],
    most: int | None,
    seed: int,
    *,
    device: torch.device,
    form: Form = "packed",
) -> Presses:
    """Load at most `most` presses of each role, at the same locations for all sensors."""
    rows = []
    for role in roles:
        of_role, locations = split.rows(sensor.table, role), split.locations(role)
        if most is not None and most < len(locations):
            order = generator(seed, "experiment", "presses", role).permutation(len(locations))
            chosen = np.isin(sensor.table["location"][of_role], locations[order[:most]])
            of_role = of_role[chosen]
        rows.append(of_role)
    with ItemProgress(f"frames of {sensor.name}", sys.stderr) as progress:
        return load_presses(
            sensor, np.concatenate(rows), device=device, form=form, progress=progress
        )


def as_images(presses: Presses) -> Presses:
    """Convert packed presses to images (N, 256, 256)."""
    images = torch.empty(presses.frames, 256, 256, dtype=torch.uint8, device=presses.device)
    for part in torch.arange(presses.frames, device=presses.device).split(256):
        images[part] = shrink_masks(unpack_masks(presses.images[part]))
    references = shrink_masks(unpack_masks(presses.references))
    return replace(presses, form="images", images=images, references=references)


def thinned(split: Split, most: int, seed: int) -> Split:
    """Return a split with at most `most` presses of each tested role; others become validation."""
    presses: list[PressKey] = []
    for role in {press.role for press in split.presses}:
        of_role = [press for press in split.presses if press.role == role]
        if role not in TESTED:
            presses += of_role
            continue
        order = generator(seed, "experiment", "scored", role).permutation(len(of_role))
        scored = set(order[:most].tolist())
        presses += [
            press if number in scored else replace(press, role="validation")
            for number, press in enumerate(of_role)
        ]
    return replace(split, presses=tuple(sorted(presses, key=lambda press: press.location)))


# Translation in memory.

# Frames translated at once: 79 MB of masks.
_AT_ONCE = 256


@dataclass(frozen=True, slots=True, eq=False)
class TargetView:
    """References of the target for the frames of a source."""

    view: SensorView
    """View of the target's images."""
    references: Tensor
    """Packed masks without contact (K, 38400) uint8, on the device."""
    reference: Tensor
    """Row of `references` for each frame of the source (N,) int64, on the CPU."""


def look_of(target: ArchivedSensor, presses: Presses, device: torch.device) -> TargetView:
    """Return a target's references at the locations of a source's presses."""
    of_press = target_references(presses.location.numpy(), target.table).astype(np.int64)
    return TargetView(
        SensorView.of(target),
        torch.from_numpy(target.references).to(device),
        torch.from_numpy(of_press)[presses.of_frame],
    )


def translate_presses(
    presses: Presses,
    look: TargetView,
    translator: Translator,
    *,
    progress: ReportItems = lambda done, total: None,
) -> Presses:
    """Translate presses to another sensor, as images.

    Frames of packed presses are grouped by references, not by press, so the translator of the pair
    must depend on single frames and their reference only.
    """

    def translated(rows: Tensor, own: int, other: int) -> Tensor:
        masks = unpack_masks(presses.images[rows.to(presses.device)])
        before, after = presses.references[own : own + 1], look.references[other : other + 1]
        return translator.translate(masks, unpack_masks(after)[0], unpack_masks(before)[0])

    return _as_target_images(presses, look, translated, progress)


def warp_presses(
    presses: Presses,
    look: TargetView,
    fields: Tensor,
    *,
    progress: ReportItems = lambda done, total: None,
) -> Presses:
    """Translate packed presses to another sensor by displacement (N, 57, 73, 2) [px], on the CPU.

    The displacement is that in the target's image.
    """

    def translated(rows: Tensor, own: int, other: int) -> Tensor:
        after = unpack_masks(look.references[other : other + 1])[0]
        return warp_masks(after, fields[rows].to(presses.device).float())

    return _as_target_images(presses, look, translated, progress)


def flow_fields(
    presses: Presses,
    source: SensorView,
    target: SensorView,
    *,
    processes: int = 1,
    progress: ReportItems = lambda done, total: None,
) -> Tensor:
    """Compute displacements (N, 57, 73, 2) float16 [px of the target's image] from tracked markers.

    Presses are packed, each from its first frame on.
    """
    images = presses.images.cpu().numpy()
    fields = fields_of_presses(
        lambda first, end: images[first:end],
        presses.starts.numpy(),
        presses.references.cpu().numpy(),
        presses.reference.cpu().numpy(),
        source=source,
        target=target,
        processes=processes,
        progress=progress,
    )
    return torch.from_numpy(fields)


def _as_target_images(
    presses: Presses,
    look: TargetView,
    translated: Callable[[Tensor, int, int], Tensor],
    progress: ReportItems,
) -> Presses:
    images = torch.empty(presses.frames, 256, 256, dtype=torch.uint8, device=presses.device)
    done = 0
    progress(0, presses.frames)
    for rows, own, other in _groups(presses.reference.cpu(), look.reference):
        images[rows.to(presses.device)] = shrink_masks(translated(rows, own, other))
        done += len(rows)
        progress(done, presses.frames)
    return replace(
        presses,
        sensor=f"{presses.sensor}-to-{look.view.name}",
        mm_per_px=look.view.mm_per_column,
        form="images",
        images=images,
        references=shrink_masks(unpack_masks(look.references)),
        reference=look.reference.to(presses.device),
    )


def _groups(own: Tensor, other: Tensor) -> Iterator[tuple[Tensor, int, int]]:
    """Yield rows (n,) that share both references, at most 256, and the references' rows."""
    both = np.stack([own.numpy(), other.numpy()], axis=1)
    for one, another in np.unique(both, axis=0).tolist():
        rows = torch.from_numpy(np.flatnonzero((both == (one, another)).all(axis=1)))
        for part in rows.split(_AT_ONCE):
            yield part, one, another
