"""Camera and markers of twins: images that are followed, fits of planted cameras, refusals."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.marker_rows import write_rows

from recorder import MarkerArchive
from recorder.markers import pack
from sim.errors import SceneError
from sim.markers import Camera
from sim.scene import Body
from sim.sensors import (
    CameraSignal,
    Posterior,
    SimulatedSensor,
    SurfaceField,
    read_sensor,
    readout,
    sensor,
)
from sim.sensors.posterior import CAMERA
from sim.sensors.quantities import camera_quantities, draw_sensor, with_camera
from sim.twin import CameraFit, MarkerObservations, PressTrack, marker_observations
from sim.twin.camera import Scenery, differences, layouts, nearest, unmirrored
from sim.twin.record import twin_yaml

pytestmark = pytest.mark.slow

DESIGN = Camera.of_scale(0.0249)
TRUE = Camera(
    1.1 * DESIGN.focal, 1.155 * DESIGN.distance, (16.0, -9.0), np.radians(2.0)
)  # a scale 5 % larger
BODY = Body()


def track(name: str = "a.zarr", run: int = 0) -> PressTrack:
    """Return a track that presses for 1 s from 1 s on, and rests."""
    time = np.arange(0.0, 2.0, 0.1)
    tip = np.zeros((len(time), 3))
    tip[:, 2] = np.where(time < 1.0, 1e-3, -1e-3)
    target = np.where(time < 1.0, -1, 0)
    return PressTrack(name, "sphere", time, tip, 0 * tip, 0 * time + 1e-3, target, run, 5_000)


def scenery(
    camera: Camera, shears: tuple[tuple[float, float], ...], pitch: float = 2.5e-3
) -> Scenery:
    """Return bumps under shears [m], whose markers `pitch` apart a camera sees."""
    x = np.linspace(-10e-3, 10e-3, 41)
    gauss = np.exp(-(x[:, None] ** 2 + x**2) / (2 * 2.5e-3**2))
    out = np.exp(-(x[:, None] ** 2 + x**2) / (2 * 4e-3**2)) * 30.0
    bulge = 1e-3 * out * x[:, None]
    planes = [
        np.stack([along * gauss + bulge, across * gauss + bulge.T, -8e-4 * gauss], -1)
        for along, across in shears
    ]
    top = SurfaceField(x, x, np.array(planes, np.float32))
    grid = np.arange(-8.75e-3, 9e-3, pitch)
    spots = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    markers = camera.project(np.column_stack([spots, 0 * spots[:, 0]]))
    markers = markers[((markers > 8) & (markers < [632, 472])).all(axis=1)]
    blank = np.zeros((480, 640), bool)
    observation = MarkerObservations(
        track(), np.arange(len(shears)), blank, markers, np.zeros((0, 0, 2))
    )
    made = Scenery(BODY, [observation], [top])
    return replace(made, observations=[replace(observation, observed=made.projected(camera)[0])])


def camera_of(found: NDArray[np.float64]) -> Camera:
    scale, distance = np.exp(found[:2])
    tilt = found[5], found[6]
    return Camera(float(distance / scale), float(distance), (found[2], found[3]), found[4], tilt)


SHEARS = ((0.0, 0.0), (3e-4, 0.0), (0.0, 3e-4))


@pytest.fixture
def few_beginnings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Begin level and turned by half a turn alone, which is enough for little rotation."""
    monkeypatch.setattr("sim.twin.camera.BEGINNINGS", (0.0, math.pi))


@pytest.mark.parametrize(
    "turn", [-1.7, *(pytest.param(each, marks=pytest.mark.slow) for each in (0.03, 1.4, 3.1))]
)
def test_a_camera_of_any_rotation_is_told_by_how_markers_move(turn: float) -> None:
    best, either_way = unmirrored(scenery(replace(TRUE, rotation=turn), SHEARS), DESIGN)
    found = camera_of(best.x)
    assert found.mm_per_px == pytest.approx(TRUE.mm_per_px, rel=2e-3)
    assert found.distance == pytest.approx(TRUE.distance, rel=0.02)
    assert found.shift == pytest.approx(TRUE.shift, abs=0.5)
    assert np.cos(found.rotation - turn) == pytest.approx(1.0, abs=2e-6)
    assert not either_way


@pytest.mark.usefixtures("few_beginnings")
def test_a_tilt_is_told_by_large_shear_at_many_places() -> None:
    tilted = replace(TRUE, tilt=(0.04, -0.03))
    made = scenery(tilted, ((0.0, 0.0), (1e-3, 0.0), (0.0, 1e-3), (-1e-3, 0.0)))
    best, _ = unmirrored(made, DESIGN)
    # Now without the priors, as by many more markers.
    found = camera_of(nearest(made, camera_of(best.x), DESIGN, 1e-3).x)
    assert found.tilt == pytest.approx(tilted.tilt, abs=2e-3)
    assert found.distance == pytest.approx(tilted.distance, rel=5e-3)
    # From it, and from a level camera, markers move otherwise.
    level = replace(found, tilt=(0.0, 0.0))
    assert np.abs(made.residuals(found)).max() < 0.01
    assert np.abs(made.residuals(level)).max() > 0.2


@pytest.mark.usefixtures("few_beginnings")
def test_a_press_without_shear_does_not_tell_the_rotation() -> None:
    def unidentified(shears: tuple[tuple[float, float], ...]) -> tuple[str, ...]:
        best, either_way = unmirrored(scenery(TRUE, shears, 1.75e-3), DESIGN)
        covariance = np.linalg.inv(best.jac.T @ best.jac)
        return CameraFit(mine(), covariance, 1.0, either_way, (), ()).unidentified

    assert unidentified(SHEARS[:1]) == ("rotation", "camera_tilt_x", "camera_tilt_y")
    assert unidentified(SHEARS) == ()


