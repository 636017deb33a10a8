"""Programs that measure the product and write the pages of docs/results.

Run from the repository.
"""
