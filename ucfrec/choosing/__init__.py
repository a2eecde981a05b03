"""Which decision rule is best for what users would do: `choose_rule` returns a `RuleChoice`."""
