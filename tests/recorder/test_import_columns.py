"""Tables of other programs come in by a mapping of their columns; the how-to's examples run."""

import os
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.tutorials import ROOT, blocks

from recorder import Session, SessionError, check, faults
from recorder.convert import Answers, draft_recordings
from recorder.settings import Reader
from tactile.__main__ import main

h5py = pytest.importorskip("h5py")

T, RANDOM = np.arange(180) / 60, np.random.default_rng(0)
FORCE = 5.0 * np.clip(np.sin(np.pi * (T - 1)), 0, None) * (T > 1) + RANDOM.normal(0, 5e-3, 180)
# Counts of a uSkin whose taxel 5 is pressed, and pictures that redden, with the force.
UNPRESSED = RANDOM.normal([33_000, 34_500, 21_000], 300, (16, 3))
COUNTS = np.rint(UNPRESSED + RANDOM.normal(0, 2, (180, 16, 3))).astype(int)
COUNTS[:, 5, 2] += np.rint(600 * FORCE).astype(int)
RED = (12 * FORCE)[:, None, None, None] * [1, 0.3, -0.5] + RANDOM.normal(0, 1, (180, 48, 64, 3))
PICTURES = (100 + np.arange(64)[:, None] / 4 + RED).astype(np.uint8)
LAYOUT = "columns:\n  time: {name: t, unit: s}\n  Fz: {name: f, unit: N}\n"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run_example(section: str) -> Session:
    """Run the command of a section of the how-to with its mappings; return its session."""
    page = (ROOT / "docs/how-to/foreign-tables.md").read_text()
    Path("page.md").write_text(page.partition(f"\n## {section}")[2].partition("\n## ")[0])
    code = blocks(Path("page.md"))
    words = shlex.split(next(text for kind, text in code if kind == "sh"))[1:]
    names = [words[at + 1] for at, word in enumerate(words) if word == "--columns"]
    for name, text in zip(names, (text for kind, text in code if kind == "yaml"), strict=True):
        Path(name).write_text(text)
    assert main(words) == 0
    session = Session(words[words.index("--out") + 1])
    assert faults(check(session.path)) == []
    return session


def test_xelas_own_log_becomes_taxels_at_their_times() -> None:
    names = [f"{taxel}{axis}" for taxel in range(1, 17) for axis in "XYZ"]
    lines = [
        f"Receive time,Send time,Message number,{','.join(names)},Force {',Force '.join(names)}"
    ]
    for row, counts in enumerate(COUNTS):
        stamps = f"{1767225600.01021 + T[row]:.5f},{1767225600.01 + T[row]:.4f},{row},"
        lines.append(stamps + ",".join(map(str, [*counts.reshape(-1), *[0.01 * row] * 48])))
    Path("press.csv").write_text("\n".join(lines) + "\n")
    session = run_example("XELA")
    assert np.array_equal(session.streams["taxels"].array("value"), COUNTS)
    assert session.streams["taxels"].t_ns == pytest.approx(T * 1e9, abs=2e4)
    assert session.streams["values"].array("value")[7] == pytest.approx([0.07] * 48)
    assert main(["import", "press.csv", "--like", "xela.zarr", "--out", "b.zarr", "--yes"]) == 0


def test_a_row_of_a_table_has_its_picture_and_force() -> None:
    Path("gel/png").mkdir(parents=True)
    lines = ["Indentation 7", "operator;Ito", "picture;Kraft z [N];remark"]
    for number, image in enumerate(PICTURES[60:120:7]):
        lines.append(f"png/{f'{number:03}' if number else 'rest'}.png;{number},5;slow")
        Image.fromarray(image).save(f"gel/{lines[-1].partition(';')[0]}")
    Path("gel/labels.csv").write_text("\n".join(lines) + "\n\n")
    session = run_example("A table of images")
    assert np.array_equal(session.streams["camera"].images([4])[0], PICTURES[88])
    assert session.streams["force"].array("value")[:, 2] == pytest.approx(-0.5 - np.arange(9))
    assert (session.reference["image"].tolist(), len(session.targets["depth"])) == ([0], 8)


