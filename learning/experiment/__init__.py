"""A whole experiment in one command: translate, train, compensate, evaluate, pair by pair."""
