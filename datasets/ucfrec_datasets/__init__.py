"""File and column mappings of the datasets of `ucfrec prepare --dataset NAME`."""
