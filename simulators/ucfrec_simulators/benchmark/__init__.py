"""The recommendation benchmark: methods of the paper's Table 2, ablations, sweeps, a distractor."""
