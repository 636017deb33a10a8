"""Exports in general: atomic, inside their folder, and with clear errors for missing libraries."""

import builtins
import json
import sys
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.commands import python
from support.made_up_archives import made_up_archive
from support.sessions import make_session, set_attrs

from recorder import MarkerArchive, SessionError
from recorder.convert import FORMATS, Options, export
from recorder.convert.export import file_name
from recorder.convert.runs import parse_utc
from recorder.progress import ReportItems
from recorder.store.files import building
from tactile.__main__ import main

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("to", FORMATS)
def test_every_format_is_written_to_its_target_alone_and_never_over_something(
    to: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_session(tmp_path / "in" / "s.zarr")
    set_attrs(path, sensor="../../x", indenter="/etc/passwd", operator="\0../y")
    (tmp_path / "there").mkdir()
    target = tmp_path / "there" / "out"
    command = ["session", "export", str(path), str(target), "--to", to]
    pixels = ["--images", "pixels"] if to == "zarr" else []
    assert main([*command, *pixels]) == 0
    assert main(command) == 2
    captured = capsys.readouterr()
    assert captured.out == f"{target}: written, {to}\n"
    # On a busy machine lines of progress come first.
    assert (
        captured.err.splitlines()[-1]
        == f"wrong input: {target}: exists already; choose another name"
    )
    assert {*tmp_path.glob("*"), *tmp_path.glob("*/*")} == {
        path.parent,
        path,
        target.parent,
        target,
    }


@pytest.mark.parametrize("to", FORMATS)
def test_progress_ends_at_its_total_and_an_export_that_ends_early_leaves_nothing(
    to: str, recorded: Path, tmp_path: Path
) -> None:
    full = OSError(28, "write failed: errno = 28, buf = 0x5586", str(tmp_path / "beside"))
    for error in (KeyboardInterrupt(), full):
        steps = []

        def stop(
            done: int, total: int, error: BaseException = error, steps: list[Any] = steps
        ) -> None:
            steps.append((done, total))
            raise error

        with pytest.raises(type(error)) as caught:
            export(recorded, tmp_path / "out", to, progress=stop)
        assert len(steps) == 1
        assert 0 < steps[0][0] <= steps[0][1]
        assert list(tmp_path.iterdir()) == []
    assert isinstance(caught.value, OSError)
    assert caught.value.filename == str(tmp_path / "out")
    assert caught.value.strerror == "No space left on device"
    steps = []
    export(recorded, tmp_path / "out", to, progress=lambda *step: steps.append(step))
    assert steps == sorted(steps)
    assert steps[-1][0] == steps[-1][1]


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("wedge", "wedge"),
        ("../x", "_x"),
        ("/etc/passwd", "_etc_passwd"),
        ("..", "unnamed"),
        ("", "unnamed"),
        ("a\\b\0c\nd", "a_b_c_d"),
        ("x" * 300, "x" * 80),
    ],
)
def test_a_file_name_is_one_harmless_component(text: str, name: str) -> None:
    assert file_name(text) == name


@pytest.mark.parametrize("name", ["../../../secret", "/etc", "a/b", ".."])
def test_columns_that_point_out_of_their_stream_are_refused(name: str, tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("force",))
    set_attrs(path / "streams/force", columns=[name, "t_ns"])
    with pytest.raises(SessionError, match="expected a plain name"):
        export(path, tmp_path / "out", "hdf5")


