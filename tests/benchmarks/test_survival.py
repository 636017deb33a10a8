"""The benchmark that kills programs finds nothing lost, and finds what was lost."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from random import Random

import pytest

from benchmarks.faults import survival
from recorder import Session, SessionError


def test_a_chain_of_kills_loses_nothing(tmp_path: Path) -> None:
    killed: Counter[str] = Counter()
    accepted = survival._chain(tmp_path, Random(1), killed)
    assert accepted > 0
    assert sum(killed.values()) >= 1
    assert Session(tmp_path / "s.zarr").status in ("recovered", "complete")


def test_a_missing_or_changed_row_is_a_failure(tmp_path: Path) -> None:
    accepted = survival.mmap.mmap(-1, 16)
    survival._create(tmp_path / "s.zarr")
    survival._write(tmp_path / "s.zarr", accepted, limit=3)
    survival._look(tmp_path / "s.zarr", accepted, "writing")
    accepted[8:16] = (1000).to_bytes(8, "little")
    with pytest.raises(survival.Loss, match="force: 1000 rows accepted, 48 found"):
        survival._look(tmp_path / "s.zarr", accepted, "writing")
    wrong: list[str] = []

    def lost(_: Path) -> int:
        raise SessionError("gone")

    assert survival._in_scratch(lost, wrong) == 0
    assert wrong == ["gone"]
