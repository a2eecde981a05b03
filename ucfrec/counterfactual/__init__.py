"""The causal reward model, the state generators and the augmented episodes."""
