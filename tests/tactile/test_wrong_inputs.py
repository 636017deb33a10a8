"""Wrong files and options: each is refused in a line, and nothing is written."""

from pathlib import Path

import numpy as np
import pytest
from support import reference
from support.wrong_files import FOLDERS, TEXTS, intact_files, refusals, run

from rig.acquire import collector
from rig.core.packaged import BENCHES
from rig.mock.bench import MockBench

# Options by command, and a part of the message. In the folder are the session `s.zarr`, the archive
# `a.markers.zarr` of the sensors `dots` and `grid`, its split, and a force model without ONNX.
OPTIONS = {
    "collect": "--sensor, --bench: both missing; allowed: one of them",
    "collect --sensor nosuch": "--sensor: found 'nosuch'; known in benches/ or packaged: array-i,",
    "collect --sensor tacplam": "--sensor: found 'tacplam'; did you mean tacpalm? known in",
    "collect --sensor tacpalm --indenter bananna": "--indenter: found 'bananna'; known in the",
    "collect --sensor tacpalm --indenter cylinde": "did you mean cylinder?",
    "collect --sensor uskin --camera .": "uskin.yaml has no camera: nothing",
    "collect --sensor tacpalm --still": "--still: goes with --camera only",
    "collect --bench lab.yaml --camera .": "--camera: lab.yaml is a lab bench",
    "collect --bench lab.yaml --truth t": "--truth: lab.yaml is a lab bench",
    "collect --bench lab.yaml": "lab bench: no terminal to ask on",
    "collect --sensor tacpalm --watch 203.0.113.7:8765": "allowed: a free port of this",
    "collect --sensor tacpalm --watch 70000": "--watch: found '70000'; allowed: PORT or HOST:PORT",
    "collect --sensor tacpalm --watch 0.0.0.0:": "--watch: found '0.0.0.0:'",
    "collect --sensor tacpalm --watch=-1": "--watch: found '-1'",
    "home --sensor tacpalm --indenter bananna": "found 'bananna'",
    "home --bench lab.yaml": "no terminal to ask on",
    "calibrate-latency --sensor tacpalm --indenter bananna": "found 'bananna'",
    "calibrate-latency --bench lab.yaml": "no terminal to ask on",
    "force-depth --sensor tacpalm --indenter bananna": "found 'bananna'",
    "force-depth --bench lab.yaml": "no terminal to ask on",
    "collect --sensor gelsight --targets 0": "--targets: found 0; allowed: 1 to 240",
    "collect --sensor gelsight --targets 999": "--targets: found 999; allowed: 1 to 240",
    "collect --sensor gelsight --camera x": "--camera: x: no such file or folder",
    "collect --sensor gelsight --taxels x.npy": "gelsight.yaml has no taxels: nothing would play",
    "collect --sensor gelsight --out s.zarr": "s.zarr: exists already; resume it or",
    "collect --resume x.zarr": "x.zarr: no such session",
    "collect --resume s.zarr --targets 3": "neither --out, --targets nor --indenter go with",
    "collect --resume s.zarr --sensor tacpalm": "s.zarr was recorded with 'gelsight'",
    "force-depth --sensor gelsight --out s.zarr": "s.zarr: exists already; resume it",
    "home --sensor gelsight --repeats 0": "home: repeats: 0; allowed: 1 or more",
    "calibrate-latency --sensor gelsight --taps 0": "--taps: found 0; allowed: 4 or more",
    "jog --sensor gelsight": "gelsight.yaml.jog: missing; allowed: {kind: spacemouse",
    "grip --sensor nosuch": "--sensor: found 'nosuch'; known in benches/ or packaged: array-i,",
    "campaign --file none.yaml --list": "none.yaml: no such file",
    "replay --session x.zarr": "x.zarr: no such session",
    "replay --session s.zarr --speed 0": "--speed: found '0'; allowed: 0.01 to 1000, or max",
    "replay --session s.zarr --speed x": "--speed: found 'x'; allowed: 0.01 to 1000, or max",
    "replay --session s.zarr --out s.zarr": "s.zarr: exists already; choose",
    "replay --session s.zarr --without smell": "no stream 'smell' to leave out; known: camera",
    "replay --session a.markers.zarr": "found format 'tactile-rig markers', expected",
    "live --session s.zarr": "the following arguments are required: --model",
    "live --model x --session s.zarr": "model: found 'x'; no such folder; allowed: the folder",
    "live --model model": "--sensor, --bench: both missing",
    "live --model . --sensor uskin": "found no config.yaml; allowed: the folder of a training run",
    "live --model model --sensor no": "--sensor: found 'no'",
    "live --model model --sensor uskin --rate-hz -1": "--rate-hz: found '-1'",
    "live --model model --sensor uskin --page x": "--page: found 'x'; allowed: PORT or HOST:PORT",
    "live --model model --session s.zarr --indenter cone": "--indenter: s.zarr is no mock bench",
    "live --model model --session x.zarr": "x.zarr: no such session",
    "live --model model --session s.zarr --runtime onnx": "--runtime torch needs none",
    "live --model model --session s.zarr --seconds 0": "--seconds: found '0'; allowed: a number",
    "live --model model --session s.zarr --sensor a": "--sensor: not allowed with argument",
    "session list none": "no such folder",
    "session list . --since today": "found 'today'; allowed: a day such as 2026-11-24",
    "session info x.zarr": "x.zarr: no such session",
    "session check x.zarr": "x.zarr: no such session",
    "session recover x.zarr": "x.zarr: no such session",
    "session info split.json": "found a file; allowed: the folder of a session or an archive",
    "session check split.json": "found a file; allowed: the folder of a session or an archive",
    "session info a.markers.zarr --picture x.png": "expected 'tactile-rig session'",
    "session export s.zarr split.json --to hdf5": "split.json: exists already",
    "session export s.zarr x --to word": "--to: invalid choice: 'word' (choose from 'zarr',",
    "session export s.zarr x --to zarr --images small": "--images: invalid choice: 'small'",
    "session export a.markers.zarr x --to hdf5": "hdf5 is not for a marker archive; allowed:",
    "session recover s3://bucket/x.zarr": "remote stores are only read; copy it here first",
    "import x --out y.zarr": "x: no such file or folder",
    "import split.json --out y.zarr": "found nothing to import: split.json: left out, no recording",
    "import y.zarr --sensor a --indenter b": "--out: missing; allowed: the session or folder to",
    "import y.zarr --taxels t.npy --sensor a --indenter b": "60 rows say no times; say --taxels-hz",
    "import y.zarr --taxels t.npy --taxels-hz -1 --sensor a --indenter b": "--taxels-hz: found -1",
    "import y.zarr --taxels split.npy --taxels-hz 60 --sensor a --indenter b": "file of its kind",
    "import y.zarr --taxels 7.npy --taxels-hz 60 --sensor a --indenter b": "allowed: (n, 48), (n",
    "import y.zarr --force f.csv --force-hz 40 --sensor a --indenter b": "says no unit; say",
    "import y.zarr --video f.csv --fps 9 --sensor a --indenter b": "OpenCV finds no video in it",
    "import y.zarr --video none --fps 9 --sensor a --indenter b": "none: no such video file or",
    "import x.pkl --base . --out y": "x.pkl: no such file",
    "sim press --depths 1,1": "--depths[1]",
    "sim archive": "the following arguments are required: CONTENTS",
    "sim archive material --draws 2": "--draws: r6 has no posterior",
    "sim archive digits": "sensor: 'digits'; allowed: array-i, array-ii, circle-i",
    "sim archive none.yaml": "none.yaml: no such file",
    "sim archive r6 --scale 2": "--scale: '2'; allowed: smoke, full, or above 0 to 1",
    "sim archive r6 --indenters egg": "--indenters: egg; allowed: sphere, sphere_s, hemisphere",
    "sim archive r6 --steps -1": "--steps: found '-1'; allowed: whole numbers, 1 to 1000",
    "sim archive r6 --tier fem --tolerance '3 %'": "--tier: 'fem' with --tolerance; allowed",
    "sim archive states:Spiral": "pattern: 'Spiral'; allowed: Array1, Array2",
    "sim archive r6 --processes 0": "--processes: found '0'; allowed: whole numbers, 1 or more",
    "sim archive x.markers.zarr": "x.markers.zarr: no such archive",
    "sim archive r6 --out planned.markers.zarr": "was begun with another plan, which differs in",
    "markers s.zarr": "the following arguments are required: --out",
    "markers x.zarr --out m.markers.zarr": "x.zarr",
    "markers s.zarr --out m.markers.zarr --preset /none.yaml": "no such file",
    "markers s.zarr --out m.markers.zarr --preset no": "preset: found 'no'; known: bench-digit,",
    "markers s.zarr --out m.markers.zarr --mm-per-px -1": "mm_per_px: found -1.0, expected more",
    "markers s.zarr --out m.markers.zarr --sam-encoder x": "found one; allowed: both or neither",
    "compensate a.markers.zarr --out c.json --pairs dots:digit": "no sensor digit; known: dots,",
    "compensate a.markers.zarr --out c.json --pairs dots": "SOURCE:TARGET",
    "compensate a.markers.zarr --out c.json --pairs dots:grid": "a force-depth session of",
    "archive join a.markers.zarr:q a.markers.zarr --dry-run": "has no sensor 'q'; allowed: dots,",
    "archive join a.markers.zarr:dots --dry-run": "sensors: found 1; allowed: two or more",
    "archive join a.markers.zarr none.markers.zarr --dry-run": "none.markers.zarr",
    "archive join a.markers.zarr --place-mm 2000 --dry-run": "place: found 2.0",
    "compensate a.markers.zarr --out c.json --range-mm dots": "found 'dots'; allowed: NAME=NUMBER",
    "translate a.markers.zarr --out x.markers.zarr": "--source, --target: missing; allowed: both",
    "translate a.markers.zarr --source dots --target dots --out x.markers.zarr": "the source",
    "translate a.markers.zarr --source dots --target grid --role train --out x.markers.zarr": (
        "--split, --role: found one; allowed: both or neither"
    ),
    "translate a.markers.zarr --source dots --target grid --model model --out x.markers.zarr": (
        "model/config.yaml: found kind 'force'; allowed: field, diffusion, or 'flow'"
    ),
    "translate a.markers.zarr --source dots --target grid --all --out y": "--all: found",
    "translate a.markers.zarr --source lost --target grid --out x.markers.zarr": (
        "found no sensor 'lost'; known: dots, grid"
    ),
    "translate a.markers.zarr --all --model nowhere --out x.markers.zarr": (
        "--model: found 'nowhere'; allowed: flow"
    ),
    "predict model a.markers.zarr --sensor a --split split.json --out a.npz": "--sensor: found 'a'",
    "evaluate none": "none: found no folder; allowed: results of `predict`, X.markers.zarr, a",
    "train force x.markers.zarr --sensor a --out x": "x.markers.zarr: no such archive",
    "train force a.markers.zarr --sensor a --split split.json --preset tiny --out x": (
        "--sensor: found a; known: dots, grid"
    ),
    "train force a.markers.zarr --sensor dots --split split.json --preset huge --out x": (
        "preset: found 'huge'; known: authors_code, displacement"
    ),
    "train force a.markers.zarr --sensor dots --preset tiny --labels split.json --out x": (
        "--pair: found dots; allowed with --labels split.json: A-to-B"
    ),
    "train force a.markers.zarr --sensor dots --preset tiny --pair dots-to-grid --out x": (
        "--pair: found without --labels"
    ),
    "train force a.markers.zarr --sensor dots --preset tiny --start-from nowhere --out x": (
        "model: found 'nowhere'; no such folder"
    ),
    "train force a.markers.zarr --sensor dots --preset tiny --out model": (
        "model: was begun with other data"
    ),
    "train diffusion a.markers.zarr --base none --out x": "weights.base: found 'none' without unet",
    "experiment a.markers.zarr --out x --pairs dots": "allowed: SOURCE:TARGET, two of dots, grid",
    "experiment a.markers.zarr --out x --preset none": "preset: found 'none'; known: demo,",
}


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of intact files."""
    folder = tmp_path_factory.mktemp("lab")
    intact_files(folder)
    np.save(folder / "t.npy", np.zeros((60, 48)))
    np.save(folder / "7.npy", np.zeros((60, 7)))
    (folder / "split.npy").write_text("no array")
    mine = "mock: false\nworld: null\n"
    (folder / "lab.yaml").write_text(f"extends: {BENCHES / 'tacpalm.yaml'}\n{mine}")
    (folder / "f.csv").write_text("fx,fy,fz\n1,2,x\n")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*TEXTS, *FOLDERS])
def test_a_mistake_in_a_file_is_refused_with_the_message_of_the_page(kind: str, lab: Path) -> None:
    found = list(refusals(kind, lab))
    assert {refusal.code for refusal in found} == {2}
    assert not [refusal.mistake for refusal in found if refusal.written]
    page = (reference.FOLDER / "wrong-inputs.md").read_text()
    assert reference.section_of(kind, found) in page, "docs/reference is old: make reference"


@pytest.mark.parametrize("first", sorted({command.split()[0] for command in OPTIONS}))
def test_a_wrong_option_is_refused_in_words_before_a_device_or_an_emulator_starts(
    first: str, lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log of a replay says what was refused, too."""
    monkeypatch.setattr(collector, "Streams", None)
    monkeypatch.setattr(MockBench, "__enter__", None)
    before = {*lab.rglob("*")}
    for command in (each for each in OPTIONS if each.split()[0] == first):
        code, message = run(lab, command)
        assert (code, OPTIONS[command] in message) == (2, True), f"{command}: {message}"
    written = {path for path in {*lab.rglob("*")} - before if path.is_file()}
    assert {path.suffix for path in written} <= {".log"}
