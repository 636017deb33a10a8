"""Twins without a gauge: fits of planted skins, weights and their texts, and errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.marker_rows import write_rows
from support.sessions import CONTACT_FRAME, T0, Columns, make_session

from recorder.markers import pack
from sim.errors import SceneError
from sim.indenters import named
from sim.layer import Layer
from sim.markers import Camera
from sim.result import Result
from sim.scene import Effects, Friction, Motion, Scene
from sim.sensors import SimulatedSensor, SurfaceField, read_sensor, sensor
from sim.sensors.quantities import camera_quantities, with_quantities
from sim.tiers import simulate
from sim.twin import MarkedPress, fitted_without_gauge, gaugeless, weighed_press
from sim.twin.gaugeless import GRAVITY, LAYER, GaugelessFit, Problem
from tactile.__main__ import main

TRUE = {"modulus": 190e3, "thickness": 3.6e-3, "poisson": 0.46, "friction": 0.4}
CAMERA = Camera.of_scale(0.0249 * 1.004)
NOISE = 0.1


def design() -> SimulatedSensor:
    return replace(sensor("gelsight"), trajectory=None, force_depth=None)


def solved(name: str, tip: np.ndarray) -> Result:
    body = with_quantities(design(), {k: v for k, v in TRUE.items() if k != "friction"}).body
    way = np.linalg.norm(np.diff(tip, axis=0), axis=1)
    motion = Motion(tuple(map(tuple, tip.tolist())), (0.0, *np.cumsum(way / 5e-3).tolist()))
    scene = Scene(named(name), motion, body=body, effects=Effects(friction=Friction(0.4)))
    return simulate(scene, Layer(grid=48))


def press(name: str, number: int, tip: np.ndarray, off: float = 0.0) -> MarkedPress:
    """Return markers of a press, where the bench takes the tip to be `off` [m] aside."""
    grid = np.arange(-6e-3, 6.1e-3, 1.2e-3)
    spots = np.stack(np.meshgrid(grid, 0.75 * grid), axis=-1).reshape(-1, 2)
    flat = np.column_stack([spots, 0 * spots[:, 0]])
    result = solved(name, tip)
    moved = SurfaceField.of(result).at(spots)[1:]
    seen = CAMERA.project(flat + moved)
    seen += np.random.default_rng(number).normal(0.0, NOISE, seen.shape)
    weight = -float(result.force[-1, 2]) if number == 9 else 0.0
    taken = tip + np.array([off, 0.0, 0.0])
    return MarkedPress(name, name, number, taken, CAMERA.project(flat), seen, weight)


SHEARED = np.array([[0.0, 0.0, 5e-5], [0.0, 0.0, -8e-4], [6e-4, 3e-4, -8e-4]])
DOWN = np.array([[1e-3, -5e-4, 5e-5], [1e-3, -5e-4, -1e-3]])


@pytest.mark.slow
def test_motion_of_markers_gives_the_skin_and_a_weight_its_scale() -> None:
    presses = [press("sphere", 0, SHEARED, 2e-4), press("sphere_s", 1, SHEARED, -1e-4)]
    without = fitted_without_gauge(presses, design(), tier="layer")
    fit = fitted_without_gauge([*presses, press("sphere", 9, DOWN)], design(), tier="layer")
    for name, true in TRUE.items():
        low, high = fit.interval(name, z=3.5)
        assert low < true < high, name
    assert fit.values["thickness"] == pytest.approx(TRUE["thickness"], rel=0.02)
    assert fit.values["modulus"] == pytest.approx(TRUE["modulus"], rel=0.05)
    apart = fit.values["place_x@0"] - fit.values["place_x@1"]
    assert apart == pytest.approx(-3e-4, abs=2e-5)
    assert fit.noise[0] == pytest.approx(NOISE, rel=0.1)
    assert fit.weighed
    assert "modulus" not in fit.unidentified
    # Without a weight the scale keeps the design's value and the prior's spread.
    assert "modulus" in without.unidentified
    low, high = without.interval("modulus")
    assert high / low > 5
    # A weight that was not fitted.
    deeper = press("sphere_s", 9, DOWN * [1, 1, 0.8])
    force, spread = fit.force_of(deeper)
    assert abs(np.log(force / deeper.weight)) < 3 * spread < 0.3
    posterior = fit.sensor.posterior
    assert posterior is not None
    assert posterior.spreads[posterior.names.index("time_1")] == 0.5


def archive_of(path: Path, shift: int, session: str = "w.zarr", seconds: float = 1.0) -> Path:
    """Write pictures of a weight, or a session, in which all markers move by some pixels."""
    rows, columns = np.mgrid[-40:40, -40:40]
    wide = np.pad(np.tile(columns**2 + rows**2 <= 64, (6, 8)), ((0, 0), (50, 0)))
    ways = np.clip(np.arange(-5, round(20 * seconds) - 5) * shift // 8, 0, shift)
    packed = pack(np.array([wide[:, 50 - way : 690 - way] for way in ways]))
    time = T0 + np.linspace(0.0, 1e9 * seconds, len(ways)).astype(np.int64)
    write_rows(path, session, time, packed, pack(wide[None, :, 50:690])[0])
    return path


@pytest.mark.parametrize(
    ("text", "force"), [("200g", 0.2 * GRAVITY), ("0.2 kg", 0.2 * GRAVITY), ("1.96N", 1.96)]
)
def test_a_weight_has_a_unit_and_the_pictures_under_it(
    tmp_path: Path, text: str, force: float
) -> None:
    made = weighed_press(f"{text}={archive_of(tmp_path / 'w.markers.zarr', 16)}", 3)
    assert made.weight == pytest.approx(force)
    assert made.indenter == "sphere"
    known = np.isfinite(made.observed[0, :, 0])
    assert known.mean() > 0.8
    moved = (made.observed[0] - made.undeformed)[known]
    assert moved == pytest.approx(np.tile([16.0, 0.0], (len(moved), 1)), abs=0.3)


@pytest.mark.parametrize("text", ["200", "200=x", "0g=x", "-5g=x", "200lb=x", "1.2.3g=x"])
def test_a_weight_without_unit_or_archive_is_refused(text: str) -> None:
    with pytest.raises(SceneError, match=r"weight: .*allowed: .* g, kg or N"):
        weighed_press(text, 0)


def test_pictures_without_a_weight_are_refused(tmp_path: Path) -> None:
    path = archive_of(tmp_path / "w.markers.zarr", 0)
    with pytest.raises(SceneError, match=r"move by up to 0\.0 px"):
        weighed_press(f"200g={path}", 0)


def test_presses_too_deep_or_by_weights_alone_are_refused() -> None:
    blank = np.zeros((1, 9, 2))
    deep = MarkedPress("a", "sphere", 0, DOWN * [1, 1, 3.5], blank[0], blank)
    with pytest.raises(SceneError, match=r"a: 3\.5 mm deep; allowed: up to 3 mm"):
        fitted_without_gauge([deep], design())
    with pytest.raises(SceneError, match="none by an arm"):
        fitted_without_gauge([replace(deep, weight=1.0)], design())


def press_of(name: str, columns: Columns) -> Columns:
    """Return the poses of a press: down, at rest, sheared, at rest, back, at rest, and up."""
    if name != "pose":
        return columns
    time = np.arange(0.0, 4.0, 0.01)
    corners = [0.0, 0.5, 0.7, 1.4, 1.6, 2.3, 2.5, 3.2, 3.5]
    way = np.interp(time, corners, [0, 0, 0, 0, 6e-4, 6e-4, 0, 0, 0])
    down = np.interp(time, corners, [1e-3, 1e-3, -8e-4, -8e-4, -8e-4, -8e-4, -8e-4, -8e-4, 1e-3])
    rows = np.tile(np.asarray(CONTACT_FRAME, float), (len(time), 1))
    rows[:, 0] += way
    rows[:, 2] += down
    first = {key: np.repeat(values[:1], len(time)) for key, values in columns.items()}
    return {**first, "t_ns": T0 + np.round(1e9 * time).astype(np.int64), "value": rows}


@pytest.mark.parametrize("off", [0.0, 9.0])
def test_the_command_fits_sessions_without_forces_and_foretells_a_weight(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    off: float,
) -> None:
    session = make_session(tmp_path / "s.zarr", seconds=0.5, names=("pose",), change=press_of)
    marked = archive_of(tmp_path / "m.markers.zarr", 16, session.name, 4.0)
    weight = archive_of(tmp_path / "w.markers.zarr", 16)
    given: list[MarkedPress] = []

    def known(presses: list[MarkedPress], design: SimulatedSensor, **_: object) -> GaugelessFit:
        given[:] = presses
        problem = Problem(design, [replace(p, tip=DOWN) for p in presses], list, LAYER)
        predicted = tuple(each.observed + off for each in presses)
        covariance, values = 1e-4 * np.eye(len(problem.names)), {**problem.centre, "shift_x": 3.0}
        left = (0.1, 0.01), 3, "layer", "cpu"
        return GaugelessFit(
            problem.names, covariance, design, values, tuple(presses), predicted, *left
        )

    monkeypatch.setattr("sim.twin.fitted_without_gauge", known)
    monkeypatch.setattr(GaugelessFit, "force_of", lambda *_: (3.0, 0.05))
    out = tmp_path / "mine.yaml"
    words = ["twin", "fit", str(session), "--sensor", "gelsight", "--out", str(out), "--no-gauge"]
    words += ["--markers", str(marked), "--weight", f"200g={weight}"]
    assert main([*words, "--check-weight", f"100g={weight}"]) == (1 if off else 0)
    printed = capsys.readouterr()
    # Rests after the way back are left out, and the weight is the last.
    arm, weighed = given
    assert arm.tip[1:, 2] == pytest.approx([-8e-4, -8e-4])
    assert arm.tip[1:, 0] == pytest.approx([0.0, 6e-4])
    assert arm.observed.shape == (2, *arm.undeformed.shape)
    assert weighed.weight == pytest.approx(0.2 * GRAVITY)
    assert "100 g on sphere, not fitted: 0.981 N; by the twin 3.000 N" in printed.out
    assert "OUTSIDE" in printed.out
    if off:
        assert "refused: markers at rest differ by" in printed.err
        assert not out.exists()
        return
    twin = read_sensor(out)
    assert twin.posterior is not None
    assert {"modulus", "thickness", "scale"} < set(twin.posterior.names)
    assert camera_quantities(twin)["shift_x"] == pytest.approx(3.0)


def test_a_weight_needs_a_fit_without_a_gauge(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["twin", "fit", "a.zarr", "--sensor", "gelsight", "--weight", "200g=w"]) == 2
    assert "--weight: with a gauge; allowed: with --no-gauge" in capsys.readouterr().err


def test_a_marker_is_found_at_the_centroid_of_its_stretched_image() -> None:
    """Beside a disc's image under x + c x^2, whose centroid is an integral over the disc."""
    radius, bend = 14.0, 2e-3
    outline = radius * gaugeless.ROUND
    outline[:, 0] += bend * outline[:, 0] ** 2
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 801) * radius])
    inside = x**2 + y**2 < radius**2
    area = 1 + 2 * bend * x[inside]
    centroid = ((x + bend * x**2)[inside] * area).sum() / area.sum()
    assert gaugeless._middles(outline)[0] == pytest.approx(centroid, rel=0.02)
    assert centroid > 2.5 * (bend * x[inside] ** 2).mean()