def test_wrong_input_is_one_clear_error(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="known: zarr, lerobot, mcap, hdf5, genforce"):
        export(recorded, tmp_path / "out", "rosbag")
    with pytest.raises(SessionError, match="no such directory"):
        export(recorded, tmp_path / "nowhere" / "out", "mcap")
    open_one = make_session(tmp_path / "open.zarr", finish=False, names=("force",))
    with pytest.raises(SessionError, match="still recording"):
        export(open_one, tmp_path / "out", "hdf5")
    without = make_session(tmp_path / "f.zarr", names=("force",))
    with pytest.raises(SessionError, match="neither camera nor taxels"):
        export(without, tmp_path / "out", "genforce")
    document = json.loads((without / "zarr.json").read_text())["attributes"]
    runs = [{key: entry[key] for key in entry if key != "utc"} for entry in document["runs"]]
    set_attrs(without, runs=runs)
    with pytest.raises(SessionError, match="run 0 has no start time in UTC"):
        export(without, tmp_path / "out", "mcap")
    assert not (tmp_path / "out").exists()


def test_a_damaged_session_is_not_exported(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("camera", "force"))
    shard = path / "streams/camera/value/c/0/0/0/0"
    shard.write_bytes(shard.read_bytes()[:-10_000])
    for to in FORMATS:
        with pytest.raises(SessionError, match="bytes, the manifest of run 0 names"):
            export(path, tmp_path / "out", to)
    assert [entry.name for entry in tmp_path.iterdir()] == ["s.zarr"]


def test_a_missing_library_is_named_with_its_extra(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.split(".")[0] in ("h5py", "fsspec"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return real(name, *rest)

    for name in [name for name in sys.modules if name == "recorder.convert.hdf5_format"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(SessionError, match=r"hdf5 needs h5py: pip install 'tactile-rig\[export\]'"):
        export(recorded, tmp_path / "out", "hdf5")
    with pytest.raises(SessionError, match=r"pip install 'tactile-rig\[remote\]'"):
        export("memory://nowhere", tmp_path / "out", "hdf5")


def test_a_row_of_the_table_writes_archives_of_another_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = tmp_path / "a.markers.zarr"
    made_up_archive(archive, indenters=("sphere",), unseen=(), targets=1)
    with pytest.raises(SessionError, match="hdf5 is not for a marker archive; allowed: genforce"):
        export(archive, tmp_path / "out", "hdf5")
    module = types.ModuleType("elsewhere")

    def write(source: MarkerArchive, path: Path, options: Options, progress: ReportItems) -> None:
        path.write_text(f"{', '.join(source)} {options.valid_only}")

    module.write_archive = write  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "elsewhere", module)
    row = replace(FORMATS["mcap"], module="elsewhere", of_archives=True)
    monkeypatch.setitem(FORMATS, "mcap", row)
    export(archive, tmp_path / "out", "mcap", options=Options(valid_only=True))
    assert (tmp_path / "out").read_text() == "dots, grid True"


def test_the_recorder_alone_imports_no_extra() -> None:
    # fsspec is not listed: zarr-python imports it if it is installed.
    heavy = {"pyarrow", "h5py", "s3fs", "mcap", "google.protobuf", "pandas", "torch"}
    heavy |= {"matplotlib"}
    code = f"import sys, recorder, tactile.__main__; print(sorted({heavy} & set(sys.modules)))"
    assert python("-c", code).stdout == "[]\n"


def test_building_replaces_what_an_earlier_kill_left(tmp_path: Path) -> None:
    (tmp_path / "out.creating").mkdir()
    (tmp_path / "out.creating" / "half").write_text("x")
    with building(tmp_path / "out") as beside:
        assert not beside.exists()
        beside.write_text("whole")
    assert (tmp_path / "out").read_text() == "whole"
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1970-01-01T00:00:00.000000001Z", 1),
        ("2026-11-21T01:17:06.458172368Z", 1795223826458172368),
        ("2026-11-21T03:17:06.458172368+02:00", 1795223826458172368),
        ("1970-01-01T00:00:02.5", 2_500_000_000),
    ],
)
def test_utc_is_read_to_the_nanosecond(text: str, expected: int) -> None:
    assert parse_utc(text) == expected


def test_a_time_that_is_none_is_refused() -> None:
    with pytest.raises(SessionError, match="found utc 'yesterday'"):
        parse_utc("yesterday")
