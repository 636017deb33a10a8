"""Readers of a shared record see complete records in order, and survive a dead writer."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from rig.core.shared_memory import AwaitedRecord, SharedLatest

PAIR = np.dtype([("a", "<i8"), ("value", "<f8", (40,))])


def test_the_latest_record_is_read_whole(tmp_path: Path) -> None:
    writer = SharedLatest.create(tmp_path / "x", PAIR)
    reader = SharedLatest.attach(tmp_path / "x", PAIR)
    assert reader.read() is None
    for k in range(30):
        writer.write((k, np.full(40, k)))
        found = reader.read()
        assert found is not None
        assert reader.count == k + 1
        assert int(found["a"]) == k
        assert (found["value"] == k).all()
    reader.close()
    writer.close()
    writer.close()


def test_a_reader_never_sees_half_a_record_of_a_busy_writer(tmp_path: Path) -> None:
    path = tmp_path / "x"
    writer = SharedLatest.create(path, PAIR)
    code = textwrap.dedent(
        f"""
        import sys
        import numpy as np
        from pathlib import Path
        from rig.core.shared_memory import AwaitedRecord, SharedLatest
        dtype = np.dtype([("a", "<i8"), ("value", "<f8", (40,))])
        record = SharedLatest.attach(Path({str(path)!r}), dtype, writable=True)
        k = 0
        while True:
            k += 1
            record.write((k, np.full(40, k)))
        """
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    try:
        while writer.count == 0:
            assert process.poll() is None
        last = 0
        for _ in range(20_000):
            found = writer.read()
            assert found is not None
            assert (found["value"] == found["a"]).all()
            assert int(found["a"]) >= last
            last = int(found["a"])
    finally:
        process.kill()
        process.wait()
    # If killed anywhere in a write, the previous record stays readable.
    found = writer.read()
    assert found is not None
    assert (found["value"] == found["a"]).all()
    writer.close()


def test_a_writer_that_starts_after_its_readers_leaves_their_mapping_alone(tmp_path: Path) -> None:
    path = tmp_path / "x"
    SharedLatest.create(path, PAIR).close()
    reader = SharedLatest.attach(path, PAIR)
    with pytest.raises(FileExistsError):
        SharedLatest.create(path, PAIR)
    writer = SharedLatest.publish(path, PAIR)
    writer.write((7, np.zeros(40)))
    found = reader.read()
    assert found is not None
    assert int(found["a"]) == 7
    fresh = SharedLatest.publish(tmp_path / "y", PAIR)
    assert fresh.count == 0


def test_a_file_of_another_layout_is_refused(tmp_path: Path) -> None:
    SharedLatest.create(tmp_path / "x", PAIR).close()
    with pytest.raises(ValueError, match="expected"):
        SharedLatest.attach(tmp_path / "x", np.dtype([("a", "<i8", (100,))]))


def test_a_reader_gets_every_record_since_its_last_look(tmp_path: Path) -> None:
    writer = SharedLatest.create(tmp_path / "x", PAIR, 64)
    reader = AwaitedRecord(tmp_path / "x", PAIR)
    assert reader.unread() is None
    for k in range(5):
        writer.write((k, np.full(40, k)))
    first = reader.unread()
    assert first is not None
    assert first["a"].tolist() == [4], "what came before the first look is not the reader's"
    for k in range(5, 25):
        writer.write((k, np.full(40, k)))
    unread = reader.unread()
    assert unread is not None
    assert unread["a"].tolist() == list(range(5, 25))
    assert (unread["value"] == unread["a"][:, None]).all()
    again = reader.unread()
    assert again is not None
    assert again["a"].tolist() == [24]
    assert reader.missed == 0


def test_records_that_were_overwritten_before_a_look_are_counted(tmp_path: Path) -> None:
    writer = SharedLatest.create(tmp_path / "x", PAIR, 8)
    reader = AwaitedRecord(tmp_path / "x", PAIR)
    writer.write((0, np.zeros(40)))
    reader.unread()
    for k in range(1, 21):
        writer.write((k, np.full(40, k)))
    unread = reader.unread()
    assert unread is not None
    assert unread["a"].tolist() == list(range(14, 21))
    assert reader.missed == 13
    writer.write((21, np.zeros(40)))
    assert reader.unread() is not None
    assert reader.missed == 0
