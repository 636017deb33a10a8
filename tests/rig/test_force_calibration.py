"""ATI calibration files: parsing, rejection, and comparison with ATI's own library."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.cal_files import emit_calibration

from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES
from rig.devices.force.calibration import (
    FORCE_UNITS,
    TORQUE_UNITS,
    ToolTransform,
    TransducerCalibration,
    parse_calibration,
    read_calibration,
)

RATED = (12.0, 12.0, 17.0, 0.12, 0.12, 0.12)
Edit = Callable[[ET.Element], None]


def synthetic(seed: int = 1) -> TransducerCalibration:
    """Return a fictitious transducer: random, scaled like a Nano17."""
    matrix = np.diag(RATED) @ np.random.default_rng(seed).normal(size=(6, 6)) / 5
    return TransducerCalibration("FT00000", "SI-12-0.12", matrix, RATED)


def edited(edit: Edit) -> bytes:
    root = ET.fromstring(emit_calibration(synthetic()))
    edit(root)
    return bytes(ET.tostring(root))


def calibration_of(root: ET.Element) -> ET.Element:
    (element,) = root.findall("Calibration")
    return element


def user_axis(root: ET.Element, name: str) -> ET.Element:
    return next(row for row in calibration_of(root).findall("UserAxis") if row.get("Name") == name)


UNITS = [("force_unit", name) for name in FORCE_UNITS]
UNITS += [("torque_unit", name) for name in TORQUE_UNITS]


@pytest.mark.parametrize(("kind", "unit"), UNITS)
def test_every_unit_reads_as_newton_and_newton_metre(kind: str, unit: str) -> None:
    found = parse_calibration(emit_calibration(synthetic(), **{kind: unit}), "x.cal")
    np.testing.assert_allclose(found.matrix, synthetic().matrix, rtol=1e-9)
    np.testing.assert_allclose(found.rated, RATED, rtol=1e-9)


def test_a_file_in_pound_and_inch_has_the_numbers_of_its_units() -> None:
    content = emit_calibration(synthetic(), force_unit="lbf", torque_unit="lbf-in")
    root = ET.fromstring(content)
    assert float(user_axis(root, "Fz").get("max", "")) == pytest.approx(17 / 4.4482216152605)
    assert float(user_axis(root, "Tz").get("max", "")) == pytest.approx(0.12 / 0.1129848290276167)


def test_the_user_axes_count_and_not_the_factory_axes() -> None:
    def scaled(root: ET.Element) -> None:
        for row in calibration_of(root).findall("Axis"):
            row.set("values", "1 2 3 4 5 6")

    found = parse_calibration(edited(scaled), "x.cal")
    np.testing.assert_allclose(found.matrix, synthetic().matrix, rtol=1e-9)


def test_a_unipolar_output_ranges_from_zero() -> None:
    unipolar = edited(calibration(OutputRange="5", OutputBipolar="False"))
    assert parse_calibration(unipolar, "x.cal").volts_range == (0.0, 5.0)
    assert parse_calibration(emit_calibration(synthetic()), "x.cal").volts_range == (-10.0, 10.0)


def calibration(**attributes: str) -> Edit:
    """Return an edit that sets attributes of the calibration."""
    return lambda root: calibration_of(root).attrib.update(attributes)


def axis(name: str, **attributes: str) -> Edit:
    """Return an edit that sets attributes of a user axis."""
    return lambda root: user_axis(root, name).attrib.update(attributes)


def one_row_twice(root: ET.Element) -> None:
    axis("Fy", values=user_axis(root, "Fx").get("values", ""))(root)


def without_ty(root: ET.Element) -> None:
    calibration_of(root).remove(user_axis(root, "Ty"))


REFUSED: dict[str, tuple[Edit, str]] = {
    "another root": (lambda root: setattr(root, "tag", "Sensor"), r"<Sensor>; allowed: <FTSensor>"),
    "five gauges": (lambda root: root.set("NumGages", "5"), r"NumGages: found '5'; allowed: '6'"),
    "no calibration": (lambda root: root.remove(calibration_of(root)), r"found 0; allowed: 1"),
    "two calibrations": (lambda root: root.append(calibration_of(root)), r"found 2; allowed: 1"),
    "unknown unit": (calibration(TorqueUnits="stone-ft"), r"found 'stone-ft'; allowed: .*N-mm"),
    "axis missing": (without_ty, r"UserAxis: missing \['Ty'\]"),
    "axis twice": (axis("Ty", Name="Tx"), r"UserAxis\[Tx\]: found 'Tx'; allowed: each of Fx.*once"),
    "unnamed axis": (lambda root: user_axis(root, "Ty").attrib.pop("Name"), r"missing 'Name'"),
    "five values": (axis("Fz", values="1 2 3 4 5"), r"UserAxis\[Fz\].values: found 5; allowed: 6"),
    "not a number": (axis("Fz", values="1 2 3 4 5 nan"), r"found 'nan'; allowed: a finite number"),
    "decimal comma": (axis("Fz", values="1,5 2 3 4 5 6"), r"values: found '1,5'"),
    "rated at nothing": (axis("Fz", max="0"), r"max: found 0; allowed: above 0"),
    "one row twice": (one_row_twice, r"do not determine six components"),
    "no output range": (calibration(OutputRange="-1"), r"OutputRange: found -1; allowed: above 0"),
    "odd polarity": (calibration(OutputBipolar="perhaps"), r"OutputBipolar: found 'perhaps'"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_whole_calibration_is_refused_by_name(name: str) -> None:
    edit, message = REFUSED[name]
    with pytest.raises(ConfigError, match=message) as caught:
        parse_calibration(edited(edit), "FT1.cal")
    assert str(caught.value).startswith("FT1.cal")


@given(cut=st.integers(0, len(emit_calibration(synthetic())) - len("</FTSensor>\n")))
def test_a_truncated_file_is_refused_wherever_it_ends(cut: int) -> None:
    with pytest.raises(ConfigError, match="not XML"):
        parse_calibration(emit_calibration(synthetic())[:cut], "x.cal")


LAUGHS = """<!DOCTYPE FTSensor [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>
<FTSensor Serial="&b;" NumGages="6"/>"""


@pytest.mark.parametrize(
    "content",
    [
        LAUGHS.encode(),
        ('<?xml version="1.0" encoding="utf-16"?>' + LAUGHS).encode("utf-16"),
        b'<!DOCTYPE FTSensor SYSTEM "file:///etc/hostname"><FTSensor/>',
    ],
)
def test_a_document_type_is_refused_before_anything_is_expanded_or_fetched(content: bytes) -> None:
    with pytest.raises(ConfigError, match="document type"):
        parse_calibration(content, "x.cal")


def test_a_huge_file_is_refused_and_one_that_is_not_there_named(tmp_path: Path) -> None:
    path = tmp_path / "FT9.cal"
    with pytest.raises(ConfigError, match=r"FT9\.cal: No such file.*allowed"):
        read_calibration(path)
    path.write_bytes(b" " * (1 << 21))
    with pytest.raises(ConfigError, match="more than"):
        read_calibration(path)


def test_the_benches_own_calibration_is_whole_and_says_that_it_is_made_up() -> None:
    path = BENCHES / "mock-nano17.cal"
    found = read_calibration(path)
    assert found.rated == pytest.approx(RATED)
    # A gauge must not saturate below the rated load on any single axis.
    assert np.abs(found.volts(np.diag(RATED))).max() < 10
    assert "Synthetic" in path.read_text()


@given(wrench=st.lists(st.floats(-17, 17), min_size=6, max_size=6))
def test_volts_and_wrench_are_inverse(wrench: list[float]) -> None:
    calibration = synthetic()
    np.testing.assert_allclose(calibration.wrench(calibration.volts(wrench)), wrench, atol=1e-9)


def test_a_bias_in_volts_is_a_bias_in_newton() -> None:
    calibration, rng = synthetic(), np.random.default_rng(3)
    volts, bias = rng.normal(size=(10, 6)), rng.normal(size=6)
    tared = calibration.wrench(volts) - calibration.wrench(bias)
    np.testing.assert_allclose(calibration.wrench(volts - bias), tared, atol=1e-12)


def test_a_gauge_at_either_end_of_its_range_is_saturated() -> None:
    calibration = synthetic()
    volts = np.zeros((4, 6))
    volts[1, 5], volts[2, 0], volts[3, 3] = 10.0, -9.995, 9.98
    assert calibration.saturated(volts).tolist() == [False, True, True, False]
    assert calibration.saturated(volts, 0.99).tolist() == [False, True, True, True]


def test_beyond_the_rating_is_told_axis_by_axis() -> None:
    wrenches = [[0, 0, 17, 0, 0, 0], [0, 0, -17.1, 0, 0, 0], [0, 0, 0, 0, 0.121, 0]]
    assert synthetic().beyond_rating(wrenches).tolist() == [False, True, True]


@pytest.mark.parametrize(
    ("tool", "wrench", "felt"),
    [
        # 1 N along x at a height of 20 mm gives 20 N mm about y: about that point there is none.
        (ToolTransform((0.0, 0.0, 0.02)), [1, 0, 0, 0, 0.02, 0], [1, 0, 0, 0, 0, 0]),
        (
            ToolTransform(rotation=(0.0, 0.0, math.pi / 2)),
            [1, 0, 2, 0.03, 0, 0],
            [0, -1, 2, 0, -0.03, 0],
        ),
    ],
    ids=["away from the transducer: the lever", "turned: the force turned the other way"],
)
def test_a_tool_feels_the_wrench_in_its_own_frame(
    tool: ToolTransform, wrench: list[float], felt: list[float]
) -> None:
    volts = synthetic().volts(wrench)
    np.testing.assert_allclose(synthetic().moved(tool).wrench(volts), felt, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_atis_own_library_finds_the_same_wrench(tmp_path: Path, seed: int) -> None:
    atiiaftt = pytest.importorskip(
        "atiiaftt", reason="ATI's C library is not installed: pip install atiiaftt (needs gcc)"
    )
    rng = np.random.default_rng(seed)
    calibration = synthetic(seed)
    path = tmp_path / "FT0.cal"
    path.write_bytes(emit_calibration(calibration))
    volts, bias = rng.uniform(-8, 8, 6), rng.uniform(-1, 1, 6)
    displacement, degrees = rng.uniform(-30, 30, 3), rng.uniform(-180, 180, 3)
    found = calibration.moved(
        ToolTransform(tuple(1e-3 * displacement), tuple(np.deg2rad(degrees)))
    ).wrench(volts - bias)
    sensor = atiiaftt.FTSensor(str(path), 1)
    units = atiiaftt.FTUnit
    sensor.setToolTransform([*displacement, *degrees], units.DIST_MM, units.ANGLE_DEG)
    sensor.bias(bias.tolist())
    expected = np.array(sensor.convertToFt(volts.tolist())) * [1, 1, 1, 1e-3, 1e-3, 1e-3]
    # The library computes in single precision.
    np.testing.assert_allclose(found / RATED, expected / RATED, atol=1e-5)
