"""Sessions behind URLs: same values as on disk, little network traffic, and clear errors."""

import http.server
import logging
import os
import pickle
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
from fsspec.asyn import get_loop
from fsspec.implementations.memory import MemoryFileSystem
from support.sessions import flip, make_session, set_attrs

from recorder import Session, SessionError, check, contact_sheet
from recorder.convert import export
from recorder.store.files import join_ranges
from tactile.__main__ import main

pytestmark = pytest.mark.slow

get_loop()  # fsspec keeps one thread for the life of the process


class CountedFileSystem(MemoryFileSystem):
    """A store that records its requests."""

    protocol = "counted"
    store: dict[str, Any] = {}  # noqa: RUF012 - as its parent has it
    pseudo_dirs = [""]  # noqa: RUF012
    asked: list[tuple[str, int]] = []  # noqa: RUF012

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(path.replace("counted://", "memory://")))

    def cat_file(self, path: str, start: Any = None, end: Any = None, **rest: Any) -> bytes:
        data = super().cat_file(path, start=start, end=end, **rest)
        self.asked.append((path, len(data)))
        return data


fsspec.register_implementation("counted", CountedFileSystem)


@pytest.fixture(scope="module")
def counted(recorded: Path) -> str:
    fsspec.filesystem("counted").put(str(recorded), "/bucket/s.zarr", recursive=True)
    return "counted://bucket/s.zarr"


class _Quiet(http.server.SimpleHTTPRequestHandler):
    """HTTP server for a directory with byte ranges, which the standard library does not support."""

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        asked, path = self.headers.get("Range"), Path(self.translate_path(self.path))
        if asked is None or not path.is_file():
            super().do_GET()
            return
        data = path.read_bytes()
        first, last = asked.removeprefix("bytes=").split("-")
        start = int(first) if first else len(data) - int(last)
        stop = int(last) + 1 if first and last else len(data)
        part = data[start:stop]
        self.send_response(206)
        self.send_header("Content-Length", str(len(part)))
        self.send_header("Content-Range", f"bytes {start}-{start + len(part) - 1}/{len(data)}")
        self.end_headers()
        self.wfile.write(part)


@pytest.fixture(scope="module")
def web(recorded: Path) -> Iterator[str]:
    with served(recorded.parent, _Quiet) as address:
        yield f"{address}/s.zarr"


class _WithoutRanges(_Quiet):
    do_GET = http.server.SimpleHTTPRequestHandler.do_GET  # noqa: N815


@contextmanager
def served(folder: Path, kind: type[_Quiet]) -> Iterator[str]:
    def handler(*arguments: Any) -> _Quiet:
        return kind(*arguments, directory=str(folder))

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def s3(recorded: Path) -> Iterator[str]:
    server_module = pytest.importorskip("moto.server", reason="needs moto[s3] and flask")
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = server_module.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    reported = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_EC2_METADATA_DISABLED": "true",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in reported.items():
            patch.setenv(name, value)
        system = fsspec.filesystem("s3")
        system.mkdir("bucket")
        system.put(str(recorded), "bucket/s.zarr", recursive=True)
        yield "s3://bucket/s.zarr"
    server.stop()


@pytest.fixture(scope="module", autouse=True)
def _servers_run_all_the_time(web: str, s3: str) -> None:
    """Start the servers before any test counts its threads."""


@pytest.fixture(
    params=["counted", *(pytest.param(n, marks=pytest.mark.slow) for n in ("web", "s3"))]
)
def url_of_commands(request: pytest.FixtureRequest) -> str:
    return request.getfixturevalue(request.param)


@pytest.fixture(params=["counted", "web", "s3"])
def url(request: pytest.FixtureRequest) -> str:
    return request.getfixturevalue(request.param)


