"""The catalogue: it finds sessions, and never shows outdated ones."""

import json
import os
import shutil
from datetime import date
from pathlib import Path
from typing import Any

import pytest
from support.commands import python
from support.sessions import make_session

from recorder import catalogue
from recorder.catalogue import FILE, UNREADABLE, Catalogue, Query
from recorder.cli.list_sessions import _STATUSES
from recorder.spec import FORMAT, STATUSES
from tactile.__main__ import main


def _write(path: Path, **attrs: Any) -> Path:
    """Write the metadata of a session, as a catalogue reads it."""
    path.mkdir(parents=True, exist_ok=True)
    fixed = {"format": FORMAT, "status": "complete", "sensor": "tacpalm", "indenter": "sphere"}
    document = {"zarr_format": 3, "attributes": {**fixed, **attrs}}
    # A new file, so that a change is seen however short the time between two.
    temporary = path / "new"
    temporary.write_text(json.dumps(document))
    temporary.replace(path / "zarr.json")
    return path


def _fresh(folder: Path) -> Catalogue:
    found = Catalogue(folder)
    found.refresh()
    return found


def _paths(folder: Path, **query: Any) -> list[str]:
    return [row.path for row in _fresh(folder).find(Query(**query))]


@pytest.fixture
def day(tmp_path: Path) -> Path:
    _write(tmp_path / "a.zarr", started_utc="2026-11-20T09:00:00Z", plan={"kind": "press_shear"})
    _write(tmp_path / "more/b.zarr", started_utc="2026-11-21T23:59:59Z", indenter="cone")
    _write(tmp_path / "c.zarr", started_utc="2026-11-22T00:00:00Z", status="stopped", reason="x")
    _write(tmp_path / "d.zarr", sensor="uskin", summary={"force": {"dropped": 3}})
    _write(tmp_path / "a.markers.zarr", format="tactile-rig markers")
    (tmp_path / "notes").mkdir()
    return tmp_path


def test_sessions_are_found_by_each_of_their_properties(day: Path) -> None:
    assert _paths(day) == ["d.zarr", "a.zarr", "more/b.zarr", "c.zarr"]
    assert _paths(day, sensor="uskin") == ["d.zarr"]
    assert _paths(day, indenter="cone") == ["more/b.zarr"]
    assert _paths(day, plan="press_shear") == ["a.zarr"]
    assert _paths(day, status="stopped") == ["c.zarr"]
    assert _paths(day, since=date(2026, 11, 21)) == ["more/b.zarr", "c.zarr"]
    assert _paths(day, until=date(2026, 11, 21)) == ["a.zarr", "more/b.zarr"]
    assert _paths(day, faults=True) == ["d.zarr", "c.zarr"]
    assert _paths(day, faults=False) == ["a.zarr", "more/b.zarr"]


def test_only_what_changed_is_read_again(day: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _fresh(day)
    read: list[str] = []
    original = catalogue._read

    def count(folder: Path, path: str, stamp: tuple[int, int, int]) -> catalogue.Row:
        read.append(path)
        return original(folder, path, stamp)

    monkeypatch.setattr(catalogue, "_read", count)
    _fresh(day)
    assert read == []
    _write(day / "c.zarr", status="recovered")
    shutil.rmtree(day / "d.zarr")
    (day / "more/b.zarr").rename(day / "b.zarr")
    assert {row.path for row in _fresh(day)} == {"a.zarr", "b.zarr", "c.zarr"}
    assert sorted(read) == ["b.zarr", "c.zarr"]
    assert _paths(day, status="recovered") == ["c.zarr"]
    read.clear()
    (day / FILE).unlink()
    _fresh(day)
    assert len(read) == 4  # three sessions and a marker archive


@pytest.mark.parametrize("content", ["", "{", "[]", '{"version": 1, "rows": [{"path": 1}]}'])
def test_a_damaged_or_deleted_catalogue_is_rebuilt_from_disk(day: Path, content: str) -> None:
    before = list(_fresh(day))
    (day / FILE).write_text(content)
    assert list(_fresh(day)) == before
    (day / FILE).unlink()
    assert list(_fresh(day)) == before


@pytest.mark.parametrize(
    "content", ["", "[1]", '{"attributes": 3}', '{"attributes": {"format": "tactile-rig session"}']
)
def test_a_session_with_damaged_metadata_is_listed_as_unreadable(day: Path, content: str) -> None:
    (day / "a.zarr/zarr.json").write_text(content)
    (row,) = _fresh(day).find(Query(status=UNREADABLE))
    assert row.path == "a.zarr"
    assert "a.zarr/zarr.json" in row.reason
    assert row.faults == (UNREADABLE,)


def test_strange_attributes_are_no_traceback(tmp_path: Path) -> None:
    _write(tmp_path / "a.zarr", summary=[1], runs=3, targets_wanted="many")
    assert _paths(tmp_path, status=UNREADABLE) == ["a.zarr"]


def test_a_check_is_remembered_until_the_session_changes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = make_session(tmp_path / "s.zarr")
    assert main(["session", "list", str(tmp_path), "--check", "--faults"]) == 0
    assert "0 of 1 sessions, 0 with faults, 0 not checked" in capsys.readouterr().out
    (session / "streams/force/seq/c/0").unlink()
    (tmp_path / FILE).unlink()
    assert main(["session", "list", str(tmp_path), "--check", "--json"]) == 0
    row = json.loads(capsys.readouterr().out)
    assert (row["sensor"], row["findings"]) == ("wedge", row["faults"])
    assert "missing-chunk" in row["faults"]
    assert main(["session", "list", str(tmp_path), "--faults"]) == 0
    table = capsys.readouterr().out
    assert "missing-chunk" in table
    # The path is one that other commands take.
    assert table.splitlines()[1].split()[-1] == str(session)
    os.utime(session / "zarr.json")
    assert _fresh(tmp_path).find(Query())[0].findings is None


def test_the_command_knows_every_status() -> None:
    assert set(_STATUSES) == {*STATUSES, UNREADABLE}
    assert catalogue._FORMAT == FORMAT


def test_two_thousand_sessions_are_listed_without_importing_zarr(tmp_path: Path) -> None:
    for number in range(2000):
        _write(tmp_path / f"{number // 100}" / f"{number}.zarr", bench={"limits": [0.5] * 50})
    program = (
        "import sys; from tactile.__main__ import main; "
        f"code = main(['session', 'list', {str(tmp_path)!r}, '--faults']); "
        "assert not {'numpy', 'zarr'} & set(sys.modules); sys.exit(code)"
    )
    ran = python("-c", program)
    assert ran.stdout.splitlines()[-1] == "0 of 2000 sessions, 0 with faults, 0 not checked"
