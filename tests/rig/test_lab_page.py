"""The page of a lab on the wire: search, replay, marks; and requests that are refused."""

import io
import json
import urllib.parse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.lab_page import PLAN, TARGETS, LabPage, make_lab, running, serving
from support.sessions import make_session
from support.waiting import until
from websockets.exceptions import ConnectionClosed, InvalidStatus

from recorder import Session
from rig.acquire.campaign import load_campaign, progress_of
from rig.core.config import read_yaml
from rig.core.packaged import BENCHES
from rig.monitor.server import MAX_MESSAGE
from tactile.__main__ import main

pytestmark = pytest.mark.slow

MOON = "day/moon.zarr"


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LabPage]:
    with serving(make_lab(tmp_path_factory.mktemp("lab"))) as found:
        yield found


def data(route: str, **given: object) -> str:
    return f"/data/{route}?{urllib.parse.urlencode(given)}"


def paths(bench: LabPage, **given: str) -> list[str]:
    return [row["path"] for row in bench.get(data("sessions", **given))["rows"]]


def test_sessions_are_found_by_words_and_conditions(bench: LabPage) -> None:
    assert paths(bench)[0] == MOON
    assert set(paths(bench)) == {MOON, "u.zarr", "live.zarr", "import.zarr"}
    assert paths(bench, text="MOON ada") == [MOON]
    assert paths(bench, text="moon nobody") == []
    assert paths(bench, sensor="uskin") == ["u.zarr"]
    assert paths(bench, status="recording", faults="yes") == ["live.zarr"]
    assert paths(bench, since="2026-11-24") == [MOON]
    assert paths(bench, since="2026-11-25") == []
    found = bench.get(data("sessions", sensor="uskin"))
    assert (found["found"], found["total"]) == (1, 4)
    assert found["choices"]["sensor"] == ["gelsight", "uskin", "wedge"]
    assert found["rows"][0]["faults"] == ["3 dropped"]


def test_a_session_is_described_with_its_targets_and_curves(bench: LabPage) -> None:
    about = bench.get(data("session", session=MOON))
    session = Session(bench.folder / "sessions" / MOON)
    assert about["frames"] == len(session.frames["t_ns"])
    assert about["outcomes"] == "dd" + "." * (TARGETS - 2)
    assert about["directions"] == PLAN.direction_count
    assert about["points"][1]["at"] == pytest.approx([-3.0, 4.0])
    target = session.frames["target"]
    last = {str(k): np.flatnonzero(target == k)[[0, -1]].tolist() for k in (0, 1)}
    assert about["presses"] == last
    first, final = last["1"]
    wrench = session.frames["wrench"][first : final + 1]
    curves = bench.get(data("curves", session=MOON, first=first, last=final))
    assert curves["at"] == list(range(first, final + 1))
    assert min(low for low, _ in curves["fz"]) == pytest.approx(wrench[:, 2].min(), abs=1e-3)
    assert max(high for _, high in curves["fx"]) == pytest.approx(wrench[:, 0].max(), abs=1e-3)
    assert [row["name"] for row in about["streams"]] == ["camera", "force", "pose"]


def test_a_frame_has_its_values_and_the_cameras_own_image(bench: LabPage) -> None:
    session = Session(bench.folder / "sessions" / MOON)
    frames = session.frames
    k = int(np.argmin(frames["wrench"][:, 2]))
    found = bench.get(data("frame", session=MOON, frame=k))
    assert found["wrench"][2] == pytest.approx(frames["wrench"][k][2], abs=1e-3)
    assert found["depth"] == pytest.approx(1e3 * frames["depth"][k], abs=1e-3)
    assert found["target"] == frames["target"][k]
    assert found["phase"] in ("normal_inc", "shear_inc", "shear_dec")
    status, body, headers = bench.fetch(data("image", session=MOON, frame=k, camera="camera"))
    assert (status, headers["Content-Type"]) == (200, "image/jpeg")
    assert body == session.streams["camera"].jpeg(int(frames["image"][k]))


