"""The choice of the decision rule: candidates, their evaluation, the rule that is kept."""
