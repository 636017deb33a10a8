"""An address of its own for each test of a device."""

import itertools
import os

import pytest

_numbers = itertools.count()


@pytest.fixture
def host() -> str:
    """Return a loopback address that no other test of this process has."""
    number = next(_numbers)
    return f"127.{1 + os.getpid() % 250}.{10 + number // 250}.{1 + number % 250}"
