"""Checks of sessions and archives for every known problem."""