def test_everything_reads_as_it_does_from_the_disk(url: str, recorded: Path) -> None:
    far, near = Session(url), Session(recorded)
    assert (far.attrs, far.name, far.rate_hz) == (near.attrs, url, near.rate_hz)
    assert [*far.streams] == [*near.streams]
    for name, stream in far.streams.items():
        assert len(stream) == len(near.streams[name])
        for column in stream.small:
            np.testing.assert_array_equal(stream.array(column), near.streams[name].array(column))
    for table in ("targets", "segments", "reference", "frames"):
        for column, values in getattr(near, table).items():
            np.testing.assert_array_equal(getattr(far, table)[column], values)
    for index in (30, 77, len(near.frames["t_ns"]) - 1):
        t_ns = int(near.frames["t_ns"][index])
        for method in ("mean", "interpolated", "latest"):
            expected, found = (
                near.window(t_ns, 16, align={"force": method}),
                far.window(t_ns, 16, align={"force": method}),
            )
            for field in ("t_ns", "capture_ns", "signal_row", "valid", "skew"):
                np.testing.assert_array_equal(getattr(found, field), getattr(expected, field))
            assert [*found.streams] == [*expected.streams] == far.order
            for name, stream in expected.streams.items():
                for field in ("value", "row", "age", "valid"):
                    here, there = (getattr(w.streams[name], field) for w in (expected, found))
                    np.testing.assert_array_equal(there, here, err_msg=f"{stream.traits} {field}")
    np.testing.assert_array_equal(
        np.asarray(far.streams["camera"].images([100])[0]), near.streams["camera"].images([100])[0]
    )


