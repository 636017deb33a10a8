"""The session that every command of `tactile session` works on."""

import argparse
from pathlib import Path

from recorder.store.files import is_url


def add_session(parser: argparse.ArgumentParser, *, remote: bool = False) -> None:
    """Add the session: a folder, or with `remote` also a URL."""
    forms = "a directory NAME.zarr" + (" or a URL, e.g. s3://bucket/NAME.zarr" * remote)
    parse = _path_or_url if remote else _directory
    parser.add_argument("session", type=parse, help=f"the session, {forms}")


def _path_or_url(text: str) -> str | Path:
    return text if is_url(text) else Path(text)


def _directory(text: str) -> Path:
    if is_url(text):
        raise argparse.ArgumentTypeError(f"{text}: remote stores are only read; copy it here first")
    return Path(text)
