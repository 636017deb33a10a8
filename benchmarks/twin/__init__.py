"""Twins of planted sensors: what a fit finds of skins that are known."""
