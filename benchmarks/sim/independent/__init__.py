"""Presses solved by other means than `sim`, to hold `sim` against.

Only the table that compares (`comparison`) and its command import it.
"""
