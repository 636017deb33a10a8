"""Cyclic garbage is collected only at suitable moments."""

import gc
import weakref
from collections.abc import Iterator

import pytest

from rig.core.clock import SECOND_NS
from rig.core.realtime import Sweeper


class Node:
    def __init__(self) -> None:
        self.itself = self


@pytest.fixture(autouse=True)
def collection_off() -> Iterator[None]:
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def test_a_cycle_is_collected_once_it_is_time_and_what_is_in_use_stays() -> None:
    sweeper = Sweeper(every=5.0)
    assert sweeper.sweep(0)
    used, left = Node(), weakref.ref(Node())
    assert not sweeper.sweep(4 * SECOND_NS)
    assert left() is not None
    reference = weakref.ref(used)
    assert sweeper.sweep(5 * SECOND_NS)
    assert left() is None
    assert reference() is used
