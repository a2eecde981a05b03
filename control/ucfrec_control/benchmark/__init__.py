"""Tables of every method on the control files."""
