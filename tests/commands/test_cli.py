"""The command line as a stranger meets it: small logs, real commands, clear refusals."""

import json
import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from safetensors.numpy import load_file

from tests.support.markdown import ROOT
from ucfrec import Recommender
from ucfrec.acting.rollout import rollout
from ucfrec.commands.cli import UCFREC, explanation, main, parse_command
from ucfrec.commands.train import settings_text
from ucfrec.evaluation.collect import collect_store
from ucfrec.evaluation.simulator import Environment
from ucfrec.files.atomic import write_json
from ucfrec.logs.join import join_feedback
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.off_policy.ab_test import compare_arms
from ucfrec.plugins import load_plugin
from ucfrec.results.rows import ResultRow, ResultTable, latest, read_results
from ucfrec.runs.config import settings_given
from ucfrec.runs.promoted import promote
from ucfrec.runs.record import verify_run
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.tuning.space import Search
from ucfrec.tuning.study import Plan, tune

Capsys = pytest.CaptureFixture[str]
Catalog = tuple[str, Path]

TINY = [
    "train.steps=40",
    "train.validate_every=20",
    "policy.dim=16",
    "policy.context=5",
    "crm.epochs=1",
    "csg.epochs=1",
]


def settings(*more: str) -> list[str]:
    return [argument for setting in (*TINY, *more) for argument in ("--set", setting)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of both kinds, their stores, and a run on the catalogue."""
    folder = tmp_path_factory.mktemp("cli")
    for environment in ("synthetic-taobao", "synthetic-catalog"):
        logs, store = folder / f"{environment}-logs", folder / f"{environment}-store"
        assert main(["collect", "--env", environment, "--sessions", "300", "--out", str(logs)]) == 0
        sessions = str(logs / "sessions.parquet")
        feedback = load_plugin("simulators", environment).feedback
        assert main(["prepare", sessions, "--out", str(store), "--reward", feedback]) == 0
    trained_on(folder, "synthetic-catalog")
    return folder


def trained_on(folder: Path, environment: str) -> str:
    """The run on one of the stores."""
    run, store = str(folder / f"{environment}-run"), str(folder / f"{environment}-store")
    assert main(["train", store, "--out", run, *settings()]) == 0
    return run


def refused(arguments: list[str], capsys: Capsys) -> str:
    """The one line that a refused command prints."""
    capsys.readouterr()
    assert main(arguments) == 2
    printed = capsys.readouterr().err.strip()
    assert "\n" not in printed
    return printed


@pytest.mark.parametrize("command", UCFREC.commands)
def test_help_fits_a_screen(command: str, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    printed = {}
    for word in ("--help", "--help-all"):
        with pytest.raises(SystemExit):
            main([command, word])
        printed[word] = capsys.readouterr().out
    assert len(printed["--help"].splitlines()) <= 30
    listed, described = (set(re.findall(r"--[a-z-]+[a-z]", text)) for text in printed.values())
    assert listed <= described | {"--help-all"}


@pytest.mark.parametrize(
    "line",
    [
        "ope run --json F logs",
        "ope --json F run logs",
        "rank run --k 3 logs",
        "recommend --k 3 run --out F logs",
        "score run --out F logs",
        "evaluate run --env E logs",
        "report run --out F logs",
        "prepare --out F run --reward r logs",
    ],
)
def test_options_stand_anywhere(line: str) -> None:
    words = line.split()
    options = vars(parse_command(UCFREC, words)[1])
    named = [options.get("run"), *options.get("runs", []), *options.get("logs", [])]
    assert [str(one) for one in named if one is not None] == ["run", "logs"]
    assert "F" in map(str, options.values()) or options.get("k") == 3 or options["env"] == "E"
    for wrong in ("--no-such-option", "--memory=800MB"):  # --memory-limit is not abbreviated
        with pytest.raises(SystemExit):
            parse_command(UCFREC, [*words, wrong])


@pytest.fixture(scope="module")
def catalog(folder: Path) -> Catalog:
    """The catalogue's run and its logs."""
    return str(folder / "synthetic-catalog-run"), folder / "synthetic-catalog-logs/sessions.parquet"


def save(table: ResultTable | pd.DataFrame) -> None:
    """Write what the Python API returns as the command of its name does."""
    if isinstance(table, pd.DataFrame):
        table.to_parquet("out")
    else:
        table.save("out")


STORE, LATER, SHOWN = "synthetic-catalog-store", "later.parquet", "shown.parquet"
MEASURED = ROOT / "benchmarks" / "results" / "recommendation.jsonl"
ALIKE: dict[str, tuple[str, Callable[[Recommender], object]]] = {
    "prepare": (
        "prepare later.parquet --out out --reward is_click --session-by gap --gap-minutes 7",
        lambda _: prepare(
            [LATER],
            LogMapping(),
            Path("out"),
            PrepareOptions(reward="is_click", session_by="gap", gap_minutes=7),
        ),
    ),
    "train": (
        f"train {STORE} --out out {' '.join(settings())}",
        lambda _: Recommender(settings=TINY).fit(STORE, "out", refit=True),
    ),
    "rank": ("rank run later.parquet --seed 2 --json out", lambda p: save(p.rank(LATER, seed=2))),
    "ope": ("ope run later.parquet --seed 2 --json out", lambda p: save(p.ope(LATER, seed=2))),
    "evaluate": (
        "evaluate run --env synthetic-catalog --episodes 20 --behavior random --seed 2 --json out",
        lambda p: save(p.evaluate("synthetic-catalog", 20, behaviors="random", seed=2)),
    ),
    "recommend": (
        "recommend run later.parquet --out out",
        lambda p: save(p.recommend(pd.read_parquet(LATER))),
    ),
    "score": ("score run later.parquet --out out", lambda p: save(p.score(LATER))),
    "update": ("update run newer.parquet --out out", lambda p: p.update("newer.parquet", "out")),
    "export": ("export run --onnx out --k 7", lambda p: p.export("out", 7)),
    "report": ("report run --out out", lambda p: p.report("out")),
    "collect": (
        "collect --env synthetic-catalog --sessions 30 --seed 3 --out new/logs",
        lambda _: (
            collect_store(Environment("synthetic-catalog"), Path("new"), 30, 3),
            shutil.rmtree("new/store"),
        ),
    ),
    "settings": (
        "settings --policy dt",
        lambda _: print(settings_text("dt", shutil.get_terminal_size().columns)),
    ),
    "promote": ("promote run --force", lambda _: promote(Path("run"), force=True)),
    "join": (
        f"join {SHOWN} {LATER} --within 1h --out out",
        lambda _: join_feedback([SHOWN], [LATER], Path("out"), 3_600_000),
    ),
    "compare": (
        f"compare {SHOWN} --column propensity --json out",
        lambda _: write_json(Path("out"), asdict(compare_arms([SHOWN], "propensity"))),
    ),
    "tune": (
        f"tune {STORE} --out out --policy dt --metric ndcg --trials 1 {' '.join(settings())}",
        lambda _: tune(
            Plan(Path(STORE), Path("out"), Search(("dt",), settings_given(TINY), False, 0), "ndcg"),
            trials=1,
        ),
    ),
    "verify": ("verify run", lambda _: verify_run(Path("run"))),
    "benchmark": (
        f"benchmark recommendation --show-only --table sweeps --results {MEASURED}",
        lambda _: print(
            load_plugin("benchmarks", "recommendation")
            .tables["sweeps"]
            .show([row for row in latest(read_results(MEASURED)) if row.table == "sweeps"])
        ),
    ),
}
"""Command line, and what does the same in Python."""
ELSEWHERE = {
    "demo": "commands/test_demo.py",
    "serve": "recommending/test_web.py",
    "explore": "exploring/test_explain.py",
    "datasets": "datasets/test_movielens.py",
}
"""Files of tests that compare other commands with Python."""
SLOW = ("train", "rank", "update", "export", "tune")


@pytest.mark.parametrize(
    "command",
    [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in ALIKE],
)
def test_a_command_does_what_the_python_api_does(
    folder: Path,
    catalog: Catalog,
    command: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capsys,
) -> None:
    """The same numbers and files, model cards of the run too."""
    arguments, function = ALIKE[command]
    log = pd.read_parquet(catalog[1])
    shown = log[["user_id", "item_id", "timestamp"]].head(300)
    shown = shown.assign(request_id=shown.index.astype(str), position=1, run="r", rule="d")
    shown["propensity"] = np.linspace(0.1, 0.9, len(shown))
    shown["arm"] = np.where(shown.index % 2, "a", "b")
    written, printed = [], []
    for place in ("the command", "api"):
        shutil.copytree(catalog[0], tmp_path / place / "run")
        shutil.copytree(folder / STORE, tmp_path / place / STORE)
        monkeypatch.chdir(tmp_path / place)
        log.head(400).to_parquet(LATER)
        shown.to_parquet(SHOWN)
        log.assign(timestamp=log.timestamp + 10**9).head(600).to_parquet("newer.parquet")
        capsys.readouterr()
        if place == "the command":
            assert main(arguments.split()) == 0
        else:
            function(Recommender.load("run"))
        printed.append(capsys.readouterr().out)
        files = [path for path in Path().rglob("*") if path.is_file() and STORE not in str(path)]
        written.append({str(path): _content(path) for path in files if "tfevents" not in path.name})
    for hint in re.findall(r"(?:next: | {6})(ucfrec .*?)(?:, |$)", printed[0], re.MULTILINE):
        parse_command(UCFREC, shlex.split(hint)[1:])
    assert written[0].keys() == written[1].keys()
    for name, content in written[0].items():
        if isinstance(content, pd.DataFrame):
            pd.testing.assert_frame_equal(content, written[1][name], check_dtype=False)
        else:
            assert content == written[1][name], name
    if command in ("settings", "benchmark"):
        assert printed[0] == printed[1]


def test_every_command_is_compared_with_python() -> None:
    assert {*ALIKE, *ELSEWHERE} == {*UCFREC.commands}
    assert all((ROOT / "tests" / file).is_file() for file in ELSEWHERE.values())


def _content(path: Path) -> object:
    """What two runs of the same write alike."""
    if path.suffix == ".safetensors":
        return {name: tensor.tobytes() for name, tensor in load_file(path).items()}
    if path.read_bytes()[:4] == b"PAR1":
        return pd.read_parquet(path).drop(columns="request_id", errors="ignore")
    if path.suffix in (".npy", ".onnx"):
        return path.read_bytes()
    if path.name == "out":
        text = path.read_text()
        return _numbers(path) if text.startswith("[") else text
    return path.read_text() if path.suffix == ".md" else None


def _numbers(file: Path) -> list[dict[str, object]]:
    """Result rows as texts, without what differs between two runs of a command."""
    rows = json.loads(file.read_text())
    for row in rows:
        row.get("details", {}).pop("candidate", None)
    passing = ("command", "wall_time_s")
    return [{n: repr(value) for n, value in row.items() if n not in passing} for row in rows]


def estimate(
    arguments: str, log: pd.DataFrame | Path, folder: Path, capsys: Capsys
) -> tuple[dict[str, ResultRow], str]:
    """Rows by estimator, and what is printed, of `ope RUN LOG OPTIONS`."""
    if isinstance(log, pd.DataFrame):
        log.to_parquet(log_file := folder / "log.parquet")
        log = log_file
    run, *options = arguments.split()
    capsys.readouterr()
    assert main(["ope", run, str(log), *options, "--json", str(folder / "rows.json")]) == 0
    rows = [row for row in read_results(folder / "rows.json") if row.metric == "R_cum"]
    rows = {row.method: row for row in rows}
    return rows, capsys.readouterr().out


def collect_at_random(folder: Path, sessions: int, seed: int = 0) -> Path:
    words = f"collect --env synthetic-catalog --behavior random --sessions {sessions} --seed {seed}"
    assert main([*words.split(), "--out", str(folder / "logs")]) == 0
    return folder / "logs" / "sessions.parquet"


@pytest.mark.parametrize("temperature", [1, 0])
def test_ope(catalog: Catalog, temperature: int, tmp_path: Path, capsys: Capsys) -> None:
    run, logs = catalog
    arguments = f"{run} --temperature {temperature} --seed 3 --details"
    rows, printed = estimate(arguments, logs, tmp_path, capsys)
    weighted = set(rows) - {"logged", "DM", "FQE"}
    assert weighted or not temperature
    assert not weighted or {"IPS", "SNIPS", "PDIS", "SNPDIS", "DR", "SNDR"} <= weighted
    log = pd.read_parquet(logs)
    assert rows["logged"]["R_cum"] == pytest.approx(log.is_click.sum() / 300)
    # Their error is the model's, which no resampling of sessions shows.
    assert rows["DM"]["R_cum_low"] is rows["FQE"]["R_cum_high"] is None
    assert re.search(r"^DM .* –  ", printed, re.MULTILINE)
    # These are the logs that the run was trained on, and it says so.
    logged = rows["logged"]
    assert all(line in printed for line in logged.details["warnings"])
    assert logged["seen_in_training"] > 0.8
    assert "of the rows were seen in training" in logged.details["warnings"][0]
    assert logged.details["reliable"] is False
    assert re.match(r"the log cannot say: \d+% of the rows were seen in training", printed)
    assert not re.search(r"^(?!logged).*\d \[", printed.partition("sessions\n")[2], re.MULTILINE)


def test_ope_agrees_with_rollouts(catalog: Catalog, tmp_path: Path, capsys: Capsys) -> None:
    arguments = f"{catalog[0]} --temperature 2.5 --reward-weight 0"
    rows, _ = estimate(arguments, collect_at_random(tmp_path, 3000), tmp_path, capsys)
    trained = TrainedPolicy.load(Path(catalog[0]))
    actor = trained.actor(512, replace(trained.rule, temperature=2.5, reward_weight=0.0))
    env = Environment("synthetic-catalog", None).simulator().make(512, None)
    returns = rollout(env, actor, 4000, seed=0).returns
    truth, error = returns.mean(), returns.std() / 4000**0.5
    assert abs(truth - rows["logged"]["R_cum"]) > 2 * error
    for name in ("IPS", "SNIPS", "PDIS", "DR"):
        row = rows[name]
        assert row["R_cum_low"] - 2 * error < truth < row["R_cum_high"] + 2 * error, name
    errors = [rows[name]["R_cum_error"] for name in ("DR", "PDIS", "IPS")]
    assert errors == sorted(errors)
    assert rows["DR"]["overlap"] == pytest.approx(1, abs=0.05)
    # Simulated clocks are coarse: a few users are shown the same item at the same time.
    assert 0 < rows["DR"]["seen_in_training"] < 0.05
    assert rows["DR"].details["reliable"]


def test_model_card(catalog: Catalog, tmp_path: Path) -> None:
    shutil.copytree(catalog[0], tmp_path / "run")
    run, logs = str(tmp_path / "run"), str(tmp_path / "sessions.parquet")
    log, card = pd.read_parquet(catalog[1]), tmp_path / "run" / "MODEL_CARD.md"
    log[log.session_id < 100].to_parquet(logs)
    trained = card.read_text()
    assert "# Model card: ucf" in trained
    assert "| reward | `is_click` |" in trained
    environment = ["--env", "synthetic-catalog", "--episodes", "20"]
    assert main(["evaluate", run, *environment]) == 0
    assert main(["ope", run, logs, "--temperature", "1"]) == 0
    for rule in ([], ["--temperature", "3", "--target", "q0.5"]):
        assert main(["rank", run, logs, "--k", "5", *rule]) == 0
    found = card.read_text()
    assert "### ucfrec evaluate: synthetic-catalog, target " in found
    assert re.search(r"### ucfrec ope: REG on sessions\.parquet, target .*temperature 1", found)
    assert "- the log cannot say: " in found
    own = TrainedPolicy.load(Path(run)).rule
    median = TrainedPolicy.load(Path(run)).target_return(0.5)
    for rule in (own, replace(own, temperature=3.0, target=median)):
        assert f"### ucfrec rank: sessions.parquet, {rule}, k 5, checkpoint best" in found
    assert re.search(r"\| hit_rate_liked \| [\d.]+ \[[\d.]+, [\d.]+\] \|", found)
    assert str(tmp_path) not in found


def test_ope_ranks_rules(catalog: Catalog, tmp_path: Path, capsys: Capsys) -> None:
    run, logs = catalog[0], collect_at_random(tmp_path, 1500, seed=7)
    arguments = f"{run} --targets q0.5,6 --temperatures 2,0 --reward-weight 0"
    _, printed = estimate(arguments, logs, tmp_path, capsys)
    rows = read_results(tmp_path / "rows.json")
    names = list(dict.fromkeys(row.details["candidate"] for row in rows))
    assert len(names) == 4
    assert names[-1] == "target return 6, temperature 0"
    ranked = {row.details["candidate"]: row for row in rows if "rank" in row.metrics}
    assert ranked
    # A policy that always shows one item agrees with hardly any whole random session.
    assert not any("temperature 0" in name for name in ranked)
    assert "target return 6, temperature 0: the log cannot say: " in printed
    first = min(ranked.values(), key=lambda row: row["rank"])
    assert f"choice: {first.details['selection']}" in printed
    assert sum(row["probability_best"] for row in ranked.values()) == pytest.approx(1)
    assert all(row["band_low"] < row["band_high"] for row in ranked.values())
    for more, says in (
        ([run, "--targets", "5,much"], "--targets: 'much' is not a number"),
        ([run, "--temperatures", "1,hot"], "is not a number; write e.g. 0,0.5,1"),
        ([run, "--target", "much"], "--target: 'much' is not a number; write e.g. 5 or q0.9"),
        ([], "name a run folder"),
    ):
        assert says in refused(["ope", *more, str(logs)], capsys)
    # Without logs, the test split of the run's store.
    assert main(["ope", run, "--targets", "q0.5,6", "--details"]) == 0
    assert "test split of " in capsys.readouterr().out


def test_missing_propensities(catalog: Catalog, tmp_path: Path, capsys: Capsys) -> None:
    run, log = catalog[0], pd.read_parquet(catalog[1])
    without = pd.concat([log, log.tail(2).assign(item_id=987654)]).drop(columns="propensity")
    rows, printed = estimate(f"{run} --temperature 1", without, tmp_path, capsys)
    assert [*rows] == ["logged", "DM", "FQE"]
    assert "overlap" not in rows["logged"].metrics
    assert "no session has all its propensities" in printed
    assert "note: 2 rows show items" in printed
    assert rows["logged"]["unknown_item_rows"] == 2
    hole = log.assign(propensity=log.propensity.where(log.index != 5))
    rows, printed = estimate(f"{run} --temperature 1", hole, tmp_path, capsys)
    assert {"DR", "SNPDIS"} <= rows.keys()
    assert rows["logged"]["sessions_without_propensity"] == 1
    assert "note: 1 of 300 sessions have a step without propensity" in printed


def test_estimated_propensities(catalog: Catalog, tmp_path: Path, capsys: Capsys) -> None:
    run, log = catalog[0], pd.read_parquet(catalog[1]).drop(columns="propensity")
    arguments = f"{run} --estimate-propensities --temperature 1"
    rows, printed = estimate(f"{arguments} --lift 0.5", log, tmp_path, capsys)
    assert {"IPS", "DR"} <= set(rows)
    assert f"with the propensities of {len(log):,} steps estimated (held-out loss" in printed
    assert rows["DR"].details["declared"].startswith("with the propensities of")
    assert rows["DR"]["wanted_lift"] == 0.5


def test_score_and_ope_refuse(
    folder: Path, catalog: Catalog, tmp_path: Path, capsys: Capsys
) -> None:
    run, logs = catalog
    out, blind = str(tmp_path / "out"), str(tmp_path / "blind.parquet")
    pd.read_parquet(logs).drop(columns="observation").to_parquet(blind)
    vectors = str(tmp_path / "vectors")
    store = str(folder / "synthetic-taobao-store")
    assert main(["train", store, "--out", vectors, "--policy", "bc", *settings()]) == 0
    for command, to in (("score", "--out"), ("ope", "--json")):
        assert "observations of 16 numbers" in refused([command, run, blind, to, out], capsys)
        assert "are vectors" in refused([command, vectors, str(logs), to, out], capsys)
    assert not (tmp_path / "out").exists()


def test_a_run_of_another_store_is_refused(folder: Path, capsys: Capsys) -> None:
    run = str(folder / "synthetic-catalog-run")
    other = str(folder / "synthetic-taobao-store")
    assert "another store" in refused(["train", other, "--out", run, *settings()], capsys)
    store = str(folder / "synthetic-catalog-store")
    assert main(["train", store, "--out", run, *settings()]) == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("train nowhere --out run", "nowhere is not an episode store"),
        ("evaluate nowhere --env synthetic-taobao", "nowhere is not a run folder"),
        ("evaluate --env synthetic-taobao", "name a run folder"),
        ("evaluate --env taobao --behavior random", "no simulator is called"),
        ("evaluate --env synthetic-taobao --behavior best", "it has .*optimal"),
        ("prepare nowhere.parquet --out store", "nowhere.parquet does not exist"),
        (
            "prepare log.csv --out store --session-by user --gap-minutes 5",
            "--gap-minutes needs --session-by gap, not user",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(
    arguments: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text("user_id,item_id,timestamp,reward\n1,1,1,1\n")
    Path("run.json").write_text("{}")
    printed = refused(arguments.split(), capsys)
    assert re.search(says, printed), printed
    assert {path.name for path in tmp_path.iterdir()} == {"log.csv", "run.json"}


def test_numbers_out_of_their_range_are_refused(capsys: Capsys) -> None:
    for number in ("0", "257", "9" * 20, "1.5"):
        with pytest.raises(SystemExit):
            main(["serve", "run", "--workers", number])
        assert f"{number} is not a whole number from 1 to 256" in capsys.readouterr().err


def test_errors_are_shown_whole() -> None:
    long = "x" * 999
    assert f"({long})" in str(explanation(MemoryError(long)))


def test_a_package_that_is_missing_is_named_with_its_extra() -> None:
    extras = {"h5py": "control", "stable_baselines3": "collect", "optuna": "tune"}
    for module, extra in extras.items():
        text = explanation(ModuleNotFoundError(name=f"{module}.part"))
        assert f"install ucfrec[{extra}]" in text
    # A defect of ucfrec, such as a package that no extra has, is shown with its traceback.
    assert explanation(ModuleNotFoundError(name="hypothesis")) is None
    assert explanation(ModuleNotFoundError(name="ucfrec.nowhere")) is None
