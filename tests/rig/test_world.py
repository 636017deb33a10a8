"""The mock bench's World: the rows' sensors under real shapes, and the effects of labs."""

import contextlib
import itertools
import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rig.bench.bench import BenchFile, find_bench, read_content
from rig.bench.expected import mount_of
from rig.bench.worlds import Grip, Lab, WorldSpec
from rig.core.config import build
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES, OTHERS
from rig.core.samples import WORLD_STATE
from rig.devices.arm.emulated_arm import PoseError
from rig.mock.world import LadderWorld, load_view
from rig.mock.world.lab import Gauge
from rig.mock.world.picture import MarkerPicture
from rig.mock.world.truth import Truth, TruthLog
from sim.sensors import sensor

FRAME = (-0.12, -0.43, 0.16, 0.0, 0.0, 0.0)
MS = 1_000_000
SECOND = 1000 * MS


def states_along(
    spec: WorldSpec, places: Any, indenter: str = "sphere", step_ns: int = 4 * MS
) -> np.ndarray:
    """Return WORLD_STATE (n,) along tip positions (n, 3) in the contact frame [m]."""
    world = LadderWorld(spec, indenter, FRAME)
    origin = np.array(FRAME[:3])
    return np.array(
        [
            world.step(SECOND + k * step_ns, np.array([*(origin + place), math.pi, 0, 0]))
            for k, place in enumerate(places)
        ]
    )


def way(*corners: tuple[float, float, float], steps: int = 40) -> np.ndarray:
    """Return positions (n, 3) [m] along straight ways from corner to corner [mm]."""
    parts = [np.linspace(a, b, steps) for a, b in itertools.pairwise(corners)]
    return 1e-3 * np.concatenate(parts)


PRESS = way((0, 0, 0.2), (0, 0, -0.8), (0, 0, 0.2))
SHEAR = way((0, 0, 0.2), (0, 0, -0.8), (0.8, 0, -0.8))


def view_of(tmp_path: Path, name: str, indenter: str = "sphere", kind: str = "camera", **more: Any):
    """Return the view of a packaged bench's World, with settings changed."""
    world = {**read_content(find_bench(name, BENCHES))["world"], **more}
    frame = {"position_mm": [0.0, 0.0, 0.0]}
    path = tmp_path / "world.json"
    content = {"world": world, "contact_frame": frame, "folder": str(tmp_path)}
    path.write_text(json.dumps({**content, "indenter": indenter}))
    return load_view(path, kind)


def test_a_press_pushes_down_drags_within_friction_and_lets_go() -> None:
    spec = WorldSpec(sensor="gelsight")
    states = states_along(spec, SHEAR)
    wrench, row = states["wrench"], sensor("gelsight")
    assert (wrench[states["depth"] <= 0] == 0).all()
    assert (wrench[:, 2] <= 0).all()
    drag = np.hypot(wrench[:, 0], wrench[:, 1])
    assert (drag <= row.effects.friction.coefficient * -wrench[:, 2] + 1e-9).all()
    assert wrench[-1, 0] > 0.4 * -wrench[-1, 2]
    # About the F/T origin, gauge_depth below the top.
    assert wrench[-1, 4] > 0.8 * wrench[-1, 0] * (spec.gauge_depth - 0.8e-3)
    loop = states_along(spec, PRESS)["wrench"][:, 2]
    down, up = loop[:40], loop[40:][::-1]
    assert (up >= down - 1e-9).all()
    assert up.sum() > 0.97 * down.sum()


def test_a_domed_sensor_is_touched_at_its_own_height() -> None:
    drop = 29e-3 - math.sqrt(29e-3**2 - 2 * 6.5e-3**2)
    tips = np.array([[0, 0, -1e-3], [6.5e-3, -6.5e-3, -1e-3 - drop], [6.5e-3, -6.5e-3, -1e-3]])
    states = [states_along(WorldSpec(sensor="tacpalm"), [tip])[0] for tip in tips]
    assert [state["depth"] for state in states] == pytest.approx([1e-3, 1e-3, 1e-3 - drop])
    forces = [state["wrench"][2] for state in states]
    assert forces[0] == pytest.approx(forces[1])
    assert forces[2] == 0


