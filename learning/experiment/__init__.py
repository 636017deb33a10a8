"""A whole experiment in one command: translate, train, compensate and evaluate, pair by pair."""
