"""The exported graph gives torch's scores, and what `recommend` shows."""

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor, nn

from tests.recommending.test_responder import answered, recommended
from tests.support.logs import store_of
from tests.support.served import (
    FULL,
    OBSERVED,
    SETTINGS,
    boredom,
    histories,
    learn_interests,
    learn_tastes,
    observed_log,
    requests_of,
    responder,
    trained_run,
)
from tests.support.tagged import tagged_log
from ucfrec import Recommender
from ucfrec.acting.decision import DecisionRule, best_items
from ucfrec.commands.cli import main
from ucfrec.episodes.offers import Offers
from ucfrec.episodes.windows import Sessions
from ucfrec.errors import InputError
from ucfrec.logs.mapping import LogMapping
from ucfrec.recommending.export import (
    DESCRIPTION,
    GRAPH,
    OUTPUTS,
    _run_graph,
    compile_scores,
    export,
    find_best,
    measure_magnitude,
    require_close,
    start_runner,
    write_graph,
)
from ucfrec.recommending.histories import histories_of_frame
from ucfrec.recommending.responder import ONNXRUNTIME, Responder
from ucfrec.runs.trained_policy import TrainedPolicy

onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicy:
    """A run whose items have no tags."""
    folder, options = tmp_path_factory.mktemp("plain"), {"gap_minutes": 120, "embedding_size": 6}
    store = store_of(tagged_log(), folder, reward="reward", session_by="gap", **options)
    Recommender("dt", settings=SETTINGS).fit(store, folder / "run")
    return TrainedPolicy.load(folder / "run")


def ranked(folder: Path, trained: TrainedPolicy, log: pd.DataFrame, at: int | None) -> pd.DataFrame:
    """What the graph recommends, from the log and the description alone."""
    description = json.loads((folder / DESCRIPTION).read_text())
    length = next(i["shape"][1] for i in description["inputs"] if i["name"] == "items")
    context = trained.policy.config.context
    item_of = {item: n for n, item in enumerate(description["item_ids"])}
    user_of = {user: n for n, user in enumerate(description["user_ids"])}
    rows: dict[str, list[Any]] = {entry["name"]: [] for entry in description["inputs"]}
    users = []
    mapping = OBSERVED if "observation" in log else LogMapping()
    for batch in histories_of_frame(trained, log, mapping):
        latest = batch.latest_session(description["session_gap_ms"])
        for number, user in enumerate(batch.users):
            own = latest.owner == number
            items = [item_of[item] for item in latest.item_ids[own].tolist()]
            rewards = latest.rewards[own].tolist()
            missing = max(0, length - len(items))
            rows["items"].append([-1] * missing + items[-length:])
            rows["rewards"].append([0.0] * missing + rewards[-length:])
            rows["steps"].append(len(items))
            rows["collected"].append(sum(rewards))
            rows["users"].append(user_of.get(user, -1))
            trained_rows = latest.timestamps[own] <= (description["trained_until"] or 0)
            rows["trained_steps"].append(trained_rows.sum() * (user in user_of))
            seen = [item_of[item] for item in batch.seen_ids[batch.seen_owner == number].tolist()]
            rows["excluded"].append(seen + [-1] * (60 - len(seen)))
            if "observations" in rows:
                rows["observations"].append([batch.observations[number]] * context)
            rows.get("times", []).append(at)
            users.append(user)
    dtypes = {entry["name"]: entry["dtype"] for entry in description["inputs"]}
    given = {name: np.asarray(values, dtypes[name]) for name, values in rows.items()}
    session = onnxruntime.InferenceSession(str(folder / GRAPH))
    found = dict(zip(OUTPUTS, session.run(list(OUTPUTS), given), strict=True))
    frames = []
    for user, best, values in zip(users, found["top_items"], found["top_scores"], strict=True):
        kept = best >= 0
        ids = [description["item_ids"][n] for n in best[kept]]
        frame = {"rank": range(1, len(ids) + 1), "item_id": ids, "score": values[kept]}
        frames.append(pd.DataFrame({"user_id": user, **frame}))
    return pd.concat(frames, ignore_index=True)


def agree(
    folder: Path, trained: TrainedPolicy, log: pd.DataFrame, rule: DecisionRule, at: Any = None
) -> None:
    """The graph recommends what the policy does."""
    expected = recommended(trained, log, 20, rule=rule, at=at)
    found = ranked(folder, trained, log, at)
    expected = expected[[*found.columns]]  # a graph says nothing of draws
    pd.testing.assert_frame_equal(found, expected, check_dtype=False, rtol=1e-4, atol=1e-4)


