"""The CIRS exit rule against a plain reading of it."""

import numpy as np
import pytest

from tests.support.real_data import data_folder
from tests.support.single_session import check_environment
from ucfrec.acting.rollout import rollout
from ucfrec_simulators.taobao.cirs import SIMULATOR, CirsTaobao

pytestmark = pytest.mark.realdata


def test_exits_and_observations_agree_with_a_plain_reading() -> None:
    check_environment(CirsTaobao(data_folder("virtualtaobao")))
    env = CirsTaobao(data_folder("virtualtaobao"), 8, max_turn=12)
    first, _ = env.reset(seed=0)
    rng = np.random.default_rng(1)
    played: list[list[np.ndarray]] = [[] for _ in range(8)]
    bored_ends = capped_ends = 0
    assert (first[:, :88].sum(axis=1) == 11).all()
    for _ in range(60):
        actions = rng.uniform(-0.92, 0.92, (8, 27)).astype(np.float32)
        after, clicks, terminated, truncated, info = env.step(actions)
        for row, before in enumerate(played):
            bored = any(np.linalg.norm(actions[row] - a) <= 3.0 for a in before[-4:])
            before.append(actions[row])
            capped = len(before) >= 12 and not bored
            assert (terminated[row], truncated[row]) == (bored, capped)
            seen = info["final_obs"][row] if bored or capped else after[row]
            assert not seen[:88].any()
            np.testing.assert_array_equal(seen[88:115], actions[row])
            assert (seen[115], seen[117]) == (clicks[row], len(before))
            if bored or capped:
                assert after[row, :88].sum() == 11
                assert not after[row, 88:].any()
                before.clear()
            bored_ends, capped_ends = bored_ends + bored, capped_ends + capped
    assert min(bored_ends, capped_ends) > 5


def test_a_constant_policy_bores_on_its_second_page() -> None:
    env = SIMULATOR.make(64, data_folder("virtualtaobao"))
    actors = (SIMULATOR.behaviors[name](env, 0) for name in ("zero", "random"))
    zero, random = (rollout(env, actor, 100, 0).lengths for actor in actors)
    assert (zero == 2).all()
    assert 10 < random.mean() <= 50
