"""What users would do: `UserModel` has the reward of every item, session ends and fatigue."""
