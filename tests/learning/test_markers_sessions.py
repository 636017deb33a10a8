"""Sessions converted to archives: labels, references, locations, flags, resuming, and errors."""

import json
import math
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image
from support.copies import digests
from support.dot_camera import MarkerCamera
from support.learning_sessions import DEPTH, HIDDEN, TARGETS, altered, record, state, surface
from support.marker_truth import VIEWS
from support.sessions import reseal

import sim.indenters
from learning.errors import LearningError
from learning.indenters import NAMES
from learning.markers import Segmenter, preset
from learning.markers.build import archive_sessions
from learning.markers.frames import FLAG, INVALID, taxel_masks
from learning.markers.recording import read_group
from recorder import MarkerArchive, Session, check
from recorder.archive import location_pairs
from recorder.markers import marker_centres, unpack
from tactile.__main__ import main
from trajectories import PressShear, plan_to_json

pytestmark = pytest.mark.slow

OWN = "dark-markers"
CONE = {"indenter": "cone"}
# Counts without contact, of which one is missing.
NO_COUNT = np.where(np.arange(48) == 5, np.nan, 3e4).reshape(1, 16, 3)


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("camera") / "sphere.zarr")


@pytest.fixture(scope="module")
def taxels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("taxels") / "pad.zarr", "taxels")


@pytest.fixture(scope="module")
def archive(camera: Path, tmp_path_factory: pytest.TempPathFactory) -> MarkerArchive:
    out = tmp_path_factory.mktemp("archive") / "a.markers.zarr"
    made, _ = archive_sessions([camera], out)
    assert made == len(Session(camera).frames["t_ns"]) == 32
    return MarkerArchive(out)


def made(out: Path, *sessions: Path, **options: Any) -> MarkerArchive:
    archive_sessions(list(sessions), out, **options)
    return MarkerArchive(out)


def hidden(session: Path) -> Any:
    """Return the frames with pictures of hidden markers."""
    return np.isin(Session(session).frames["image"], list(HIDDEN))


def test_labels_are_those_of_the_frames(archive: MarkerArchive, camera: Path) -> None:
    frames, table = Session(camera).frames, archive["gelsight"].table
    for name in ("wrench", "phase", "t_ns", "target"):
        np.testing.assert_array_equal(table[name], frames[name])
    np.testing.assert_allclose(table["depth"], np.maximum(frames["depth"], 0), atol=1e-12)
    assert table["depth"].max() == pytest.approx(DEPTH, rel=0.1)
    assert table["wrench"][np.argmax(table["depth"]), 2] < -2  # pressing is negative Fz
    assert archive.indenters == NAMES == sim.indenters.NAMES
    assert set(table["indenter"]) == {NAMES.index("sphere")}
    assert table["seen"].all()
    assert table["valid"].all()
    for target in range(TARGETS):
        rows = table["target"] == target
        np.testing.assert_array_equal(table["frame"][rows], np.arange(rows.sum()))
    reported = json.loads(archive["gelsight"].sources[0])
    assert reported == {"session": "sphere.zarr", "run": 0, "target": 0}


def test_a_camera_of_any_name_is_read(camera: Path, archive: MarkerArchive, tmp_path: Path) -> None:
    renamed = altered(camera, tmp_path / camera.name)
    (renamed / "streams/camera").rename(renamed / "streams/inside")
    names = renamed / "streams/zarr.json"
    names.write_text(names.read_text().replace('"camera"', '"inside"'))
    reseal(renamed, inside="camera")
    found = made(tmp_path / "a.markers.zarr", renamed)["gelsight"]
    np.testing.assert_array_equal(
        found.packed(slice(None)), archive["gelsight"].packed(slice(None))
    )


def test_masks_show_markers_where_the_world_had_them(archive: MarkerArchive, camera: Path) -> None:
    session, sensor = Session(camera), archive["gelsight"]
    rows = np.flatnonzero(~hidden(camera))[::6]
    seconds = session.streams["camera"].array("device_t")[session.frames["image"][rows]]
    world = MarkerCamera(VIEWS["bench-gelsight"])
    for mask, depth, shear in zip(sensor.masks(rows), *state(seconds - 0.1), strict=True):
        truth = world.pixels(surface(float(depth), float(shear)))
        centres = marker_centres(mask)
        assert len(centres) == len(truth) == 63
        apart = np.linalg.norm(truth[:, None] - centres[None], axis=-1)
        assert apart.min(axis=1).max() < 0.4


