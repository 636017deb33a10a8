"""Imported recordings become valid sessions, or leave nothing behind but a clear error."""

import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from PIL import Image

from recorder import Session, SessionError, check, faults
from recorder.convert import Answers, As, draft_recordings, write_sessions
from recorder.convert.import_columns import parse_header
from recorder.convert.import_numbers import counts_of, parse_unit
from recorder.convert.import_tracks import FORCE_UNITS, TORQUE_UNITS, TaxelOrder, every
from recorder.convert.import_video import read_avi, whole_jpeg
from recorder.session.sheet import contact_sheet
from tactile.__main__ import main

SIZE = (48, 64)


def picture(number: int) -> Any:
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.stack([x * 3, y * 4, 7 * number + 0 * x], axis=-1).astype(np.uint8)


def jpegs(count: int) -> list[bytes]:
    return [simplejpeg.encode_jpeg(picture(k), quality=90) for k in range(count)]


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack("<4sI", kind, len(content)) + content + b"\0" * (len(content) % 2)


def listed(kind: bytes, form: bytes, *chunks: bytes) -> bytes:
    return chunk(kind, form + b"".join(chunks))


def avi(
    frames: list[bytes],
    *,
    codec: bytes = b"MJPG",
    rate: tuple[int, int] = (30, 1),
    audio_first: bool = False,
    opendml: bool = False,
) -> bytes:
    """Return an AVI file; with audio before the video, or half of it in a second RIFF chunk."""
    head = struct.pack(
        "<4s4sIHHIIIIIIII", b"vids", codec, 0, 0, 0, 0, rate[1], rate[0], 0, 0, 0, 0, 0
    )
    video = listed(b"LIST", b"strl", chunk(b"strh", head), chunk(b"strf", bytes(16) + codec))
    audio = listed(b"LIST", b"strl", chunk(b"strh", b"auds" + bytes(52)), chunk(b"strf", bytes(18)))
    streams = [audio, video] if audio_first else [video]
    name = b"01dc" if audio_first else b"00dc"
    content = [chunk(name, frame) for frame in frames]
    if audio_first:
        content = [part for frame in content for part in (chunk(b"00wb", b"abc"), frame)]
    half = len(content) // 2 if opendml else len(content)
    first = listed(b"LIST", b"movi", listed(b"LIST", b"rec ", *content[:half]))
    file = listed(
        b"RIFF", b"AVI ", listed(b"LIST", b"hdrl", chunk(b"avih", bytes(56)), *streams), first
    )
    if opendml:
        file += listed(b"RIFF", b"AVIX", listed(b"LIST", b"movi", *content[half:]))
    return file


def imported(folder: Path, **options: Any) -> list[str]:
    """Import files whose kind is stated as a session without presses; return the messages."""
    stated: list[tuple[As, str, Path]] = [
        (kind, "", options.pop(kind)) for kind in ("video", "force", "taxels") if kind in options
    ]
    for name in ("fps", "force_hz", "taxels_hz"):
        if name in options:
            options[name] = (f"{options[name]:g}",)
    answers = Answers(sensor="wedge", indenter="ball", press=("none",), lag=0.0, **options)
    drafts = draft_recordings([], stated, answers)
    write_sessions(drafts, folder / "s.zarr", answers)
    return [line for draft in drafts for line in draft.assumed]


def rejected(folder: Path, match: str, **options: Any) -> None:
    """Check that the import raises and leaves nothing behind."""
    before = set(folder.iterdir())
    with pytest.raises(SessionError, match=match):
        imported(folder, **options)
    assert set(folder.iterdir()) == before


def saved(path: Path, content: Any) -> Path:
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, str):
        path.write_text(content)
    else:
        np.save(path, content)
    return path


@pytest.mark.parametrize("options", [{}, {"audio_first": True}, {"opendml": True}])
def test_the_cameras_own_bytes_are_taken_out_of_an_avi_file(
    options: dict[str, bool], tmp_path: Path
) -> None:
    frames = jpegs(7)
    motion = read_avi(saved(tmp_path / "v.avi", avi(frames, rate=(30_000, 1001), **options)))
    assert motion is not None
    assert motion.frames == frames
    assert motion.rate_hz == pytest.approx(29.97, abs=1e-3)


