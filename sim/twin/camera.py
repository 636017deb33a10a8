"""Fit of a twin's camera and marker layout to the markers seen under its presses.

The image without contact shows markers at pixels; a camera says where on the skin they are, and so
how they move under a press. Scale, distance, shift, rotation and tilt of the camera are those that
move them as they were seen to move.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Self, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import center_of_mass, find_objects, label
from scipy.optimize import least_squares

from recorder.markers import smallest_marker
from sim.arrays import Array, Progress
from sim.errors import SceneError
from sim.markers import WIDTH, Camera, Pattern
from sim.markers.camera import TILT_MOST
from sim.markers.pattern import Shape
from sim.scene import Body
from sim.sensors import CameraSignal, Posterior, SimulatedSensor, SurfaceField, readout
from sim.sensors.posterior import CAMERA, interval_of
from sim.sensors.quantities import camera_quantities
from sim.twin.fit import COARSER, UNIDENTIFIED, Fit, Z, moved_by, way_of
from sim.twin.gaugeless import MarkedPress
from sim.twin.markers import MarkerObservations, Masks, camera_signal
from sim.twin.model import STEPS, TrackModel
from sim.twin.observations import PressTrack

# Prior spread of the logarithm of the lens, distance over scale, about the row's.
LENS = 0.3
# Derivative of that logarithm by the unknowns, in the order of `CAMERA`.
OF_LENS = np.array([-1.0, 1.0, *[0.0] * 5])
# Rotations from which a fit begins [rad], that of the row first.
BEGINNINGS = (0.0, math.pi / 2, -math.pi / 2, math.pi)
# Typical steps of the unknowns, and their prior spread about where a fit begins.
SIZES = np.array([0.02, 0.1, 5.0, 5.0, 0.02, 0.02, 0.02])
WIDE = np.array([0.5, 0.5, 200.0, 200.0, 0.6, 0.05, 0.05])
# Residuals that are of priors, at the end of all.
PRIORS = 1 + len(WIDE)
# Most cameras that a fit tries, derivatives aside: a good one needs some 10, one turned the wrong
# way would wander.
MOST_TRIED = 60
# Times by which mirrored images must fit better to be taken for mirrored.
MIRRORED = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """Camera and markers fitted to observations, and how well they explain them."""

    sensor: SimulatedSensor
    """The twin with this camera and layout; its posterior has both skin and camera."""
    covariance: Array
    """(7, 7) of `CAMERA`: logarithms of scale and distance, px and rad."""
    overlap: float
    """Pixels of markers that the twin's image without contact shares with the real one, over all
    of both."""
    either_way: bool
    """True if images mirrored from left to right would fit as well."""
    observations: tuple[MarkerObservations, ...]
    predicted: tuple[Array, ...]
    """Markers of the twin (f, m, 2) [px], of each observation."""

    @property
    def signal(self) -> CameraSignal:
        """Camera and layout."""
        return camera_signal(self.sensor)

    @property
    def values(self) -> dict[str, float]:
        """Quantities of the camera by their names in `CAMERA`."""
        return camera_quantities(self.sensor)

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Quantities that images do not identify; so is a distance that only the lens gives."""
        wide = np.sqrt(np.diag(self.covariance)) > UNIDENTIFIED * WIDE
        wide[1] |= math.sqrt(OF_LENS @ self.covariance @ OF_LENS) > UNIDENTIFIED * LENS
        return tuple(name for name, is_wide in zip(CAMERA, wide, strict=True) if is_wide)

    def interval(self, name: str, z: float = Z) -> tuple[float, float]:
        """Return the interval of a quantity, 90 % by default."""
        index = CAMERA.index(name)
        spread = z * math.sqrt(self.covariance[index, index])
        return interval_of(name, self.values[name], spread)


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Presses that are not fitted, and the twin's predictions of them."""

    tracks: tuple[PressTrack, ...]
    readings: tuple[Array, ...]
    """Forces that the twin gives (n, 3) [N], of each track."""
    observations: tuple[MarkerObservations, ...]
    predicted: tuple[Array, ...]
    """Markers of the twin (f, m, 2) [px], of each observation."""


