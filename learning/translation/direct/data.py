"""Training data of the direct translator: aligned images with segmentation and mounting errors.

Images are (n, 1, h, w) in 0..1. Everything random comes from a numpy generator, so that a resumed
training draws the same numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from learning.data.images import read_fields, shrink, unit
from learning.data.presses import Progress, read_frames_of
from learning.data.splits import Role, Split
from learning.data.synthetic import before, pixel_grid, sample_patterns
from learning.errors import LearningError
from learning.translation.direct.autoencoder import orient
from recorder.archive import ArchivedSensor, MarkerArchive, location_pairs
from recorder.markers import Lattice

if TYPE_CHECKING:
    from learning.translation.direct.train import Augmentation


# Standard deviation of the blur before the shifted threshold [px].
EDGE_SIGMA = 1.2
# Largest number of blots in an image.
BLOTS = 8
# Radius of a blot [px]: about that of a marker.
BLOT_RADIUS = 3.0, 9.0


def move_edges(images: Tensor, by: Tensor) -> Tensor:
    """Return images whose marker edges are moved outwards by (n,) [px], or inwards if negative.

    Mimics a wrong segmentation threshold: images are blurred and cut at another level.
    """
    reach = int(3 * EDGE_SIGMA)
    steps = torch.arange(-reach, reach + 1, device=images.device, dtype=images.dtype)
    kernel = torch.exp(-0.5 * (steps / EDGE_SIGMA) ** 2)
    kernel = kernel / kernel.sum()
    padded = functional.pad(images, (reach,) * 4, mode="replicate")
    blurred = functional.conv2d(padded, kernel.view(1, 1, 1, -1))
    blurred = functional.conv2d(blurred, kernel.view(1, 1, -1, 1))
    score = by.to(images.dtype) / EDGE_SIGMA
    level = torch.special.ndtr(-score)
    slope = torch.exp(-0.5 * score**2) / (EDGE_SIGMA * (2 * torch.pi) ** 0.5)
    cut: Tensor = 0.5 + (blurred - level[:, None, None, None]) / slope[:, None, None, None]
    return cut.clamp(0, 1)


def blot(images: Tensor, largest_share: float, generator: np.random.Generator) -> Tensor:
    """Return images with random discs erased, up to a fraction of their area."""
    count, _, height, width = images.shape
    radius = generator.uniform(*BLOT_RADIUS, (count, BLOTS))
    fraction = generator.uniform(0, largest_share, (count, 1))
    due = fraction * height * width / (np.pi * (radius**2).mean(axis=1, keepdims=True))
    radius = np.where(generator.random((count, BLOTS)) < due / BLOTS, radius, 0.0)
    centre = generator.random((count, BLOTS, 2)) * (height, width)
    rows = torch.arange(height, device=images.device)[:, None]
    columns = torch.arange(width, device=images.device)[None]
    kept = torch.ones((count, height, width), dtype=torch.bool, device=images.device)
    for place in range(BLOTS):
        row, column, size = (
            torch.from_numpy(np.asarray(value, np.float32)).to(images.device)[:, None, None]
            for value in (centre[:, place, 0], centre[:, place, 1], radius[:, place])
        )
        kept &= (rows - row) ** 2 + (columns - column) ** 2 >= size**2
    return images * kept.unsqueeze(1)


def remount(
    images: list[Tensor], options: Augmentation, generator: np.random.Generator
) -> list[Tensor]:
    """Return images of a slightly displaced sensor, the same displacement within a sample."""
    count, _, height, width = images[0].shape
    angle = generator.uniform(-1, 1, count) * options.mount_angle
    scale = 1 + generator.uniform(-1, 1, count) * options.mount_scale
    shift = generator.uniform(-1, 1, (count, 2)) * options.mount_shift * 2 / (width, height)
    cosine, sine = np.cos(angle) * scale, np.sin(angle) * scale
    matrix = np.stack(
        [
            np.stack([cosine, -sine, shift[:, 0]], axis=1),
            np.stack([sine, cosine, shift[:, 1]], axis=1),
        ],
        axis=1,
    )
    theta = torch.from_numpy(matrix.astype(np.float32)).to(images[0].device)
    grid = functional.affine_grid(theta, [count, 1, height, width], align_corners=False)
    return [functional.grid_sample(image, grid, align_corners=False) for image in images]


def disturb_source(
    frame: Tensor, reference: Tensor, options: Augmentation, generator: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Return a source's frames and references with random mounting and segmentation errors."""
    count = len(frame)
    if options.mount_shift or options.mount_angle or options.mount_scale:
        frame, reference = remount([frame, reference], options, generator)
    if options.edge or options.edge_frame:
        both = generator.uniform(-options.edge, options.edge, count)
        alone = generator.uniform(-options.edge_frame, options.edge_frame, count)
        frame, reference = (
            move_edges(image, torch.from_numpy(by.astype(np.float32)).to(frame.device))
            for image, by in ((frame, both + alone), (reference, both))
        )
    if options.drop:
        frame = blot(frame, options.drop, generator)
    return frame, reference


