"""onnxruntime answers a request that comes alone as torch does."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor

from tests.recommending.test_responder import answered
from tests.support.served import (
    FULL,
    boredom,
    histories,
    learn_tastes,
    requests_of,
    responder,
    trained_run,
)
from ucfrec.episodes.windows import Sessions
from ucfrec.errors import InputError
from ucfrec.recommending.export_graph import measure_magnitude, require_close
from ucfrec.recommending.responder import ONNXRUNTIME, Responder
from ucfrec.runs.trained_policy import TrainedPolicy

pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicy:
    trained = trained_run(tmp_path_factory.mktemp("scores"))
    learn_tastes(trained)
    assert trained.reward_model is not None
    return replace(trained, session_end=boredom(trained.reward_model.likeness))


@pytest.fixture(scope="module")
def fast(trained: TrainedPolicy) -> Responder:
    return responder(trained, rule=replace(FULL, lookahead=2.0), k=24, engine=ONNXRUNTIME)


@pytest.mark.slow
def test_answers_are_those_of_torch(
    trained: TrainedPolicy, fast: Responder, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = [*requests_of(histories()), {"user_id": "new", "request_id": "1"}]
    graph, alone = fast._chooser.scorer._engine, []

    def counted(sessions: Sessions, excluded: Tensor) -> Any:
        alone.append(len(sessions.users))
        assert graph is not None
        return graph(sessions, excluded)

    monkeypatch.setattr(fast._chooser.scorer, "_engine", counted)
    expected = answered(responder(trained, rule=fast.rule, k=24), asked)
    one_by_one = pd.concat([answered(fast, [each]) for each in asked], ignore_index=True)
    pd.testing.assert_frame_equal(one_by_one, expected, rtol=1e-5, atol=1e-5)
    assert alone == [1] * len(asked)
    pd.testing.assert_frame_equal(answered(fast, asked), expected, rtol=1e-5, atol=1e-5)
    assert len(alone) == len(asked)


@pytest.mark.slow
def test_the_run_s_own_scorer_stays_as_it_is(trained: TrainedPolicy, fast: Responder) -> None:
    assert trained.scorer(fast.rule)._engine is None


def test_graphs_differ_by_the_rounding_of_what_is_added(trained: TrainedPolicy) -> None:
    rule = replace(trained.rule, reward_weight=32.0, lookahead=4.8)
    assert measure_magnitude(trained.scorer(rule)) == pytest.approx(32 * 5.8)
    assert measure_magnitude(trained.scorer(replace(rule, lookahead=0.0))) == 32.0
    assert measure_magnitude(trained.scorer(replace(rule, reward_weight=0.0, lookahead=0.0))) == 1.0
    ours, theirs = torch.tensor([0.0]), np.float32([1.5e-5])
    assert require_close([theirs], [ours], "", 185.6) < 1e-6
    with pytest.raises(InputError, match="differs from torch's"):
        require_close([theirs], [ours], "", 1.0)


def test_policies_that_score_in_their_own_way_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"item-knn.*use --engine torch"):
        responder(trained_run(tmp_path, "item-knn"), engine=ONNXRUNTIME)


def test_an_unknown_engine_is_refused(trained: TrainedPolicy) -> None:
    with pytest.raises(InputError, match="give one of torch, onnxruntime"):
        responder(trained, engine="gpu")
