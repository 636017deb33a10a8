"""Natural sort order of names."""

import pytest

from recorder.natural_order import natural_key, naturally_sorted


def test_natural_order_counts_numbers() -> None:
    names = ["b", "image_10", "image_2", "image_2b", "10", "9"]
    assert sorted(names, key=natural_key) == ["9", "10", "b", "image_2", "image_2b", "image_10"]


@pytest.mark.parametrize(
    "names",
    [
        ["d.0.png", "d.05.png", "d.1.png", "d.15.png", "d.2.png"],
        ["0.1mm", "0.15mm", "0.2mm", "1.0mm", "10.5mm"],
        ["f.1", "f.2", "f.9", "f.10", "f.11"],
        ["f.01", "f.99", "f.100", "f.101"],
        ["1.9.1", "1.10.1", "1.10.12"],
    ],
)
def test_numbers_after_a_point_are_decimals_unless_they_count(names: list[str]) -> None:
    assert naturally_sorted(names[::-1], str) == names
