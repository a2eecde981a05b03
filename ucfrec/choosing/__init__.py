"""Which decision rule is best for what users would do; each choice is a `RuleChoice`."""
