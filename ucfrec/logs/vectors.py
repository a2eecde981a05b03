"""Vectors of a log, `action` and `observation`: their sizes, and whether they are finite."""

from collections.abc import Iterable, Mapping, Sequence

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.tables import Table


def vectors(columns: Iterable[str]) -> tuple[str, ...]:
    """Those of some log columns that are vectors."""
    return tuple(name for name in columns if name in (schema.ACTION, schema.OBSERVATION))


def vector_counts(name: str, rows: str) -> str:
    """SQL of how many vectors of each size a column of a relation has, missing ones excluded."""
    return (
        f"SELECT len({name}) AS size, count(*) AS n FROM {rows} WHERE {name} IS NOT NULL "
        "GROUP BY size"
    )


def vector_sizes(counts: Mapping[str, Mapping[int, int]]) -> dict[str, int]:
    """Dimensions of each vector column.

    Args:
        counts: column to the number of its vectors by size, missing ones excluded.

    Raises:
        InputError: a column has vectors of unequal or no size.
    """
    sizes: dict[str, int] = {}
    for name, sizes_found in counts.items():
        ordered = sorted(sizes_found.items(), key=lambda pair: (-pair[1], pair[0]))
        if len(ordered) > 1:
            lengths = ", ".join(f"{n} rows of {size}" for size, n in ordered[:4])
            raise InputError(f"{name} has lists of unequal length: {lengths}; make them equal")
        if not ordered or ordered[0][0] == 0:
            raise InputError(
                f"{name} is empty in every row; map another column or --column {name}="
            )
        sizes[name] = int(ordered[0][0])
    return sizes


def observation_counts(rows: str) -> str:
    """SQL of the numbers of rows of a relation: those without a finite observation, and all."""
    return f"SELECT count_if({not_finite(schema.OBSERVATION)}), count(*) FROM {rows}"


def require_observations(tables: Sequence[Table], bad: int, rows: int) -> None:
    """Check that a log has a finite observation in every row.

    Args:
        bad: number of rows without one.

    Raises:
        InputError: there are rows without one.
    """
    if bad:
        raise InputError(
            f"{tables[0].files[0]}: {schema.OBSERVATION} is missing or holds NaN or infinity "
            f"in {bad:,} of {rows:,} rows; fill them in, leave those rows out, or ignore the "
            f"column with --column {schema.OBSERVATION}="
        )


def not_finite(vector: str) -> str:
    """SQL that says whether a vector is missing or has a number that is not finite."""
    finite = f"list_bool_and([coalesce(isfinite(v), false) FOR v IN {vector}])"
    return f"{vector} IS NULL OR NOT {finite}"
