"""Monitoring page of a collection; its separate process can only read and send requests."""
