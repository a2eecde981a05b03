"""The command line of the control adapter: one file a command."""
