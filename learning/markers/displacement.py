"""Displacement of a skin from its markers: edges, splines, matching, and fields of whole presses.

In a frame, with or without the frames before, a marker is first expected at its last position plus
half its last motion, or at its position without contact. Detections within half a pitch are matched
if they are mutual nearest neighbours. A match that the others predict more than half a pitch away
is dropped. The spline through the rest predicts all markers again, and the matching is repeated.
Merged discs are divided between their markers.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from learning.errors import LearningError
from learning.markers.pattern import pitch_of
from learning.markers.track import GATE, SPEED
from recorder.markers import HEIGHT, SMALLEST_PX, WIDTH, Blobs, Lattice, find_blobs, pack, unpack
from recorder.processes import Workers

if TYPE_CHECKING:
    from learning.translation.translator import SensorView

# Subpixel edges of a mask's markers, which are warped instead of the mask.
#
# A binary mask has edges that are off by up to half a pixel, back and forth along them. Markers are
# smooth: each is blurred separately and thresholded at the level that preserves its area. The mask
# is where the level is above one half.

# Standard deviation of the blur. A larger one gives smoother edges and rounder corners of markers.
BLUR_PX = 1.0
_REACH = 5  # pixels that the blur extends beyond a marker
_LEAST_SLOPE = 1e-3  # level per pixel: flatter pixels count as wholly above or below
_HALVINGS = 14
_REFERENCES = 64  # cached levels: a drifting sensor has a reference for each contact point


def edge_level(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the level (480, 640), about 0 to 1, which is above 0.5 on markers; cached."""
    return _level(pack(mask).tobytes())