AHEAD = DecisionRule(3.0, reward_weight=4.0, policy_weight=0.5, lookahead=2.0)


@pytest.mark.slow
@pytest.mark.parametrize(("tags", "rule"), [(True, replace(FULL, tag_run=2)), (False, AHEAD)])
def test_the_graph_recommends_what_the_policy_does(
    trained: TrainedPolicy, plain: TrainedPolicy, tmp_path: Path, tags: bool, rule: DecisionRule
) -> None:
    given = trained if tags else plain
    given = replace(given, session_end=boredom(given.reward_model.likeness))  # type: ignore[union-attr]
    given = replace(given, reward_model=copy.deepcopy(given.reward_model))
    log = histories()
    (learn_tastes(given) if tags else learn_interests(given, int(log.timestamp.median())))
    # Several sessions and one are compared with torch in there.
    assert export(given, tmp_path / "out", rule=rule, k=20).difference <= 1e-5
    for some in (log, log[log.user_id == log.user_id.min()]):
        agree(tmp_path / "out", given, some, rule)


def test_a_graph_has_observations(observing: TrainedPolicy, tmp_path: Path) -> None:
    rule = DecisionRule(3.0, 1.0, reward_weight=0.7)
    export(observing, tmp_path / "out", rule=rule, k=20)
    agree(tmp_path / "out", observing, observed_log(histories()), rule)


