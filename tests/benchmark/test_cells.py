"""Which cells methods have on a task."""

from pathlib import Path

from ucfrec.benchmark.cells import Budget, Evaluation, Method, Plan, Task, make_key

BUDGET = Budget("tiny", ("a",), 2, Evaluation(10, 7), fewer_seeds={"slow": 1, "b": 1})


def test_a_built_in_policy_is_told_apart_from_a_method_of_its_name(tmp_path: Path) -> None:
    plan = Plan("suite", tmp_path, BUDGET, lambda name, method: ())
    task = Task("a", tmp_path / "store", behaviors=("popular", "random"))
    keys = [
        make_key(cell) for cell in plan.list_built_in("main", task, {"popular": Method("popular")})
    ]
    assert [each.method for each in keys] == ["popular (simulator)", "random"]
    assert [each.policy for each in keys] == ["popular", "random"]
    assert {each.training_seed for each in keys} == {None}


def test_a_method_or_a_task_may_have_fewer_seeds() -> None:
    seeds = {(task, method): BUDGET.seeds_of(task, method) for task in "ab" for method in "xy"}
    assert seeds == {("a", "x"): 2, ("a", "y"): 2, ("b", "x"): 1, ("b", "y"): 1}
    assert BUDGET.seeds_of("a", "slow") == 1
    assert BUDGET.narrow(seeds=5).seeds_of("b", "slow") == 5