@pytest.mark.usefixtures("few_beginnings")
def test_mirrored_images_are_refused_and_shear_along_one_line_does_not_tell_them() -> None:
    with pytest.raises(SceneError, match=r"mirrored against the arm.* px, mirrored by 0\.\d+ px"):
        unmirrored(scenery(TRUE, SHEARS).mirrored(), DESIGN)
    assert unmirrored(scenery(TRUE, SHEARS[:2]), DESIGN)[1]


def test_markers_are_followed_from_frame_to_frame(tmp_path: Path) -> None:
    rows, columns = np.mgrid[-40:40, -40:40]
    # With 50 columns on the left, from which nothing comes in.
    wide = np.pad(np.tile(columns**2 + rows**2 <= 64, (6, 8)), ((0, 0), (50, 0)))
    time = np.arange(0.0, 2.0, 0.1)
    # All move by more than half of their distance, in steps.
    ways = np.clip(60 * (time - 1.0), 0, 50).round().astype(int)
    packed = pack(np.array([wide[:, 50 - way : 690 - way] for way in ways]))
    path = tmp_path / "a.markers.zarr"
    write_rows(path, "a.zarr", np.round(1e9 * time).astype(np.int64) + 5_000, packed, packed[0])
    (observation,) = marker_observations([track()], [MarkerArchive(path)])
    moved = observation.observed[-1] - observation.undeformed
    known = ~np.isnan(moved[:, 0])
    assert known.mean() > 0.8  # those that leave the image are lost
    assert moved[known] == pytest.approx(np.tile([50.0, 0.0], (known.sum(), 1)), abs=0.3)
    off, way = differences([observation], [observation.observed + np.array([3.0, 4.0])])
    assert (off, way) == pytest.approx((5.0, 50.0), abs=0.3)


def test_an_archive_of_other_sessions_is_refused(tmp_path: Path) -> None:
    mask = readout(sensor("gelsight")).packed(SurfaceField.undeformed(BODY))[0, 0]
    path = tmp_path / "b.markers.zarr"
    write_rows(path, "b.zarr", np.arange(20) * 100_000_000 + 5_000, np.tile(mask, (20, 1)), mask)
    archive = MarkerArchive(path)
    with pytest.raises(SceneError, match=r"is of b\.zarr, and has no picture .* of a\.zarr"):
        marker_observations([track("a.zarr")], [archive])
    with pytest.raises(SceneError, match="no picture"):
        marker_observations([track("b.zarr", run=1)], [archive])
    assert len(marker_observations([track("b.zarr")], [archive])) == 1


def test_the_layout_of_an_image_is_that_which_made_it() -> None:
    design = sensor("gelsight")
    assert isinstance(design.signal, CameraSignal)
    signal = replace(design.signal.mounted(TRUE), patterns=("Diamond-I",))
    mask = readout(replace(design, signal=signal)).masks(SurfaceField.undeformed(BODY))[0, 0]
    by_shape = {each.shape: each for each in layouts(mask, TRUE, BODY, "mine")}
    found, (true,) = by_shape["diamond"], signal.drawn()
    assert found.size == pytest.approx(true.size, rel=0.02)
    near = np.linalg.norm(found.centres[:, None] - true.centres, axis=-1).min(axis=1)
    # Markers that the border cuts are as well placed as whole ones.
    assert near.max() < 15e-6
    assert len(found) > 30


def mine() -> SimulatedSensor:
    """Return a sensor with a layout, a mounted camera and an uncertain one."""
    design = sensor("gelsight")
    assert isinstance(design.signal, CameraSignal)
    layout = replace(design.signal.drawn()[0], name="mine", angle=0.1)
    signal = replace(design.signal.mounted(TRUE), layout=layout, patterns=("mine",))
    spreads = np.array([0.03, 0.1, 4.0, 4.0, 0.01, 0.002, 0.002])
    # As a fit gives them: numbers of numpy.
    off = np.float64(20 * 1e-6), np.float64(0.0053)
    posterior = Posterior.of(CAMERA, np.diag(spreads**2), "layer", *off)
    return replace(design, signal=signal, posterior=posterior)


def test_a_row_with_a_camera_and_a_layout_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(twin_yaml(mine(), "gelsight.yaml", ["a.zarr"]))
    found = read_sensor(path)
    assert camera_quantities(found) == pytest.approx(camera_quantities(mine()), rel=1e-5)
    assert isinstance(found.signal, CameraSignal)
    assert found.signal.layout is not None
    assert found.signal.layout.angle == pytest.approx(0.1, rel=1e-5)
    assert found.posterior == mine().posterior


def test_cameras_drawn_from_a_twin_see_the_same_image_without_contact() -> None:
    flat = SurfaceField.undeformed(BODY)
    seen = readout(mine()).masks(flat)[0, 0]
    posterior = mine().posterior
    assert posterior is not None
    drawn = draw_sensor(mine(), posterior, np.random.default_rng(3))
    assert abs(camera_quantities(drawn)["shift_x"] - 16.0) > 0.5
    other = readout(drawn).masks(flat)[0, 0]
    assert (seen & other).sum() > 0.98 * (seen | other).sum()


def test_a_camera_of_taxels_is_refused() -> None:
    assert camera_quantities(sensor("uskin")) == {}
    with pytest.raises(SceneError, match="taxels; allowed: a camera"):
        with_camera(sensor("uskin"), {"scale": 1e-5})
    uncertain = Posterior(("scale",), (0.1,), ((1.0,),))
    with pytest.raises(SceneError, match="uskin: scale; allowed: modulus"):
        draw_sensor(sensor("uskin"), uncertain, np.random.default_rng(0))