# Images of several sensors under the same presses, in memory.

_AT_ONCE = 256


@dataclass(frozen=True, slots=True, eq=False)
class AlignedImages:
    """Images of S sensors at the same N moments of presses."""

    sensors: tuple[str, ...]
    """Names of the sensors (S)."""
    images: Tensor
    """(S, N, 256, 256) uint8."""
    references: Tensor
    """Reference images (K, 256, 256) uint8, concatenated over sensors."""
    reference: Tensor
    """Row of `references` for each image (S, N) int64."""
    location: NDArray[np.int64]
    """Location of each moment (N,)."""
    fields: Tensor | None = None
    """Displacements (F, N, 2, h, w) float16 [px of 640 x 480] of surfaces that have them."""
    field_of: tuple[int, ...] = ()
    """Row of `fields` for each sensor (S); -1: none."""
    lattice: Lattice | None = None
    """Lattice of the fields; None: cells that cover the image."""

    def __len__(self) -> int:
        """Return the number of moments."""
        return self.images.shape[1]


def align(
    archive: MarkerArchive,
    split: Split,
    role: Role,
    *,
    sensors: Sequence[str] | None = None,
    preset: str = "supplement",
    fields: bool = True,
    device: torch.device | str = "cpu",
    progress: Progress = lambda done, total: None,
) -> AlignedImages:
    """Return location-paired images of an archive's sensors, at moments that all of them have.

    Args:
        archive: Archive to read.
        split: Split of its locations.
        role: Role of the locations to read.
        sensors: Names of two or more; None: all that the split does not hold out.
        preset: Rule for pairing frames (`recorder.archive.PRESETS`).
        fields: True to read displacement fields where available.
        device: Device for all tensors.
        progress: Called with the number of images read and the total.

    Raises:
        LearningError: The split belongs to another archive, there are fewer than two sensors, a
            sensor is held out, or no frames can be paired.
        SessionError: A sensor does not exist, or the archive is damaged or still being written.
    """
    names = group(archive, split, sensors)
    chosen = [archive[name] for name in names]
    rows, location = _common_rows(chosen, preset)
    kept = np.isin(location, split.locations(role))
    rows, location = rows[:, kept], location[kept]
    if not len(location):
        raise LearningError(
            f"{archive.name}: no location of role {role} was seen by all of {', '.join(names)}"
        )
    images = read_frames_of(chosen, [*rows], device, progress)
    kinds = [torch.from_numpy(shrink(sensor.references)) for sensor in chosen]
    firsts = np.cumsum([0, *(len(kind) for kind in kinds[:-1])])
    reference = np.stack(
        [
            sensor.table["reference"][mine].astype(np.int64) + first
            for sensor, mine, first in zip(chosen, rows, firsts, strict=True)
        ]
    )
    found = _read_surfaces(chosen, rows, device) if fields else None
    return AlignedImages(
        sensors=names,
        images=images.unflatten(0, rows.shape),
        references=torch.cat(kinds).to(device),
        reference=torch.from_numpy(reference).to(device),
        location=location,
        fields=None if found is None else found[0],
        field_of=(-1,) * len(names) if found is None else found[1],
        lattice=None if found is None else found[2],
    )


