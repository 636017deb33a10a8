"""Sensor rows: specified values, and errors that state the place and the cause."""

import math
from pathlib import Path

import numpy as np
import pytest

from sim.errors import SceneError
from sim.indenters import named
from sim.layer import Layer
from sim.scene import through
from sim.sensors import (
    HETEROGENEOUS,
    HOMOGENEOUS,
    MATERIAL,
    NAMES,
    CameraSignal,
    SimulatedSensor,
    TaxelSignal,
    read_sensor,
    sensor,
)
from sim.sensors.field import SurfaceField
from sim.sensors.sensor import ROWS
from sim.sensors.taxels import TaxelPad
from sim.tiers import simulate


@pytest.mark.parametrize("name", NAMES)
def test_every_row_is_read_and_named_as_its_file(name: str) -> None:
    assert sensor(name).name == name
    assert sensor(name).description


def test_the_groups_are_the_papers() -> None:
    groups = {*HOMOGENEOUS, *MATERIAL, *HETEROGENEOUS, "gel"}
    assert groups | {"digit", "gelsight-mini"} == set(NAMES)
    assert len(HOMOGENEOUS) == 5
    assert len(MATERIAL) == 7


def test_skins_grow_softer_with_their_ratio() -> None:
    moduli = [sensor(name).body.modulus for name in MATERIAL]
    assert moduli == [3.0e5, 2.5e5, 2.1e5, 1.8e5, 1.55e5, 1.35e5, 1.2e5]


@pytest.mark.slow
def test_forces_and_losses_of_the_three_kinds_are_those_that_they_were_fitted_to() -> None:
    peaks = {}
    for name, lost in (("uskin", 0.12), ("gelsight", 0.15), ("tacpalm", 0.15)):
        each = sensor(name)
        assert each.force_depth is not None
        down = np.linspace(0.0, each.force_depth.depth_max, 9)
        depth = np.concatenate([down, down[-2::-1]])
        motion = through([(0.0, 0.0, -one) for one in depth], speed=each.speed)
        force = -simulate(each.scene(named("prism"), motion), Layer()).force[:, 2]
        loading = np.trapezoid(force[:9], down)
        assert (loading + np.trapezoid(force[8:], depth[8:])) / loading == pytest.approx(lost, 0.1)
        peaks[name] = force[8]
    parts = [peaks[name] / peaks["gelsight"] for name in peaks]
    assert parts == pytest.approx([2, 1, 0.5], rel=0.1)


def test_a_full_press_of_uskin_with_shear_reaches_the_counts_that_its_gains_are_for() -> None:
    pad = sensor("uskin")
    plan = pad.trajectory
    assert isinstance(pad.signal, TaxelSignal)
    assert plan is not None
    (x, y), deep = plan.position(2), -plan.depth_max
    motion = through([(x, y, 0), (x, y, deep), (x + plan.shear, y, deep)], speed=pad.speed)
    result = simulate(pad.scene(named("prism"), motion), Layer())
    counts = TaxelPad(pad.body, pad.signal).counts(SurfaceField.of(result))
    assert counts[..., 2].max() == pytest.approx(10_000, rel=0.05)
    assert np.abs(counts[..., :2]).max() == pytest.approx(2_000, rel=0.3)


def test_homogeneous_sensors_share_a_body_and_a_life_and_differ_in_patterns() -> None:
    rows = [sensor(name) for name in HOMOGENEOUS]
    assert len({row.body for row in rows}) == 1
    assert len({row.variation for row in rows}) == 1
    signals = [row.signal for row in rows if isinstance(row.signal, CameraSignal)]
    assert len({signal.patterns for signal in signals}) == 5


def test_the_units_of_keys_are_taken_to_si() -> None:
    uskin = sensor("uskin")
    assert isinstance(uskin.signal, TaxelSignal)
    assert uskin.body.thickness == pytest.approx(4e-3)
    assert uskin.signal.pitch == pytest.approx(4.7e-3)
    assert uskin.signal.moment == pytest.approx(0.9e-3)
    assert uskin.speed == pytest.approx(5e-3)


