"""GenForce folders, built here as published: reading, writing and rejection."""

import functools
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from support.learning_sessions import record
from support.planned_archives import WRENCH, planned_archive, training_folder, write_mask

from learning.data.genforce.format import (
    Compensation,
    GenForcePress,
    read_coefficients,
    read_compensation,
    read_mask,
)
from learning.data.genforce.importing import Choices, import_folder, layout_of
from learning.data.genforce.turns import fitted_turn, turn_of
from learning.data.matching import SensorSelection, read_presses
from learning.errors import LearningError
from learning.indenters import NAMES
from learning.markers.build import archive_sessions
from recorder import MarkerArchive, SessionError, check
from recorder.archive import location_pairs
from recorder.convert import export
from recorder.markers import count_markers, pack, unpack
from tactile.__main__ import main
from tests.support.few import few
from trajectories import PressShear

Change = Callable[[Path], Any]

# Last frames of the phases of every press.
LAST = (4, 7, 9, 12)
FRAMES = LAST[-1] + 1
SENSORS, INDENTERS, POINTS = ("Array1", "uskin_a"), ("cone", "sphere"), 2


@functools.cache
def mask_of(number: int) -> Any:
    y, x = np.mgrid[:480, :640]
    return ((x - 15 - number % 7) % 50 < 20) & ((y - 15 - number % 3) % 50 < 20)


def force_of(number: int) -> Any:
    return np.array([[0.1 * k, -0.02 * k, -number - k / 8, k, 2 * k, -k] for k in range(FRAMES)])


def written(root: Path, **options: Any) -> Path:
    made = {"last": LAST, "mask_of": mask_of, "force_of": force_of, **options}
    return training_folder(root, SENSORS, INDENTERS, POINTS, **made)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("training") / "homo", depths=True)


@pytest.fixture
def root(folder: Path, tmp_path: Path) -> Path:
    """A copy of the folder, to change."""
    return shutil.copytree(folder, tmp_path / "homo")


def imported(folder: Path, **choices: Any) -> MarkerArchive:
    """Import a folder into the archive beside it."""
    out = folder.parent / f"{folder.name}-imported.markers.zarr"
    import_folder(folder, out, choices=Choices(**choices))
    return MarkerArchive(out)


