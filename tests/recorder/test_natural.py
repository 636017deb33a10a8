"""Natural sort order of names."""

from recorder.natural_order import natural_key


def test_natural_order_counts_numbers() -> None:
    names = ["b", "image_10", "image_2", "image_2b", "10", "9"]
    assert sorted(names, key=natural_key) == ["9", "10", "b", "image_2", "image_2b", "image_10"]
