"""Forces of twins in the presses of an archive."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder import MarkerArchive
from recorder.archive import check_archive
from sim.errors import SimulationDiverged
from sim.sensors import read_sensor
from sim.sensors.quantities import draw_sensor
from sim.twin.labels import ArchivedPress, by_fem_at_once, by_layer, forces, provenance
from tactile.__main__ import main

TWIN = """\
extends: gelsight.yaml
body: {modulus_kpa: MODULUS}
posterior: {names: [modulus], spreads: [0.05], correlations: [[1.0]]}
"""


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("labels") / "x.markers.zarr"
    words = ["sim", "archive", "gelsight", "--indenters", "sphere,prism"]
    words += ["--tier", "layer", "--scale", "smoke", "--processes", "1", "--no-check"]
    assert main([*words, "--out", str(path)]) == 0
    return path


def labels(archive: Path, twin: Path | str, *more: str) -> int:
    words = ["sim", "labels", str(archive), "--sensor", "gelsight", "--twin", str(twin)]
    return main([*words, "--grid", "48", "--processes", "1", *more])


@pytest.mark.slow
def test_forces_of_a_twin_are_those_of_its_presses(
    archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = tmp_path / "mine.yaml"
    twin.write_text(TWIN.replace("MODULUS", "290"))
    assert MarkerArchive(archive)["gelsight"].simulated is None
    assert labels(archive, twin, "--draws", "3") == 0
    opened = MarkerArchive(archive)
    sensor = opened["gelsight"]
    found, true = sensor.simulated, sensor.table["wrench"][:, :3]
    assert found is not None
    # Twice the modulus of the archive's skin: twice its forces.
    size = np.abs(true).max()
    rows = sensor.table["location"] >= 0
    np.testing.assert_allclose(found.force[rows], 2 * true[rows], atol=0.06 * size)
    assert np.isnan(found.force[~rows]).all()
    part = found.spread[rows, 2].max() / np.abs(found.force[rows, 2]).max()
    assert 0.01 < part < 0.15
    assert list(check_archive(opened.files, archive)) == []
    capsys.readouterr()
    assert labels(archive, twin, "--draws", "3") == 0
    assert "has these forces already" in capsys.readouterr().out
    assert labels(archive, twin, "--draws", "0") == 0
    again = MarkerArchive(archive)["gelsight"].simulated
    assert again is not None
    assert not again.spread[rows].any()
    np.testing.assert_array_equal(again.force, found.force)
    # A surface that is higher than the archive has it is pressed deeper.
    assert labels(archive, twin, "--draws", "0", "--height-um", "50") == 0
    assert "height 50 um" in capsys.readouterr().out
    higher = MarkerArchive(archive)["gelsight"].simulated
    assert higher is not None
    deep = rows & (found.force[:, 2] < -0.1)
    assert (higher.force[deep, 2] < 1.02 * found.force[deep, 2]).all()
    # The height of a twin's fit belongs to its quantities.
    twin.write_text(TWIN.replace("MODULUS", "290").replace("]]}", "]], height_um: 50}"))
    assert labels(archive, twin, "--draws", "0", "--height-um", "0") == 0
    assert "height" not in capsys.readouterr().out
    assert labels(archive, twin, "--draws", "0") == 0
    assert "height 50 um" in capsys.readouterr().out
    own = MarkerArchive(archive)["gelsight"].simulated
    assert own is not None
    np.testing.assert_array_equal(own.force, higher.force)
    # What the fit did not explain is in the spread, and in no force.
    twin.write_text(TWIN.replace("MODULUS", "290").replace("]]}", "]], law: 0.04}"))
    assert labels(archive, twin, "--draws", "3") == 0
    assert "law 4.00%" in capsys.readouterr().out
    wide = MarkerArchive(archive)["gelsight"].simulated
    assert wide is not None
    np.testing.assert_array_equal(wide.force, found.force)
    unexplained = 0.04 * np.linalg.norm(found.force, axis=1, keepdims=True)
    np.testing.assert_allclose(wide.spread, np.hypot(found.spread, unexplained), rtol=1e-5)
    assert labels(archive, twin, "--height-um", "2000") == 2
    assert "--height-um: found 2000; allowed: up to 1000" in capsys.readouterr().err


@pytest.mark.slow
def test_forces_of_a_twin_that_was_identified_by_tier_fem_are_of_that_tier(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(TWIN.replace("MODULUS", "145").replace("]]}", "]], tier: fem}"))
    twin = read_sensor(path)
    assert twin.posterior is not None
    drawn = draw_sensor(twin, twin.posterior, np.random.default_rng(0))
    time, depth = np.array([0.0, 0.1, 0.2]), np.array([0.3e-3, 0.8e-3, 1.3e-3])
    tip = np.stack([0 * depth, 0 * depth, -depth], axis=1)
    press = ArchivedPress("sphere", np.arange(3), tip, time)
    found, layer = forces([twin, drawn], press, 48), by_layer([twin, drawn], press, 48)
    (at_once,) = by_fem_at_once(twin, [press], "cpu", lambda fraction: None)
    np.testing.assert_allclose(at_once, found[0], rtol=1e-6, atol=1e-9)
    over = found[0, :, 2] / layer[0, :, 2]
    # A third of the thickness deep the layer lacks a part of the force, near the surface none.
    assert over[0] == pytest.approx(1.0, abs=0.05)
    assert over[2] > over[0] + 0.03
    assert found[1, :, 2] / found[0, :, 2] == pytest.approx(layer[1, :, 2] / layer[0, :, 2])
    assert provenance(twin, 1, 0, 48).endswith("tier fem")
    words = ["sim", "archive", str(path), "--draws", "20", "--tier", "layer"]
    assert main([*words, "--out", str(tmp_path / "x.markers.zarr")]) == 2


@pytest.mark.slow
def test_a_press_without_a_solution_has_no_force_and_is_named(
    archive: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def without(*wanted: str) -> Any:
        def of(sensors: Any, press: ArchivedPress, *given: Any) -> Any:
            if press.indenter in wanted:
                raise SimulationDiverged("the skin folds")
            return forces(sensors, press, *given)

        return of

    twin = tmp_path / "mine.yaml"
    twin.write_text(TWIN.replace("MODULUS", "200"))
    monkeypatch.setattr("sim.twin.labels.forces", without("sphere"))
    assert labels(archive, twin, "--draws", "1") == 0
    assert "have no solution, and no force: sphere at (" in capsys.readouterr().err
    opened = MarkerArchive(archive)
    sensor = opened["gelsight"]
    assert sensor.simulated is not None
    known = np.isfinite(sensor.simulated.force).all(axis=1)
    located = sensor.table["location"] >= 0
    prism = sensor.table["indenter"] == opened.indenters.index("prism")
    np.testing.assert_array_equal(known, located & prism)
    assert list(check_archive(opened.files, archive)) == []
    monkeypatch.setattr("sim.twin.labels.forces", without("sphere", "prism"))
    assert labels(archive, twin, "--draws", "0") == 1
    assert "no press has a solution" in capsys.readouterr().err


@pytest.mark.slow
def test_what_cannot_be_simulated_is_refused(
    archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert labels(archive, "gelsight", "--draws", "2") == 2
    assert "no posterior" in capsys.readouterr().err
    words = ["sim", "labels", str(archive), "--sensor", "other", "--twin", "gelsight"]
    assert main(words) == 2
    assert "allowed: gelsight" in capsys.readouterr().err
