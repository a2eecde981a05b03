"""The recommendation benchmark: Table 2 of the paper, ablations, sweeps and a distractor."""
