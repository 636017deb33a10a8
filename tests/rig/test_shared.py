"""Readers of a shared record see complete records in order, and survive a dead writer."""

import itertools
import multiprocessing
from pathlib import Path

import numpy as np
import pytest
from support.waiting import until

from rig.core.shared_memory import AwaitedRecord, SharedLatest

PAIR = np.dtype([("a", "<i8"), ("value", "<f8", (40,))])


def writes(path: Path) -> None:
    record = SharedLatest.attach(path, PAIR, writable=True)
    for k in itertools.count(1):
        record.write((k, np.full(40, k)))


def test_a_reader_never_sees_half_a_record_of_a_busy_writer(tmp_path: Path) -> None:
    writer = SharedLatest.create(tmp_path / "x", PAIR)
    process = multiprocessing.get_context("spawn").Process(target=writes, args=(tmp_path / "x",))
    process.start()
    try:
        until(lambda: writer.count or not process.is_alive())
        last = 0
        for _ in range(20_000):
            found = writer.read()
            assert found is not None
            assert (found["value"] == found["a"]).all()
            assert int(found["a"]) >= last
            last = int(found["a"])
    finally:
        process.kill()
        process.join()
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
    with pytest.raises(ValueError, match="expected"):
        SharedLatest.attach(path, np.dtype([("a", "<i8", (100,))]))
    assert reader.read() is None
    writer = SharedLatest.publish(path, PAIR)
    for k in range(30):
        writer.write((k, np.full(40, k)))
        found = reader.read()
        assert found is not None
        assert (int(found["a"]), reader.count) == (k, k + 1)
    reader.close()
    writer.close()
    writer.close()
    assert SharedLatest.publish(tmp_path / "y", PAIR).count == 0


@pytest.mark.parametrize(
    ("places", "written", "unread", "missed"),
    [(64, 20, list(range(1, 21)), 0), (8, 20, list(range(14, 21)), 13)],
    ids=["all", "more than there are places for"],
)
def test_a_reader_gets_every_record_since_its_last_look_or_the_number_of_those_it_missed(
    places: int, written: int, unread: list[int], missed: int, tmp_path: Path
) -> None:
    writer = SharedLatest.create(tmp_path / "x", PAIR, places)
    reader = AwaitedRecord(tmp_path / "x", PAIR)

    def look() -> list[int] | None:
        records = reader.unread()
        if records is None:
            return None
        assert (records["value"] == records["a"][:, None]).all()
        return records["a"].tolist()

    assert look() is None
    for k in (-1, 0):
        writer.write((k, np.full(40, k)))
    assert look() == [0], "what came before the first look is not the reader's"
    for k in range(1, written + 1):
        writer.write((k, np.full(40, k)))
    assert (look(), reader.missed) == (unread, missed)
    assert (look(), reader.missed) == ([written], 0)
    writer.write((-2, np.full(40, -2)))
    assert (look(), reader.missed) == ([-2], 0)