BASE = """
extends: gelsight.yaml
description: a test
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    (folder / "gelsight.yaml").write_text((ROWS / "gelsight.yaml").read_text())
    path.write_text(text)
    return path


def read(folder: Path, text: str) -> SimulatedSensor:
    return read_sensor(written(folder, text))


def test_a_row_says_only_what_differs(tmp_path: Path) -> None:
    mine = read(tmp_path, BASE + "body: {modulus_kpa: 200.0, footprint: ellipse}\n")
    assert mine.name == "mine"
    assert (mine.body.modulus, mine.body.footprint) == (2e5, "ellipse")
    assert mine.body.thickness == sensor("gelsight").body.thickness


def test_a_row_with_scale_and_distance_has_the_lens_of_both(tmp_path: Path) -> None:
    signal = read(tmp_path, BASE + "signal: {distance_mm: 20.0, rotation_deg: 90}\n").signal
    assert isinstance(signal, CameraSignal)
    camera = signal.camera()
    assert camera.mm_per_px == pytest.approx(0.0249)
    assert camera.distance == pytest.approx(20e-3)
    assert camera.rotation == pytest.approx(math.pi / 2)


def test_a_layout_has_the_name_in_patterns(tmp_path: Path) -> None:
    layout = "layout: {name: b, shape: disc, size_mm: 1, places_mm: [[0, 1]]}"
    with pytest.raises(SceneError, match=r"signal\.patterns: GelSight; allowed: b, the name"):
        read(tmp_path, BASE + f"signal: {{{layout}}}\n")
    signal = read(tmp_path, BASE + f"signal: {{patterns: [b], {layout}}}\n").signal
    assert isinstance(signal, CameraSignal)
    assert signal.drawn()[0].places == ((0.0, 1e-3),)


def test_a_signal_of_another_kind_replaces_the_whole(tmp_path: Path) -> None:
    signal = (
        "signal: {kind: taxels, pitch_mm: 4.0, magnet_depth_mm: 1.0, hall_depth_mm: 1.0, "
        "moment_ma_m2: 1.0, gain_shear_counts_per_mt: 1.0, gain_normal_counts_per_mt: 1.0}\n"
    )
    assert isinstance(read(tmp_path, BASE + signal).signal, TaxelSignal)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: other\n", r"mine\.yaml: unknown \['name'\]"),
        ("depth_max_mm: 3.9\n", r"mine\.depth_max: 0\.0039 m; allowed: above 0 to 0\.0036 m"),
        ("depth_max_mm: 0.9\n", r"mine\.trajectory\.depth_max: 0\.001 m; allowed: up to"),
        ("effects: {friction: {coefficient: -1}}\n", r"\.effects\.friction: friction\.coefficient"),
        ("effects: {viscosity: {ratios: [0.1]}}\n", r"\.effects\.viscosity: .*1 ratios and 2"),
        ("effects: {viscosity: {ratios: 0.1}}\n", r"\.viscosity\.ratios: found 0\.1.*list"),
        ("signal: {patterns: []}\n", r"\.signal: signal\.patterns: none"),
        (
            "signal: {patterns: [b], layout: {name: b, shape: disc, size_mm: 1, places_mm: [4]}}\n",
            r"\.layout\.places_mm\[0\]: found 4; allowed: a list",
        ),
        ("signal: {shift_px: [2000, 0]}\n", r"\.signal: camera\.shift\[0\]: 2000\.0 px; allowed"),
        ("signal: {kind: sonar}\n", r"\.signal\.kind: found 'sonar'; allowed: camera, taxels"),
        ("signal: {patterns: [TacPalm]}\n", r"mine\.yaml: pattern 'TacPalm': .* beyond the gel"),
        ("trajectory: {points: [7]}\n", r"mine\.yaml\.trajectory: points: \(7,\)"),
        ("variation: {drift: {}}\n", r"\.variation\.drift: missing step_um"),
    ],
)
def test_errors_name_file_key_value_and_what_is_allowed(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(SceneError, match=message):
        read(tmp_path, BASE + text)
