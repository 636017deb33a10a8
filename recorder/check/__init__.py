"""Looks for everything that can be wrong with a session or an archive."""
