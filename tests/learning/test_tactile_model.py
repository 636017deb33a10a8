"""`tactile.load`: frames of every kind become the forces of `tactile predict` and of `live`.

The scripts of the guide run as they are.
"""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from support.authors_net import SMALL, Theirs
from support.few import few
from support.force_models import random_model
from support.learning_sessions import record

import tactile
from learning.cli.predict import predicted
from learning.data.images import shrink
from learning.data.splits import make_split
from learning.errors import LearningError
from learning.force.intervals import AxisError, Intervals, LearnedShapes, Scale
from learning.force.live import START_FRAMES
from learning.force.model import prepare
from learning.force.tactile_model import HELD, TactileModel
from learning.markers import Segmenter, preset
from learning.markers.build import archive_sessions
from recorder import MarkerArchive, Session
from recorder.markers import pack

GUIDE = Path(__file__).parents[2] / "docs/how-to/forces-in-python.md"
SCRIPTS = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), flags=re.S)
Array = np.ndarray[Any, Any]
PRESETS = {"both": "bench-gelsight", "field": "bench-gelsight", "shading": "shading"}


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a session, pictures and masks of its first press, a model, a checkpoint."""
    lab = tmp_path_factory.mktemp("lab")
    session = Session(record(lab / "sessions/press.zarr"))
    rows = session.frames["image"][session.frames["target"] == 0]
    pictures = session.streams["camera"].images([*session.reference["image"], *rows])
    segmenter = Segmenter(preset("bench-gelsight"))  # type: ignore[arg-type]
    for name, frames in (("pictures", pictures), ("markers", map(segmenter.mask, pictures[:6]))):
        (lab / name).mkdir()
        for number, frame in enumerate(frames):
            Image.fromarray(frame).save(lab / name / f"{number:04d}.png")
    torch.manual_seed(0)
    torch.save(Theirs(*SMALL).state_dict(), lab / "epoch_20.pth")
    random_model(lab / "model", "both", "bench-gelsight")
    return lab


def read(folder: Path) -> Array:
    return np.stack([np.asarray(Image.open(file)) for file in sorted(folder.glob("*.png"))])


@pytest.fixture(scope="module")
def pictures(lab: Path) -> Array:
    """The picture without contact, and those of a press."""
    return read(lab / "pictures")


@pytest.fixture
def model(lab: Path, pictures: Array) -> TactileModel:
    model = tactile.load(lab / "model")
    model.reference(pictures[0])
    return model


@pytest.mark.parametrize("form", few([*PRESETS, "taxels"], 2))
def test_forces_are_those_of_predict(form: str, lab: Path, tmp_path: Path) -> None:
    chosen = PRESETS.get(form, "uskin")
    folder = random_model(tmp_path / "m", "field" if form == "taxels" else form, chosen)
    path, out = lab / "sessions/press.zarr", tmp_path / "x.markers.zarr"
    session = Session(record(tmp_path / "u.zarr", form) if form == "taxels" else path)
    archive_sessions([Path(session.path)], out, preset_name=chosen, mm_per_px=0.03)
    archive, split = MarkerArchive(out), tmp_path / "split.json"
    make_split(archive, validation=0, new_press=0).write(split)
    due, _ = predicted(str(folder), archive, None, split, ("train",), "cpu")
    column = "taxels" if form == "taxels" else "image"
    rest, values = session.reference[column], session.frames[column]
    if column == "image":
        rest, values = (session.streams["camera"].images(rows) for rows in (rest, values))
    model = tactile.load(folder)
    model.reference(rest)
    presses = [values[session.frames["target"] == target] for target in (0, 1)]
    found = [model.predict(press, sequence=True) for press in presses]
    np.testing.assert_allclose(np.concatenate([f.force for f in found]), due.predicted, atol=2e-4)
    assert np.ptp(due.predicted, axis=0).min() > 1e-3
    assert np.isnan(found[0].low).all()
    assert found[0].outside is None


def test_a_stream_has_the_forces_of_live_and_of_a_sequence(
    lab: Path, pictures: Array, model: TactileModel
) -> None:
    first, stream = tactile.load(lab / "model").stream(), model.stream()
    assert [first.step(pictures[0]) for _ in range(START_FRAMES)] == [None] * START_FRAMES
    live = [one for one in map(stream.step, pictures[1:]) if one is not None]
    assert live == [first.step(picture) for picture in pictures[1:]]
    # The sensor is touched from the second frame on, so the state is reset only once.
    assert [one.contact for one in live] == [False, *[True] * (len(live) - 1)]
    found = model.predict(pictures[1:], sequence=True)
    np.testing.assert_allclose([one.force for one in live], found.force, atol=1e-5)


def test_only_frames_of_a_sequence_depend_on_those_before(
    pictures: Array, model: TactileModel
) -> None:
    some = pictures[[3, 10, 15]]
    alone = model.predict(some, sequence=False).force
    for frames, due in ((some[::-1], alone[::-1]), (some[1], alone[1:2])):
        np.testing.assert_allclose(model.predict(frames, sequence=False).force, due, atol=1e-5)
    held = model.predict(np.stack([some[1]] * HELD), sequence=True).force[-1]
    np.testing.assert_allclose(held, alone[1], atol=1e-5)
    assert np.abs(model.predict(some, sequence=True).force - alone).max() > 1e-3
    with pytest.raises(LearningError, match="sequence: missing; allowed: True if the 3 frames"):
        model.predict(some)


def test_masks_and_inputs_of_the_network_have_the_forces_of_their_pictures(
    lab: Path, pictures: Array, model: TactileModel
) -> None:
    due = model.predict(pictures[:6], sequence=True).force
    masks = read(lab / "markers")
    for frames in (masks, masks.astype(np.uint8) * 255, torch.from_numpy(shrink(pack(masks)))):
        model.reference(frames[0])
        np.testing.assert_allclose(model.predict(frames, sequence=True).force, due, atol=1e-5)


def test_intervals_and_the_flag_are_those_of_the_model(pictures: Array, tmp_path: Path) -> None:
    folder = random_model(tmp_path / "model", "both", "bench-gelsight")
    units = tuple(map(tuple, np.eye(7).tolist()))
    error, scale, largest = AxisError(0.1, 0.0), Scale(1.0, "a gauge", assumed=False), (99.0,) * 3
    for limit in (0.0, 1e6):
        learned = LearnedShapes(units, ((0.0,) * 7,), limit)
        Intervals((error,) * 3, scale, largest, learned, 9, ("sphere",), "labels").write(folder)
        model = tactile.load(folder / "config.yaml")
        model.reference(pictures[0])
        found = model.predict(pictures, sequence=True)
        np.testing.assert_allclose((found.high - found.force, found.force - found.low), 0.1)
        assert found.outside is not None
        assert found.outside.tolist() == [limit == 0] * len(pictures)


def test_wrong_frames_are_refused_with_what_is_allowed(
    lab: Path, pictures: Array, model: TactileModel
) -> None:
    rest = pictures[0]
    with pytest.raises(LearningError, match=r"reference: missing; .*reference\(picture\)"):
        tactile.load(lab / "model").predict(rest)
    with pytest.raises(LearningError, match=r"reference: missing; .*reference\(mask\)"):
        model.predict(np.zeros((480, 640), bool))
    for frame, found in (
        (rest / 255.0, r"float64 \(480, 640, 3\) from 0.0\d* to 0.6\d*; allowed: pictures"),
        (rest // 100, r"uint8 \(480, 640, 3\) from 0 to 1; allowed: pictures"),
        (rest > 100, r"bool \(480, 640, 3\) from 0 to 1; allowed: pictures"),
        (np.moveaxis(rest, 2, 0), r"uint8 \(3, 480, 640\) from \d+ to \d+; allowed: pictures"),
        (rest[..., 0], r"uint8 \(480, 640\) from \d+ to \d+; allowed: .*of 0 and 255"),
        (np.zeros((0, 480, 640, 3), np.uint8), r"uint8 \(0, 480, 640, 3\); allowed"),
        ("a.png", r"<U5 \(\); allowed: .*or \(n, 256, 256\)$"),
    ):
        with pytest.raises(LearningError, match=rf"frames: found {found}"):
            model.predict(frame)
    for name, problem in (
        ("uskin", r"taxels: found \(480, 640, 3\)"),
        ("shading", "a preset of s"),
    ):
        with pytest.raises(LearningError, match=problem):
            tactile.load(lab / "model", preset=name).reference(rest)
    with pytest.warns(UserWarning, match="made for gelsight .*56 markers.*: another pattern"):
        tactile.load("demo", preset="bench-gelsight").reference(rest)


def test_a_model_opens_by_a_url(lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    model = tactile.load(f"file://{lab}/model/model.safetensors")
    assert model.force_model.axes == ("Fx", "Fy", "Fz")
    assert (tmp_path / "models/model/config.yaml").is_file()
    monkeypatch.setitem(sys.modules, "s3fs", None)
    for url, problem in (("memory://a/no", "FileNotFound"), ("s3://bucket/a", "Install s3fs")):
        with pytest.raises(
            LearningError, match=rf"{url}/config\.yaml: cannot be read: .*{problem}"
        ):
            tactile.load(url)


def test_importing_tactile_imports_neither_torch_nor_numpy() -> None:
    code = "import sys, tactile; print({'torch', 'numpy', 'learning'} & set(sys.modules))"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout == "set()\n"
    assert {"Forces", "TactileModel", "load"} <= set(dir(tactile))


def run_scripts(*numbers: int) -> list[dict[str, Any]]:
    """Run some scripts of the guide, and return their names."""
    ran = []
    for script in (SCRIPTS[number] for number in numbers):
        assert sum(bool(line.strip()) for line in script.splitlines()) <= 10
        ran.append(dict[str, Any]())
        exec(compile(script, "guide", "exec"), ran[-1])
    return ran


def test_scripts_from_pictures_a_session_and_a_checkpoint_to_newtons(
    lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(lab)
    folder, session, authors = run_scripts(0, 1, 2)
    again = folder["model"].predict(folder["pictures"][1:], sequence=True).force
    np.testing.assert_allclose(session["forces"].force, again, atol=1e-5)
    # Forces of the checkpoint are those of the authors' network.
    network, masks = authors["model"].force_model, authors["masks"]
    theirs = Theirs(*SMALL).eval()
    theirs.load_state_dict(torch.load("epoch_20.pth", weights_only=True))
    with torch.no_grad():
        images = prepare(torch.from_numpy(shrink(pack(masks))), None, network.inputs)
        due = network.denormalise(theirs(images)).numpy()
    found = authors["model"].predict(masks, sequence=True).force
    np.testing.assert_allclose(found, due, atol=1e-4)
    assert network.inputs.marker_value == 1 / 255


def test_scripts_of_a_network_of_one_s_own_and_of_tables(
    lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pandas", reason="pandas is not installed: extra tables")
    pytest.importorskip("xarray", reason="xarray is not installed: extra tables")
    monkeypatch.chdir(lab)
    own, tables = run_scripts(3, 5)
    steps = [int(state["step"]) for state in own["optimiser"].state.values()]
    assert steps == [len(own["windows"].batches(16))] * 2
    least = tables["session"].frames["wrench"][:, 2].min()
    assert capsys.readouterr().out.endswith(f"\n{least:.1f} N\n")
