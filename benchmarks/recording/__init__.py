"""What recording costs on this machine, beside what others' stores cost.

Written to `docs/results/recording.md`.
"""
