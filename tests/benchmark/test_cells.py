"""Which cells methods have on a task."""

from pathlib import Path

from ucfrec.benchmark.cells import Budget, Evaluation, Method, Plan, Task, make_key

BUDGET = Budget("tiny", ("a",), 2, Evaluation(10, 7), fewer_seeds={"slow": 1, "b": 1})


def test_a_built_in_policy_is_told_apart_from_a_method_of_its_name(tmp_path: Path) -> None:
    plan = Plan("suite", tmp_path, BUDGET, lambda name, method: ())
    task = Task("a", tmp_path / "store", behaviors=("popular", "random"))
    cells = plan.list_built_in("main", task, {"popular": Method("popular")})
    keys = [make_key(cell) for cell in cells]
    found = [(each.method, each.policy) for each in keys]
    assert found == [("popular (simulator)", "popular"), ("random", "random")]
    assert {each.training_seed for each in keys} == {None}
    assert (BUDGET.seeds_of("a", "x"), BUDGET.narrow(seeds=5).seeds_of("b", "slow")) == (2, 5)
