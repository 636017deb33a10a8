"""Presses solved by other means than `sim`, to hold `sim` against: nothing here imports it but the
table that compares (`comparison`)."""
