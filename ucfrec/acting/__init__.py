"""A trained policy acts, session by session."""
