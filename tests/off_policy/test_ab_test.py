"""The difference of two arms: what is planted is found, and looking often finds nothing else."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ucfrec.commands.cli import main
from ucfrec.errors import InputError, InputNote
from ucfrec.off_policy.ab_test import Comparison, always_valid, compare_arms


def log(users: int, lift: float, seed: int = 0, per_user: int = 10) -> pd.DataFrame:
    """Items shown to users who click more or less often, a fifth of them in arm b."""
    rng = np.random.default_rng(seed)
    user = np.repeat(np.arange(users), per_user)
    rate = rng.beta(1, 4, users)[user] * np.where(user % 5 == 0, 1 + lift, 1)
    clicks = (rng.random(len(user)) < rate).astype(int)
    arm = np.where(user % 5 == 0, "b", "a")
    hours = 3_600_000 * np.arange(len(user))  # a session each
    columns = {"user_id": user.astype(str), "arm": arm, "feedback": clicks, "timestamp": hours}
    return pd.DataFrame(columns)


SHARES = {"a": 0.8, "b": 0.2}


def test_a_planted_difference_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log(4000, 0.4).to_parquet(tmp_path / "log.parquet")
    arguments = ["compare", str(tmp_path / "log.parquet"), "--expected", "0.05"]
    arguments += ["--shares", "a=0.8,b=0.2"]
    assert main([*arguments, "--json", str(tmp_path / "out.json")]) == 0
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["arms"] == ["a", "b"]
    assert found["planned"]["low"] < 0.2 * 0.4 < found["planned"]["high"]
    assert 0 < found["always"]["low"] < found["planned"]["low"]
    assert capsys.readouterr().out.startswith("b is better than a\n")


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ([0, 0], [1, 1]),
        ([0, 1, 0], [1, 1, 1, 0]),
        ([0] * 50, [1] * 50),
        ([0] * 50, [1, 0] * 25),
        ([0] * 50, [0] * 50),
    ],
)
def test_users_that_do_not_differ_or_are_few_decide_nothing(
    tmp_path: Path, a: list[int], b: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    arms, users = ["a"] * len(a) + ["b"] * len(b), range(len(a) + len(b))
    frame = pd.DataFrame({"user_id": users, "arm": arms, "feedback": a + b, "timestamp": 0})
    frame.to_parquet(tmp_path / "log.parquet")
    arguments = ["compare", str(tmp_path / "log.parquet"), "--arms", "a,b"]
    assert main([*arguments, "--json", str(tmp_path / "out.json")]) == 0
    found = json.loads((tmp_path / "out.json").read_text())
    assert {found[name][end] for name in ("planned", "always") for end in ("low", "high")} == {None}
    said = capsys.readouterr().out
    assert "b − a: – at a planned end; – always valid" in said
    assert said.startswith("nothing can be concluded: a")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"arm": "a"}, r"two arms .* 'a' \(50 users\)"),
        ({"feedback": "x"}, "is VARCHAR; name a column of numbers"),
        ({"arm": None}, "two arms .* none"),
        ({"feedback": np.nan}, r"value of feedback .* 'a' \(0 users\), 'b' \(0 users\)"),
        ({"feedback": np.inf}, r"log\.parquet: feedback is infinite .* in 500 rows"),
    ],
)
def test_what_has_no_two_arms(tmp_path: Path, change: dict[str, str], message: str) -> None:
    log(50, 0.0).assign(**change).to_parquet(tmp_path / "log.parquet")
    with pytest.raises(InputError, match=message):
        compare_arms([tmp_path / "log.parquet"])
    log(50, 0.0).to_parquet(tmp_path / "log.parquet")
    with pytest.raises(InputError, match=r"no column 'clicks'"):
        compare_arms([tmp_path / "log.parquet"], "clicks")


@pytest.mark.parametrize("where", ["rows", "all rows of some users"])
def test_rows_without_a_value(
    tmp_path: Path, where: str, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = log(200, 0.5).assign(feedback=lambda rows: rows.feedback.astype(float))
    lacks = frame.index % 7 == 0 if where == "rows" else frame.user_id.str.endswith("1")
    kept = frame[~lacks].reset_index(drop=True)
    missing = [None, np.nan] * len(frame)
    values = [m if lack else v for lack, v, m in zip(lacks, frame.feedback, missing, strict=False)]
    column = pa.array(values, pa.float64(), from_pandas=False)
    table = pa.Table.from_pandas(frame.drop(columns="feedback"), preserve_index=False)
    pq.write_table(table.append_column("feedback", column), tmp_path / "log.parquet")
    kept.to_parquet(tmp_path / "kept.parquet")
    expected = compare_arms([tmp_path / "kept.parquet"], shares=SHARES)
    arguments = ["compare", str(tmp_path / "log.parquet"), "--shares", "a=0.8,b=0.2"]
    assert main([*arguments, "--json", str(tmp_path / "o.json")]) == 0
    of_a, of_b = (int((lacks & (frame.arm == arm)).sum()) for arm in "ab")
    said = f"log.parquet: feedback has no value in {of_a} rows of a and {of_b} of b"
    assert said in capsys.readouterr().err
    found = json.loads((tmp_path / "o.json").read_text())
    assert found["without_value"] == [of_a, of_b]
    for name in ("values", "users", "units"):
        assert found[name] == pytest.approx(getattr(expected, name)), name
    assert found["always"]["low"] == pytest.approx(expected.always.low)


def test_rows_without_a_user_or_an_arm_are_counted(tmp_path: Path) -> None:
    frame = log(200, 0.5)
    frame.to_parquet(tmp_path / "kept.parquet")
    more = [frame[:7].assign(user_id=None), frame[-4:].assign(user_id="", arm=None)]
    more += [frame[:3].assign(arm=None), frame[:2].assign(arm="")]
    pd.concat([frame, *more]).to_parquet(tmp_path / "log.parquet")
    found = compare_arms([tmp_path / "log.parquet"])
    assert (found.without_user, found.without_arm, found.in_several) == (11, 5, 0)
    assert "11 rows have no user_id; they are left out\n5 rows have no arm;" in str(found)
    once = compare_arms([tmp_path / "kept.parquet"])
    assert replace(found, without_user=0, without_arm=0) == once
    # Rows of one user count as one, and users of several arms not at all.
    both = frame[frame.user_id == "1"].assign(arm="b")
    pd.concat([frame] * 4).to_parquet(tmp_path / "log.parquet")
    again = compare_arms([tmp_path / "log.parquet"], shares=SHARES, per="item").planned
    once = compare_arms([tmp_path / "kept.parquet"], shares=SHARES, per="item").planned
    assert again.low == pytest.approx(once.low)
    pd.concat([frame, both]).to_parquet(tmp_path / "log.parquet")
    found = compare_arms([tmp_path / "log.parquet"])
    assert (found.in_several, found.several_names, found.users) == (1, ("1",), (159, 40))
    assert "1 users were in more than one arm (1); their rows are left out" in str(found)
    named = compare_arms([tmp_path / "log.parquet"], arms=("b", "a"))
    assert named.planned.value == pytest.approx(-found.planned.value)


def test_returns_of_sessions_are_those_of_plain_pandas(tmp_path: Path) -> None:
    """Arm b has half the reward of an item and twice the items: the return is the same."""
    rng, frame = np.random.default_rng(0), log(400, 0.0, per_user=20)
    frame["timestamp"] = rng.integers(0, 10 * 3_600_000, len(frame))
    of_b = frame.arm == "b"
    twice = frame[of_b].assign(timestamp=lambda rows: rows.timestamp + 1)
    frame.loc[of_b, "feedback"] = 0
    frame = pd.concat([frame, twice]).sample(frac=1, random_state=0)
    frame.to_parquet(tmp_path / "log.parquet")
    result = compare_arms([tmp_path / "log.parquet"], arms=("a", "b"), shares=SHARES)
    ordered = frame.sort_values(["user_id", "timestamp"])
    pauses = ordered.groupby("user_id").timestamp.diff()
    ordered["begins"] = pauses.isna() | (pauses > 30 * 60_000)
    sums = ordered.groupby("arm")[["feedback", "begins"]].sum()
    assert result.units == tuple(sums.begins)
    assert result.values == pytest.approx(tuple(sums.feedback / sums.begins))
    assert result.planned.low is not None
    assert result.planned.low < 0 < (result.planned.high or 0)
    by_item = compare_arms([tmp_path / "log.parquet"], arms=("a", "b"), shares=SHARES, per="item")
    assert by_item.conclusion == "b is worse than a"
    days = compare_arms([tmp_path / "log.parquet"], gap_minutes=600)
    assert sum(days.units) == 400
    for wrong in ({"per": "user"}, {"gap_minutes": float("inf")}, {"gap_minutes": 0.0}):
        with pytest.raises(InputError, match="give"):
            compare_arms([tmp_path / "log.parquet"], **wrong)  # type: ignore[arg-type]
    frame.drop(columns="timestamp").to_parquet(tmp_path / "log.parquet")
    with pytest.raises(InputError, match=r"no column 'timestamp' \(sessions, or give per item"):
        compare_arms([tmp_path / "log.parquet"])


def test_users_and_arms_in_csv_files_are_the_text_of_the_file(tmp_path: Path) -> None:
    users = ["1e1", "10", "2e1", "20", "30", "40"]
    frame = pd.DataFrame(
        {"user_id": users, "arm": ["1", "1.0"] * 3, "feedback": range(6), "timestamp": 0}
    )
    frame.to_csv(tmp_path / "log.csv", index=False)
    found = compare_arms([tmp_path / "log.csv"])
    assert (found.arms, found.users, found.in_several) == (("1", "1.0"), (3, 3), 0)


@pytest.mark.parametrize("kind", ["int8", "float64", "category", "bool"])
def test_arms_and_values_of_any_type_are_the_same(tmp_path: Path, kind: str) -> None:
    frame = log(100, 0.5)
    frame.to_parquet(tmp_path / "text.parquet")
    expected = compare_arms([tmp_path / "text.parquet"], arms=("a", "b"))
    arm = (frame.arm == "b").astype(int).astype(kind)
    typed = frame.assign(arm=arm, feedback=frame.feedback.astype(bool))
    typed.to_parquet(tmp_path / "typed.parquet")
    found = compare_arms([tmp_path / "typed.parquet"])
    assert replace(found, arms=("a", "b")) == expected


def test_guardrails_and_groups_are_compared(tmp_path: Path) -> None:
    file, shares = tmp_path / "log.parquet", SHARES
    frame = log(5000, 0.5)
    phone = frame.index % 10 < 4
    b = frame.arm == "b"
    # Dwell falls by a tenth; the gain is on phones only.
    frame["dwell"] = np.random.default_rng(1).exponential(10, len(frame)) * np.where(b, 0.9, 1)
    frame["device"] = np.where(phone, "phone", "web")
    lost = b & ~phone & (np.random.default_rng(2).random(len(frame)) < 1 / 3)
    frame.loc[lost, "feedback"] = 0
    frame.to_parquet(file)

    def compare(*guardrails: str) -> Comparison:
        return compare_arms([file], shares=shares, guardrails=guardrails, by="device")

    phones, web = compare("dwell >= -20%").groups
    assert (phones.name, phones.users, web.name) == ("phone", 5000, "web")
    assert phones.difference.standing() == "better"
    assert web.difference.low < 0 < web.difference.high
    # The interval of a group is that of its rows, wider as there are two.
    frame[phone].to_parquet(tmp_path / "phone.parquet")
    alone = compare_arms([tmp_path / "phone.parquet"], shares=shares).always
    assert phones.difference.value == pytest.approx(alone.value)
    assert phones.difference.low < alone.low
    for guardrail, outcome, says in (
        ("dwell >= -20%", "holds", "b is better than a"),
        ("2 * dwell >= -5%", "broken", "b is better than a, but a guardrail is broken"),
        ("dwell >= -10%", "open", "b is better than a, but a guardrail is open"),
    ):
        found = compare(guardrail)
        assert found.guardrails[0].outcome == outcome
        assert found.guardrails[0].change.low < -0.1 < found.guardrails[0].change.high
        assert found.conclusion == says
    frame.assign(dwell=frame.dwell.where(frame.index % 9 > 0)).to_parquet(file)
    with pytest.warns(InputNote, match="dwell has no value in .* rows of a and"):
        compare("dwell >= -20%")
    mismatched = compare_arms([file], guardrails=["dwell >= -20%"], by="device")
    assert "guardrail dwell: –, at least -20.0%: open (sample" in str(mismatched)
    assert all("–" in str(group) for group in mismatched.groups)


def test_looking_every_day_finds_a_difference_that_is_not_there_in_few_tests() -> None:
    """40 looks at tests without a difference; the interval of a planned end is wrong in many."""
    rng = np.random.default_rng(0)
    tests, looks, users = 400, 40, 50
    values = rng.exponential(size=(tests, 2, looks * users)) - 1
    wrong = {"always": np.zeros(tests, dtype=bool), "planned": np.zeros(tests, dtype=bool)}
    for look in range(1, looks + 1):
        seen = values[:, :, : look * users]
        difference = seen[:, 1].mean(1) - seen[:, 0].mean(1)
        variance = (seen.var(axis=2) / seen.shape[2]).sum(axis=1)
        for test in range(tests):
            low, high = always_valid(difference[test], variance[test], 0.1)
            wrong["always"][test] |= not low <= 0 <= high
        wrong["planned"] |= np.abs(difference) > 1.96 * np.sqrt(variance)
    assert wrong["always"].mean() <= 0.05
    assert wrong["planned"].mean() > 0.2


def test_arms_that_lack_users_conclude_nothing(tmp_path: Path) -> None:
    file = tmp_path / "log.parquet"
    log(5000, 0.4).to_parquet(file)
    as_drawn = compare_arms([file], shares={"a": 0.4, "b": 0.1, "c": 0.5})
    assert as_drawn.always.standing() == "better"
    even = compare_arms([file])
    assert "80.0% and 20.0%, where 50.0% and 50.0% were intended (p = 0)" in str(even)
    assert even.conclusion.startswith("nothing can be concluded: sample ratio mismatch")
    assert "b − a: – at a planned end" in str(even)
    for given, says in (
        *(({"shares": {"a": 0.0, arm: 0.5}}, "give one above 0 to each arm of") for arm in "bc"),
        *(({"expected": wrong}, "give a difference above 0") for wrong in (-1.0, 1e-200, 1e200)),
        ({"arms": ["a", "a"]}, "two arms"),
    ):
        with pytest.raises(InputError, match=says):
            compare_arms([file], **given)