def test_arrays_of_hdf5_are_on_one_clock() -> None:
    fine = np.arange(3000) / 1000
    wrench = -np.interp(fine, T, FORCE)[:, None] * [0, 0, 1, 0, 0, 0]
    with h5py.File("grasp.h5", "w") as file:
        file["gauge/time"], file["gauge/wrench"] = 5_000_000_000 + np.rint(fine * 1e9), wrench
        file["camera/time"] = 5_000_000_000 + np.rint(T[6:] * 1e9).astype(np.int64)
        file["camera/frames"] = PICTURES[6:, ..., ::-1]
    session = run_example("HDF5")
    assert session.streams["camera"].t_ns[0] - session.streams["force"].t_ns[0] == 10**8
    assert np.array_equal(session.streams["camera"].images([60])[0], PICTURES[66])
    assert session.reference["image"].min() >= 0  # zero is where both are


def test_arrays_of_npz_are_read_by_name() -> None:
    odd, load = np.array([{}, None], object), FORCE / 9.80665e-3
    np.savez("press.npz", stamp=1e3 * T + 9e6, skin=COUNTS, load=load, odd=odd)
    session = run_example("NPZ")
    assert np.array_equal(session.streams["taxels"].array("value"), COUNTS)
    assert session.streams["force"].array("value")[:, 2] == pytest.approx(-FORCE, abs=1e-6)


def read(path: str, mapping: str) -> Any:
    """Return the recording in a file, read by a mapping."""
    columns = (("m.yaml", Reader(SessionError).parse(mapping, "m.yaml")),)
    answers = Answers(sensor="s", indenter="i", press=("none",), columns=columns)
    return draft_recordings([Path(path)], [], answers)[0].take


GERMAN = "separator: ;\ndecimal: ','\n"
NUMBERED = "header: false\ncolumns: {time: {name: 1, unit: ms}, Fz: {name: 2, unit: mN}}"
UNIX = LAYOUT.replace("unit: s", "unit: unix").replace("N}", "N, sign: -1}")
TEXTS = {
    "\ufeff t , f ,x\n7,1.5,a\n8,-2,b\n\n\n": LAYOUT,
    "one\ntwo\nt;f\n7;1,5\n8;-2\n": f"{GERMAN}skip: 2\n{LAYOUT}",
    "  t  f\n  7  1.5 \n  8 -2.0 \n": f'separator: " "\n{LAYOUT}',
    "t\tf\n7\t1.5\n8\t-2\n": f'separator: "\\t"\n{LAYOUT}',
    "t_s;Fz (N)\n7;1,5\n8;-2\n": GERMAN,
    "0,7e3,1500\n0,8e3,-2000\n": NUMBERED,
    "t,f\n2026-01-31T10:00:07,1.5\n2026-01-31 12:00:08+02:00,-2\n": LAYOUT.replace(": s", ": iso"),
    "t,f\n1.7e9,-1.5\n1700000001,2\n": UNIX,
}


@pytest.mark.parametrize("text", TEXTS)
def test_a_text_is_read_as_its_mapping_says(text: str) -> None:
    for encoding in ("utf-8", "utf-16"):
        Path("a.txt").write_text(text, encoding=encoding)
        numbers = read("a.txt", f"encoding: {encoding}\n{TEXTS[text]}").numbers("force")
        assert numbers.value[:, 2].tolist() == [1.5, -2.0]
        assert numbers.t_ns.tolist() == [0, 10**9]


def test_poses_turn_by_rotation_vectors_or_quaternions() -> None:
    np.save("a.npy", [[time, 1, 2, 3, 0, 0, 90, 0, 0, 2, 2] for time in (0.0, 1.0)])
    axes = "columns:\n  time: {index: 0, unit: s}\n  Fz: {index: 1, unit: N}\n"
    axes += "".join(f"  {name}: {{index: {at}, unit: mm}}\n" for at, name in enumerate("XYZ", 1))
    for names, first, unit in (("RX RY RZ", 4, "deg"), ("QX QY QZ QW", 7, "''")):
        turn = enumerate(names.split(), first)
        text = axes + "".join(f"  {each}: {{index: {at}, unit: {unit}}}\n" for at, each in turn)
        pose = read("a.npy", text).numbers("pose").value[1]
        assert pose == pytest.approx([1e-3, 2e-3, 3e-3, 0, 0, np.pi / 2])
    with pytest.raises(SessionError, match=r"found time, Fz, X, Y, Z; .* a pose is X, Y, Z with"):
        read("a.npy", axes)


