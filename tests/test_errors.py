"""Messages are one line, whatever text they quote."""

import errno
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ucfrec.errors import InputError, damage_explained, explain_os_error, one_line


@given(st.text())
def test_every_text_becomes_one_printable_line(text: str) -> None:
    assert one_line(text) == text if text.isprintable() else one_line(text).isprintable()
    assert str(InputError(f"a: {text}")).isprintable()


def test_a_terminal_is_not_steered() -> None:
    assert one_line("a\n\x1b[31mred\x07\r\nb") == "a \\x1b[31mred\\x07  b"


def test_an_error_of_the_system_is_one_line_with_its_file() -> None:
    full = explain_os_error(OSError(errno.ENOSPC, "No space left", "some\nfile"))
    assert full == "some file: No space left; nothing was written; free space and run again"
    assert explain_os_error(OSError("it broke\nbadly")) == "it broke badly"
    assert explain_os_error(OSError(errno.EXDEV, "x", "a", None, "b")) == "a → b: x"


def test_damage_names_the_file() -> None:
    with (
        pytest.raises(InputError, match=r"x is damaged .KeyError: 'missing'.; restore it"),
        damage_explained(Path("x"), "restore it"),
    ):
        {}["missing"]
