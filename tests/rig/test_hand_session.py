"""Sessions of a hand: checked, exported, read back, and their markers by finger."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from support.hands import PLAN, TURNS, hand_session

from learning.errors import LearningError
from learning.markers.build import archive_sessions
from recorder import MarkerArchive
from recorder.checks.check import check
from recorder.convert import export
from recorder.session import Session


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hand_session(tmp_path_factory.mktemp("hand") / "hand.zarr")


def test_a_healthy_session_raises_no_warning(path: Path) -> None:
    session = Session(path)
    assert [one for one in check(path) if one.level != "note"] == []
    targets = session.targets
    assert targets["step"].tolist() == [0, 1, 2] * 4
    assert targets["lifted"].tolist() == [0, 0, 1] * 4
    assert {tuple(turn) for turn in targets["turn"].tolist()} == set(TURNS)
    assert session.columns == {
        **{"left": "taxels", "right": "right", "gripper": "gripper", "action": "action"}
    }
    assert bool(np.asarray(session.frames["valid"])[5:-5].all())


def test_lerobot_has_actions_and_the_samples_since_the_last_frame(
    path: Path, tmp_path: Path
) -> None:
    export(path, tmp_path / "d", "lerobot")
    session = Session(path)
    table = pq.read_table(tmp_path / "d" / "data").to_pydict()
    frames, info = session.frames, json.loads((tmp_path / "d/meta/info.json").read_text())
    assert info["total_episodes"] == 12
    np.testing.assert_array_equal(table["action"], frames["action"].astype(np.float32))
    np.testing.assert_array_equal(table["observation.gripper"], frames["gripper"].astype("f4"))
    ages = np.array(table["observation.right.window_age"])
    most, counts = ages.shape[1], np.isfinite(ages).sum(axis=1)
    assert most == counts.max()
    stream = session.streams["right"]
    values = np.array(table["observation.right.window"]).reshape(len(ages), most, 16, 3)
    begins = [0, *np.flatnonzero(np.diff(table["episode_index"])) + 1]
    for row in range(1, len(ages)):
        if row in begins:
            continue
        first, last = table["t_ns"][row - 1], table["t_ns"][row]
        since = (stream.t_ns > first) & (stream.t_ns <= last)
        assert counts[row] == since.sum()
        np.testing.assert_array_equal(
            values[row][most - counts[row] :], stream.array("value")[since]
        )
    # Every sample between the first and the last frame of an episode is in one window.
    assert counts.sum() >= len(ages) * 1.9


def test_mcap_has_every_command_and_both_fingers(path: Path, tmp_path: Path) -> None:
    export(path, tmp_path / "s.mcap", "mcap")
    session = Session(path)
    with (tmp_path / "s.mcap").open("rb") as file:
        read = list(make_reader(file).iter_messages())
    counts = {name: 0 for name in ("/left", "/right", "/gripper", "/action")}
    for _, channel, _ in read:
        if channel.topic in counts:
            counts[channel.topic] += 1
    assert counts == {f"/{name}": len(session.streams[name]) for name in session.streams}
    sent = [json.loads(m.data)["value"] for _, c, m in read if c.topic == "/action"]
    np.testing.assert_allclose(sent, session.streams["action"].array("value"))


def test_each_finger_has_an_archive_that_knows_its_squeezes(path: Path, tmp_path: Path) -> None:
    session = Session(path)
    with pytest.raises(LearningError, match="allowed: --finger left or right"):
        archive_sessions([path], tmp_path / "x.markers.zarr")
    for finger in ("left", "right"):
        out = tmp_path / f"{finger}.markers.zarr"
        archive_sessions([path], out, finger=finger)
        sensor = MarkerArchive(out)["uskin"]
        assert sensor.attrs["finger"] == finger
        assert len(sensor) == (np.asarray(session.frames["target"]) >= 0).sum()
        sources = [json.loads(line) for line in sensor.provenance(slice(None))]
        names = np.array(MarkerArchive(out).indenters)[sensor.table["indenter"]]
        for source, name, location in zip(sources, names, sensor.table["location"], strict=True):
            target = source["target"]
            assert name == ("light", "heavy")[target // 6]
            assert source["step"] == target % 3
            assert source["turn"] == list(TURNS[target // 3 % 2])
            assert source["mass"] == ((0.04, 0.08)[target // 6] if source["step"] == 2 else 0.0)
            assert not (source["still"] and target == 2)
            assert location % 12 % 4 == target // 3 or location >= 12
        still = sum(source["still"] for source in sources)
        assert still == pytest.approx(11 * PLAN.hold * 30, abs=11)
        assert sensor.masks(slice(0, 3)).any()