PLAIN, IMAGE = "t,f\n0,1\n1,2\n", LAYOUT + "  image: {name: i}\n"
WRONG = [
    ("decimal: ','\n" + LAYOUT, PLAIN, "m.yaml: separator: found ',' with decimal ','; allowed"),
    (LAYOUT.replace("Fz", "Fq"), PLAIN, "a.csv: columns: found time, Fq; allowed: time, Fx"),
    (LAYOUT.replace("N}", "kg}"), PLAIN, "columns.Fz.unit: found unit 'kg'; allowed: N, mN"),
    (LAYOUT.replace("name: f", "name: g"), PLAIN, "columns.Fz: found 0 columns 'g', .* of t, f"),
    (UNIX, PLAIN, "line 2: found 0 s since 1970"),
    (LAYOUT + "files: '*.dat'", PLAIN, "m.yaml.files: fits no file"),
    (LAYOUT, 't,f\n0,1\n1,"2,5"\n', "line 3: f: found '2,5', expected a number with decimal '.'"),
    (GERMAN + LAYOUT, "t;f\n0;1.500\n", "found '1.500', expected a number with decimal ','"),
    (LAYOUT, "t,f\n0,1\n1,\0\n", "line 3: too long, or not utf-8"),
    (LAYOUT, "", "line 1: too long, or not utf-8"),
    (LAYOUT, "c," * 10**6, "line 1: too long, or not utf-8"),
    (IMAGE, "t,f,i\n0,1,in.png\n1,2,../out.png\n", "line 3: i: found '../out.png', expected a f"),
    (IMAGE, "t,f,i\n0,1,in.png\n1,2,link.png\n", "line 3: i: found 'link.png', expected a file"),
]


@pytest.mark.parametrize(("mapping", "text", "match"), WRONG)
def test_what_is_wrong_is_refused_by_key_or_line(mapping: str, text: str, match: str) -> None:
    Path("in").mkdir()
    Image.fromarray(PICTURES[0]).save("out.png")
    Image.fromarray(PICTURES[0]).save("in/in.png")
    Path("in/link.png").symlink_to("../out.png")
    Path("in/a.csv").write_text(text)
    if not text:
        os.truncate("in/a.csv", 1 << 30)
    with pytest.raises(SessionError, match=match):
        read("in/a.csv", mapping)


def test_hdf5_is_read_from_the_file_itself() -> None:
    with h5py.File("a.h5", "w") as file:
        file["t"] = file["group/f"] = np.arange(9.0)
        file["soft"], file["texts"] = h5py.SoftLink("/t"), ["a"] * 9
        file["external"] = h5py.ExternalLink("b.h5", "/group")
        file.create_dataset("raw", shape=(9,), dtype="f8", external=[("b.raw", 0, 72)])
        layout = h5py.VirtualLayout(shape=(9,), dtype="f8")
        layout[:] = h5py.VirtualSource("b.h5", "t", shape=(9,))
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("huge", shape=(10**12,), chunks=(1000,), dtype="f8")
    Path("b.h5").write_bytes(Path("a.h5").read_bytes())
    assert read("a.h5", LAYOUT.replace("name: f", "name: group/f")).first("force") is not None
    for name in ("soft", "external/f", "raw", "virtual", "texts", "group", "none", "huge"):
        with pytest.raises(SessionError, match="holds 8" if name == "huge" else f"found '{name}'"):
            read("a.h5", LAYOUT.replace("name: f", f"name: {name}"))


def test_a_refused_header_prints_a_mapping_to_start_from() -> None:
    Path("a.csv").write_text("Zeit;Kräfte [N]\n0;1\n1;2\n")
    with pytest.raises(SessionError, match=r'others: "Kräfte \[N\]"') as error:
        draft_recordings([Path("a.csv")], [], Answers(sensor="s", indenter="i"))
    mapping = str(error.value).partition("\n")[2].replace("QUANTITY", "time").replace("UNIT", "s")
    take = read("a.csv", f'{mapping}\n  Fz: {{name: "Kräfte [N]", unit: N}}')
    assert take.numbers("force").value[:, 2].tolist() == [1, 2]
