"""What can be asked of an estimate from logs, beside the policy and the logs."""

from dataclasses import dataclass

from ucfrec.errors import InputError


@dataclass(frozen=True)
class EstimateOptions:
    """How `evaluate_off_policy` estimates.

    Raises:
        InputError: a value is out of its range, or two contradict each other.
    """

    discount: float = 1.0
    """Discount factor γ of the estimated returns, in (0, 1]."""
    pages: bool = False
    """Estimate the return of a page: sessions of one step, of one user within 10 ms, are the
    positions of a page (`ucfrec.off_policy.pages`)."""
    users_known: bool = True
    """Whether the logs' users are persons, whose sessions are resampled together; if not, each
    session is taken to be somebody else's."""
    reward_range: tuple[float, float] | None = None
    """Least and greatest reward of a step, for the bounds of what unsupported choices could earn;
    None for those observed."""
    wanted_lift: float | None = None
    """Return a session that a launch should gain over the logged policy; None for 5% of the mean
    logged return."""
    item_clusters: int = 0
    """Clusters of items for MIPS; 0 chooses by the size of the catalogue, 1 leaves MIPS out."""
    estimate_propensities: bool = False
    """Estimate the propensities that the logs lack, cross-fitted and calibrated."""

    def __post_init__(self) -> None:
        if not 0 < self.discount <= 1:
            raise InputError(f"discount is {self.discount}; it is above 0 and at most 1")
        if self.reward_range is not None and not self.reward_range[0] <= self.reward_range[1]:
            low, high = self.reward_range
            raise InputError(f"the reward range is {low} to {high}; name the least one first")
        if self.wanted_lift is not None and not self.wanted_lift > 0:
            raise InputError(f"the lift to find is {self.wanted_lift}; it is above 0")
        if self.item_clusters < 0:
            raise InputError(f"item clusters are {self.item_clusters}; use 0 for the default")
