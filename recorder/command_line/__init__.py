"""What the commands of all packages share: errors and exit codes, options, extras.

Imports only the standard library, so that help is fast; see docs/decisions/0029.
"""
