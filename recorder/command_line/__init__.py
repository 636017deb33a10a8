"""Command line of all packages: the table of commands, and one way to run and end them.

Imports only the standard library, so that help is fast; see docs/decisions/0029.
"""