def test_a_graph_knows_what_is_on_offer_and_how_old(ending: TrainedPolicy, tmp_path: Path) -> None:
    log, n, model = histories(), np.arange(1, 24), copy.deepcopy(ending.reward_model)
    model.running, model.latest = nn.Buffer(torch.linspace(-1, 1, 6)), nn.Buffer(torch.randn(4, 24))
    end, hour = int(log.timestamp.max()), 3_600_000
    once, again = np.stack([n, end - 24 * n * hour, end + n * hour]), np.stack([n, n, n])[:, :5]
    again[1:] += np.array([[30], [90]]) * hour + end  # the first five return
    offers = Offers.of(24, np.hstack([once, again]), np.zeros((2, 0), np.int64))
    given = replace(ending, reward_model=model, offers=offers)
    export(given, tmp_path / "out", rule=AHEAD, k=20)
    for hours in (6, 12, 40):
        agree(tmp_path / "out", given, log, AHEAD, end + hours * hour)


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example of a plug-in, as pip installs it."""
    plugin = Path(__file__).parents[2] / "examples" / "plugin"
    info = tmp_path / "site" / "ucfrec_gru-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: ucfrec-gru\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text("[ucfrec.policies]\ngru = ucfrec_gru:GRUPolicy\n")
    monkeypatch.syspath_prepend(str(plugin))
    monkeypatch.syspath_prepend(str(info.parent))


@pytest.mark.slow
@pytest.mark.usefixtures("example")
def test_the_graph_of_a_recurrent_plug_in_has_its_scores(tmp_path: Path) -> None:
    store = store_of(tagged_log(), tmp_path, reward="reward", session_by="gap", embedding_size=6)
    settings = [*SETTINGS, "policy.context=12", "policy.layers=2"]
    Recommender("gru", settings=settings).fit(store, tmp_path / "run")
    given, log = TrainedPolicy.load(tmp_path / "run"), histories()
    rule = DecisionRule(3.0)
    assert export(given, tmp_path / "out", rule=rule, k=20).difference <= 1e-5
    # Alone, a session has less padding before it than in a graph or beside a longer session.
    for users in (log.user_id.unique(), *([user] for user in log.user_id.unique()[:3])):
        some = log[log.user_id.isin(users)].groupby("user_id").tail(3)
        agree(tmp_path / "out", given, some, rule)


def test_the_command_writes_it_whole_or_not_at_all(
    trained: TrainedPolicy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["export", str(trained.folder), "--onnx", str(out), "--k", "25"]) == 2
    assert "--k is 25; the run has 24 items: give a whole" in capsys.readouterr().err
    assert not out.exists()


_SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("gsasrec", "recent-rate")]


@pytest.mark.parametrize("name", ["sasrec", *_SLOW])
def test_peers_are_exported(tmp_path: Path, name: str) -> None:
    trained = trained_run(tmp_path, name)
    written = export(trained, tmp_path / "out", k=5)
    assert written.difference <= 1e-5
    description = json.loads((tmp_path / "out" / DESCRIPTION).read_text())
    assert description["files"] == [GRAPH]
    # What is done by the graph, and what is left to the caller.
    assert [name for name in description["rule"] if name not in description["rule_notes"]] == []


@pytest.mark.parametrize("name", ["item-knn", "boosted"])
def test_what_scores_items_in_its_own_way_is_refused(tmp_path: Path, name: str) -> None:
    trained = trained_run(tmp_path, name)
    with pytest.raises(InputError, match=rf"'{name}.*cannot be exported; train"):
        export(trained, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match=rf"{name}.*use --engine torch"):
        responder(trained, engine=ONNXRUNTIME)


class _Best(nn.Module):
    def forward(self, scores: Tensor) -> tuple[Tensor, Tensor]:
        return find_best(scores, 9)


def test_the_graph_finds_the_best_in_the_order_of_recommend(tmp_path: Path) -> None:
    scores = torch.randn(4, 1000, generator=torch.Generator().manual_seed(0))
    scores[1], scores[2, 5:] = -torch.inf, -torch.inf
    scores[3] = (scores[3] / 2).round()  # many are equal
    write_graph(_Best(), {"scores": scores}, tmp_path / GRAPH, ["best", "values"], "", "")
    best, values = _run_graph(start_runner(tmp_path / GRAPH), {"scores": scores})
    assert best.tolist()[::3] == best_items(scores[::3], 9).tolist()
    expected = scores[0].log_softmax(-1).topk(9)
    torch.testing.assert_close(torch.from_numpy(values[0]), expected.values)
    assert best[1].tolist() == [-1] * 9
    assert sorted(best[2].tolist()) == [-1] * 4 + [0, 1, 2, 3, 4]


# onnxruntime answers a request that comes alone as torch does.


@pytest.fixture(scope="module")
def ending(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicy:
    trained = trained_run(tmp_path_factory.mktemp("scores"))
    learn_interests(trained)
    return replace(trained, session_end=boredom(trained.reward_model.likeness))


@pytest.fixture(scope="module")
def fast(ending: TrainedPolicy) -> Responder:
    return responder(ending, rule=replace(FULL, lookahead=2.0), k=24, engine=ONNXRUNTIME)


def test_a_lookahead_over_items_that_come_and_go_is_refused(ending: TrainedPolicy) -> None:
    model = copy.deepcopy(ending.reward_model)
    model.running = nn.Buffer(torch.ones(6))
    scorer = replace(ending, reward_model=model).item_scorer(AHEAD)
    with pytest.raises(InputError, match=r"a lookahead depends on the time, .* --engine torch"):
        compile_scores(scorer, "ucf")


def test_lists_by_marginal_gain_are_not_exported(ending: TrainedPolicy, tmp_path: Path) -> None:
    rule = replace(AHEAD, by_marginal_gain=True)
    with pytest.raises(InputError, match=r"marginal gain, and has lookahead .* set the lookahead"):
        export(ending, tmp_path / "out", rule=rule)
    model = copy.deepcopy(ending.reward_model)
    model.above.fill_(-1.0)
    with pytest.raises(InputError, match=r"marginal gain, which a graph cannot; use `ucfrec serve"):
        export(replace(ending, reward_model=model), tmp_path, rule=replace(rule, lookahead=0.0))


@pytest.mark.slow
def test_answers_are_those_of_torch(
    ending: TrainedPolicy, fast: Responder, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = [*requests_of(histories()), {"user_id": "new", "request_id": "1"}]
    graph, alone = fast._chooser.scorer.engine, []

    def counted(sessions: Sessions, excluded: Tensor) -> Any:
        alone.append(len(sessions.users))
        return graph(sessions, excluded)

    monkeypatch.setattr(fast._chooser.scorer, "engine", counted)
    expected = answered(responder(ending, rule=fast.rule, k=24), asked)
    one_by_one = pd.concat([answered(fast, [each]) for each in asked], ignore_index=True)
    pd.testing.assert_frame_equal(one_by_one, expected, rtol=1e-5, atol=1e-5)
    assert alone == [1] * len(asked)
    pd.testing.assert_frame_equal(answered(fast, asked), expected, rtol=1e-5, atol=1e-5)
    assert len(alone) == len(asked)


def test_graphs_differ_by_the_rounding_of_what_is_added(ending: TrainedPolicy) -> None:
    rule = replace(ending.rule, reward_weight=32.0, lookahead=4.8)
    assert measure_magnitude(ending.scorer(rule)) == pytest.approx(32 * 5.8)
    assert measure_magnitude(ending.scorer(replace(rule, reward_weight=0.0, lookahead=0.0))) == 1.0
    ours, theirs = torch.tensor([0.0]), np.float32([1.5e-5])
    assert require_close([(theirs, ours)], "", 185.6) < 1e-6
    with pytest.raises(InputError, match="differs from torch's"):
        require_close([(theirs, ours)], "", 1.0)
