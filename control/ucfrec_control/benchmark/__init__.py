"""Tables of every learner on the control files."""