@functools.lru_cache(maxsize=_REFERENCES)
def _level(packed: bytes) -> NDArray[np.float32]:
    mask = unpack(np.frombuffer(packed, np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=4)
    # Pixels between markers belong to the nearest.
    _, nearest = cv2.distanceTransformWithLabels(
        (~mask).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner = np.zeros(int(nearest.max()) + 1, np.int32)
    owner[nearest[mask]] = labels[mask]
    owners = owner[nearest]
    level = np.zeros(mask.shape, np.float32)
    for label in range(1, count):
        left, top, width, height, area = stats[label]
        part = (
            slice(max(top - _REACH, 0), top + height + _REACH),
            slice(max(left - _REACH, 0), left + width + _REACH),
        )
        # A marker continues beyond the image border, where its cut is no edge.
        soft = cv2.GaussianBlur(
            (labels[part] == label).astype(np.float32),
            (0, 0),
            BLUR_PX,
            borderType=cv2.BORDER_REPLICATE,
        )
        middle = _middle(soft, float(area))
        mine = owners[part] == label
        level[part][mine] = soft[mine] + np.float32(0.5 - middle)
    level.flags.writeable = False
    return level


def _middle(soft: NDArray[np.float32], area: float) -> float:
    """Return the level of a blurred marker (h, w) above which its area lies, with partial pixels.

    The fraction of a pixel above the level follows from its value and slope. Whole pixels would
    switch by the dozen, since markers are symmetric.
    """
    down, across = np.gradient(soft)
    slope = np.maximum(np.hypot(down, across), _LEAST_SLOPE)
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        covered = float(np.clip(0.5 + (soft - middle) / slope, 0.0, 1.0).sum())
        low, high = (middle, high) if covered > area else (low, middle)
    return 0.5 * (low + high)


# Smooth interpolation of marker displacements: the thin-plate spline (Duchon, 1977).
#
# Of all fields with given values at the markers it has the least bending energy. Markers are
# identified by their positions without contact, so the knots are the same in all frames.
# Evaluation, bending energy and leave-one-out prediction are each one matrix per reference.

Floats = NDArray[np.float64]
Chosen = NDArray[np.bool_]

# Regularisation as a fraction of the stiffness. It makes a field unique if its markers (fewer than
# three, or all on one line) do not determine it.
_RIDGE = 1e-6
# Minimum number of markers for a field that grows linearly beyond them.
_AFFINE_FROM = 6


class Spline:
    """Splines with knots at one set of markers."""

    def __init__(self, knots: Floats, *, smoothing: float = 0.0) -> None:
        """Prepare the matrices for knots: column and row (m, 2) [px] without contact.

        `smoothing` is the weight of bending against misfit at the markers, relative to the kernel
        at the distance of neighbours; 0 interpolates.
        """
        self.knots = np.asarray(knots, np.float64)
        count = len(self.knots)
        self._middle = self.knots.mean(axis=0)
        self._unit = max(pitch(self.knots), 1.0)
        rank = 3 if count >= _AFFINE_FROM and _spread(self.knots) else 1
        plain, line = self._basis(self.knots, rank)
        system = np.zeros((count + rank, count + rank))
        system[:count, :count] = plain + smoothing * np.eye(count)
        system[:count, count:], system[count:, :count] = line, line.T
        self._solved = np.linalg.inv(system)[:, :count]
        self._rank = rank
        self.energy: Floats = np.array(self._solved[:count])
        """Bending energy: d^T energy d for displacements d (m,) of the markers (m, m)."""

    def at(self, places: Floats) -> Floats:
        """Return the matrix (q, m) from displacements of the markers to those of places (q, 2)."""
        plain, line = self._basis(places, self._rank)
        return np.asarray(np.concatenate([plain, line], axis=1) @ self._solved, np.float64)

    def filled(self, values: Floats, matched: Chosen) -> Floats:
        """Fill values (m, k) of markers that are not matched (m,), with least bending energy."""
        if matched.all():
            return values
        lost = ~matched
        held = self.energy[np.ix_(lost, lost)]
        ridge = max(_RIDGE * float(np.trace(self.energy)) / len(self.knots), _RIDGE)
        pull = -self.energy[np.ix_(lost, matched)] @ values[matched]
        whole = np.array(values)
        whole[lost] = np.linalg.solve(held + ridge * np.eye(len(held)), pull)
        return whole

    def surprise(self, values: Floats) -> Floats:
        """Return the leave-one-out error (m,) of values (m, k) of all markers [unit of values].

        In closed form: the spline through all other knots differs from the value at a knot by (E
        d)_i / E_ii.
        """
        own = np.maximum(np.diagonal(self.energy), np.finfo(np.float64).tiny)
        return np.asarray(np.linalg.norm((self.energy @ values) / own[:, None], axis=1))

    def _basis(self, places: Floats, rank: int) -> tuple[Floats, Floats]:
        """Return kernel (q, m) and polynomials (q, rank) at places (q, 2)."""
        square = ((places[:, None] - self.knots[None]) ** 2).sum(axis=-1) / self._unit**2
        line = np.ones((len(places), rank))
        if rank == 1:
            # The kernel of a membrane in space: no growth beyond the markers.
            return -np.sqrt(square), line
        line[:, 1:] = (places - self._middle) / self._unit
        return 0.5 * square * np.log(np.maximum(square, 1e-12)), line


def pitch(places: Floats) -> float:
    """Return the median distance of nearest neighbours [px]; 0 for a single marker."""
    return float(np.median(pitch_of(places))) if len(places) > 1 else 0.0


def _spread(places: Floats) -> bool:
    """Return True if markers spread in two directions, so that they determine a plane."""
    along = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(along[-1] > 0.05 * along[0])


Masks = NDArray[np.bool_]
Packed = NDArray[np.uint8]
Indices = NDArray[np.int64]

# Maximum number of matching rounds per frame.
ROUNDS = 5
# Area, relative to the median marker, above which a patch counts as merged markers.
MERGED = 1.5
_CUTS = 6  # iterations of dividing a patch
_LONE_PITCH = 80.0  # px, assumed for a single marker
# Smoothing of the spline: centres of patches are off by a tenth of a pixel, so fields may be too.
SMOOTHING = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """The reference's markers in one frame."""

    moved: Floats
    """Displacement of each marker (m, 2) [px]; predicted by the spline for lost ones."""
    growth: Floats
    """Logarithm of each marker's relative area (m,); predicted for lost ones as well."""
    matched: Chosen
    """True for matched markers (m,)."""


class Matcher:
    """Finds the markers of one reference in frames; remembers the previous frame."""

    def __init__(self, reference: Masks) -> None:
        """Index the markers by their order in the reference (480, 640)."""
        patches = find_blobs(reference[None], SMALLEST_PX)
        # Markers at the border are excluded, as their visible centre moves with the cut.
        chosen = patches.whole if patches.whole.any() else np.ones(len(patches), np.bool_)
        if not chosen.any():
            raise LearningError(f"reference: found no marker of {SMALLEST_PX} px or more")
        self.markers: Floats = patches.centre[chosen]
        self.area = patches.area[chosen].astype(np.float64)
        self.spline = Spline(self.markers, smoothing=SMOOTHING)
        self.pitch_px = pitch(self.markers) or _LONE_PITCH
        self._all_cut = not patches.whole.any()
        self.restart()

    def restart(self) -> None:
        """Forget the previous frame: the next is expected to look like the reference."""
        self._before = np.zeros_like(self.markers)
        self._step = np.zeros_like(self.markers)

    def step(self, mask: Masks) -> Match:
        """Find the markers in the next frame (480, 640)."""
        patches = find_blobs(mask[None], SMALLEST_PX)
        start = self._before + SPEED * self._step
        moved, assigned = self._searched(start, patches)
        if not (assigned >= 0).all() and len(patches):
            cut = self._cut(mask, patches, self.markers + moved)
            if cut is not None:
                patches = cut
                moved, assigned = self._searched(moved, patches)
        matched = assigned >= 0
        self._step, self._before = moved - self._before, moved
        growth = np.zeros((len(self.markers), 1))
        growth[matched, 0] = np.log(patches.area[assigned[matched]] / self.area[matched])
        return Match(moved, self.spline.filled(growth, matched)[:, 0], matched)

    def _searched(self, start: Floats, patches: Blobs) -> tuple[Floats, Indices]:
        """Return the displacement of all markers (m, 2), and the detection of each (m,) or -1."""
        usable = np.flatnonzero(patches.whole | self._all_cut)
        centres = patches.centre[usable]
        moved, assigned = start, np.full(len(self.markers), -1)
        if not len(centres):
            return moved, assigned
        tree = cKDTree(centres)
        for _ in range(ROUNDS):
            again = self._nearest(self.markers + moved, centres, tree)
            offset = np.where(again[:, None] >= 0, centres[again] - self.markers, 0.0)
            again, moved = self._agreed(again, offset, start)
            if np.array_equal(again, assigned):
                break
            assigned = again
        return moved, np.where(assigned >= 0, usable[assigned], -1)

    def _nearest(self, expected: Floats, places: Floats, tree: cKDTree) -> Indices:
        """Return the mutual nearest neighbour of each marker (m,) within the gate, or -1."""
        apart, nearest = tree.query(expected)
        _, back = cKDTree(expected).query(places)
        mine = (back[nearest] == np.arange(len(expected))) & (apart <= GATE * self.pitch_px)
        return np.where(mine, nearest, -1)

    def _agreed(self, assigned: Indices, offset: Floats, start: Floats) -> tuple[Indices, Floats]:
        """Return the consistent matches, and the motion of all markers that follows from them."""
        assigned = assigned.copy()
        while True:
            matched = assigned >= 0
            moved = offset
            if not matched.all():  # lost ones move as expected, and deviate as the others do
                moved = start + self.spline.filled(offset - start, matched)
            surprise = np.where(matched, self.spline.surprise(moved), 0.0)
            worst = int(surprise.argmax())
            if surprise[worst] <= GATE * self.pitch_px:
                return assigned, moved
            assigned[worst] = -1

    def _cut(self, mask: Masks, patches: Blobs, expected: Floats) -> Blobs | None:
        """Return detections with merged patches divided between markers; None if there are none."""
        large = MERGED * float(np.median(self.area))
        if not (patches.area > large).any():
            return None
        _, labels, stats, middle = cv2.connectedComponentsWithStats(
            mask.view(np.uint8), connectivity=4
        )
        height, width = mask.shape
        column, row = np.rint(expected).astype(np.int64).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        at = np.zeros(len(expected), np.int64)
        at[inside] = labels[row[inside], column[inside]]
        claims = np.bincount(at, minlength=len(stats))
        merged = (claims > 1) & (stats[:, cv2.CC_STAT_AREA] > large)
        merged[0] = False
        centre, area, whole = list(patches.centre), list(patches.area), list(patches.whole)
        gone: list[int] = []
        for label in np.flatnonzero(merged).tolist():
            left, top, wide, high, _ = stats[label]
            rows, columns = np.nonzero(labels[top : top + high, left : left + wide] == label)
            pixels = np.stack([columns + left, rows + top], axis=1).astype(np.float64)
            parts, sizes = _parted(pixels, expected[at == label])
            one = int(np.linalg.norm(patches.centre - middle[label], axis=1).argmin())
            gone.append(one)
            centre += list(parts)
            area += sizes
            whole += [bool(patches.whole[one])] * len(parts)
        if not gone:
            return None
        keep = np.ones(len(centre), np.bool_)
        keep[gone] = False
        frame = np.zeros(len(centre), np.int64)
        return Blobs(frame, np.array(area, np.int64), np.array(centre), np.array(whole)).only(keep)


def _parted(pixels: Floats, claims: Floats) -> tuple[Floats, list[int]]:
    """Return centres (k, 2) and sizes of the parts of a patch, one for each claim (k-means)."""
    centres = claims.copy()
    for _ in range(_CUTS):
        apart = ((pixels[:, None] - centres[None]) ** 2).sum(axis=-1)
        owner = apart.argmin(axis=1)
        sizes = np.bincount(owner, minlength=len(centres))
        for one in np.flatnonzero(sizes):
            centres[one] = pixels[owner == one].mean(axis=0)
    used = np.flatnonzero(sizes)
    return centres[used], sizes[used].tolist()


# Displacement and growth of the skin between the markers of a press.
#
# A `FieldReader` belongs to one reference. It converts frames to displacement fields on the lattice
# of marker archives, [px] of a target sensor, or to small maps of displacement and growth that a
# force model can use as inputs instead of images.

# Lattice of displacement fields, the default of archives.
LATTICE = Lattice()
# Rows and columns of the maps for force models.
MAP_SIDE = 32

_MIDDLE = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])


