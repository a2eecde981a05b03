"""Training, screening and judging on a control store."""
