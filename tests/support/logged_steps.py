"""Random logged steps, and the reference inputs of the Open Bandit Pipeline and SCOPE-RL: of sb-obp
0.5.10 and scope-rl 0.2.1, which need packages older than ours; the script that made them:
`git show 9733b2b8:tests/off_policy/fixtures/make_obp_fixture.py`."""

from pathlib import Path

import numpy as np

from ucfrec.arrays import Array, Float32Array, Float64Array, IntArray
from ucfrec.off_policy.logged_steps import LoggedSteps, Modelled
from ucfrec.off_policy.models import fit_models

REFERENCE = Path(__file__).parents[1] / "off_policy" / "fixtures" / "reference.npz"


def random_steps(
    lengths: list[int], seed: int = 0, modelled: bool = True, discount: float = 1.0
) -> LoggedSteps:
    rng = np.random.default_rng(seed)
    n = sum(lengths)
    session, reward = np.repeat(np.arange(len(lengths)), lengths), rng.normal(size=n)
    propensity, target = rng.uniform(0.05, 1, n), rng.uniform(0, 1, n) * (rng.random(n) < 0.9)
    model = Modelled(*rng.normal(size=(3, n)), np.zeros(n)) if modelled else None
    return LoggedSteps(session, reward, propensity, target, model=model, discount=discount)


def steps_of(reward: Float64Array, session: IntArray, user: IntArray | None = None) -> LoggedSteps:
    return LoggedSteps(session, reward, np.ones(len(reward)), np.ones(len(reward)), user=user)


def fitted(
    features: Float32Array,
    at_policy: Float32Array,
    reward: Float64Array,
    session: IntArray,
    seed: int = 0,
    user: IntArray | None = None,
) -> Modelled:
    """What models say of steps whose features are in memory."""
    steps = steps_of(reward, session, user)
    return fit_models(lambda: iter([(features, at_policy)]), steps, seed)[0]


def reference(name: str) -> tuple[LoggedSteps, dict[str, Array]]:
    """The inputs "bandit" or "sequence" as logged steps, and what the references make of them."""
    with np.load(REFERENCE) as files:
        given = {key: files[key] for key in files.files}
    shared = {key: given[key] for key in ("gamma", "lambdas", *(k for k in given if "λ" in k))}
    ours = {k.removeprefix(f"{name} "): v for k, v in given.items() if k.startswith(f"{name} ")}
    row, action, q = np.arange(len(ours["reward"])), ours["action"], ours["q"]
    v = (ours["target"] * q).sum(axis=1)
    length = 1 if name == "bandit" else 5
    own = {"discount": float(given["gamma"])}
    if name == "bandit":
        own = {}
    own["model"] = Modelled(reward=v, q=q[row, action], v=v, logged_reward=q[row, action])
    chosen = (ours[policy][row, action] for policy in ("behavior", "target"))
    return LoggedSteps(row // length, ours["reward"], *chosen, **own), ours | shared
