"""The episode store, its windows, states and returns-to-go."""
