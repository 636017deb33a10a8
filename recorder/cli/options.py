"""The session that every command of `tactile session` works on."""

import argparse
from pathlib import Path

from recorder.store.files import is_url


def add_session(parser: argparse.ArgumentParser, *, remote: bool = False) -> None:
    """Add the session: a folder, or with `remote` also a URL."""
    forms = "a directory NAME.zarr" + (" or a URL, e.g. s3://bucket/NAME.zarr" * remote)

    def parse(text: str) -> str | Path:
        if not is_url(text):
            return Path(text)
        if not remote:
            raise argparse.ArgumentTypeError(
                f"{text}: remote stores are only read; copy it here first"
            )
        return text

    parser.add_argument("session", type=parse, help=f"the session, {forms}")
