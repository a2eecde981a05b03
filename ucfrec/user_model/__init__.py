"""What users would do: the reward of every item, session ends, fatigue, simulated sessions."""
