"""The recommendation benchmark: Table 2 of the paper, its ablations, sweeps and the distractor."""