def held_out_predictions(
    fit: Fit,
    camera_fit: CameraFit | None,
    tracks: Sequence[PressTrack],
    observations: Sequence[MarkerObservations],
    grid: int,
) -> HeldOut:
    """Return a twin's forces along tracks, by its tier, and its markers if a camera is fitted.

    Raises:
        SimulationDiverged: No contact was found.
    """
    model = TrackModel(fit.design, tracks, grid=grid)
    if fit.tier == "fem":
        model.correct(fit.values)
    readings = model.readings(fit.values)
    predicted: tuple[Array, ...] = ()
    if camera_fit is not None and observations:
        predicted = Scenery.of(fit, observations, grid).projected(camera_fit.signal.camera())
    return HeldOut(tuple(tracks), tuple(readings), tuple(observations), predicted)


def differences(
    observations: Sequence[MarkerObservations | MarkedPress], predictions: Sequence[Array]
) -> tuple[float, float]:
    """Return the RMS distance of markers from predictions, and their RMS way under presses [px]."""
    pairs = list(zip(observations, predictions, strict=True))
    off = np.concatenate([(each.observed - predicted).reshape(-1, 2) for each, predicted in pairs])
    way = np.concatenate([(each.observed - each.undeformed).reshape(-1, 2) for each, _ in pairs])
    rms_off, rms_way = (float(np.nanmean(np.square(each).sum(axis=1))) for each in (off, way))
    return math.sqrt(rms_off), math.sqrt(rms_way)


@dataclass(frozen=True, slots=True, eq=False)
class Scenery:
    """Skin of a twin under presses, whose markers cameras see."""

    body: Body
    observations: Sequence[MarkerObservations]
    tops: Sequence[SurfaceField]
    """Displacement of the layer with the markers, at the points of each observation."""

    @classmethod
    def of(
        cls,
        fit: Fit,
        observations: Sequence[MarkerObservations],
        grid: int,
        changed: Mapping[str, float] | None = None,
    ) -> Self:
        """Return the skin of a fit, with some quantities changed."""
        pins, values = camera_signal(fit.design).pins, {**fit.values, **(changed or {})}
        of_tracks = [list(own) for _, own in groupby(observations, key=lambda each: id(each.track))]
        model = TrackModel(fit.design, [own[0].track for own in of_tracks], grid=grid)
        rows = [np.concatenate([each.rows for each in own]) for own in of_tracks]
        tops = []
        for own, top in zip(of_tracks, model.surfaces(values, rows), strict=True):
            carrier = top if pins is None else pins.tips(top)
            ends = np.cumsum([len(each.rows) for each in own])[:-1]
            parts = np.split(carrier.displacement, ends)
            tops += [replace(carrier, displacement=part) for part in parts]
        return cls(fit.design.body, observations, tops)

    def projected(self, camera: Camera) -> tuple[Array, ...]:
        """Return the markers at each point (f, m, 2) [px], of every observation."""
        positions = []
        for each, top in zip(self.observations, self.tops, strict=True):
            flat = camera.places(each.undeformed, self.body)
            points = np.column_stack([flat, self.body.heights_at(*flat.T)])
            positions.append(camera.project(points + top.at(flat)))
        return tuple(positions)

    def residuals(self, camera: Camera) -> Array:
        """Return observed less projected markers (r,) [px], 0 where a marker is missing."""
        pairs = zip(self.observations, self.projected(camera), strict=True)
        return np.concatenate(
            [np.nan_to_num(each.observed - projected).ravel() for each, projected in pairs]
        )

    @property
    def points(self) -> NDArray[np.int64]:
        """Number of the point that each residual is of (r,)."""
        sizes = [markers.size for each in self.observations for markers in each.observed]
        return np.repeat(np.arange(len(sizes)), sizes)

    def mirrored(self) -> Self:
        """Return the same with images mirrored from left to right."""
        flip, width = np.array([-1.0, 1.0]), np.array([WIDTH - 1.0, 0.0])
        flipped = [
            replace(
                each,
                undeformed=flip * each.undeformed + width,
                observed=flip * each.observed + width,
            )
            for each in self.observations
        ]
        return replace(self, observations=flipped)


