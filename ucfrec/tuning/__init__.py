"""The search for the settings of a training, on validation rows."""
