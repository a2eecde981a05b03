"""Every sequence policy: UCF and the baselines."""
