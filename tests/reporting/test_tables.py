"""Tables and numbers as they are written."""

from ucfrec.reporting.tables import (
    format_number,
    format_rows,
    format_value,
    markdown_table,
    text_table,
)


def test_columns_are_aligned_names_left_and_numbers_right() -> None:
    table = text_table(("a", "b", "value"), [("long name", "x", 1.5), ("y", "longer", None)])
    assert table.splitlines() == [
        "a          b       value",
        "---------  ------  -----",
        "long name  x       1.500",
        "y          longer      –",
    ]
    assert markdown_table(("a", "b"), [("x", 0.5)]) == "| a | b |\n| --- | --- |\n| x | 0.500 |"


def test_a_value_with_an_interval_shows_it() -> None:
    row = {"policy": "ucf", "R_cum": 2.0, "R_cum_low": 1.5, "R_cum_high": 0.0123, "n": 3}
    assert format_rows([row], ("policy", "R_cum", "n")).splitlines()[2] == (
        "ucf     2.000 [1.500, 0.0123]  3"
    )


def test_small_numbers_keep_three_digits() -> None:
    assert [format_number(value) for value in (0.0, 0.01234, -2.0)] == ["0.000", "0.0123", "-2.000"]
    assert [format_value(v) for v in (None, float("nan"), 12345.6, 0.5, 1234, "x")] == [
        *("–", "–", "12,346", "0.5", "1,234", "x")
    ]
