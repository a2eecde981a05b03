"""Other learners, each a sequence policy on the same store, loop and rollout."""
