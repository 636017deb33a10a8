"""Presses solved by methods independent of `sim`, to verify `sim`.

Only `comparison` and the command import `sim`.
"""
