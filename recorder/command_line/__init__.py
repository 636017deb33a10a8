"""Errors, exit codes, options and extras that the commands of all packages share.

Imports only the standard library, so that help is fast; see docs/decisions/0029.
"""