def fitted_camera(
    fit: Fit,
    observations: Sequence[MarkerObservations],
    *,
    name: str,
    grid: int = 96,
    progress: Progress = lambda fraction: None,
) -> CameraFit:
    """Return the camera and layout that explain observations, however badly.

    The fit of the skin is to the same presses; `name` is that of the layout, `grid` the pixels
    along the body's longer side.

    Raises:
        SceneError: The design has no camera, or images are mirrored.
        SimulationDiverged: The contact of a candidate did not converge.
    """
    scenery = Scenery.of(fit, observations, grid)
    design = camera_signal(fit.design).camera()
    best, either = unmirrored(scenery, design)
    # Markers at one point are wrong alike, so that many of them count as one.
    sigma = _rms(best) * math.sqrt(_variance_inflation(best, scenery.points))
    best = nearest(scenery, _camera(best.x), design, sigma)
    camera, slopes = _camera(best.x), best.jac[:-PRIORS]
    conditional = np.linalg.inv(best.jac.T @ best.jac)
    # Errors of the skin and of its grid move the camera as well.
    base, gains = scenery.residuals(camera), []
    coarser = Scenery.of(fit, observations, round(COARSER * grid))
    shifted = {name: moved_by(name, fit.values, step) for name, step in STEPS.items()}
    for done, (name, value) in enumerate(shifted.items()):
        progress(done / len(shifted))
        changed = Scenery.of(fit, observations, grid, {name: value})
        off = (changed.residuals(camera) - base) / way_of(name, fit.values, {name: value})
        gains.append(-conditional @ slopes.T @ off / sigma)
    gain = np.stack(gains, axis=1)
    grid_error = conditional @ slopes.T @ (coarser.residuals(camera) - base) / sigma
    rows = [fit.names.index(name) for name in shifted]
    covariance = conditional + gain @ fit.covariance[np.ix_(rows, rows)] @ gain.T
    covariance += np.outer(grid_error, grid_error)
    progress(1.0)
    sensor, overlap = _with_layout(fit.sensor, camera, observations[0].reference, name)
    assert sensor.posterior is not None
    skin = [fit.names.index(each) for each in sensor.posterior.names]
    both = fit.covariance[np.ix_(skin, rows)] @ gain.T
    matrix = np.block([[fit.covariance[np.ix_(skin, skin)], both], [both.T, covariance]])
    of_skin = sensor.posterior
    posterior = Posterior.of(
        (*of_skin.names, *CAMERA), matrix, fit.tier, of_skin.height, of_skin.law
    )
    return CameraFit(
        sensor=replace(sensor, posterior=posterior),
        covariance=covariance,
        overlap=overlap,
        either_way=either,
        observations=tuple(observations),
        predicted=scenery.projected(camera),
    )


def unmirrored(scenery: Scenery, design: Camera) -> tuple[Any, bool]:
    """Return SciPy's result of the best camera, and whether mirrored images would fit as well."""
    best, other = _best(scenery, design), _best(scenery.mirrored(), design)
    if best.cost > MIRRORED**2 * other.cost:
        raise SceneError(
            f"{scenery.observations[0].track.name}: images are mirrored against the arm's x and y: "
            f"markers differ by {_rms(best):.2f} px, mirrored by {_rms(other):.2f} px; allowed: "
            "images as seen from the touched side"
        )
    return best, bool(other.cost < MIRRORED**2 * best.cost)


def _with_layout(
    twin: SimulatedSensor, camera: Camera, mask: Masks, name: str
) -> tuple[SimulatedSensor, float]:
    """Return a twin with camera and layout, of the shape that overlaps most with an image."""
    signal, candidates = camera_signal(twin).mounted(camera), []
    for layout in layouts(mask, camera, twin.body, name):
        if signal.pins is None or layout.shape == "disc":
            own = replace(twin, signal=replace(signal, layout=layout, patterns=(name,)))
            image = readout(own).masks(SurfaceField.undeformed(own.body))[0, 0]
            candidates.append((own, float((image & mask).sum() / (image | mask).sum())))
    return max(candidates, key=lambda each: each[1])