def test_the_reference_is_the_picture_without_contact(archive: MarkerArchive, camera: Path) -> None:
    (picture,) = Session(camera).streams["camera"].images([0])
    mask = Segmenter(preset("bench-gelsight")).mask(picture)  # type: ignore[arg-type]
    np.testing.assert_array_equal(unpack(archive["gelsight"].references), mask[None])
    assert len(marker_centres(mask)) == 63


def test_frames_missing_markers_are_flagged_and_kept(archive: MarkerArchive, camera: Path) -> None:
    sensor = archive["gelsight"]
    reported = [json.loads(sensor.sources[one]) for one in sensor.table["source"]]
    flagged = np.array([FLAG in one for one in reported])
    np.testing.assert_array_equal(flagged, hidden(camera))
    assert flagged.sum() >= 2
    assert all("missing" in reported[row][FLAG] for row in np.flatnonzero(flagged))
    assert sensor.masks(np.flatnonzero(flagged)).any(axis=(1, 2)).all()
    assert [finding.code for finding in check(archive.name)] == ["marker-count"]


def test_a_turned_contact_frame_turns_positions(camera: Path, tmp_path: Path) -> None:
    turned = altered(camera, tmp_path / "s.zarr", contact_frame=[0.4, -0.1, 0.2, 0, 0, np.pi / 2])
    position = made(tmp_path / "a.markers.zarr", turned)["gelsight"].table["position"]
    pose = Session(turned).frames["pose"]
    np.testing.assert_allclose(position[:, 0], pose[:, 1] + 0.1, atol=1e-12)
    np.testing.assert_allclose(position[:, 1], 0.4 - pose[:, 0], atol=1e-12)
    assert np.abs(position[:, 1]).max() > 4e-4


def test_sensors_of_one_plan_are_paired_by_location(
    camera: Path, taxels: Path, tmp_path: Path
) -> None:
    archive = made(tmp_path / "a.markers.zarr", camera, taxels)
    pairs = location_pairs(archive["gelsight"].table, archive["uskin"].table)
    assert len(pairs) == 4 * TARGETS
    session, pad = Session(taxels), archive["uskin"]
    still = session.reference["taxels"][0]
    expected = taxel_masks(session.frames["taxels"], still, preset("uskin"))  # type: ignore[arg-type]
    np.testing.assert_array_equal(pad.masks(slice(0, len(pad))), expected)
    assert expected.any(axis=0).sum() > expected[0].sum()
    assert pad.attrs["marker_check"] is None
    assert len(marker_centres(pad.reference(0))) == 16


def test_indenters_of_a_sensor_have_locations_and_references_of_their_own(
    camera: Path, tmp_path: Path
) -> None:
    paths = [altered(camera, tmp_path / f"{name}.zarr", indenter=name) for name in ("key", "cone")]
    archive = made(tmp_path / "a.markers.zarr", *paths, unseen=("cone",))
    table = archive["gelsight"].table
    assert archive.indenters == (*NAMES, "key")
    codes = list(dict.fromkeys(table["indenter"].tolist()))
    assert [archive.indenters[code] for code in codes] == ["cone", "key"]
    np.testing.assert_array_equal(table["location"], table["indenter"] * TARGETS + table["target"])
    np.testing.assert_array_equal(table["seen"], table["indenter"] == codes[1])
    assert table["reference"].tolist() == [0] * 32 + [1] * 32


