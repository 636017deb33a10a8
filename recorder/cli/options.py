"""The session that every command of `tactile session` works on."""

from __future__ import annotations

import argparse
from pathlib import Path

from recorder.store.files import is_url


def add_session(parser: argparse.ArgumentParser, *, remote: bool = False) -> None:
    """Add the session: a folder, or with `remote` also a URL."""
    where = "a directory NAME.zarr" + (" or a URL, e.g. s3://bucket/NAME.zarr" * remote)
    place = _place if remote else _directory
    parser.add_argument("session", type=place, help=f"the session, {where}")


def _place(text: str) -> str | Path:
    return text if is_url(text) else Path(text)


def _directory(text: str) -> Path:
    if is_url(text):
        raise argparse.ArgumentTypeError(f"{text}: remote stores are only read; copy it here first")
    return Path(text)