def test_the_commands_take_a_url(
    url_of_commands: str, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url = url_of_commands
    assert main(["session", "info", url]) == 0
    far = capsys.readouterr().out
    assert main(["session", "info", str(recorded)]) == 0
    assert far == capsys.readouterr().out.replace(str(recorded), url)
    assert main(["session", "check", url]) == 0
    assert capsys.readouterr().out.endswith(f"{url}: no faults, 2 notes\n")
    assert main(["session", "export", url, str(tmp_path / "far"), "--to", "genforce"]) == 0
    export(recorded, tmp_path / "near", "genforce")
    trees = [
        {str(f.relative_to(root)): f.read_bytes() for f in root.rglob("*") if f.is_file()}
        for root in (tmp_path / "far", tmp_path / "near")
    ]
    assert trees[0] == trees[1]
    contact_sheet(url, tmp_path / "s.png")
    assert (tmp_path / "s.png").stat().st_size > 10_000


def test_a_window_moves_only_the_chunks_it_needs(counted: str, recorded: Path) -> None:
    session, asked = Session(counted), CountedFileSystem.asked
    frames = session.frames
    times = [int(frames["t_ns"][index]) for index in (20, 60, 100)]
    session.window(times[0], 8, run=0)  # times and shard indices are fetched once
    asked.clear()
    session.window(times[1], 8, run=0)
    second = list(asked)
    asked.clear()
    session.window(times[1] - 1, 8, run=0)
    images = [path for path, _ in asked if "/camera/value/" in path]
    assert [path for path, _ in asked if "/camera/value/" not in path] == []
    assert len(images) <= 2  # one request, or two across the end of a shard
    columns = {path.split("/streams/")[1].split("/c/")[0] for path, _ in second}
    assert columns <= {"camera/value", "force/value", "pose/value"}
    camera = Session(recorded).streams["camera"]
    first = int(np.searchsorted(camera.t_ns, times[1])) - 1
    needed = sum(len(camera.jpeg(row) or b"") for row in range(first - 13, first + 1))
    moved = sum(nbytes for path, nbytes in second if "/camera/value/" in path)
    whole = sum(f.stat().st_size for f in (recorded / "streams/camera/value").rglob("0"))
    assert moved <= needed + 14 * 24 + 2 * 1028 < whole / 4
    force = sum(nbytes for path, nbytes in second if "/force/value/" in path)
    assert force < (recorded / "streams/force/value/c/0/0").stat().st_size


def test_opening_moves_metadata_and_no_samples(counted: str) -> None:
    CountedFileSystem.asked.clear()
    Session(counted)
    assert {path.rpartition("/")[2] for path, _ in CountedFileSystem.asked} == {"zarr.json"}
    assert len({path for path, _ in CountedFileSystem.asked}) == len(CountedFileSystem.asked)


def test_a_far_session_can_be_pickled(url: str, recorded: Path) -> None:
    t_ns = int(Session(recorded).frames["t_ns"][50])
    again: Session = pickle.loads(pickle.dumps(Session(url)))
    np.testing.assert_array_equal(
        again.window(t_ns, 4).image, Session(recorded).window(t_ns, 4).image
    )


def test_faults_are_found_from_afar(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr")
    (path / "streams/force/seq/c/0").unlink()
    flip(path / "streams/camera/value/c/0/0/0/0", 40_000)
    (path / "frames/pose/c/0/0").unlink()
    (path / "streams/pose/t_ns/journal-99").write_bytes(b"x")
    fsspec.filesystem("memory").put(str(path), "/faulty/s.zarr", recursive=True)
    far = [(finding.code, finding.where) for finding in check("memory://faulty/s.zarr")]
    assert far == [(finding.code, finding.where) for finding in check(path)]
    assert {code for code, _ in far} == {"manifest", "missing-chunk", "bad-crc", "journal-left"}


def test_a_chunk_that_is_missing_or_short_is_an_error(recorded: Path) -> None:
    system = fsspec.filesystem("memory")
    system.put(str(recorded), "/short/s.zarr", recursive=True)
    name = "/short/s.zarr/streams/camera/value/c/0/0/0/0"
    end = Session(recorded).streams["camera"].layout.columns[0].end_bytes
    system.pipe_file(name, system.cat_file(name)[-end - 250 :])  # an index without data
    camera = Session("memory://short/s.zarr").streams["camera"]
    with pytest.raises(SessionError, match=r"memory://short/s\.zarr/.*/c/0/0/0/0: chunk .* short"):
        camera.images([70, 100])
    system.rm(name)
    camera = Session("memory://short/s.zarr").streams["camera"]
    with pytest.raises(SessionError, match="shard missing"):
        camera.images([100])


def test_what_cannot_be_opened_says_why(
    s3: str, web: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cases = {
        "s3://nobucket/s.zarr": "no such session (The specified bucket does not exist)",
        "s3://bucket/other.zarr": "no such session",
        web.replace("s.zarr", "other.zarr"): "no such session",
        "http://127.0.0.1:9/s.zarr": "no answer",
        "memory://nothing/s.zarr": "no such session",
        "nope://x/s.zarr": "Protocol not known: nope",
    }
    for place, message in cases.items():
        assert main(["session", "info", place]) == 2
        reported = capsys.readouterr().err
        assert reported.startswith(f"wrong input: {place}")
        assert message in reported
        assert reported.count("\n") == 1
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", os.devnull)
    monkeypatch.setenv("AWS_CONFIG_FILE", os.devnull)
    with pytest.raises(SessionError, match="no credentials: set AWS_ACCESS_KEY_ID"):
        Session(s3, storage_options={"skip_instance_cache": True})
    with pytest.raises(SessionError, match="not allowed: wrong credentials, or no read"):
        Session(s3, storage_options={"anon": True})


def test_secrets_are_never_said(recorded: Path) -> None:
    options = {"key": "AKIA", "secret": "hush", "endpoint_url": "http://127.0.0.1:9"}
    with pytest.raises(SessionError, match="no answer") as caught:
        Session(
            "s3://bucket/s.zarr",
            storage_options={**options, "config_kwargs": {"retries": {"max_attempts": 0}}},
        )
    assert "hush" not in str(caught.value)


def test_nothing_is_written_to_a_url(counted: str, tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="remote stores are only read"):
        export(counted, tmp_path / "copy.zarr", "zarr")
    for command in (["recover", counted], ["export", counted, str(tmp_path / "c"), "--to", "zarr"]):
        assert main(["session", *command]) == 2
    with pytest.raises(SessionError, match="storage options are for URLs"):
        Session(tmp_path, storage_options={"anon": True})


def test_a_far_session_that_is_unfinished_or_names_columns_outside_itself_is_refused(
    tmp_path: Path,
) -> None:
    path = make_session(tmp_path / "evil.zarr", names=("force",), seconds=1.0)
    set_attrs(path / "streams/force", columns=["../../../other/s.zarr/x", "t_ns"])
    make_session(tmp_path / "open.zarr", finish=False, names=("force",), seconds=1.0)
    fsspec.filesystem("memory").put(str(tmp_path), "/refused", recursive=True)
    with pytest.raises(SessionError, match="expected a plain name"):
        Session("memory://refused/evil.zarr")
    with pytest.raises(SessionError, match="recover it where it was recorded"):
        Session("memory://refused/open.zarr")


def test_near_ranges_become_one_request() -> None:
    assert join_ranges([(100, 50), (174, 10), (1_000_000, 5)]) == [
        (100, 184),
        (1_000_000, 1_000_005),
    ]
    assert join_ranges([(500, 5), (0, 600)]) == [(0, 600)]
    assert join_ranges([]) == []


def test_a_server_without_byte_ranges_is_named_as_such(recorded: Path) -> None:
    with (
        served(recorded.parent, _WithoutRanges) as address,
        pytest.raises(SessionError, match="allowed: a server of byte ranges, such as"),
    ):
        Session(f"{address}/s.zarr").window(0, n=1)