class FieldReader:
    """Computes fields from the frames of one sensor and reference; caches matrices."""

    def __init__(self, reference: Masks) -> None:
        """Find the markers of the reference (480, 640)."""
        self._matcher = Matcher(reference)
        self._operators: dict[tuple[float, float], Floats] = {}

    @property
    def markers(self) -> Floats:
        """Column and row of the markers without contact (m, 2) [px]."""
        return self._matcher.markers

    def matches(self, frames: NDArray[Any], *, ordered: bool) -> list[Match]:
        """Find the markers of the reference in each frame.

        Frames are masks, bool (n, 480, 640) or packed uint8 (n, 38400). If `ordered`, they are one
        press in order of time, and markers are tracked.
        """
        self._matcher.restart()
        matches = []
        for mask in unpack(frames) if frames.dtype == np.uint8 else frames:
            matches.append(self._matcher.step(mask))
            if not ordered:
                self._matcher.restart()
        return matches

    def displacement(
        self,
        frames: NDArray[Any],
        *,
        ordered: bool,
        source: SensorView | None = None,
        target: SensorView | None = None,
    ) -> NDArray[np.float32]:
        """Return the displacement on `LATTICE` (n, 57, 73, 2) [px], components column and row.

        Frames are as in `matches`. With two views, it is the displacement in the target's image:
        the same motion in mm at the same place of the contact frame, which is at the centre of both
        images. Beyond the source's view, the values at its border continue.
        """
        scale = np.ones(2)
        if source is not None and target is not None:
            scale = np.array(source.pixels_of(target))
        operator = self._operator(scale)
        moved = np.stack([match.moved for match in self.matches(frames, ordered=ordered)])
        field = np.tensordot(operator, moved, axes=(1, 1)).transpose(1, 0, 2) / scale
        return field.reshape(len(moved), *LATTICE.shape).astype(np.float32)

    def maps(self, frames: NDArray[Any], *, ordered: bool) -> NDArray[np.float32]:
        """Return displacement and growth (n, 3, 32, 32): columns [px], rows [px], log of area.

        Values are at the centres of 32 x 32 cells of the image without contact; frames are as in
        `matches`.
        """
        matches = self.matches(frames, ordered=ordered)
        values = np.stack(
            [np.concatenate([one.moved, one.growth[:, None]], axis=1) for one in matches]
        )
        maps = np.tensordot(self._map_operator, values, axes=(1, 1))
        return np.moveaxis(maps, 0, -1).reshape(-1, 3, MAP_SIDE, MAP_SIDE).astype(np.float32)

    def _operator(self, scale: Floats) -> Floats:
        """Return the matrix from markers to the target's lattice (57 x 73, m)."""
        key = (float(scale[0]), float(scale[1]))
        if key not in self._operators:
            columns, rows = np.meshgrid(LATTICE.columns, LATTICE.rows)
            points = _MIDDLE + (np.stack([columns, rows], axis=-1).reshape(-1, 2) - _MIDDLE) * scale
            margin = LATTICE.margin_px
            within = np.clip(points, -margin, np.array([WIDTH, HEIGHT]) + margin)
            self._operators[key] = self._matcher.spline.at(within)
        return self._operators[key]

    @functools.cached_property
    def _map_operator(self) -> Floats:
        across = (np.arange(MAP_SIDE) + 0.5) / MAP_SIDE
        columns, rows = np.meshgrid(across * WIDTH - 0.5, across * HEIGHT - 0.5)
        return self._matcher.spline.at(np.stack([columns, rows], axis=-1).reshape(-1, 2))


