"""Cost of recording on this machine, compared with other stores.

Written to `docs/results/recording.md`.
"""
