"""Tables of settings: they behave as dataclasses, and reject invalid values."""

import copy
import pickle
from dataclasses import FrozenInstanceError, asdict, fields, replace
from typing import Annotated, Literal

import pytest
from pydantic import Field

from ucfrec.errors import InputError
from ucfrec.settings import SettingError, allowed_values, require, settings_table


@settings_table("shop")
class Shop:
    """A table."""

    shelves: Annotated[int, Field(ge=1, le=2000)]
    """How many
    there are."""
    width: Annotated[float, Field(gt=0)] = 0.5
    """Of each."""
    sells: Literal["bread", "wine"] = "bread"
    """What is on them."""
    open: bool = True
    """Now."""
    hours: tuple[int, int] | None = None
    """From, to."""
    name: str = ""
    """Above the door."""
    staff: tuple[str, ...] = ("Ann",)
    """Who works there."""
    shifts: Annotated[tuple[tuple[int, int], ...], Field(min_length=1)] = ((8, 17),)
    """From, to, of each."""

    def __post_init__(self) -> None:
        require(
            self.shelves * self.width <= 10,
            f"shop.shelves is {self.shelves}; no room for {self.width}",
            "shop.shelves",
            "shop.width",
        )


@settings_table("shop")
class Bakery(Shop):
    """A table over another."""

    width: Annotated[float, Field(gt=0)] = 0.25
    ovens: int = 2
    """In the back."""


def test_a_table_is_a_dataclass() -> None:
    shop = Bakery(3, ovens=1)
    assert asdict(shop) == asdict(Shop(3, width=0.25)) | {"ovens": 1}
    assert fields(shop)[1].default == 0.25
    assert replace(shop, width=2) == Bakery(3, 2.0, ovens=1)
    assert type(replace(shop, width=2).width) is float
    assert {shop, copy.deepcopy(shop), pickle.loads(pickle.dumps(shop))} == {shop}
    with pytest.raises(FrozenInstanceError):
        shop.ovens = 3  # type: ignore[misc]


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"shelves": 0}, "shop.shelves is 0; it must be a whole number from 1 to 2,000"),
        ({"shelves": True}, "shop.shelves is True; it must be a whole number from 1 to 2,000"),
        ({"width": "1"}, "shop.width is '1'; it must be a number above 0"),
        ({"width": float("inf")}, "shop.width is inf; it must be a number above 0"),
        ({"sells": "milk"}, "shop.sells is 'milk'; it must be 'bread' or 'wine'"),
        ({"open": 1}, "shop.open is 1; it must be true or false"),
        ({"hours": (1,)}, "shop.hours is (1,); it must be 2 values, each a whole number, or unset"),
        ({"staff": "Ann"}, "shop.staff is 'Ann'; it must be one or more values, each text"),
        ({"name": 3}, "shop.name is 3; it must be text"),
        ({"name": ["x" * 100]}, f"shop.name is ['{'x' * 55}…; it must be text"),
        ({"shelfs": 2}, "shop has no field 'shelfs'; did you mean 'shelves'?"),
        ({"shelves": 300}, "shop.shelves is 300; no room for 0.25"),
    ],
)
def test_what_is_not_allowed_is_named(given: dict[str, object], says: str) -> None:
    with pytest.raises(SettingError) as caught:
        Bakery(**{"shelves": 3, **given})  # type: ignore[arg-type]
    assert str(caught.value) == says
    assert isinstance(caught.value, InputError)


def test_a_list_is_accepted_for_a_tuple() -> None:
    listed = Bakery(3, hours=[9, 17], staff=["Ann"], shifts=[[8, 17]])  # type: ignore[arg-type]
    assert listed == Bakery(3, hours=(9, 17))
    assert hash(listed) == hash(Bakery(3, hours=(9, 17)))
    assert Bakery(3, 0.25, "bread", True, [9, 17]) == listed  # type: ignore[arg-type]
    assert replace(listed, staff=[]).staff == ()  # type: ignore[arg-type]
    with pytest.raises(SettingError, match=r"^shop\.shifts is \[\]; it must be one or more values"):
        Bakery(3, shifts=[])  # type: ignore[arg-type]


def test_positions_and_what_is_missing_are_named_too() -> None:
    with pytest.raises(SettingError, match=r"^shop\.width is 0; it must be a number above 0$"):
        Bakery(3, 0)
    with pytest.raises(SettingError, match=r"^shop\.shelves is missing; it must be a whole"):
        Bakery()  # type: ignore[call-arg]
    with pytest.raises(SettingError, match="no room for 6") as caught:
        replace(Shop(2), width=6)
    assert caught.value.keys == ("shop.shelves", "shop.width")


def test_types_and_ranges_are_said_in_words() -> None:
    assert allowed_values(Bakery, "hours") == "2 values, each a whole number, or unset"
    assert allowed_values(Bakery, "width") == "a number above 0"