def test_taxels_and_images_without_jpeg_bytes_are_shown(bench: LabPage) -> None:
    found = bench.get(data("frame", session="u.zarr", frame=0))
    assert np.shape(found["taxels"]) == (16, 3)
    rest = np.max(found["taxels"])
    assert np.max(bench.get(data("frame", session="u.zarr", frame=40))["taxels"]) > rest + 500
    assert found["images"] == {}
    _, body, _ = bench.fetch(data("image", session="import.zarr", frame=3, camera="camera"))
    assert Image.open(io.BytesIO(body)).size == (64, 48)
    for name in (MOON, "u.zarr", "import.zarr"):
        status, body, _ = bench.fetch(data("thumbnail", session=name))
        assert status == 200
        assert Image.open(io.BytesIO(body)).size == (248, 186)


def test_a_lab_has_campaigns_benches_and_indenters_with_pictures(bench: LabPage) -> None:
    lab = bench.get("/data/lab")
    day = lab["campaigns"][0]
    assert (day["name"], day["command"]) == ("day", "tactile campaign --file campaigns/day.yaml")
    assert day["items"][0]["state"] == "open"
    by_name = {each["name"]: each for each in lab["benches"]}
    assert by_name["gelsight"]["newest"] == MOON
    assert by_name["gelsight"]["targets"] == len(PLAN)
    assert {each["name"] for each in lab["indenters"]} >= {"moon", "sphere"}
    for path in (data("plan", sensor="gelsight"), data("indenter", name="moon")):
        status, body, _ = bench.fetch(path)
        assert status == 200
        assert Image.open(io.BytesIO(body)).format == "PNG"


def test_steps_of_a_set_up_and_its_report_are_shown(bench: LabPage) -> None:
    folder = bench.folder / "calibrations"
    folder.mkdir()
    step = {"date_utc": "2026-11-24T08:00:00Z", "state": "well", "answers": {}, "findings": []}
    running_now = {"step": "home", "number": 2, "count": 9, "pid": 1, "findings": []}
    stored = {"mock": True, "steps": {"arm": step}, "acceptance": None, "running": running_now}
    (folder / "gelsight.setup.json").write_text(json.dumps(stored))
    (folder / "broken.setup.json").write_text("{")
    broken, found = bench.get("/data/lab")["setups"]
    assert "broken.setup.json" in broken["error"]
    assert (found["steps"][0]["name"], found["running"]["step"]) == ("arm", "home")
    assert found["report"] is False
    stored |= {"acceptance": {"result": "accepted"}, "running": {**running_now, "pid": 2**30}}
    (folder / "gelsight.setup.json").write_text(json.dumps(stored))
    (folder / "gelsight.acceptance.html").write_text("<script>alert(1)</script>")
    found = bench.get("/data/lab")["setups"][1]
    assert (found["running"], found["result"], found["report"]) == (None, "accepted", True)
    status, _, headers = bench.fetch(data("report", sensor="gelsight"))
    assert status == 200
    # A report may not run scripts, whatever it holds.
    policy = headers.get_all("Content-Security-Policy")
    assert len(policy) == 1
    assert "default-src 'none'" in policy[0]
    assert policy[0].endswith("sandbox")


