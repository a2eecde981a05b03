"""What a server showed is in its files: whole ones, and all of them once it is told to stop."""

import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.support.killed_loop import kills
from tests.support.served import histories, requests_of, responder, tagged_log, with_rule
from ucfrec import Recommender
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.logs.join import join_feedback
from ucfrec.logs.mapping import LogMapping, log_files
from ucfrec.recommending.exposures import ExposureLog
from ucfrec.recommending.requests import Request
from ucfrec.recommending.responder import Answer
from ucfrec.runs.trained_policy import TrainedPolicy


def answers(trained: TrainedPolicy) -> dict[int, Answer]:
    by = responder(trained, k=3, rule=with_rule(trained, temperature=1.0))
    requests = [Request.model_validate(each) for each in requests_of(histories(users=4))]
    found = by.answers(requests)
    return {int(r.user_id): a for r, a in zip(requests, found, strict=True)}  # type: ignore[misc]


def rows_of(given: dict[int, Answer]) -> list[tuple[object, ...]]:
    return [
        (
            *(str(user), item, answer.request_id, position, propensity),
            *(answer.session_began, answer.excludes_seen, answer.run, answer.rule),
        )
        for user, answer in given.items()
        for position, (item, propensity) in enumerate(
            zip(answer.items, answer.propensities, strict=True), 1
        )
    ]


def read(folder: Path) -> list[tuple[object, ...]]:
    frame = pd.concat([pd.read_parquet(file) for file in sorted(folder.glob("*.parquet"))])
    assert frame.timestamp.between((time.time() - 600) * 1000, time.time() * 1000).all()
    assert (frame.candidates == "").all()
    columns = frame.drop(columns=["timestamp", "arm", "candidates"])
    return list(columns.itertuples(index=False, name=None))


def test_files_rotate_by_size_and_by_time(trained: TrainedPolicy, tmp_path: Path) -> None:
    given = answers(trained)

    def files_before_the_end(folder: Path, **limits: float) -> int:
        with closing(ExposureLog(folder, trained, **limits)) as log:  # type: ignore[arg-type]
            for user, answer in given.items():
                log.add(user, answer)
                time.sleep(0.1)
            until = time.monotonic() + 20
            while not (found := [*folder.glob("*.parquet")]) and time.monotonic() < until:
                time.sleep(0.01)
        assert sorted(read(folder)) == sorted(rows_of(given))
        return len(found)

    assert files_before_the_end(tmp_path / "size", rows=3) >= 1
    assert files_before_the_end(tmp_path / "time", seconds=0.05) >= 1


def test_a_folder_that_cannot_be_written_loses_nothing_once_it_can(
    trained: TrainedPolicy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given, folder = answers(trained), tmp_path / "shown"
    with closing(ExposureLog(folder, trained, rows=1, seconds=0.05)) as log:
        folder.rmdir()
        folder.write_text("in the way")
        for user, answer in given.items():
            log.add(user, answer)
        time.sleep(0.5)
        folder.unlink()
        folder.mkdir()
    assert sorted(read(folder)) == sorted(rows_of(given))
    assert "cannot be written" in capsys.readouterr().err
    log, lost = ExposureLog(tmp_path / "gone", trained, seconds=0.05), len(rows_of(given))
    (tmp_path / "gone").rmdir()
    (tmp_path / "gone").write_text("in the way")
    for user, answer in given.items():
        log.add(user, answer)
    with pytest.raises(InputError, match=f"gone: {lost} rows of exposures are lost"):
        log.close()


def test_recommend_writes_its_exposures(trained: TrainedPolicy, tmp_path: Path) -> None:
    histories().to_parquet(tmp_path / "log.parquet")
    out, shown = tmp_path / "out.parquet", tmp_path / "shown.parquet"
    arguments = ["recommend", str(trained.folder), str(tmp_path / "log.parquet"), "--k", "4"]
    arguments += ["--temperature", "1", "--seed", "3", "--out", str(out)]
    assert main([*arguments, "--exposures", str(shown)]) == 0
    recommended, exposures = pd.read_parquet(out), pd.read_parquet(shown)
    assert exposures.user_id.tolist() == recommended.user_id.astype(str).tolist()
    assert exposures.position.tolist() == recommended["rank"].tolist()
    for name in ("item_id", "propensity", "request_id"):
        assert exposures[name].tolist() == recommended[name].tolist()
    assert set(exposures.run) == {trained.fingerprint}
    assert set(exposures.rule) == {with_rule(trained, temperature=1.0).hash}


@pytest.mark.parametrize("served", [False, True])
def test_weights_of_a_policys_own_log_are_1_given_the_candidates(
    trained: TrainedPolicy, tmp_path: Path, served: bool
) -> None:
    rule, shown = with_rule(trained, temperature=1.0), tmp_path / "shown"
    file, joined = tmp_path / "rows.parquet", tmp_path / "log.parquet"
    log, ids = tagged_log(), trained.items.ids.tolist()
    log = log[log.user_id < 130]
    log.to_parquet(file)
    if served:
        sets = [[*ids[::2], ids[0]], ids[:12], ids[::2][::-1], None]
        requests = [
            Request.model_validate(request | {"candidates": sets[n % 4]})
            for n, request in enumerate(requests_of(log))
        ]
        found = responder(trained, k=1, rule=rule).answers(requests)
        # A minute after the last row, so that sessions go on.
        clock = iter(log.groupby("user_id").timestamp.max() / 1000 + 60).__next__
        with closing(ExposureLog(shown, trained, clock=clock)) as exposures:
            for request, answer in zip(requests, found, strict=True):
                assert isinstance(answer, Answer)
                exposures.add(request.user_id, answer)
    else:
        shown.mkdir()
        pd.DataFrame({"item_id": ids[::2]}).to_parquet(tmp_path / "half.parquet")
        command = f"recommend {trained.folder} {file} --k 1 --temperature 1 --new-session --out"
        command += f" {tmp_path}/out --exposures {shown}/a --candidates {tmp_path}/half.parquet"
        assert main(command.split()) == 0
        (shown / "a").rename(shown / "a.parquet")
    rows = pd.concat(map(pd.read_parquet, log_files([shown])))
    clicks = rows[["user_id", "item_id", "timestamp"]].assign(reward=1.0)
    clicks.to_parquet(tmp_path / "clicks.parquet")
    join_feedback([shown], [tmp_path / "clicks.parquet"], joined, 1)
    assert len(pd.read_parquet(tmp_path / "log.candidates.parquet")) == 1 + served
    first = pd.to_datetime(rows.timestamp.iloc[0], unit="ms")
    assert not served or [*shown.glob(f"exposures-{first:%Y%m%dT%H%M%S}-*")]
    policy = Recommender.load(trained.folder)
    scores = policy.score(joined, rule=rule)
    assert scores.user_id.nunique() == len(scores) == 30
    np.testing.assert_allclose(scores.probability, scores.propensity, rtol=1e-5)
    mapping = LogMapping({"candidates": ""})
    scores = policy.score(joined, rule=rule, mapping=mapping)
    assert (scores.probability / scores.propensity).mean() < 0.8


@pytest.mark.slow
def test_a_kill_loses_only_what_waited(trained: TrainedPolicy) -> None:
    assert kills("exposures", trained.folder.parent) >= 7
