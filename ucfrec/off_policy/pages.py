"""Pages: sessions whose steps are positions of one page, chosen at once.

The return of a page under another policy depends on how its positions influence each other, and the
weights follow from what is assumed (McInerney, Brost, Chandar, Mehrotra & Carterette,
*Counterfactual Evaluation of Slate Recommendations with Sequential Reward Interactions*, KDD 2020):

| model of the reward at a position | depends on the items at | weight | estimates |
|---|---|---|---|
| independent | this position | ρ_it | IIPS, SNIIPS (Li et al., KDD 2018) |
| cascade | this position and those before it | w_it = Π_{k ≤ t} ρ_ik | PDIS (their RIPS), SNPDIS |
| slate | all positions | w_i = Π_k ρ_ik | IPS, SNIPS |

Each model contains the one above it: a weaker assumption, and heavier weights.
"""

from dataclasses import replace

import numpy as np

from ucfrec.arrays import Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.off_policy.logged_steps import LoggedSteps

_LEAST_RATIO = 1e-12
"""Mean ratio of a position below which nothing is divided by it."""
PAGE_MS = 10
"""Most milliseconds between rows of one page: Open Bandit writes its positions one by one."""


def as_pages(steps: LoggedSteps, page: IntArray, position: IntArray | None = None) -> LoggedSteps:
    """Sessions of one step each, put together to pages.

    The evaluated policy chooses each position without knowing what the others got; its probability
    of a page is the product of those of the positions. A model of the steps' reward stays: in DR it
    is a control variate, whose errors the weights correct.

    Args:
        steps: sessions of one step.
        page: (N,) whose equal numbers mark one page.
        position: (N,) by which the steps of a page are ordered, the cascade's first in front; None
            for the order of the steps.

    Returns:
        A session a page, in order of the numbers of `page`, each of the user of its first step.

    Raises:
        InputError: a session has several steps, or `page` has another shape.
    """
    if len(steps.first) < len(steps.session):
        raise InputError(
            f"only {len(steps.first):,} sessions for {len(steps.session):,} steps: pages are made "
            "of sessions of one step; prepare the logs with one session a row"
        )
    if page.shape != steps.session.shape:
        raise InputError(f"page has shape {page.shape} for {len(steps.session):,} steps")
    places = np.zeros(len(page)) if position is None else position
    order = np.lexsort((places, page))
    number = np.unique(page[order], return_inverse=True)[1]
    first = np.flatnonzero(np.diff(number, prepend=-1))
    user = None if steps.user is None else steps.user[order][first]
    return replace(steps.regroup(order, number, user), pages=True)


def number_pages(user: IntArray, time: IntArray) -> IntArray:
    """(N,) number of the page of each step: of one user, each row within 10 ms of the one before.

    Args:
        user: (N,) whose step it is.
        time: (N,) ms.
    """
    order = np.lexsort((time, user))
    begins = (np.diff(user[order], prepend=-1) != 0) | (np.diff(time[order], prepend=0) > PAGE_MS)
    page = np.empty(len(order), dtype=np.int64)
    page[order] = np.cumsum(begins) - 1
    return page


def independent_terms(steps: LoggedSteps) -> dict[str, tuple[Float64Array, Float64Array]]:
    """Of each estimator under the independent model: the terms (S,) whose mean is the estimate, and
    what each page counts (S,), its mean ratio. Propensities of all steps are known."""
    ratios = steps.target / steps.propensity
    rewards = steps.discounts * ratios * steps.reward
    counts = steps.per_session(ratios) / steps.lengths
    terms = {"IIPS": (steps.per_session(rewards), counts)}
    # Means over pages, by position, of ρ, of ρ r γ^t over it, and of there being such a position.
    pages = len(steps.first)
    below = np.bincount(steps.step, ratios) / pages
    if (below > _LEAST_RATIO).all():
        mean = np.bincount(steps.step, rewards) / pages / below
        positions = np.bincount(steps.step) / pages
        # The estimate Σ_t positions_t mean_t, plus each page's influence on it.
        beyond = (steps.discounts * steps.reward - mean[steps.step]) * ratios
        influence = (positions / below)[steps.step] * beyond + mean[steps.step]
        terms["SNIIPS"] = (steps.per_session(influence), counts)
    return terms