@pytest.mark.parametrize("axes", [3, 6])
def test_an_axis_without_a_number_was_not_measured(axes: int, tmp_path: Path) -> None:
    wrench = np.arange(40.0 * axes).reshape(40, axes) * -1e-3
    wrench[:, 1] = np.nan
    units: dict[str, Any] = {"units": "N", "torque_units": "N m"}
    imported(tmp_path, force=saved(tmp_path / "f.npy", wrench), force_hz=30, **units)
    force = Session(tmp_path / "s.zarr").streams["force"]
    assert np.isnan(force.array("value")[:, 1]).all()
    assert "Fy" not in force.attrs["axes_measured"]
    wrench[:, 1] = np.where(np.arange(40) < 9, 0.0, np.nan)
    path = saved(tmp_path / "g.npy", wrench)
    with pytest.raises(SessionError, match="row 9: NaN or infinite"):
        imported(tmp_path, force=path, force_hz=30, **units)


def test_video_and_force_become_a_sound_session(tmp_path: Path) -> None:
    frames, force = jpegs(40), 3.0 * np.sin(np.arange(40) / 9) + 0.123_456_789
    video = saved(tmp_path / "v.avi", avi(frames))
    message = imported(
        tmp_path, video=video, force=saved(tmp_path / "f.npy", force), force_hz=30, units="N"
    )
    session = Session(tmp_path / "s.zarr")
    assert faults(check(tmp_path / "s.zarr")) == []
    assert [session.streams["camera"].jpeg(row) for row in range(40)] == frames
    value = session.streams["force"].array("value")
    assert np.abs(value[:, 2] + force).max() <= 5e-7
    assert np.isnan(value[:, [0, 1, 3, 4, 5]]).all()
    assert session.streams["force"].attrs["axes_measured"] == ["Fz"]
    assert (session.attrs["mock"], session.status) == (False, "complete")
    assert session.attrs["imported"]["files"]["v/v.avi"]["name"] == "v.avi"
    assert session.attrs["imported"]["assumed"] == message
    assert any("not measured, stored as NaN" in line for line in message)
    assert str(tmp_path) not in json.dumps(session.attrs)
    frames_view = session.frames
    assert len(frames_view["t_ns"]) == 40
    assert np.isfinite(frames_view["wrench"]).any(axis=0).tolist() == [0, 0, 1, 0, 0, 0]
    assert frames_view["valid"].all()
    assert set(frames_view["target"].tolist()) == {-1}
    contact_sheet(session.path, tmp_path / "sheet.png")
    assert main(["session", "info", str(session.path)]) == 0


def test_a_dropped_frame_leaves_its_place_in_time(tmp_path: Path) -> None:
    frames = jpegs(5)
    frames[2] = b""
    message = imported(tmp_path, video=saved(tmp_path / "v.avi", avi(frames)))
    times = Session(tmp_path / "s.zarr").streams["camera"].t_ns
    assert times.tolist() == [0, 33_333_333, 100_000_000, 133_333_333]
    assert any("1 dropped frames" in line for line in message)


def test_missing_huffman_tables_are_put_in_and_change_no_pixel(tmp_path: Path) -> None:
    whole = jpegs(1)[0]
    bare, at = whole[:2], 2
    while whole[at + 1] != 0xDA:
        length = 2 + struct.unpack_from(">H", whole, at + 2)[0]
        if whole[at + 1] != 0xC4:
            bare += whole[at : at + length]
        at += length
    bare += whole[at:]
    mended, changed = whole_jpeg(bare, "x")
    assert changed
    assert np.array_equal(simplejpeg.decode_jpeg(mended), simplejpeg.decode_jpeg(whole))
    assert whole_jpeg(whole, "x") == (whole, False)
    message = imported(tmp_path, video=saved(tmp_path / "v.avi", avi([bare] * 3)))
    assert any("Huffman tables put into 3 images" in line for line in message)