def layouts(mask: Masks, camera: Camera, body: Body, name: str) -> list[Pattern]:
    """Return the markers of an image without contact (480, 640) as patterns of each shape.

    Markers that the image's border cuts are as large as the others.
    """
    patches, count = label(mask)
    boxes, middles = find_objects(patches), center_of_mass(mask, patches, range(1, count + 1))
    area = np.bincount(patches.ravel(), minlength=count + 1)[1:]
    edges = np.array([[(side.start, side.stop) for side in box] for box in boxes])  # (n, 2, 2)
    cut_low, cut_high = edges[..., 0] == 0, edges[..., 1] == mask.shape
    whole = ~(cut_low | cut_high).any(axis=1)
    half = np.median(np.diff(edges[whole], axis=-1)[..., 0], axis=0) / 2
    middle = np.where(cut_low, edges[..., 1] - 0.5 - half, np.array(middles))
    middle = np.where(cut_high, edges[..., 0] - 0.5 + half, middle)
    large = area >= smallest_marker(mask)
    centres = camera.places(middle[large, ::-1], body)
    size = 1e-3 * camera.mm_per_px * math.sqrt(float(np.median(area[whole & large])))
    widths = {"disc": 2 / math.sqrt(math.pi), "square": 1.0, "diamond": math.sqrt(2)}
    return [
        Pattern(name, shape, widths[shape] * size, tuple(map(tuple, centres.tolist()))).within(body)
        for shape in get_args(Shape)
    ]


def _camera(unknowns: Array) -> Camera:
    scale, distance = np.exp(unknowns[:2]).tolist()
    column, row, turn, *tilt = unknowns[2:].tolist()
    tilt = np.clip(tilt, -TILT_MOST, TILT_MOST).tolist()
    turn = math.remainder(turn, math.tau)
    return Camera(distance / scale, distance, (column, row), turn, (tilt[0], tilt[1]))


def _best(scenery: Scenery, design: Camera) -> Any:
    """Return the best of the fits that begin with the design, turned."""
    begun = (replace(design, rotation=design.rotation + turn) for turn in BEGINNINGS)
    return min((nearest(scenery, each, design) for each in begun), key=lambda fit: fit.cost)


def nearest(scenery: Scenery, begun: Camera, design: Camera, sigma: float = 1.0) -> Any:
    """Return SciPy's result of a fit of the unknowns to residuals with an error of `sigma` px."""
    start = np.array(
        [
            math.log(begun.distance / begun.focal),
            math.log(begun.distance),
            *begun.shift,
            begun.rotation,
            *begun.tilt,
        ]
    )

    def residuals(unknowns: Array) -> Array:
        lens = (OF_LENS @ unknowns - math.log(design.focal)) / LENS
        prior = (unknowns - start) / WIDE
        return np.asarray(np.r_[scenery.residuals(_camera(unknowns)) / sigma, lens, prior])

    bounds = start - 2.5 * WIDE, start + 2.5 * WIDE
    return least_squares(residuals, start, x_scale=SIZES, bounds=bounds, max_nfev=MOST_TRIED)


def _rms(fit: Any) -> float:
    """Return the RMS distance of markers [px] of a fit with an error of 1 px."""
    off = fit.fun[:-PRIORS]
    return math.sqrt(2 * np.square(off[off != 0]).mean())


def _variance_inflation(fit: Any, points: NDArray[np.int64]) -> float:
    """Return the variance of a fit by the scatter of its points, over that of single residuals."""
    off, slopes = fit.fun[:-PRIORS], fit.jac[:-PRIORS]
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)
    scores = np.zeros((points[-1] + 1, len(covariance)))
    np.add.at(scores, points, slopes * off[:, None])
    variance = np.diag(covariance @ scores.T @ scores @ covariance)
    return max(1.0, float(np.mean(variance / np.diag(covariance))) / float(np.mean(np.square(off))))
