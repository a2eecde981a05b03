"""What the data is: store, windows, states, returns-to-go."""