def test_a_folder_of_images_is_taken_in_the_order_of_its_numbers(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for number in (10, 2, 1):
        Image.fromarray(picture(number)).save(folder / f"image_{number}.png")
    imported(tmp_path, video=folder, fps=20.0)
    camera = Session(tmp_path / "s.zarr").streams["camera"]
    assert camera.jpeg(0) is None
    for row, number in enumerate((1, 2, 10)):
        assert np.array_equal(camera.images([row])[0], picture(number))
    assert camera.t_ns.tolist() == [0, 50_000_000, 100_000_000]


def folder_of(path: Path, images: list[Any], suffix: str = "png") -> Path:
    path.mkdir()
    for number, image in enumerate(images):
        Image.fromarray(image).save(path / f"i{number}.{suffix}")
    return path


def ramp(least: float, most: float, dtype: Any) -> Any:
    return np.linspace(least, most, 48 * 64).reshape(SIZE).astype(dtype)


@pytest.mark.parametrize(
    ("image", "suffix", "full"),
    [(ramp(0, 65535, np.uint16), "png", 65535), (ramp(0.1, 0.9, np.float32), "tif", 1.0)],
)
def test_deep_pictures_keep_their_grey_levels(
    image: Any, suffix: str, full: float, tmp_path: Path
) -> None:
    lines = imported(tmp_path, video=folder_of(tmp_path / "i", [image] * 9, suffix), fps=20.0)
    stored = Session(tmp_path / "s.zarr").streams["camera"].images([3])[0]
    np.testing.assert_array_equal(stored[..., 1], np.rint(image * (255 / full)))
    assert any("pixels of 8 bits" in line for line in lines)
    assert not any("lossless" in line for line in lines)


@pytest.mark.parametrize(
    ("image", "suffix", "match"),
    [
        (ramp(0, 4095, np.uint16), "png", "i: found values from 0 to 4095, .* at least 16383"),
        (ramp(0, 255, np.float32), "tif", "found values from 0 to 255, .* at most 1"),
        (ramp(0, np.nan, np.float32), "tif", "found values from nan"),
        (ramp(0, 1e6, np.int32), "tif", "i0.tif: found 1 pictures of mode I; allowed"),
        (np.zeros((8192, 8192), np.uint8), "png", "i0.png: found 8192x8192; allowed: up to"),
    ],
)
def test_pictures_that_8_bits_cannot_show_are_refused_by_name(
    image: Any, suffix: str, match: str, tmp_path: Path
) -> None:
    rejected(tmp_path, match, video=folder_of(tmp_path / "i", [image], suffix), fps=20.0)


def test_all_problems_of_a_folder_come_in_one_list(tmp_path: Path) -> None:
    pictures = folder_of(tmp_path / "i", [picture(0)] * 4)
    (pictures / "i1.png").write_bytes(b"no picture")
    (pictures / "i3.png").unlink()
    (pictures / "i3.png").symlink_to("nowhere")
    saved(tmp_path / "a.csv", "weight\n1\n2\n")
    (tmp_path / "b.csv").write_bytes("Fz (N)\n1\n2\n".encode("utf-16"))
    with zipfile.ZipFile(tmp_path / "c.npz", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("force.npy", bytes(70 << 20))
    answers = Answers(sensor="a", indenter="b", fps=("20",), force_hz=("20",))
    with pytest.raises(SessionError) as error:
        draft_recordings([tmp_path], [], answers)
    lines = str(error.value).splitlines()
    assert lines[0] == "5 problems:"
    for name, why in {
        "a.csv": "not known",
        "b.csv": "utf-8",
        "c.npz": "holds 73400320 bytes",
        "i1.png": "no whole picture",
        "i3.png": "found no file",
    }.items():
        assert any(name in line and why in line for line in lines), (name, lines)


def test_a_video_that_must_be_decoded_is_stored_as_it_decodes(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="needs OpenCV to write a video")
    path = tmp_path / "v.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 25.0, SIZE[::-1])
    for number in range(6):
        writer.write(np.ascontiguousarray(picture(number)[:, :, ::-1]))
    writer.release()
    imported(tmp_path, video=path)
    camera = Session(tmp_path / "s.zarr").streams["camera"]
    assert (len(camera), camera.rate_hz) == (6, 25.0)
    assert np.array_equal(camera.images([5])[0], picture(5))


def test_taxels_are_rounded_to_the_wires_counts_and_it_says_how_far(tmp_path: Path) -> None:
    counts = (30_000 + np.random.default_rng(0).normal(0, 50, (90, 48))).astype(np.float32)
    path = saved(tmp_path / "t.npy", counts)
    message = imported(tmp_path, taxels=path, taxels_hz=60, taxel_order="taxel")
    session = Session(tmp_path / "s.zarr")
    assert faults(check(tmp_path / "s.zarr")) == []
    value = session.streams["taxels"].array("value")
    assert np.array_equal(value.reshape(90, 48), np.rint(counts))
    largest = np.abs(counts - np.rint(counts)).max()
    assert any(f"largest change {largest:.3g} counts" in line for line in message)
    assert session.streams["taxels"].array("seq").tolist() == list(range(1, 91))
    contact_sheet(session.path, tmp_path / "sheet.png")


def uskin_log(rng: np.random.Generator, rows: int = 120) -> np.ndarray:
    """Return counts (n, 16, 3) of a uSkin: axes rest far apart, one patch is pressed."""
    axes = rng.permutation([33_000.0, 34_000.0, 21_000.0])
    resting = axes + rng.normal(0, 900, (16, 3))
    pressed = np.zeros((rows, 16, 3))
    pressed[rows // 3 :, rng.integers(16)] = rng.uniform(-4_000, 4_000, 3)
    return np.rint(resting + pressed + rng.normal(0, 2, (rows, 16, 3)))


def ordered(array: Any, order: TaxelOrder | None = None) -> Any:
    return counts_of("t.npy", array, every(range(len(array)), 60.0), order).value


@pytest.mark.parametrize("seed", range(8))
def test_the_order_of_taxels_is_told_by_their_resting_counts(seed: int) -> None:
    counts = uskin_log(np.random.default_rng(seed))
    by_axis = counts.transpose(0, 2, 1)
    for array in (counts.reshape(-1, 48), counts, by_axis, by_axis.reshape(-1, 48)):
        assert np.array_equal(ordered(array), counts)
    # A row by axis in the shape of a row by taxel, as np.reshape of a flat log gives.
    wrong = by_axis.reshape(-1, 16, 3)
    with pytest.raises(SessionError, match="shape says order 'taxel', its values 'axis'"):
        ordered(wrong)
    assert np.array_equal(ordered(wrong, "axis"), counts)


def test_an_order_that_nothing_tells_is_refused() -> None:
    tared = np.rint(np.random.default_rng(0).normal(1_000, 2, (60, 48)))
    with pytest.raises(SessionError, match=r"cannot tell the order .* --taxel-order axis"):
        ordered(tared)
    assert np.array_equal(ordered(tared.reshape(-1, 16, 3)), tared.reshape(-1, 16, 3))


def test_a_csv_is_read_by_its_header(tmp_path: Path) -> None:
    text = "time (ms),Fx(N),Fy [N],Fz_N,Tx(Nmm),Ty (N-mm),Tz [N mm],P(bar)\n"
    text += "".join(f"{5 * k},{k},0,-{k}.5,1000,0,{2 * k},9\n" for k in range(30))
    path = saved(tmp_path / "f.csv", text)
    rejected(tmp_path, r"column 'P\(bar\)': not known; allowed: Fx, .*--ignore NAME", force=path)
    imported(tmp_path, force=path, ignore=("P(bar)",))
    force = Session(tmp_path / "s.zarr").streams["force"]
    assert force.array("value")[3] == pytest.approx([3, 0, -3.5, 1, 0, 0.006], abs=1e-12)
    assert force.t_ns[:3].tolist() == [0, 5_000_000, 10_000_000]
    assert force.rate_hz == 200
    assert faults(check(tmp_path / "s.zarr")) == []


@pytest.mark.parametrize(
    ("header", "match"),
    [
        ("Fx,Fy", r"column 'Fx': says no unit; say --units \(N, mN"),
        ("Fx (N),Fx (N)", "column Fx comes twice"),
        ("Fx (stone)", r"found unit 'stone'; allowed: N, mN"),
        ("Tz (N)", r"found unit 'N'; allowed: N m, N mm"),
        ("time,Fx (N)", r"column 'time': says no unit"),
        ("time_s", "no force column"),
        ("force", "column 'force': not known; allowed: Fx"),
    ],
)
def test_nothing_is_guessed_from_a_header(header: str, match: str) -> None:
    with pytest.raises(SessionError, match=match):
        parse_header(header.split(","), Answers(), "f.csv")


def test_units_are_read_however_they_are_set_apart() -> None:
    for text in ("N mm", "N-mm", "Nmm", "N*mm", "N.mm"):
        assert parse_unit(text, TORQUE_UNITS, "x") == 1e-3
    with pytest.raises(SessionError, match="allowed: N, "):
        parse_unit("n", FORCE_UNITS, "x")


def test_forces_are_whole_counts_so_that_a_replay_can_give_them_back(tmp_path: Path) -> None:
    wrench = np.random.default_rng(1).normal(0, 5, (50, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
    path = saved(tmp_path / "f.npy", wrench)
    options = {"force": path, "force_hz": 100.0, "units": "N", "torque_units": "N m"}
    message = imported(tmp_path, **options)
    value = Session(tmp_path / "s.zarr").streams["force"].array("value")
    counts = np.rint(value / np.repeat([1e-6, 1e-9], 3)).astype(np.int64)
    scale = np.repeat([1.0 / 1e6, 1e-3 / 1e6], 3)
    assert (counts.astype(float) * scale - 0.0).tobytes() == value.tobytes()
    assert np.abs(value - wrench)[:, :3].max() <= 5.01e-7
    assert np.abs(value - wrench)[:, 3:].max() <= 5.01e-10
    assert any("largest change" in line for line in message)


def counts_with(bad: float) -> Any:
    counts = np.full((20, 48), 100.0)
    counts[13, 5] = bad
    return counts


WHOLE = avi(jpegs(5))
ODD = avi([*jpegs(2), simplejpeg.encode_jpeg(np.zeros((32, 32, 3), np.uint8))])


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("f.csv", "Fx (N),Fy (N)\n1,2\n3\n", r"line 3: found 1 values, the header has 2; is the"),
        ("f.csv", "Fx (N)\n1\nx\n", r"line 3: Fx \(N\): found 'x', expected a number"),
        ("f.csv", "Fx (N)\n1\nnan\n", r"line 3: NaN or infinite"),
        ("f.csv", "t_s,Fx (N)\n0,1\n1,1\n1,1\n", r"line 4: its time does not advance"),
        ("f.csv", "Fx (N)\n", "expected a header and rows"),
        ("f.csv", "Fx (N)\n1e9\n1\n", "row 0: .* is beyond 2147; are the units right"),
        ("v.avi", WHOLE[:-900], r"cut short: chunk .* lacks \d+ bytes"),
        ("v.avi", WHOLE[:400], "cut short"),
        ("v.avi", WHOLE.replace(b"\xff\xd9", b"\0\0", 1), "frame 0: no whole JPEG"),
        ("v.avi", b"RIFF\4\0\0\0AVI ", "without a frame of video"),
        ("v.avi", ODD, "image 2 is 32x32"),
        ("t.npy", counts_with(np.nan), "row 13: found nan; allowed: 0 to 65535"),
        ("t.npy", counts_with(np.inf), "row 13: found inf; allowed: 0 to 65535"),
        ("t.npy", counts_with(-1), "row 13: found -1; allowed: 0 to 65535"),
        ("t.npy", counts_with(65_536), "row 13: found 65536; allowed: 0 to 65535"),
        ("t.npy", b"", "t.npy: damaged, or no file of its kind"),
        ("t.npy", b"no numpy", "t.npy: damaged, or no file of its kind"),
        ("t.npy", b"\x93NUMPY\1\0", "t.npy: damaged, or no file of its kind"),
    ],
)
def test_a_broken_file_is_refused_with_its_place_and_leaves_nothing(
    name: str, content: Any, match: str, tmp_path: Path
) -> None:
    kind = {"f": "force", "v": "video", "t": "taxels"}[name[0]]
    has_times = kind == "video" or (isinstance(content, str) and "t_s" in content)
    rate = {} if has_times else {f"{kind}_hz": 60.0}
    rejected(tmp_path, match, **{kind: saved(tmp_path / name, content)}, **rate)


def test_recordings_of_unequal_length_are_refused_unless_trimmed(tmp_path: Path) -> None:
    video = saved(tmp_path / "v.avi", avi(jpegs(60)))
    force = saved(tmp_path / "f.npy", np.arange(300.0) / 100)
    options = {"video": video, "force": force, "force_hz": 300.0, "units": "N"}
    rejected(tmp_path, r"unequal length: v.avi 2.000 s, f.npy 1.000 s.*--trim", **options)
    imported(tmp_path, trim=True, **options)
    session = Session(tmp_path / "s.zarr")
    assert len(session.streams["camera"]) == 30
    assert len(session.streams["force"]) == 300


def test_nothing_to_import_and_a_bad_rate_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="nothing to import"):
        draft_recordings([tmp_path], [], Answers(sensor="a", indenter="b"))
    path = saved(tmp_path / "t.npy", np.zeros((9, 48)))
    rejected(tmp_path, "--taxels-hz: found -1", taxels=path, taxels_hz=-1.0)


def test_the_command_line_says_what_was_assumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = saved(tmp_path / "t.npy", np.full((60, 48), 10.25) + np.arange(60)[:, None])
    out = str(tmp_path / "s.zarr")
    command = ["import", out, "--taxels", str(path), "--sensor", "uskin", "--indenter", "ball"]
    command += ["--press", "none", "--yes"]
    assert main(command) == 2
    assert "say --taxels-hz" in capsys.readouterr().err
    assert main([*command, "--taxels-hz", "60"]) == 2
    assert "--taxel-order taxel" in capsys.readouterr().err
    command += ["--taxel-order", "taxel"]
    assert main([*command, "--taxels-hz", "60"]) == 0
    assert "largest change 0.25 counts" in capsys.readouterr().out
    assert main([*command, "--taxels-hz", "60"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["session", "check", out]) == 0


def test_several_files_of_a_kind_become_a_stream_each(tmp_path: Path) -> None:
    top, side = jpegs(30), jpegs(30)[::-1]
    (tmp_path / "a=b.avi").write_bytes(avi(top))  # the name of a file may hold a =
    side_file = saved(tmp_path / "side.avi", avi(side))
    left = saved(tmp_path / "left.npy", np.linspace(0, 1, 30))
    right = saved(tmp_path / "right.npy", np.linspace(2, 3, 60))
    words = ["import", str(tmp_path / "s.zarr"), "--sensor", "wedge", "--indenter", "ball"]
    words += ["--video", f"top={tmp_path / 'a=b.avi'}", "--video", f"side={side_file}"]
    words += ["--force", f"left={left}", "--force", f"right={right}", "--units", "N"]
    words += ["--force-hz", "left=30", "--force-hz", "right=60"]
    words += ["--press", "none", "--lag", "0", "--yes"]
    assert main(words) == 0
    session = Session(tmp_path / "s.zarr")
    assert faults(check(session.path)) == []
    assert session.order == ["top", "side", "left", "right"]
    assert [*session.streams["side"].jpegs(range(30))] == side
    assert session.columns == {"top": "image", "side": "side", "left": "wrench", "right": "right"}
    assert session.streams["right"].rate_hz == 60
    assert session.frames["right"][5, 2] < -2 < session.frames["wrench"][5, 2]
    names = {each["name"] for each in session.attrs["imported"]["files"].values()}
    assert names == {"a=b.avi", "side.avi", "left.npy", "right.npy"}


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--video", "a.avi", "--video", "b.avi"], "--video: found 'b.avi' twice; name them"),
        (["--video", "x=a.avi", "--video", "x=b.avi"], "--video: found 'x' twice"),
        (["--video", "x=a.avi", "--fps", "y=3"], "--fps: found 3 of y without the file"),
        (["--video", "a.avi", "--fps", "fast"], "--fps: found"),
    ],
)
def test_files_and_rates_that_do_not_fit_are_refused(
    words: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    head = ["import", str(tmp_path / "s.zarr"), "--sensor", "wedge", "--indenter", "ball"]
    assert main([*head, *words]) == 2
    assert text in capsys.readouterr().err