def test_benches_differ_where_the_papers_sensors_do(tmp_path: Path) -> None:
    names = [path.stem for path in sorted(BENCHES.glob("*.yaml")) if path.stem not in OTHERS]
    seen: dict[str, tuple[Any, ...]] = {}
    for name in names:
        bench = BenchFile.read(BENCHES / f"{name}.yaml").bench
        assert bench.world is not None
        row = sensor(bench.world.sensor)
        seen[name] = (row.body, row.signal, bench.world.light, bench.world.grip)
        assert bench.trajectory.depth_max <= row.depth_max
        if bench.dome_radius is not None:
            assert row.trajectory.dome_radius == bench.dome_radius
    # One sensor under two plans, and the middle of the material test's series.
    same = {"gelsight", "gelsight-hetero"}
    others = [name for name in names if name not in same]
    assert len({seen[name] for name in others}) == len(others)
    assert seen["gelsight"] == seen["gelsight-hetero"]
    assert {name for name in names if seen[name][2] == "white"} >= {"r6", "r18"}
    assert {name for name in names if seen[name][3]} == {"array-i", "circle-i"}


def test_indenters_press_with_their_own_shapes() -> None:
    forces = {
        name: states_along(WorldSpec(sensor="gelsight"), PRESS[:40], name)["wrench"][-1, 2]
        for name in ("sphere", "cone", "prism")
    }
    assert 0 > forces["cone"] > 0.5 * forces["sphere"] > forces["prism"]


@pytest.mark.parametrize("name", ["gelsight", "tacpalm"])
def test_pictures_show_the_rows_markers_where_the_skin_moved_them(
    name: str, tmp_path: Path
) -> None:
    quiet = {"noise": None}
    states = states_along(WorldSpec(sensor=name), SHEAR)
    view = view_of(tmp_path, name, **quiet)
    rest, pressed = view(states[0]), view(states[-1])
    signal = sensor(name).signal
    places = np.column_stack([signal.drawn()[0].centres, np.zeros(len(signal.drawn()[0]))])
    pixels = signal.camera().project(places)
    inside = pixels[((pixels > 20) & (pixels < [620, 460])).all(axis=1)]
    dark = read_content(BENCHES / f"{name}.yaml")["world"].get("ink", [0])[0] < 100
    grey = cv2.cvtColor(rest, cv2.COLOR_RGB2GRAY).astype(float)
    column, row = np.rint(inside).astype(int).T
    background = cv2.GaussianBlur(grey, (0, 0), 40)
    contrast = (grey - background)[row, column]
    assert ((contrast < -30) if dark else (contrast > 30)).all()
    change = np.abs(pressed.astype(int) - rest).max(axis=2)
    assert change.max() > 60
    assert np.median(change) < 10


def test_noise_is_absent_unless_it_is_set_and_white_light_has_no_colour_at_its_sides() -> None:
    rims = 300 + 10 * np.array([[[0, 0], [1, 0], [1, 1]]])
    quiet = MarkerPicture(background=(150, 150, 150), ink=(0, 0, 0), light="white")
    image = quiet.image(rims)
    assert (np.ptp(image, axis=2) == 0).all()
    coloured = MarkerPicture(background=(150, 150, 150), ink=(0, 0, 0))
    assert np.ptp(coloured.image(rims), axis=2).max() > 20
    noisy = MarkerPicture(background=(150, 150, 150), ink=(0, 0, 0), light="white", grey_noise=2.0)
    assert (noisy.image(rims).astype(int) - image).std() == pytest.approx(2.0, rel=0.05)


