"""Result rows: what was measured, its numbers and their origin, and files of such rows."""
