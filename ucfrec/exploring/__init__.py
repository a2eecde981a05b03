"""A page on which a policy is tried out: what it recommends to whom, and why."""
