"""Fixtures of the recorder's tests."""

from pathlib import Path

import pytest
from support.sessions import make_session


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished session with a camera; must not be changed."""
    return make_session(tmp_path_factory.mktemp("recorded") / "s.zarr")
