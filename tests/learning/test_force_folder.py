"""Folders of force models: paths, web addresses and the installed demo."""

import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from fsspec.asyn import get_loop

from learning.errors import LearningError
from learning.force.folder import model_folder
from learning.force.loading import load_force_model

get_loop()  # fsspec keeps one thread for the life of the process


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    """The web address of a folder with two models, of which one is incomplete."""
    place = tmp_path / "place"
    for name, files in (("mine", ("config.yaml", "model.safetensors", "card.md")), ("half", ())):
        (place / name).mkdir(parents=True)
        for file in files:
            (place / name / file).write_text(f"{file} of {name}")
    handler = partial(SimpleHTTPRequestHandler, directory=str(place))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def test_the_demo_is_found_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert model_folder("demo").joinpath("model.onnx").is_file()
    assert load_force_model("demo").axes == ("Fx", "Fy", "Fz")
    (tmp_path / "demo").mkdir()
    assert model_folder("demo") == Path("demo"), "a folder here comes first"
    with pytest.raises(LearningError, match="found 'dema'; no such folder"):
        model_folder("dema")


def test_a_model_of_a_web_address_is_copied_once(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = model_folder(f"{address}/mine/")
    assert folder == Path("models/mine")
    assert (folder / "model.safetensors").read_text() == "model.safetensors of mine"
    assert not (folder / "model.onnx").exists()
    (folder / "card.md").write_text("mine")
    assert model_folder(f"{address}/mine") == folder
    assert (folder / "card.md").read_text() == "mine", "it is there, so it is not read again"
    with pytest.raises(LearningError, match=r"half/config\.yaml: cannot be read: FileNotFound"):
        model_folder(f"{address}/half")
    with pytest.raises(LearningError, match="found another model than http"):
        model_folder(f"{address}/other/mine")
    assert [path.name for path in Path("models").iterdir()] == ["mine"]
