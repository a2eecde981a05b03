"""Files: atomic writing, checksums, locks, Parquet, remote folders."""
