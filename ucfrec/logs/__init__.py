"""Turn logs into episodes: files, mapping, cleaning, sessions, item embeddings, store."""
