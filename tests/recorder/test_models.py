"""Models that people can take: index, hashes, and names of a folder or web address."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from recorder import models
from recorder.errors import SessionError


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with two published models."""
    for name in ("one", "two"):
        folder = tmp_path / "runs" / name
        (folder / "inside").mkdir(parents=True)
        (folder / "card.md").write_text(f"A net called {name}\n")
        (folder / "inside" / "model.onnx").write_bytes(name.encode() * 100)
        models.add(folder, tmp_path / "place", name, licence="Apache-2.0", text=f"net {name}")
    return tmp_path / "place"


@pytest.fixture
def address(place: Path) -> Iterator[str]:
    """The same place as a web address."""
    handler = partial(SimpleHTTPRequestHandler, directory=str(place))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def test_models_are_taken_from_a_folder_and_from_an_address(
    place: Path, address: str, tmp_path: Path
) -> None:
    assert models.listed(place) == models.listed(address)
    for number, where in enumerate((place, address)):
        folder = models.get("two", where, tmp_path / f"own{number}")
        assert (folder / "inside" / "model.onnx").read_bytes() == b"two" * 100
        # Taking it again checks what is there.
        assert models.get("two", where, tmp_path / f"own{number}") == folder
        (folder / "card.md").write_text("another text")
        with pytest.raises(SessionError, match=r"card\.md: found SHA-256"):
            models.get("two", where, tmp_path / f"own{number}")
        assert [path.name for path in folder.parent.iterdir()] == ["two"]


def test_a_changed_or_missing_file_is_not_taken(place: Path, tmp_path: Path) -> None:
    (place / "one" / "card.md").write_text("A net called 0ne\n")
    with pytest.raises(SessionError, match=r"card\.md: found SHA-256"):
        models.get("one", place, tmp_path / "own")
    (place / "one" / "card.md").write_text("A net called one, and more\n")
    with pytest.raises(SessionError, match="found more than"):
        models.get("one", place, tmp_path / "own")
    (place / "one" / "card.md").unlink()
    with pytest.raises(SessionError, match=r"card\.md: cannot be read"):
        models.get("one", place, tmp_path / "own")
    assert not [*(tmp_path / "own").iterdir()]
    with pytest.raises(SessionError, match="no model 'three'; known: one, two"):
        models.get("three", place, tmp_path / "own")


@pytest.mark.parametrize(
    ("key", "value", "error"),
    [
        ("path", "../../etc/passwd", "leaves the model's folder"),
        ("path", "/etc/passwd", "leaves the model's folder"),
        ("sha256", "beef", "SHA-256"),
        ("bytes", -1, "size -1"),
    ],
)
def test_a_hostile_index_is_refused(place: Path, key: str, value: object, error: str) -> None:
    content = json.loads((place / models.INDEX).read_text())
    content["models"][0]["files"][0][key] = value
    (place / models.INDEX).write_text(json.dumps(content))
    with pytest.raises(SessionError, match=error):
        models.listed(place)
    content["models"][0]["name"] = "../one"
    (place / models.INDEX).write_text(json.dumps(content))
    with pytest.raises(SessionError, match="name: found"):
        models.listed(place)


def test_a_name_is_a_path_or_an_own_model_or_the_one_in_use(place: Path, tmp_path: Path) -> None:
    own = tmp_path / "own"
    assert models.find("two", own) is None
    assert models.find(None, own) is None
    with pytest.raises(SessionError, match="no model of that name"):
        models.use("two", own)
    models.get("two", place, own)
    assert models.use("two", own) == models.find("two", own) == models.find(None, own)
    assert models.find(str(place / "one"), own) == place / "one"
    assert models.find("../own/two", own) is None


def test_the_installed_models_have_their_hashes_and_are_small() -> None:
    place = models.packaged()
    size = 0
    for model in models.listed(place):
        models.require_same(model, place / model.name)
        size += sum(file.bytes for file in model.files)
        assert {"card.md", "config.yaml", "model.onnx", "model.safetensors"} <= {
            file.path for file in model.files
        }
    assert models.find("demo") == place / "demo"
    assert size < 2e6