def test_taxels_count_as_the_row_says_in_any_number(tmp_path: Path) -> None:
    states = states_along(WorldSpec(sensor="uskin"), SHEAR, "prism")
    view = view_of(tmp_path, "uskin", "prism", kind="taxels")
    rest, pressed = view(states[0]), view(states[-1])
    np.testing.assert_array_equal(rest, np.tile(np.rint(sensor("uskin").signal.rest), (16, 1)))
    inner = [5, 6, 9, 10]
    assert (pressed - rest)[inner, 2].mean() > 1000
    assert (pressed - rest)[:, 0].max() > 200
    row = tmp_path / "wide.yaml"
    row.write_text("extends: uskin.yaml\nsignal: {rows: 3, columns: 5, pitch_mm: 4.0}\n")
    assert view_of(tmp_path, "uskin", kind="taxels", sensor=str(row))(states[0]).shape == (15, 3)
    with pytest.raises(ConfigError, match=r"world.sensor: found 'gelsight'.*taxels"):
        view_of(tmp_path, "gelsight", kind="taxels")


def test_a_held_indenter_gives_way_and_slides_beyond_the_grip() -> None:
    held = WorldSpec(sensor="gelsight", grip=Grip(stiffness=20e3, slip=1e3))
    deep = way((0, 0, 0.2), (0, 0, -0.8), (0, 0, -0.8))
    firm, soft = (
        states_along(spec, deep, "prism")[-1] for spec in (WorldSpec(sensor="gelsight"), held)
    )
    assert firm["depth"] - soft["depth"] == pytest.approx(-soft["wrench"][2] / 20e3, rel=0.02)
    loose = WorldSpec(sensor="gelsight", grip=Grip(stiffness=20e3, slip=1.0))
    back = np.concatenate([deep, way((0, 0, -0.8), (0, 0, 0.2)), way((0, 0, 0.2), (0, 0, -0.1))])
    slid = states_along(loose, back, "prism")
    assert slid["wrench"][:, 2].min() > -1.6
    # Slid contact stays where it is: the next press does not reach the skin.
    assert slid["wrench"][-1, 2] == 0


def lab(**settings: Any) -> WorldSpec:
    return WorldSpec(sensor="gelsight", lab=Lab(**settings))


def test_a_sticky_skin_pulls_and_a_creeping_one_yields() -> None:
    pulled = states_along(lab(pull_off_n=0.3), PRESS)["wrench"][:, 2]
    assert 0.1 < pulled.max() <= 0.3
    assert pulled[-1] == 0
    held = np.concatenate([PRESS[:40], np.tile(PRESS[39], (40, 1))])
    clean, crept = (
        states_along(spec, held, step_ns=2 * SECOND)["wrench"][-1, 2]
        for spec in (lab(), lab(creep=0.2))
    )
    assert crept / clean == pytest.approx(0.8, abs=0.02)


def gauged(seconds: float, at: float = 0.0) -> np.void:
    state = np.zeros(1, WORLD_STATE)[0]
    state["t_ns"], state["depth"], state["contact"] = SECOND * (1 + seconds), -2e-3, (at, 0.0)
    state["wrench"] = (0.1, 0.2, -1.0, 0.01, 0.02, 0.03)
    return state


def test_a_gauge_drifts_steps_and_may_have_fz_alone() -> None:
    drifting = Gauge(Lab(drift_n_per_h=0.3))
    first, later = (drifting.measured(gauged(at)) for at in (0.0, 3600.0))
    assert (later - first)[:3] == pytest.approx([0.3] * 3)
    stepping = Gauge(Lab(cable_step_n=0.2))
    steps = [stepping.measured(gauged(0.0, at=1e-3 * at))[:3] for at in (0, 1, 5, 5, 9)]
    changes = np.abs(np.diff(steps, axis=0))
    assert changes[0].max() == 0
    assert changes[1] == pytest.approx([0.2] * 3)
    assert changes[2].max() == 0
    assert Gauge(Lab(fz_only=True)).measured(gauged(0.0)).tolist() == [0, 0, -1.0, 0, 0, 0]
    assert Gauge(Lab()).measured(gauged(9.0)).tolist() == [0.1, 0.2, -1.0, 0.01, 0.02, 0.03]


