"""Datasets that `ucfrec prepare --dataset NAME` knows: what their files and columns mean."""
