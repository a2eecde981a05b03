"""Learners by name."""

from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.bc import BCPolicy
from ucfrec.policies.cdt4rec import CDT4RecPolicy
from ucfrec.policies.crm_greedy import CRMGreedyPolicy
from ucfrec.policies.dc import DCPolicy
from ucfrec.policies.dt import DTPolicy
from ucfrec.policies.dt4rec import DT4RecPolicy
from ucfrec.policies.edt4rec import EDT4RecPolicy
from ucfrec.policies.item_knn import ItemKNNPolicy
from ucfrec.policies.lsdt import LSDTPolicy
from ucfrec.policies.popular import PopularPolicy
from ucfrec.policies.sasrec import SASRecPolicy
from ucfrec.policies.ucf import UCFPolicy

POLICIES: dict[str, type[SequencePolicy]] = {
    "ucf": UCFPolicy,
    "dt": DTPolicy,
    "dc": DCPolicy,
    "lsdt": LSDTPolicy,
    "dt4rec": DT4RecPolicy,
    "cdt4rec": CDT4RecPolicy,
    "edt4rec": EDT4RecPolicy,
    "sasrec": SASRecPolicy,
    "bc": BCPolicy,
    "popular": PopularPolicy,
    "item-knn": ItemKNNPolicy,
    "crm-greedy": CRMGreedyPolicy,
}
"""Learners by the name that `--policy` takes."""
