"""Twins of planted sensors: fits of skins that are known."""