def test_killed_and_started_again_it_ends_in_the_same_bytes(
    taxels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("learning.markers.frames.UNIT_ROWS", 8)
    monkeypatch.setattr("learning.markers.frames.CHUNK_ROWS", 4)
    whole, torn = tmp_path / "whole.markers.zarr", tmp_path / "torn.markers.zarr"
    frames = archive_sessions([taxels], whole)[0]

    def kill(done: int, total: int) -> None:
        if done >= 16:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        archive_sessions([taxels], torn, progress=kill)
    assert MarkerArchive(torn).status == "writing"
    seen: list[int] = []
    again, _ = archive_sessions([taxels], torn, progress=lambda done, _: seen.append(done))
    assert (again, seen[0], seen[-1]) == (frames - 16, 16, frames)
    assert digests(torn) == digests(whole)
    assert archive_sessions([taxels], torn)[0] == 0


def test_rows_without_a_near_sample_are_not_there_and_say_why(taxels: Path, tmp_path: Path) -> None:
    valid = np.arange(32) % 10 != 3
    path = altered(taxels, tmp_path / "s.zarr", {"frames/valid": valid})
    _, lines = archive_sessions([path], tmp_path / "a.markers.zarr")
    sensor = MarkerArchive(tmp_path / "a.markers.zarr")["uskin"]
    np.testing.assert_array_equal(sensor.table["valid"], valid)
    assert not sensor.masks(np.flatnonzero(~valid)).any()
    assert np.isnan(sensor.table["wrench"][~valid]).all()
    assert np.isfinite(sensor.table["wrench"][valid]).all()
    reported = json.loads(sensor.sources[sensor.table["source"][3]])
    assert reported[INVALID] == "a stream has no sample near enough"
    assert "3 frames are not there: a stream has no sample near enough" in lines[-1]
    assert check(tmp_path / "a.markers.zarr") == []


def test_of_a_target_pressed_twice_one_press_is_taken(taxels: Path, tmp_path: Path) -> None:
    path = altered(taxels, tmp_path / "s.zarr", {"frames/target": np.zeros(32, np.int32)})
    _, lines = archive_sessions([path], tmp_path / "a.markers.zarr")
    table = MarkerArchive(tmp_path / "a.markers.zarr")["uskin"].table
    np.testing.assert_array_equal(table["t_ns"], Session(path).frames["t_ns"][16:])
    assert any("target 0 was pressed twice: 16 frames" in line for line in lines)
    assert any("1 targets have no frames" in line for line in lines)


def test_force_and_depth_come_behind_the_targets_without_a_location(
    taxels: Path, tmp_path: Path
) -> None:
    path = altered(taxels, tmp_path / "fd.zarr", {"targets/direction": -1})
    table = made(tmp_path / "a.markers.zarr", path, taxels)["uskin"].table
    assert table["target"].tolist() == np.repeat([0, 1, 2, 3], 16).tolist()
    np.testing.assert_array_equal(table["location"] >= 0, table["target"] < TARGETS)


@pytest.mark.parametrize(
    ("arrays", "attrs", "message"),
    [
        ({}, {}, r"found sphere on uskin, as in pad\.zarr"),
        ({}, {"indenter": ""}, "found indenter ''; allowed: a name"),
        ({}, {**CONE, "plan": {"kind": "touch"}}, "found plan 'touch'"),
        ({}, {**CONE, "status": "recording"}, "still recording"),
        ({}, {**CONE, "contact_frame": None}, "has no pose or no con"),
        ({"targets/depth": 2e-3}, CONE, r"found depths up to 2 mm, pad\.zarr .* sensor has 1 mm"),
        ({"targets/point": 7}, {"sensor": "p"}, r"found 2 targets that are not those of pad\.zarr"),
        ({"frames/target": -1}, CONE, "found no frames of a press"),
        ({"reference/taxels": NO_COUNT}, CONE, "has no reference: no counts without contact"),
    ],
)
def test_sessions_that_do_not_belong_together_are_refused_by_name(
    arrays: dict[str, Any], attrs: dict[str, Any], message: str, taxels: Path, tmp_path: Path
) -> None:
    other = altered(taxels, tmp_path / "other.zarr", arrays, **attrs)
    with pytest.raises(LearningError, match=rf"other\.zarr: {message}"):
        archive_sessions([taxels, other], tmp_path / "a.markers.zarr")
    assert not (tmp_path / "a.markers.zarr").exists()


def with_plan(source: Path, path: Path, sensor: str, **changes: Any) -> Path:
    """Copy a session with directions 0 and 1, the plan changed."""
    lengths = {"step_x": 4e-3, "step_y": 4e-3, "depth_step": 1e-3, "depth_max": 1e-3, "shear": 1e-3}
    shear = PressShear(**lengths, angle_step=math.radians(30), order="quadrants")
    plan = plan_to_json(shear) | changes
    arrays = {"targets/direction": np.arange(TARGETS), "targets/point": 2}
    return altered(source, path, arrays, sensor=sensor, plan=plan)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (
            "angle_step",
            math.radians(45),
            r"found shear directions 45 deg apart, a\.zarr has 30 deg",
        ),
        ("order", "authors", r"found order 'authors' .* a\.zarr has 'quadrants'; .*archive join"),
        ("layout", "cross", r"found layout 'cross' of points, a\.zarr has 'corners'"),
        ("angle_step", 1.0, r"angle_step: 1\.0 rad"),
    ],
)
def test_equal_numbers_of_other_angles_or_layouts_are_not_paired(
    name: str, value: Any, message: str, taxels: Path, tmp_path: Path
) -> None:
    one = with_plan(taxels, tmp_path / "a.zarr", "a")
    other = with_plan(taxels, tmp_path / "b.zarr", "b", **{name: value})
    with pytest.raises(LearningError, match=rf"b\.zarr: {message}"):
        read_group([one, other])
    another = with_plan(taxels, tmp_path / "c.zarr", "c", step_x=5e-3)
    assert len(read_group([one, another])[0]) == 2, "other places alone do not matter"