# Fields of many presses, computed by several processes to feed a GPU.
#
# Markers are tracked on the CPU, press by press; presses are independent. A GPU warps thousands of
# frames per second, so the tracking that feeds it must be parallel.

# Fields on the lattice of archives (n, 57, 73, 2), or small maps (n, 3, 32, 32).
Form = Literal["displacement", "maps"]

_PRESSES = 8  # presses per task
_AHEAD = 4  # tasks per process that are read ahead


def fields_of_presses(
    packed: Callable[[int, int], Packed],
    starts: Indices,
    references: Packed,
    reference: NDArray[np.integer[Any]],
    form: Form = "displacement",
    *,
    source: SensorView | None = None,
    target: SensorView | None = None,
    processes: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> NDArray[np.floating[Any]]:
    """Compute the fields of all frames: displacement as float16, maps as float32.

    `packed` returns the packed masks (m, 38400) of the frames from a first to before an end,
    numbered press by press in order of time; `starts` (p + 1,) has the first frame of each press,
    and the number of frames. Each frame has a row of `references` (k, 38400), constant within a
    press. `source` is the view of the frames, by default that of `target`, whose image a
    displacement is for.
    """
    total, done = int(starts[-1]), 0
    shape = LATTICE.shape if form == "displacement" else (3, MAP_SIDE, MAP_SIDE)
    fields = np.empty((total, *shape), np.float16 if form == "displacement" else np.float32)
    progress(0, total)
    jobs = (
        (
            packed(int(ends[0]), int(ends[-1])),
            ends - ends[0],
            references[reference[ends[:-1]]],
            functools.partial(_field, form=form, source=source, target=target),
        )
        for ends in (starts[n : n + _PRESSES + 1] for n in range(0, len(starts) - 1, _PRESSES))
    )
    for part in _computed(jobs, min(processes, -(-(len(starts) - 1) // _PRESSES))):
        fields[done : done + len(part)] = part
        done += len(part)
        progress(done, total)
    return fields


def _computed(
    jobs: Iterator[tuple[Packed, Indices, Packed, _Field]], processes: int
) -> Iterator[NDArray[np.floating[Any]]]:
    if processes < 2:
        yield from (_fields(*job) for job in jobs)
        return
    with Workers(processes) as workers:
        tasks: deque[Future[NDArray[np.floating[Any]]]] = deque()
        for number, job in enumerate(jobs):
            tasks.append(workers.submit(_fields, *job))
            workers.done = f"{number + 1 - len(tasks)} groups of presses"
            if len(tasks) > _AHEAD * processes:
                # Removed from the queue, so that returned fields are not kept in memory.
                yield tasks.popleft().result()
        while tasks:
            yield tasks.popleft().result()


_Field = Callable[[FieldReader, Packed], NDArray[np.floating[Any]]]


def _fields(
    packed: Packed, starts: Indices, references: Packed, field: _Field
) -> NDArray[np.floating[Any]]:
    """Return the fields of presses whose references (p, 38400) are given one by one."""
    readers: dict[bytes, FieldReader] = {}
    parts = []
    for first, end, reference in zip(starts[:-1], starts[1:], references, strict=True):
        key = reference.tobytes()
        if key not in readers:
            readers[key] = FieldReader(unpack(reference))
        parts.append(field(readers[key], packed[first:end]))
    return np.concatenate(parts)


def _field(
    reader: FieldReader,
    packed: Packed,
    *,
    form: Form,
    source: SensorView | None,
    target: SensorView | None,
) -> NDArray[np.floating[Any]]:
    if form == "maps":
        return reader.maps(packed, ordered=True)
    field = reader.displacement(packed, ordered=True, source=source, target=target)
    return field.astype(np.float16)
