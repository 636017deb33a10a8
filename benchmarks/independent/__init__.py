"""Presses solved by methods independent of `sim`, to verify `sim`.

Only the comparison table (`comparison`) and its command import `sim`.
"""