def test_two_kinds_of_device_are_not_one_sensor(camera: Path, taxels: Path, tmp_path: Path) -> None:
    other = altered(taxels, tmp_path / "other.zarr", indenter="cone")
    message = r"other\.zarr: found taxels of sensor both, sphere\.zarr has camera"
    with pytest.raises(LearningError, match=message):
        archive_sessions([camera, other], tmp_path / "a.markers.zarr", sensor="both")


def test_shading_taken_for_markers_is_refused_unless_they_are_said_to_be_irregular(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # A camera that sees lamps and shadows on a gel without markers.
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:480, :640]
    grey = np.full((480, 640), 150.0)
    for _ in range(14):
        column, row, size = rng.uniform(40, 600), rng.uniform(40, 440), rng.uniform(6, 60)
        grey -= rng.uniform(40, 80) * np.exp(-((x - column) ** 2 + (y - row) ** 2) / size**2)
    picture = np.repeat(grey.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)
    shading = Mock(image=lambda _: picture.copy())
    monkeypatch.setattr("support.learning_sessions.MarkerCamera", lambda *_, **__: shading)
    session, out = record(tmp_path / "wedge.zarr"), tmp_path / "a.markers.zarr"
    command = ["markers", str(session), "--out", str(out), "--preset", "dark-markers"]
    command += ["--mm-per-px", "0.03"]
    assert main(command) == 2
    printed = capsys.readouterr().err
    assert "wedge.zarr: preset dark-markers finds no pattern of markers in its reference" in printed
    assert "patches whose areas spread" in printed
    assert not out.exists()
    assert main([*command, "--irregular"]) == 0
    assert len(MarkerArchive(out)["gelsight"]) == 32


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensor": "mine"}, "mine: no preset is assigned to it; allowed: bench-digit"),
        ({"preset_name": "uskin"}, "preset uskin: is for taxels; gelsight has camera"),
        ({"preset_name": OWN}, r"gelsight\.mm_per_px: not in preset dark-markers"),
        ({"preset_name": "nothing.yaml", "mm_per_px": 0.1}, r"sphere\.zarr: preset nothing\.yaml"),
    ],
)
def test_a_preset_that_does_not_fit_is_refused(
    options: dict[str, Any],
    message: str,
    camera: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nothing.yaml").write_text(
        "kind: camera\ndescription: finds nothing\ndetectors: [{kind: dark, below: 1}]\n"
    )
    with pytest.raises(LearningError, match=message):
        archive_sessions([camera], tmp_path / "a.markers.zarr", **options)
    assert not (tmp_path / "a.markers.zarr").exists()


def test_the_command_makes_an_archive_and_a_sheet(
    camera: Path, taxels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, sheet = tmp_path / "a.markers.zarr", tmp_path / "sheet.png"
    both = [str(camera), str(taxels)]
    assert main(["markers", *both, "--out", str(out), "--sheet", str(sheet)]) == 0
    told = capsys.readouterr().out
    assert f"gelsight: 32 frames, 1 references; marker count: {hidden(camera).sum()} flag" in told
    assert "uskin: 32 frames, 1 references; markers are not counted" in told
    with Image.open(sheet) as page:
        assert page.size == (10 + 6 * 330, 10 + 2 * 324)
        pixels = np.asarray(page.convert("RGB")).astype(int).reshape(-1, 3)
    red, green, blue = pixels.T
    assert np.sum((red > 200) & (green > 100) & (green < 190) & (blue < 110)) > 500  # outlines
    assert np.sum((red > 190) & (green < 90) & (blue < 80)) > 500  # borders of flagged frames
