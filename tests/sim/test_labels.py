"""Forces of twins in the presses of an archive."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recorder import MarkerArchive
from recorder.archive import check_archive
from sim.__main__ import main

TWIN = """\
extends: gelsight.yaml
body: {modulus_kpa: MODULUS}
posterior: {names: [modulus], spreads: [0.05], correlations: [[1.0]]}
"""


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("labels") / "x.markers.zarr"
    words = ["archive", "sensors", "--sensors", "gelsight", "--indenters", "sphere,prism"]
    words += ["--tier", "layer", "--scale", "smoke", "--processes", "1", "--no-check"]
    assert main([*words, "--out", str(path)]) == 0
    return path


def labels(archive: Path, twin: Path | str, *more: str) -> int:
    words = ["labels", str(archive), "--sensor", "gelsight", "--twin", str(twin)]
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


@pytest.mark.slow
def test_what_cannot_be_simulated_is_refused(
    archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert labels(archive, "gelsight", "--draws", "2") == 2
    assert "no posterior" in capsys.readouterr().err
    words = ["labels", str(archive), "--sensor", "other", "--twin", "gelsight"]
    assert main(words) == 2
    assert "allowed: gelsight" in capsys.readouterr().err