def group(
    archive: MarkerArchive, split: Split, sensors: Sequence[str] | None = None
) -> tuple[str, ...]:
    """Return the names of the sensors of one training.

    Args:
        archive: Archive with the sensors.
        split: Split that defines the held-out sensors.
        sensors: Requested names; None: all that are not held out.

    Raises:
        LearningError: The split belongs to another archive, there are fewer than two sensors, or a
            sensor is held out.
    """
    split.check(archive)
    trained = split.trained_sensors(archive)
    names = tuple(sensors or trained)
    for name in names:
        if name not in trained:
            raise LearningError(f"sensors: found {name!r}; allowed: {', '.join(trained)}")
    if len(names) < 2 or len(set(names)) < len(names):
        raise LearningError(
            f"sensors: found {', '.join(names) or 'none'}; allowed: two or more different ones"
        )
    return names


def _common_rows(
    sensors: Sequence[ArchivedSensor], preset: str
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows (S, N) paired across all sensors, and their locations (N,)."""
    first = sensors[0].table
    pairs = [location_pairs(first, sensor.table, preset) for sensor in sensors]
    common = functools.reduce(np.intersect1d, [pair.source for pair in pairs])
    rows = np.stack([_taken(pair.source, pair.target, common) for pair in pairs])
    return rows, first["location"][common].astype(np.int64)


def _taken(
    keys: NDArray[np.int64], values: NDArray[np.int64], chosen: NDArray[np.int64]
) -> NDArray[np.int64]:
    order = np.argsort(keys)
    return values[order][np.searchsorted(keys[order], chosen)]


def _read_surfaces(
    sensors: Sequence[ArchivedSensor], rows: NDArray[np.int64], device: torch.device | str
) -> tuple[Tensor, tuple[int, ...], Lattice] | None:
    """Return fields (F, N, 2, h, w) float16, the row of each sensor, and the lattice; None if none.

    Sensors that share an array and rows of archived fields share a row here too.
    """
    surfaces: list[Tensor] = []
    owners: dict[tuple[str, bytes], int] = {}
    field_of, lattice = [], None
    for sensor, mine in zip(sensors, rows, strict=True):
        if sensor.fields is None or (lattice is not None and sensor.lattice != lattice):
            field_of.append(-1)
            continue
        lattice = sensor.lattice
        key = str(sensor.attrs.get("displacement_of") or sensor.name), mine.tobytes()
        if key not in owners:
            owners[key] = len(surfaces)
            parts = [
                read_fields(sensor, mine[first : first + _AT_ONCE]).displacement.half()
                for first in range(0, len(mine), _AT_ONCE)
            ]
            surfaces.append(torch.cat(parts))
        field_of.append(owners[key])
    if lattice is None:
        return None
    return torch.stack(surfaces).to(device), tuple(field_of), lattice


# Training examples of a direct translator, drawn on the device.

# Indices of a source and a target sensor.
Pair = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Examples:
    """Corresponding images in 0..1 (n, 1, h, w)."""

    source: Tensor
    source_reference: Tensor
    given: Tensor
    """True if the source's reference may be used (n,) bool."""
    reference: Tensor
    """Reference of the target."""
    target: Tensor
    """True frame of the target."""


def all_pairs(sensors: int) -> tuple[Pair, ...]:
    """Return every directed pair of different sensors."""
    return tuple((i, j) for i in range(sensors) for j in range(sensors) if i != j)


def draw_examples(
    aligned: AlignedImages,
    pairs: Sequence[Pair],
    count: int,
    augmentation: Augmentation,
    generator: np.random.Generator,
) -> Examples:
    """Return random examples, the same for the same generator.

    Args:
        aligned: Images to draw from.
        pairs: Directions to train.
        count: Number of examples.
        augmentation: Augmentation of the examples.
        generator: Source of everything random.
    """
    moments = generator.integers(len(aligned), size=count)
    chosen = np.asarray(pairs)[generator.integers(len(pairs), size=count)]
    examples = examples_at(aligned, moments, chosen)
    source, target = examples.source, examples.target
    source_reference, reference = examples.source_reference, examples.reference
    random_source = generator.random(count) < augmentation.procedural_source
    random_target = generator.random(count) < augmentation.procedural_target
    # A random source uses the target's surface, a random target the source's; two share one.
    surface = np.where(random_source, chosen[:, 1], chosen[:, 0])
    for replaced, frame, rest in (
        (random_source, source, source_reference),
        (random_target, target, reference),
    ):
        _replace_by_patterns(aligned, moments, surface, replaced, (frame, rest), generator)
    source, source_reference = disturb_source(source, source_reference, augmentation, generator)
    images = [source, source_reference, reference, target]
    if augmentation.orientation:
        images = orient(images, generator)
    given = generator.random(count) >= augmentation.no_source_reference
    source, source_reference, reference, target = images
    return Examples(
        source=source,
        source_reference=source_reference,
        given=torch.from_numpy(given).to(source.device),
        reference=reference,
        target=target,
    )


def examples_at(
    aligned: AlignedImages,
    moments: np.ndarray[tuple[int], np.dtype[np.int64]],
    pairs: np.ndarray[tuple[int, int], np.dtype[np.int64]],
) -> Examples:
    """Return examples without augmentation.

    Args:
        aligned: Images to take them from.
        moments: Indices of moments (n,).
        pairs: Source and target of each example (n, 2).
    """
    device = aligned.images.device
    moment = torch.from_numpy(moments).to(device)
    source, target = torch.from_numpy(np.ascontiguousarray(pairs.T)).to(device)
    return Examples(
        source=unit(aligned.images[source, moment]),
        source_reference=unit(aligned.references[aligned.reference[source, moment]]),
        given=torch.ones(len(moment), dtype=torch.bool, device=device),
        reference=unit(aligned.references[aligned.reference[target, moment]]),
        target=unit(aligned.images[target, moment]),
    )


def _replace_by_patterns(
    aligned: AlignedImages,
    moments: np.ndarray[tuple[int], np.dtype[np.int64]],
    surface: np.ndarray[tuple[int], np.dtype[np.int64]],
    replaced: np.ndarray[tuple[int], np.dtype[np.bool_]],
    images: tuple[Tensor, Tensor],
    generator: np.random.Generator,
) -> None:
    """Replace frames and references by random patterns if their surfaces have a field.

    Args:
        aligned: Images with the fields.
        moments: Moments of the examples (n,).
        surface: Sensor whose surface each example shows (n,).
        replaced: True for examples to replace (n,).
        images: Frames and references (n, 1, h, w); changed in place.
        generator: Generator of the patterns.
    """
    if aligned.fields is None:
        return
    owner = np.asarray(aligned.field_of)[surface]
    rows = np.flatnonzero(replaced & (owner >= 0))
    if not rows.size:
        return
    frames, references = images
    device, side = frames.device, frames.shape[-1]
    where = torch.from_numpy(rows).to(device)
    field = aligned.fields[
        torch.from_numpy(owner[rows]).to(device), torch.from_numpy(moments[rows]).to(device)
    ]
    patterns = sample_patterns(len(rows), generator, device)
    frames[where] = patterns.draw(before(field, aligned.lattice, side))
    references[where] = patterns.draw(pixel_grid(side, device))