def test_marks_become_a_campaign_that_presses_those_targets_again(
    bench: LabPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(bench.folder)
    answer = bench.send(json.dumps({"session": MOON, "again": [7, 2, 2]}))
    queue = "tactile campaign --file campaigns/again.yaml"
    assert answer == {"session": MOON, "again": [2, 7], "queue": queue}
    assert bench.get(data("session", session=MOON))["again"] == [2, 7]
    (progress,) = progress_of(load_campaign(Path("campaigns/again.yaml"), BENCHES))
    assert (progress.state, progress.done, progress.item.total) == ("to resume", 0, 2)
    assert (progress.session, progress.again) == (Path("sessions") / MOON, (2, 7))
    shown = next(each for each in bench.get("/data/lab")["campaigns"] if each["name"] == "again")
    assert (shown["items"][0]["session"], shown["items"][0]["again"]) == (MOON, [2, 7])
    # What a later run has finished is done: as if the first run had come after the marks.
    text = Path("campaigns/again.yaml").read_text()
    Path("campaigns/again.yaml").write_text(text.replace("runs: 1", "runs: 0"))
    (progress,) = progress_of(load_campaign(Path("campaigns/again.yaml"), BENCHES))
    assert (progress.state, progress.done) == ("to resume", 1)
    assert progress.again == (7,)
    assert bench.send(json.dumps({"session": MOON, "again": []}))["again"] == []
    assert not Path("campaigns/again.yaml").exists()


def test_a_file_of_marks_that_is_a_campaign_is_left_as_it_is(bench: LabPage) -> None:
    file = bench.folder / "campaigns" / "again.yaml"
    file.parent.mkdir(exist_ok=True)
    file.write_text("sessions:\n  - {sensor: gelsight, indenter: moon}\n")
    answer = bench.send(json.dumps({"session": MOON, "again": [1]}))
    assert "without `again`" in answer["error"]
    assert read_yaml(file) == {"sessions": [{"sensor": "gelsight", "indenter": "moon"}]}
    file.unlink()


@pytest.mark.parametrize(
    ("message", "words"),
    [
        ({"session": "../lab", "again": [1]}, "no session"),
        ({"session": MOON, "again": [TARGETS + 1]}, f"allowed: 1 to {TARGETS}"),
        ({"session": "import.zarr", "again": [1]}, "plan"),
        ({"session": "live.zarr", "again": [1]}, "is being recorded"),
    ],
)
def test_marks_that_cannot_be_pressed_are_refused(
    bench: LabPage, message: dict[str, object], words: str
) -> None:
    assert words in bench.send(json.dumps(message))["error"]
    assert not (bench.folder / "campaigns" / "again.yaml").exists()


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/data/session?session=../../etc/passwd", 404),
        ("/data/session?session=/etc", 404),
        ("/data/session?session=day", 404),
        ("/data/session?session=live.zarr", 404),
        ("/data/session", 400),
        ("/data/frame?session=day/moon.zarr&frame=-1", 400),
        ("/data/frame?session=day/moon.zarr&frame=1e3", 400),
        ("/data/frame?session=day/moon.zarr&frame=99999999", 404),
        ("/data/frame?session=day/moon.zarr&frame=9999999999", 400),
        ("/data/image?session=day/moon.zarr&frame=0&camera=../force", 404),
        ("/data/image?session=day/moon.zarr&frame=0&camera=pose", 404),
        ("/data/report?sensor=../sessions/x", 404),
        ("/data/report?sensor=uskin", 404),
        ("/data/plan?sensor=../../x", 404),
        ("/data/indenter?name=../indenters", 404),
        ("/data/sessions?since=yesterday", 400),
        ("/data/sessions?faults=maybe", 400),
        ("/data/", 404),
        ("/data/../server.py", 404),
        ("/data/%2e%2e/lab", 404),
    ],
)
def test_paths_and_values_from_outside_are_refused(bench: LabPage, path: str, status: int) -> None:
    found, body, _ = bench.fetch(path)
    assert found == status, body
    assert b"Traceback" not in body


def test_strangers_get_no_data_and_mark_nothing(bench: LabPage) -> None:
    assert bench.fetch("/data/lab", Cookie="")[0] == 403
    assert bench.fetch("/data/lab", Cookie="rig_watch_1=x")[0] == 403
    assert bench.fetch("/data/lab", Host="evil.example")[0] == 403
    message = json.dumps({"session": MOON, "again": [1]})
    with pytest.raises(InvalidStatus):
        bench.send(message, origin="http://evil.example")
    with pytest.raises(ConnectionClosed):
        bench.send("x" * (MAX_MESSAGE + 1))
    assert not (bench.folder / "campaigns" / "again.yaml").exists()


def test_a_new_session_appears(bench: LabPage) -> None:
    make_session(bench.folder / "sessions" / "later.zarr", names=("force", "pose"))
    until(lambda: paths(bench, text="later"), 0.1)
    assert bench.get(data("frame", session="later.zarr", frame=0))["images"] == {}


def test_other_computers_need_the_token(tmp_path: Path) -> None:
    with running(tmp_path, "--port", "0.0.0.0:0") as bench:
        assert bench.get(data("sessions"))["total"] == 0
        for path in ("/", "/sessions.js", "/data/lab", "/?token=wrong"):
            assert bench.fetch(path, Cookie="")[0] == 403
        bench.cookie = bench.cookie[:-1]
        with pytest.raises(InvalidStatus):
            bench.send("{}")


def test_a_folder_that_is_missing_is_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The priority of the other tests stays.
    monkeypatch.setattr("os.nice", int)
    assert main(["page", "nowhere", "--port", "0"]) == 2
    assert "nowhere: no such folder" in capsys.readouterr().err
