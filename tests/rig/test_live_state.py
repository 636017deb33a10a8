"""The page's state of benches with several streams of a kind, which is bounded."""

import contextlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.watching import jpeg

from benchmarks.fake_clock import FakeClock
from recorder import SessionWriter, StreamWriter, camera_spec
from rig.bench.bench import Bench, bench_from
from rig.core.config import read_yaml
from rig.core.packaged import BENCHES
from rig.core.shared_memory import SharedLatest
from rig.monitor.collection import MOST_PICTURES, MOST_PLOTS, CollectionJob, CollectionView, Picture

GAUGE = {"kind": "netft", "host": "loopback", "rate_hz": 100.0}


def bench_with(cameras: int, gauges: int, taxels: int, arms: int) -> Bench:
    kinds: dict[str, tuple[int, Any]] = {
        "eye": (cameras, lambda k: {"kind": "mjpeg", "address": f"http://loopback:{8100 + k}/"}),
        "gauge": (gauges, lambda k: {"http_port": 8200 + k, "udp_port": 49200 + k} | GAUGE),
        "skin": (taxels, lambda k: {"kind": "xela", "address": f"ws://loopback:{5000 + k}"}),
        "arm": (arms, lambda k: {"kind": "ur_pose", "host": "loopback"}),
    }
    streams = {
        f"{name}_{k}": {"rate_hz": 20.0, **settings(k)}
        for name, (count, settings) in kinds.items()
        for k in range(count)
    }
    content = read_yaml(BENCHES / "tacpalm.yaml", BENCHES)
    return bench_from({**content, "streams": streams}, "b.yaml")


@contextlib.contextmanager
def seen(bench: Bench, folder: Path) -> Iterator[tuple[CollectionView, dict[str, SharedLatest]]]:
    with contextlib.ExitStack() as stack:
        records = {
            row.name: SharedLatest.create(folder / f"{row.name}.latest", row.latest)
            for row in bench.rows
        }
        for record in records.values():
            stack.callback(record.close)
        job = CollectionJob(bench, folder, folder / "s.zarr", (), 1, 0.0)
        yield stack.enter_context(contextlib.closing(CollectionView(job, FakeClock()))), records


def test_every_gauge_arm_and_taxel_array_has_its_own_values(tmp_path: Path) -> None:
    bench = bench_with(0, 2, 1, 1)
    with seen(bench, tmp_path) as (state, records):
        for number, name in enumerate(("force", "gauge_0", "gauge_1"), 1):
            records[name].write((number, 0, (float(number), 0, 0, 0, 0, 0)))
        place = np.asarray(bench.contact_frame[:3])
        for number, name in enumerate(("pose", "arm_0"), 1):
            tip = (place[0] + 1e-3 * number, *place[1:], 0.0, 0.0, 0.0)
            records[name].write((1, 0.0, 0, 2, 1.0, tip))
        records["skin_0"].write((1, np.full((16, 3), 7)))
        state.taxels()
        records["skin_0"].write((2, np.full((16, 3), 9)))
        state.sample()
        forces = state.forces()
        assert list(forces) == ["force", "gauge_0", "gauge_1"]
        assert [force["wrench"][0] for force in forces.values()] == [1.0, 2.0, 3.0]
        assert {name: tip[0] for name, tip in state.tips().items()} == {"pose": 1.0, "arm_0": 2.0}
        assert state.taxels()["skin_0"][3] == [2, 2, 2]
        newest = [trace.news(Counter(), "")[0][1] for trace in state.traces.values()]
        assert newest == [1.0, 2.0, 3.0]
        assert set(state.streams(5)) == {row.name for row in bench.rows}


def test_each_camera_has_its_own_picture(tmp_path: Path) -> None:
    bench = bench_with(1, 0, 0, 0)
    names = ("camera", "eye_0")
    specs = [camera_spec(30.0, name=name, codec="jpeg") for name in names]
    SessionWriter.create(tmp_path / "s.zarr", attrs={}, streams=specs, targets={}).close()
    with seen(bench, tmp_path) as (state, records):
        for number, name in enumerate(names):
            with StreamWriter.open(tmp_path / "s.zarr/streams" / name) as writer:
                row = writer.append(value=jpeg(number), device_t=float("nan"), t_ns=1)
            records[name].write((1, row))
        assert state.images() == {"camera": 0, "eye_0": 0}
        assert [picture.jpeg for picture in state.pictures.values()] == [jpeg(0), jpeg(1)]


@pytest.mark.parametrize("count", [0, 1, 9])
def test_the_page_shows_a_bounded_number_of_pictures_and_plots(count: int, tmp_path: Path) -> None:
    with seen(bench_with(count, count, count, count), tmp_path) as (state, _):
        shown = state.hello()
        assert next(iter(shown["pictures"])) == "camera"
        assert len(shown["pictures"]) == min(2 * count + 1, MOST_PICTURES)
        assert len(shown["plots"]) == min(count + 1, MOST_PLOTS)
        assert len(state.streams(0)) == 3 + 4 * count


def test_a_period_sends_the_first_camera_and_one_of_the_others_in_turn(tmp_path: Path) -> None:
    def sent(*names: str) -> list[bytes]:
        state.pictures = {name: Picture(tmp_path) for name in names}
        state.kinds = dict.fromkeys(names, "camera")
        client, periods = Counter[str](), []
        for row in range(4):
            for name, picture in state.pictures.items():
                picture.row, picture.jpeg = row, name.encode()
            periods.append(b"".join(message[1:] for message in state.new_pictures(client)))
        assert list(state.new_pictures(client)) == [] or len(names) > 2
        return periods

    with seen(bench_with(0, 0, 0, 0), tmp_path) as (state, _):
        assert sent() == [b""] * 4
        assert sent("a") == [b"a"] * 4
        assert sent("a", "b", "c") == [b"ac", b"ab", b"ac", b"ab"]
