"""The paper's kinds of figures, from stored results."""
