"""`tactile card`: describe a session, a marker archive or a model on one page of the same form."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from recorder.command_line.errors import CommandError

# Number of findings of a check that a card lists.
SHOWN = 10
MODEL = "model.safetensors"


class Card(NamedTuple):
    """Content of a card: texts and rows, none of them specific to a kind."""

    name: str
    kind: str
    about: list[tuple[str, str]]
    """Nature and origin: pairs of a name and a value."""
    head: tuple[str, ...]
    """Names of the columns of `parts`."""
    parts: Sequence[tuple[str, ...]]
    """Streams, sensors or inputs."""
    checks: list[str]
    """Results of a check, or measured errors."""
    limits: list[str]
    """Uses that it does not serve."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Writes a card for people who get the data: what it is, its parts, its origin, the result "
        "of its check, and its limits. Printed, or written to --out."
    )
    parser.add_argument("path", type=Path, help="session, marker archive, or folder of a model")
    parser.add_argument("--out", type=Path, metavar="FILE", help="page to write (Markdown)")


def run(options: argparse.Namespace) -> int:
    """Write or print the card; return the exit code.

    Raises:
        CommandError: The path holds nothing that has a card.
    """
    text = page(options.path)
    if options.out is None:
        print(text, end="")
    else:
        options.out.write_text(text)
        print(f"{options.out}: card of {options.path}")
    return 0


def page(path: Path) -> str:
    """Return the card of a path as Markdown.

    Raises:
        CommandError: The path holds nothing that has a card.
        SessionError: The session or the archive cannot be read.
        LearningError: The folder of a model cannot be read.
    """
    from recorder.pages import render

    if (path / MODEL).is_file():
        card = _of_model(path)
    elif path.name.rstrip("/").endswith(".markers.zarr"):
        card = _of_archive(path)
    elif (path / "zarr.json").is_file():
        card = _of_session(path)
    else:
        raise CommandError(
            f"{path}: found nothing that has a card; allowed: a session, a marker archive "
            f"NAME.markers.zarr, or a folder with {MODEL}"
        )
    return render(Path(__file__).with_suffix(".md"), **card._asdict())


def _findings(path: Path) -> list[str]:
    from recorder import check

    found = [" ".join(str(finding).split()) for finding in check(path)]
    more = [f"and {len(found) - SHOWN} more"] if len(found) > SHOWN else []
    return [*found[:SHOWN], *more] or ["`tactile session check` finds nothing"]


def _of_session(path: Path) -> Card:
    from recorder import Session

    session = Session(path)
    attrs = session.attrs
    frames = session.frames
    rows = len(frames["t_ns"])
    valid = float(frames["valid"][:].mean()) if rows else 0.0
    mock = bool(attrs.get("mock"))
    about = [
        ("sensor", str(attrs.get("sensor"))),
        ("indenter", str(attrs.get("indenter"))),
        ("recorded", f"{attrs.get('started_utc', 'unknown')} by {attrs.get('operator') or '?'}"),
        ("devices", "emulators of a mock bench" if mock else "those of a lab bench"),
        ("status", session.status),
        ("rows", f"{rows} at {session.rate_hz:g} Hz, {100 * valid:.1f} % valid"),
        ("software", _software(attrs.get("software", {}))),
        ("format", f"{attrs.get('format')} {attrs.get('format_version')}"),
    ]
    parts = [
        (name, str(stream.attrs.get("kind", "")), str(len(stream)))
        for name, stream in session.streams.items()
    ]
    limits = []
    if mock:
        limits.append("Images and forces are those of an emulated sensor, not of a real one.")
    if "force" not in session.streams:
        limits.append("It has no force gauge, so no labels.")
    if not attrs.get("calibration"):
        limits.append("The camera's latency and the surface were not calibrated.")
    return Card(
        path.name, "recorded session", about, ("stream", "kind", "rows"), parts,
        _findings(path), limits,
    )  # fmt: skip


def _of_archive(path: Path) -> Card:
    from recorder import MarkerArchive

    archive = MarkerArchive(path)
    attrs = archive.attrs
    simulated = str(attrs.get("made_from", "")) not in ("sessions", "genforce")
    about = [
        ("made from", str(attrs.get("made_from", "unknown"))),
        ("sensors", ", ".join(archive)),
        ("status", archive.status),
        ("format", f"{attrs.get('format')} {attrs.get('format_version')}"),
    ]
    parts = []
    for name, sensor in archive.items():
        table = sensor.table
        pressed = sorted({archive.indenters[k] for k in set(table["indenter"][:].tolist())})
        parts.append((name, str(len(table["valid"])), ", ".join(pressed)))
    limits = ["Marker masks, not images: colour and shading are not in it."]
    if simulated:
        limits.append("Forces and images are simulated.")
    return Card(
        path.name, "marker archive", about, ("sensor", "frames", "indenters"), parts,
        _findings(path), limits,
    )  # fmt: skip


def _of_model(path: Path) -> Card:
    from learning.training.checkpoint import read_model_folder

    config = read_model_folder(path).config
    metadata = config.metadata
    size = (path / MODEL).stat().st_size
    about = [
        ("kind", config.kind),
        ("sensors", ", ".join(map(str, metadata.get("sensors", []))) or "see the settings"),
        ("training data", f"fingerprint {config.data}"),
        ("software", f"tactile-rig {config.code_version}"),
        ("weights", f"{size / 1e6:.1f} MB, {MODEL}"),
    ]
    parts = [(name, _short(value)) for name, value in config.settings.items()]
    score = "not measured" if config.score is None else f"{config.score:.4g}, lower is better"
    checks = [f"validation score: {score}"]
    if (path / "intervals.json").is_file():
        checks.append("intervals of 90 %: `intervals.json`, explained in `card.md`")
    limits = [
        "It holds for the sensor, camera, light and depths of its training data.",
        "Contacts unlike the indenters of the training may have larger errors than measured.",
    ]
    return Card(
        path.name, f"{config.kind} model", about, ("setting", "value"), parts, checks, limits
    )


def _software(versions: Mapping[str, Any]) -> str:
    named = ("tactile-rig", "python", "zarr")
    return ", ".join(f"{name} {versions[name]}" for name in named if name in versions) or "unknown"


def _short(value: Any, most: int = 100) -> str:
    text = str(value).replace("|", "\\|")
    return text if len(text) <= most else f"{text[:most]} ..."
