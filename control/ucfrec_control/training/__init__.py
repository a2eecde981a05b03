"""Training, screening and evaluation on a control store."""
