"""The causal reward model, the state generators and the edited copies."""