@pytest.mark.slow
def test_a_camera_turns_and_follows_its_lamps(tmp_path: Path) -> None:
    plain = {"noise": None, "light": "white"}
    still = gauged(0.0)
    upright = view_of(tmp_path, "array-ii", **plain)(still)
    over = view_of(tmp_path, "array-ii", **plain, lab={"camera_turned_deg": 180})(still)
    assert np.abs(over[::-1, ::-1].astype(int) - upright).mean() < 1.0
    aside = view_of(tmp_path, "array-ii", **plain, lab={"camera_turned_deg": 90})(still)
    assert np.abs(aside.astype(int) - upright).max() > 60
    warm = view_of(tmp_path, "gelsight", **plain, lab={"led_warm_up": 0.2})
    cold, settled = (warm(gauged(at)).mean() for at in (0.0, 3600.0))
    assert cold / settled > 1.15
    adapting = view_of(tmp_path, "gelsight", **plain, lab={"auto_exposure": True})
    opened, *_, adapted = (adapting(gauged(at)).mean() for at in (0.0, 1.0, 2.0, 3.0))
    assert opened < 0.65 * adapted


def test_an_arm_jitters_and_flips_its_rotation_vector() -> None:
    pose, errors = np.array([0.1, 0.2, 0.3, 3.0, 0.5, 0.0]), PoseError(1e-4, True, seed=1)
    reported = np.array([errors.reported(pose, tick) for tick in range(200)])
    assert reported[:, :3].std(axis=0) == pytest.approx([1e-4] * 3, rel=0.3)
    turns = np.linalg.norm(reported[:, 3:], axis=1)
    angle = np.linalg.norm(pose[3:])
    assert sorted({round(turn, 6) for turn in turns}) == pytest.approx(
        sorted([angle, math.tau - angle])
    )
    assert (reported[:, 3:] @ pose[3:]).min() < 0


@pytest.mark.parametrize(
    ("lab", "message"),
    [
        ({"pull_off_n": 0.5}, "pull_off_n: 0.5; allowed: 0 to 0.3"),
        ({"creep": -0.1}, "creep: -0.1; allowed: 0 to 0.2"),
        ({"taxel_rate_hz": 30.0}, "taxel_rate_hz: 30.0; allowed: 60 to 105"),
        ({"camera_turned_deg": 45}, "camera_turned_deg: found 45; allowed: 0, 90, 180, 270"),
        ({"adhesion": 1}, "unknown adhesion"),
    ],
)
def test_settings_of_a_lab_that_cannot_be_are_refused(lab: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(WorldSpec, {"sensor": "gelsight", "lab": lab}, "bench.yaml.world")


def test_the_truth_log_gives_back_what_was_logged_between_and_despite_a_torn_end(
    tmp_path: Path,
) -> None:
    states = states_along(WorldSpec(sensor="gelsight"), PRESS)
    path = tmp_path / "truth"
    with contextlib.closing(TruthLog(path)) as log:
        for state in states:
            log.append(state)
    with path.open("ab") as file:
        file.write(b"torn")
    truth = Truth(path)
    assert len(truth.records) == len(states)
    times = SECOND + np.array([0, 3 * MS, 10 * MS])
    expected = np.interp(times, states["t_ns"], states["wrench"][:, 2])
    np.testing.assert_allclose(truth.wrench(times)[:, 2], expected, atol=1e-9)
    np.testing.assert_allclose(
        truth.depth(times), np.interp(times, states["t_ns"], states["depth"]), atol=1e-9
    )


def test_how_a_sensor_lies_is_stated() -> None:
    camera = mount_of(WorldSpec("gelsight", gauge_depth=0.03, lab=Lab(camera_turned_deg=90)))
    assert camera == {"turned": pytest.approx(math.pi / 2), "taxels": [], "gauge": [0, 0, -0.03]}
    taxels = mount_of(WorldSpec("uskin", lab=Lab(camera_turned_deg=90)))  # it has no camera
    assert taxels["turned"] == 0.0
    places = np.array(taxels["taxels"]).reshape(4, 4, 2)  # rows along y
    assert (np.diff(places[..., 0], axis=1) > 0).all()
    assert (np.diff(places[..., 1], axis=0) > 0).all()
