"""Frames of a session in pandas, xarray and notebooks."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from support.sessions import make_session, reseal

from recorder import Session, SessionError, to_pandas, to_xarray


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    path = tmp_path_factory.mktemp("tables") / "s.zarr"
    return Session(make_session(path, seconds=1.2, names=("camera", "force", "pose", "taxels")))


def test_pandas_has_the_frames_with_a_column_for_each_component(session: Session) -> None:
    pytest.importorskip("pandas", reason="pandas is not installed: extra tables")
    table = to_pandas(session)
    assert list(table.index) == session.frames["t_ns"].tolist()
    for k, label in enumerate(("fx", "fy", "fz", "tx", "ty", "tz")):
        np.testing.assert_array_equal(table[f"wrench_{label}"], session.frames["wrench"][:, k])
    np.testing.assert_array_equal(table["pose_rz"], session.frames["pose"][:, 5])
    np.testing.assert_array_equal(table["taxels_15_2"], session.frames["taxels"][:, 15, 2])
    assert table["valid"].dtype == bool
    assert table.attrs["units"]["depth"] == "m"


def test_xarray_has_units_and_names_of_components(session: Session) -> None:
    pytest.importorskip("xarray", reason="xarray is not installed: extra tables")
    found = to_xarray(session)
    np.testing.assert_array_equal(
        found["wrench"].sel(wrench_axis="fz"), session.frames["wrench"][:, 2]
    )
    assert found["taxels"].shape == (len(session.frames["t_ns"]), 16, 3)
    assert found["depth"].attrs["units"] == "m"
    assert found.attrs["sensor"] == "wedge"


def test_a_missing_library_and_missing_frames_are_said(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = make_session(tmp_path / "live.zarr", seconds=0.6, names=("force",), finish=False)
    with pytest.raises(SessionError, match=r"live\.zarr: recording, so it has no frames yet"):
        to_pandas(Session(live))
    bare = make_session(tmp_path / "bare.zarr", seconds=0.6, names=("force",))
    shutil.rmtree(bare / "frames")
    reseal(bare)
    with pytest.raises(SessionError, match=r"bare\.zarr: has no frames \(tactile session recover"):
        to_xarray(Session(bare))
    for name, table in (("pandas", to_pandas), ("xarray", to_xarray)):
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(SessionError, match=rf"needs {name}: pip install 'tactile-rig\[tables"):
            table(session)