@pytest.fixture(scope="module")
def archive(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> MarkerArchive:
    out = tmp_path_factory.mktemp("archive") / "a.markers.zarr"
    frames = len(SENSORS) * len(INDENTERS) * POINTS * FRAMES
    assert import_folder(folder, out) == frames
    assert check(out) == []
    return MarkerArchive(out)


def test_masks_and_labels_of_a_training_folder_are_in_the_archive(archive: MarkerArchive) -> None:
    assert tuple(archive) == SENSORS
    for s, name in enumerate(SENSORS):
        sensor, table = archive[name], archive[name].table
        np.testing.assert_array_equal(sensor.reference(0), mask_of(100 * s))
        for i, indenter in enumerate(INDENTERS):
            for point in range(1, POINTS + 1):
                code = NAMES.index(indenter)
                rows = np.flatnonzero((table["indenter"] == code) & (table["target"] == point - 1))
                expected = [mask_of(s + i + point + frame) for frame in range(FRAMES)]
                np.testing.assert_array_equal(sensor.masks(rows), expected)
                force = force_of(10 * i + point)
                np.testing.assert_allclose(table["wrench"][rows, :3], force[:, :3], atol=1e-6)
                np.testing.assert_allclose(table["wrench"][rows, 3:], force[:, 3:] / 1e3)
                np.testing.assert_array_equal(table["frame"][rows], np.arange(FRAMES))
                phases = np.repeat([0, 1, 2, 3], [5, 3, 2, 3])
                np.testing.assert_array_equal(table["phase"][rows], phases)
                assert table["depth"][rows].max() == pytest.approx(point / 5 * 1e-3)
                assert set(table["location"][rows]) == {code * POINTS + point - 1}
        seen = np.isin(table["indenter"], [NAMES.index("sphere")])
        np.testing.assert_array_equal(table["seen"], seen)  # a cone is held out
        assert not table["t_ns"].any()
    assert archive["uskin_a"].attrs["marker_check"] is None
    assert archive["Array1"].attrs["depth"] == "inc_z.csv and dec_z.csv, mm"
    assert "t_ns is 0" in archive["Array1"].attrs["times"]


def test_fragments_of_a_reference_are_not_counted_as_markers(root: Path, tmp_path: Path) -> None:
    mask = mask_of(0).copy()
    markers = count_markers(mask)
    # The authors' mask of a TacTip has two fragments, of 41 and 68 px, beside its 127 pins.
    mask[40:47, 40:46] = mask[40:48, 92:100] = True
    assert count_markers(mask) == markers + 2
    write_mask(root / "img" / "npy" / "Array1_ref.npy", mask)
    sensor = imported(root)["Array1"]
    smallest = sensor.attrs["marker_check"]["smallest_px"]
    assert smallest == 80
    assert count_markers(sensor.reference(0), smallest) == markers


def test_labels_of_some_axes_are_named_when_they_are_left_out(tmp_path: Path) -> None:
    plan = PressShear(3e-3, 4e-3, 1e-3, 1e-3, 2 * np.pi, 1e-3, points=(1, 2))
    fz_only = (np.nan, np.nan, -2.0, np.nan, np.nan, np.nan)
    planned_archive(tmp_path / "a.markers.zarr", {"dots": plan}, wrench=fz_only)
    omitted = export(tmp_path / "a.markers.zarr", tmp_path / "out", "genforce")
    assert omitted == (
        "dots: labels of 2 presses, which lack Fx Fy Tx Ty Tz; ft.csv holds all axes or none",
    )
    assert not list((tmp_path / "out").rglob("ft.csv"))
    assert len(list((tmp_path / "out").rglob("0000.npy"))) == 2


def test_a_frame_that_lost_a_marker_is_flagged_and_kept(root: Path, tmp_path: Path) -> None:
    path = root / "img" / "npy" / "Array1" / "sphere" / "1" / "0006.npy"
    mask = unpack(np.load(path)).copy()
    mask[200:260, 300:350] = False
    np.save(path, pack(mask))
    sensor = imported(root)["Array1"]
    reported = [json.loads(sensor.sources[one]) for one in sensor.table["source"]]
    (row,) = (row for row, one in enumerate(reported) if "marker_flag" in one)
    assert "missing" in reported[row]["marker_flag"]
    assert (reported[row]["folder"], sensor.table["frame"][row]) == ("img/npy/Array1/sphere/1", 6)
    np.testing.assert_array_equal(sensor.masks([row])[0], mask)
    np.save(root / "img" / "npy" / "Array1_ref.npy", np.zeros(38400, np.uint8))
    with pytest.raises(LearningError, match="Array1: reference 0 has no marker of 12 px or more"):
        import_folder(root, tmp_path / "b.markers.zarr")


def test_points_of_two_sensors_are_pairs(archive: MarkerArchive) -> None:
    one, other = (archive[name].table for name in SENSORS)
    pairs = location_pairs(one, other)
    assert len(pairs) == len(INDENTERS) * POINTS * 4
    assert set(one["frame"][pairs.source]) == set(LAST)
    theirs = location_pairs(one, other, "authors_code")
    assert set(one["frame"][theirs.source]) == {0, *LAST[:3]}


def test_an_archive_that_is_written_out_and_read_again_is_the_same(
    archive: MarkerArchive, tmp_path: Path
) -> None:
    assert export(archive.path, tmp_path / "out", "genforce") == ()
    assert layout_of(tmp_path / "out") == "training"
    again = imported(tmp_path / "out")
    for name in SENSORS:
        rows = slice(0, len(archive[name]))
        np.testing.assert_array_equal(again[name].packed(rows), archive[name].packed(rows))
        np.testing.assert_array_equal(again[name].references, archive[name].references)
        for column, values in archive[name].table.items():
            if column in ("wrench", "depth"):
                np.testing.assert_allclose(again[name].table[column], values, rtol=1e-14)
            elif column != "source":
                np.testing.assert_array_equal(again[name].table[column], values)


def test_what_is_written_is_what_their_scripts_read(archive: MarkerArchive, tmp_path: Path) -> None:
    export(archive.path, tmp_path / "out", "genforce")
    point = tmp_path / "out" / "img" / "npy" / "Array1" / "sphere" / "2"
    image = np.load(point / "0003.npy")
    assert (image.shape, image.dtype) == ((38400,), np.uint8)
    np.testing.assert_array_equal(np.unpackbits(image).reshape(480, 640), mask_of(0 + 1 + 2 + 3))
    last = np.loadtxt(point / "last.csv", dtype=str)
    assert [Path(name).name for name in last] == [f"{frame:04d}.npy" for frame in LAST]
    lines = (tmp_path / "out/force/Array1/sphere/2/ft.csv").read_text().splitlines()
    assert lines[0] == WRENCH
    assert len(lines) == FRAMES + 1
    z = [np.loadtxt(tmp_path / f"out/depth/Array1/sphere/2/{n}_z.csv") for n in ("inc", "dec")]
    assert [len(part) for part in z] == [8, 5]
    np.testing.assert_allclose(np.concatenate(z).max(), 0.4)


def test_pictures_lists_apart_and_missing_depths_and_forces_are_read(tmp_path: Path) -> None:
    root = written(tmp_path / "jpg", suffix=".jpg")
    shutil.rmtree(root / "force" / "uskin_a")
    for path in (root / "img" / "jpg").rglob("last.csv"):
        apart = root / "img" / "jpg_csv" / path.relative_to(root / "img" / "jpg")
        apart.parent.mkdir(parents=True)
        path.rename(apart)
    archive = imported(root)
    np.testing.assert_array_equal(archive["Array1"].masks([0])[0], mask_of(1))
    assert archive["Array1"].attrs["depth"] == "unknown: 0"
    assert np.isfinite(archive["Array1"].table["wrench"]).all()
    assert np.isnan(archive["uskin_a"].table["wrench"]).all()
    export(archive.path, tmp_path / "out", "genforce")
    assert not (tmp_path / "out" / "depth").exists()
    assert not (tmp_path / "out" / "force" / "uskin_a").exists()


@pytest.mark.parametrize(
    ("name", "surface", "stated"),
    [("tactip", 4.648126681, False), ("Array1", 3.2, False), ("Array1", 1.0, True)],
)
def test_heights_are_told_by_falling_while_force_rises_and_become_depths(
    name: str, surface: float, stated: bool, tmp_path: Path
) -> None:
    ends = [0, *LAST]
    below = np.interp(np.arange(FRAMES), ends, [0, 1.5, 1.5, 1.5, 0])
    force = np.outer(below**1.5, [0, 0, -4.0, 0, 0, 0])
    made = {"last": LAST, "mask_of": mask_of, "force_of": lambda _: force, "depths": True}
    root = training_folder(tmp_path / "homo", (name,), INDENTERS, POINTS, **made)
    heights = (surface - below[: LAST[1] + 1], surface - below[LAST[1] + 1 :])
    for place in (root / "depth" / name).glob("*/*"):
        for half, values in zip(("inc", "dec"), heights, strict=True):
            np.savetxt(place / f"{half}_z.csv", values)
    sensor = imported(root, surfaces_mm={name: surface} if stated else {})[name]
    np.testing.assert_allclose(sensor.table["depth"][:FRAMES], 1e-3 * below, atol=1e-5)
    assert ("fall while force rises" in sensor.attrs["depth"]) != stated


def test_a_surface_is_refused_for_files_of_depths(root: Path) -> None:
    with pytest.raises(LearningError, match="Array1: its depth files rise with the force"):
        imported(root, surfaces_mm={"Array1": 1.0})


def cut(size: int) -> Change:
    return lambda path: path.write_bytes(path.read_bytes()[:size])


def save(values: Any) -> Change:
    return lambda path: np.save(path, values)


def lines(change: Callable[[list[str]], list[str]]) -> Change:
    return lambda path: path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


IMAGES, FORCES, DEPTHS = (f"{name}/Array1/sphere/2" for name in ("img/npy", "force", "depth"))
MASK, FRAME, ENDS = (f"{IMAGES}/{name}" for name in ("0003.npy", "0005.npy", "last.csv"))
FT, DEC = f"{FORCES}/ft.csv", f"{DEPTHS}/dec_z.csv"
# A file, the damage done to it, and the error message, which names it or its folder.
MALFORMED: dict[str, tuple[str, Change, str]] = {
    "a mask cut short": (MASK, cut(20_000), r"2/0003\.npy: 20000 bytes, no whole"),
    "a mask without bytes": (MASK, cut(0), r"2/0003\.npy: 0 bytes, no whole"),
    "a mask of another shape": (
        MASK,
        save(np.zeros((240, 320), np.uint8)),
        r"2/0003\.npy: found uint8 \(240, 320\); expected uint8 \(38400,\)",
    ),
    "a mask with NaN": (MASK, save(np.full((480, 640), np.nan)), r"2/0003\.npy: found NaN"),
    "a sensor without indenters": (
        "img/npy/Circle1",
        Path.mkdir,
        "npy/Circle1: found no folder of",
    ),
    "no reference": (
        "img/npy/Array1_ref.npy",
        Path.unlink,
        r"npy: no such file, nor \.jpg; expect",
    ),
    "a frame that is missing": (FRAME, Path.unlink, r"2: found 0006\.npy; expected frame 0005"),
    "no forces of a point": (FT, Path.unlink, r"force/Array1/sphere/2/ft\.csv: no such file"),
    "a force less": (
        FT,
        lines(lambda old: old[:-1]),
        r"2/ft\.csv: found 12 rows; .*img/npy/Array1/sphere/2 has 13 frames",
    ),
    "a force that is NaN": (
        FT,
        lines(lambda old: [*old[:3], "nan,0,0,0,0,0", *old[4:]]),
        r"2/ft\.csv: line 4: found NaN",
    ),
    "a force that is cut": (
        FT,
        lines(lambda old: [*old[:-1], "0.1,0.2"]),
        r"2/ft\.csv: line 14: found 2 values; expected 6",
    ),
    "a word among forces": (
        FT,
        lines(lambda old: [*old[:-1], "a,0,0,0,0,0"]),
        r"2/ft\.csv: line 14: found .*; expected numbers",
    ),
    "forces in another unit": (
        FT,
        lines(lambda old: [old[0].replace("(Nmm)", "(Nm)"), *old[1:]]),
        r"2/ft\.csv: found columns Fx\(N\).*Tx\(Nm\).*; expected Fx\(N\)",
    ),
    "no list of last frames": (ENDS, Path.unlink, r"2/last\.csv: no such file"),
    "three last frames": (ENDS, lines(lambda old: old[:3]), "; expected the names of four frames"),
    "last frames in disorder": (
        ENDS,
        lines(lambda old: [old[1], old[0], *old[2:]]),
        r"2/last\.csv: found frames \(7, 4, 9, 12\); expected them in ascending order",
    ),
    "a last frame beyond the last": (
        ENDS,
        lines(lambda old: [*old[:3], "0013.npy"]),
        r"2/last\.csv: says that the last frame is 13; its folder has 13 frames",
    ),
    "a depth less": (
        DEC,
        lines(lambda old: old[1:]),
        r"depth/Array1/sphere/2: inc_z\.csv and dec_z\.csv have 8 and 4 values; .* has 13 frames",
    ),
    "depths of some points": (
        DEPTHS,
        shutil.rmtree,
        "depth/Array1: has depths of some points; exp",
    ),
    "a point that is no number": (
        IMAGES,
        lambda path: path.rename(path.with_name("b")),
        "sphere/b: found no number; expected contact points 1, 2",
    ),
}


@pytest.mark.parametrize(("name", "change", "message"), MALFORMED.values(), ids=MALFORMED.keys())
def test_a_malformed_folder_is_refused_by_the_name_of_its_file(
    name: str, change: Change, message: str, root: Path, tmp_path: Path
) -> None:
    change(root / name)
    out = tmp_path / "a.markers.zarr"
    with pytest.raises(LearningError, match=message):
        import_folder(root, out)
    # Labels are read before anything is written; a mask only when its turn comes.
    assert not out.exists() or MarkerArchive(out).status == "writing"


def test_masks_are_read_from_every_kind_of_file(tmp_path: Path) -> None:
    mask = mask_of(3)
    for name, values in (("grey", mask * 255), ("flags", mask), ("floats", mask * 1.0)):
        kind = np.float32 if name == "floats" else np.uint8
        np.save(tmp_path / f"{name}.npy", values.astype(kind))
        np.testing.assert_array_equal(unpack(read_mask(tmp_path / f"{name}.npy")), mask)
    Image.fromarray(np.where(mask, 51, 50).astype(np.uint8)).save(tmp_path / "a.png")
    np.testing.assert_array_equal(unpack(read_mask(tmp_path / "a.png")), mask)
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(tmp_path / "small.jpg")
    with pytest.raises(LearningError, match=r"small\.jpg: found 64 x 48 pixels; expected 640 x 4"):
        read_mask(tmp_path / "small.jpg")
    (tmp_path / "torn.jpg").write_bytes((tmp_path / "small.jpg").read_bytes()[:100])
    with pytest.raises(LearningError, match=r"torn\.jpg: no whole picture"):
        read_mask(tmp_path / "torn.jpg")


def test_simulated_pictures_are_numbered_as_simulated_archives_are(tmp_path: Path) -> None:
    root = tmp_path / "sim"
    states = [(x, y, d) for x in (-4, 0) for y in (0, 4) for d in (0.3, 1.5)]
    for name in ("Array1", "Circle1"):
        for indenter in ("cone", "torus"):
            (root / indenter / name).mkdir(parents=True)
            for number, (x, y, depth) in enumerate(states):
                write_mask(root / indenter / name / f"{x}_{y}_{depth}.jpg", mask_of(number))
        write_mask(root / f"{name}_ref.jpg", mask_of(50))
    archive = imported(root)
    table = archive["Circle1"].table
    first = slice(0, len(states))
    np.testing.assert_allclose(table["depth"][first], [1e-3 * state[2] for state in states])
    places = [(1e-3 * x, 1e-3 * y) for x, y, _ in states]
    np.testing.assert_allclose(table["position"][first], places)
    expected = NAMES.index("cone") * 8 + np.arange(8)
    np.testing.assert_array_equal(table["location"][first], expected)
    np.testing.assert_array_equal(archive["Array1"].masks([5])[0], mask_of(5))
    assert (table["phase"] == -1).all()
    assert len(location_pairs(table, archive["Array1"].table)) == 16
    (root / "cone" / "Array1" / "deep.jpg").write_bytes(b"")
    with pytest.raises(LearningError, match=r"deep\.jpg: expected a name <x>_<y>_<depth>\.jpg"):
        import_folder(root, tmp_path / "b.markers.zarr")


@pytest.mark.slow
@pytest.mark.parametrize("kind", few(["camera", "taxels"], 1))
def test_runs_as_collected_give_the_archive_of_their_session(kind: str, tmp_path: Path) -> None:
    session = record(tmp_path / "s.zarr", kind)
    export(session, tmp_path / "data", "genforce")
    assert layout_of(tmp_path / "data") == "raw"
    archive_sessions([session], tmp_path / "own.markers.zarr")
    raw = imported(tmp_path / "data")
    own = MarkerArchive(tmp_path / "own.markers.zarr")
    ((name, sensor),) = raw.items()
    rows = slice(0, len(own[name]))
    if kind == "camera":
        np.testing.assert_array_equal(sensor.packed(rows), own[name].packed(rows))
    else:
        # Their files have integer counts: a rim moves by less than a pixel.
        assert np.mean(sensor.masks(rows) == own[name].masks(rows)) > 0.9999
    for column in ("indenter", "seen", "location", "target", "phase", "frame", "reference"):
        np.testing.assert_array_equal(sensor.table[column], own[name].table[column])
    np.testing.assert_allclose(sensor.table["wrench"], own[name].table["wrench"], rtol=1e-12)
    shift = np.ptp(sensor.table["position"][:, 0] - own[name].table["position"][:, 0])
    assert shift < 1e-12
    # Its axes are the robot's; nothing tells how the sensor was turned, so nothing is matched.
    with pytest.raises(LearningError, match=r"position is 'unknown turn: .* --turn SENSOR=DEG"):
        read_presses(SensorSelection(raw, name, name))
    turned = tmp_path / "turned.markers.zarr"
    import_folder(tmp_path / "data", turned, choices=Choices(turns_deg={name: 90.0}))
    table = MarkerArchive(turned)[name].table
    x, y = sensor.table["position"].T
    # What lies along the robot's y axis lies along the image's x axis.
    np.testing.assert_allclose(table["position"], np.stack([y, -x], axis=1), atol=1e-15)
    assert len(read_presses(SensorSelection(MarkerArchive(turned), name, name)).target)
    with pytest.raises(LearningError, match=f"turn: found other; allowed: {name}"):
        import_folder(tmp_path / "data", turned, choices=Choices(turns_deg={"other": 1.0}))


def test_the_turn_of_a_raw_run_is_found_by_the_markers_of_sheared_presses() -> None:
    """Eight directions; the shear moves the markers of a circle by 9 px, turned by 37 degrees."""
    grid = np.stack(np.meshgrid(np.arange(8), np.arange(6)), axis=-1).reshape(-1, 2) * 70.0 + 70.0
    inside = np.linalg.norm(grid - (315, 245), axis=1) < 130

    def drawn(shift: tuple[float, float]) -> Any:
        image = np.zeros((480, 640), np.uint8)
        for place, moves in zip(grid, inside, strict=True):
            centre = place + np.array(shift) * (1, -1) * moves
            cv2.circle(image, np.round(centre * 16).astype(int).tolist(), 14 * 16, 1, -1, shift=4)
        (packed,) = pack(image.astype(bool)[None])
        return packed

    def of(turn: float, mirror: int, directions: int) -> Any:
        masks, presses = {}, []
        for number in range(8):
            angle = 2 * math.pi * (number % directions) / directions
            robot = np.array([[0, 0], [math.cos(angle), math.sin(angle)]])
            cosine, sine = math.cos(-turn), math.sin(-turn)
            x, y = np.array([[cosine, -sine], [sine, cosine]]) @ robot[1]
            files = (Path(f"{number}a"), Path(f"{number}b"))
            masks |= {files[0]: drawn((0, 0)), files[1]: drawn((9 * mirror * x, 9 * y))}
            frames, nothing = np.arange(2), np.zeros(2)
            labels = (np.zeros((2, 6)), nothing, 1e-3 * robot, np.zeros(2, int))
            presses.append(GenForcePress("cone", number, files, frames, *labels))
        return turn_of("gel", presses, drawn((0, 0))[None], masks.__getitem__)

    found = of(math.radians(37), 1, 8)
    assert math.degrees(found.angle) == pytest.approx(37, abs=0.5)
    assert found.presses == 8
    assert of(math.radians(37), 1, 1) is None  # along one line: mirrored or not
    with pytest.raises(LearningError, match="gel: its images are mirrored"):
        of(math.radians(37), -1, 8)
    noise = np.random.default_rng(0).normal(size=(2, 24, 2))
    assert fitted_turn("gel", *noise) is None
    assert fitted_turn("gel", *noise[:, :3]) is None


def test_runs_of_force_and_depth_come_behind_the_targets_without_a_location(tmp_path: Path) -> None:
    export(record(tmp_path / "s.zarr", "taxels"), tmp_path / "data", "genforce")
    for modality in ("force", "pose", "uskin_raw"):
        (run,) = (tmp_path / "data" / "uskin" / modality).iterdir()
        again = run.with_name("sphere-20270101_000000")
        shutil.copytree(run, again)
        for point in (path for path in again.iterdir() if path.is_dir()):
            for name in ("shear_inc", "shear_dec"):
                shutil.rmtree(point / name)
            (point / "normal_inc").rename(point / "down")
            (point / "normal_dec").rename(point / "up")
    table = imported(tmp_path / "data")["uskin"].table
    behind = table["location"] < 0
    assert set(table["target"][~behind]) == {0, 1}
    assert set(table["target"][behind]) == {2, 3}
    assert set(table["phase"][behind]) == {0, 3}
    assert np.isfinite(table["wrench"]).all()


@pytest.mark.slow
def test_raw_runs_that_do_not_fit_are_refused_by_name(tmp_path: Path) -> None:
    export(record(tmp_path / "c.zarr"), tmp_path / "data", "genforce")
    (run,) = (tmp_path / "data" / "gelsight" / "image").iterdir()
    picture = run / "2" / "normal_inc" / "0001.jpg"
    picture.write_bytes(picture.read_bytes()[:50])
    with pytest.raises(LearningError, match=r"2/normal_inc/0001\.jpg: jpeg:"):
        import_folder(tmp_path / "data", tmp_path / "c.markers.zarr")
    (run / "ref.jpg").unlink()
    with pytest.raises(LearningError, match=r"ref\.jpg: no such file; expected the reference"):
        import_folder(tmp_path / "data", tmp_path / "d.markers.zarr")
    shutil.rmtree(tmp_path / "data")
    export(record(tmp_path / "s.zarr", "taxels"), tmp_path / "data", "genforce")
    (run,) = (tmp_path / "data" / "uskin" / "uskin_raw").iterdir()
    np.save(run / "1" / "shear_inc" / "0001.npy", np.zeros((4, 4, 3)))
    with pytest.raises(LearningError, match=r"0001\.npy: found float64 \(4, 4, 3\); expected num"):
        import_folder(tmp_path / "data", tmp_path / "a.markers.zarr")
    shutil.copytree(run, run.with_name("sphere-20260202_000000"))
    with pytest.raises(LearningError, match="found sphere, as in sphere-2026"):
        import_folder(tmp_path / "data", tmp_path / "b.markers.zarr")
    shutil.rmtree(run.with_name("sphere-20260202_000000"))
    shutil.rmtree(run / "2" / "normal_dec")
    with pytest.raises(LearningError, match=r"2/normal_dec: no such folder; expected normal_inc"):
        import_folder(tmp_path / "data", tmp_path / "b.markers.zarr")


def test_coefficients_come_back_as_they_were(tmp_path: Path) -> None:
    values = (-1.25, 0.1 + 0.2, 3e-7)
    (tmp_path / "r6_down.csv").write_text("".join(f"{each!r}\n" for each in values))
    np.savetxt(tmp_path / "r6_up.csv", [-2.0, 0.5, 0.0], delimiter=",")
    assert read_coefficients(tmp_path / "r6_down.csv") == values
    (both,) = read_compensation(tmp_path).values()
    depth = np.array([0.0, 0.4, 1.2])
    np.testing.assert_allclose(np.polyval(both.down, depth), np.poly1d(values)(depth))
    np.testing.assert_allclose(np.polyval(both.up, depth), -2 * depth**2 + 0.5 * depth)
    (tmp_path / "line.csv").write_text("1.0,2.0,3.0\n")
    assert read_coefficients(tmp_path / "line.csv") == (1.0, 2.0, 3.0)
    for content, message in (("", "is empty"), ("1,b", "expected numbers"), ("1,nan", "found NaN")):
        (tmp_path / "bad.csv").write_text(content)
        with pytest.raises(LearningError, match=rf"bad\.csv: .*{message}"):
            read_coefficients(tmp_path / "bad.csv")
    (tmp_path / "r6_up.csv").unlink()
    with pytest.raises(LearningError, match=r"r6_up\.csv: no such file"):
        read_compensation(tmp_path)


def test_the_commands_import_and_export_with_coefficients(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    priors, out = tmp_path / "material", tmp_path / "a.markers.zarr"
    priors.mkdir()
    for half in ("down", "up"):
        (priors / f"Array1_{half}.csv").write_text("-1.0\n0.5\n0.0\n")
    own = ["--compensation", str(priors), "--mm-per-px", "Array1=0.03", "--unseen", "sphere"]
    assert main(["import", str(folder), "--out", str(out), *own]) == 0
    told = capsys.readouterr().out
    assert "Array1: 52 frames, 1 references; marker count: 0 flagged" in told
    sensor = MarkerArchive(out)["Array1"]
    assert sensor.mm_per_px == 0.03
    assert not sensor.table["seen"][sensor.table["indenter"] == NAMES.index("sphere")].any()
    assert main(["session", "export", str(out), str(tmp_path / "back"), "--to", "genforce"]) == 0
    back = read_compensation(tmp_path / "back" / "material_compensation")
    assert back == {"Array1": Compensation((-1.0, 0.5, 0.0), (-1.0, 0.5, 0.0))}
    capsys.readouterr()
    assert main(["session", "export", str(out), str(tmp_path / "back"), "--to", "genforce"]) == 2
    assert "exists already" in capsys.readouterr().err
    for place, message in (
        (tmp_path / "none", "no such folder"),
        (tmp_path, "found no img, no <Pa"),
    ):
        with pytest.raises(LearningError, match=message):
            layout_of(place)
    with pytest.raises(LearningError, match="expected one of the layouts training, states, raw"):
        import_folder(tmp_path, out)
    assert main(["session", "export", str(out), str(tmp_path / "y"), "--to", "mcap"]) == 2
    assert "not for a marker archive; allowed: genforce" in capsys.readouterr().err
    assert main(["import", str(folder), "--out", str(out), "--mm-per-px", "b"]) == 2
    assert "--mm-per-px: found 'b'; allowed: NAME=NUMBER" in capsys.readouterr().err


def test_another_folder_is_not_mixed_into_an_archive(root: Path, archive: MarkerArchive) -> None:
    np.save(root / "img/npy/Array1_ref.npy", pack(mask_of(9)))
    with pytest.raises(SessionError, match="is not the archive that was planned"):
        import_folder(root, Path(str(archive.path)))


def test_presses_that_lack_a_phase_are_left_out_and_told_of(tmp_path: Path) -> None:
    root = tmp_path / "sim"
    (root / "cone" / "Array1").mkdir(parents=True)
    write_mask(root / "cone" / "Array1" / "0_0_0.3.jpg", mask_of(1))
    write_mask(root / "Array1_ref.jpg", mask_of(0))
    with pytest.raises(SessionError, match="no press has all of normal_inc"):
        export(imported(root).path, tmp_path / "out", "genforce")
    assert not (tmp_path / "out").exists()
