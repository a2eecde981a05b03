"""Check that SQL text is one scalar expression over the columns of a log.

Rewards and column mappings are text from command lines, mapping files, run folders and stores.
DuckDB would run any SQL in it, so each text is parsed first (DuckDB's own parser returns a syntax
tree) and every node of the tree must be of a kind listed here.
"""

import json
import re
from collections.abc import Callable, Collection
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Self

from ucfrec import schema
from ucfrec.errors import InputError

if TYPE_CHECKING:
    import duckdb

MAX_LENGTH = 4000
"""Most characters of an expression."""
MAX_NESTING = 100
"""Most nested levels of an expression: brackets, calls, operators."""
MAX_GROWTH = 500
"""Most times by which text of an expression may be longer than the text of its columns."""
MAX_SIZE = 20_000
"""Most nodes of an expression as DuckDB evaluates it, counting each copy of copied arguments."""
_MAX_TREE = 2_000_000
"""Most characters of the JSON of a syntax tree."""
_MAX_COPIED = 1_000_000
"""Most characters after `CASE x WHEN` copied x."""
_MAX_QUOTED = 120
"""Most characters of an expression in a message."""

_KINDS = "BETWEEN CASE CAST COLUMN_REF COMPARISON CONJUNCTION CONSTANT FUNCTION OPERATOR TYPE"
_NODES = frozenset(_KINDS.split())
_SCALARS = """
    BOOLEAN BOOL LOGICAL TINYINT SMALLINT INTEGER BIGINT HUGEINT UTINYINT USMALLINT UINTEGER UBIGINT
    UHUGEINT INT1 INT2 INT4 INT8 SHORT LONG SIGNED UINT8 UINT16 UINT32 UINT64 FLOAT FLOAT4 FLOAT8
    DOUBLE DECIMAL VARCHAR TEXT STRING BPCHAR NVARCHAR UUID GUID JSON DATE TIME INTERVAL DATETIME
    TIMESTAMP TIMESTAMP_S TIMESTAMP_MS TIMESTAMP_US TIMESTAMP_NS TIMESTAMPTZ
"""
TYPES = frozenset(_SCALARS.split()) | {"TIMESTAMP WITH TIME ZONE", "LIST"}
"""Types that a cast may name, as the parser writes them; LIST is one of the others with []."""

# No function here reads files, settings, the clock or a random number, returns several rows, or
# returns text much longer than its arguments (replace, repeat, lpad and format would; `_growth`
# bounds what nested calls can do).
_MATHS = """
    abs sign round floor ceil ceiling trunc even sqrt cbrt exp ln log log2 log10 pow power pi mod
    gcd lcm sin cos tan asin acos atan atan2 sinh cosh tanh degrees radians bit_count
    isfinite isinf isnan if nullif least greatest
"""
_TEXTS = """
    concat concat_ws length len strlen lower upper trim ltrim rtrim left right substr substring
    reverse split_part string_split str_split string_split_regex translate starts_with ends_with
    prefix suffix contains instr position strpos regexp_matches regexp_full_match regexp_extract
    ascii md5 sha256 strip_accents
"""
_TIMES = """
    epoch epoch_ms epoch_us epoch_ns to_timestamp make_date make_time make_timestamp
    make_timestamp_ms make_timestamp_ns make_timestamptz strptime try_strptime strftime date_part
    datepart date_trunc datetrunc date_diff datediff date_sub datesub date_add time_bucket timezone
    year quarter month week day hour minute second millisecond microsecond dayofweek dayofmonth
    dayofyear weekday weekofyear isodow isoyear yearweek dayname monthname last_day julian
    to_years to_quarters to_months to_weeks to_days to_hours to_minutes to_seconds to_milliseconds
    to_microseconds
"""
_LISTS = """
    list_value list_contains list_has list_has_any list_has_all list_position list_extract
    list_element array_extract element_at list_slice array_slice list_sum list_avg list_min list_max
    list_count list_first list_last list_bool_and list_bool_or list_distinct list_unique list_sort
    list_reverse_sort list_reverse list_concat list_cat list_append list_prepend array_length
    array_contains array_position array_to_string flatten list_dot_product list_distance
    list_cosine_similarity cardinality map_extract map_keys map_values struct_extract
    json_extract json_extract_string json_array_length
"""
_OPERATORS = """
    + - * / // % ^ ** || & | << >> ~ xor @ ^@ @> <@ && ->>
    ~~ !~~ ~~* !~~* ~~~ like_escape not_like_escape ilike_escape not_ilike_escape
"""
FUNCTIONS = frozenset(" ".join((_MATHS, _TEXTS, _TIMES, _LISTS, _OPERATORS)).split())
"""Allowed functions, and operators by the parser's names (~~ is LIKE)."""
_COMPUTING = frozenset(f"{_MATHS} + - * / // % ^ **".split())
"""Functions whose arguments are numbers."""
COPYING = frozenset({"least", "greatest", "nullif", "split_part", "array_to_string"})
"""Macros: DuckDB copies each argument up to three times, or nine times with three arguments."""
_JOINING = ("concat", "||", "list_concat", "list_cat", "list_append", "list_prepend")
"""What they return is as long as all their arguments together."""
_QUOTING = (
    *("string_split", "str_split", "string_split_regex"),
    *("json_extract", "json_extract_string", "->>"),
)
"""What they return is longer than an argument once it is text: lists have quotes and commas."""
_QUOTES = 3
_DATE_PARTS = 12
"""Characters for two of the format of `strftime`."""
_TEXTS_AND_LISTS = ("VARCHAR", "TEXT", "STRING", "BPCHAR", "NVARCHAR", "JSON", "LIST")
_PLACES = ("query_location", "query_location_length")
_SIMPLE_CASE = re.compile(r"\bcase\b(?!\s+when\b)", re.IGNORECASE)
_WHEN = re.compile(r"\bwhen\b", re.IGNORECASE)
_ALLOWED = (
    "allowed are columns, literals, operators, casts, CASE, and the functions that "
    "docs/log-format.md lists"
)
_Node = dict[str, Any]
_TOO_DEEP = f"it is nested more than {MAX_NESTING} levels deep; simplify it"
_TOO_LARGE = f"it is too large; nest fewer of CASE x WHEN, {', '.join(sorted(COPYING))}"


class Expression(str):
    """SQL text, not parsed, with its origin for messages: the file or option that it comes from."""

    origin: str

    def __new__(cls, text: object, origin: str) -> Self:
        if not isinstance(text, str):
            raise InputError(f"{origin}: {_quote(text)} is not text; write a SQL expression")
        expression = super().__new__(cls, text)
        expression.origin = origin
        return expression


def computes_with_reward(expression: str) -> bool:
    """Whether an expression computes from the column `reward`, and is not only this column."""
    text = expression.strip().casefold()
    return text != schema.REWARD and schema.REWARD in re.findall(r"\w+", text)


class NotScalarError(Exception):
    """A text is not an allowed scalar expression; the message says why."""


def refusal(
    what: str,
    expression: str,
    source: str,
    reason: str,
) -> InputError:
    """One-line error for an expression that cannot be used, `what` for (e.g. "for the reward"),
    over the columns of a file or table, `source`."""
    origin = f"{expression.origin}: " if isinstance(expression, Expression) else ""
    return InputError(
        f"{origin}{what.partition(';')[0]}: {_quote(expression)} is not a scalar SQL expression "
        f"over the columns of {source}: {reason}"
    )


def columns_of(connection: "duckdb.DuckDBPyConnection", expression: str) -> tuple[str, ...]:
    """Names of the columns that an expression reads, once it is found to be one allowed scalar one.

    It is not evaluated, nor are the existence and types of columns checked. Raises NotScalarError
    if it is anything else, too long, too large, or nested too deep.
    """
    if len(expression) > MAX_LENGTH:
        raise NotScalarError(f"it has {len(expression):,} characters; {MAX_LENGTH:,} are allowed")
    depths = accumulate((char in "([{") - (char in ")]}") for char in expression)
    if max(depths, default=0) > MAX_NESTING:
        raise NotScalarError(_TOO_DEEP)
    # CASE x WHEN … copies x for every WHEN, so nested ones multiply. The product of the copies is
    # largest if every CASE has the same number of WHENs.
    cases, whens = len(_SIMPLE_CASE.findall(expression)), len(_WHEN.findall(expression))
    if cases and (whens / cases) ** cases * len(expression) > _MAX_COPIED:
        raise NotScalarError(
            f"it has {cases} CASE x WHEN … with {whens} WHEN; write CASE WHEN x = … instead"
        )
    # Parsed alone and in the brackets in which it will be used: a text with an unmatched bracket,
    # quote or comment cannot give the same tree both times.
    query, alone = _select(connection, f"{expression}\n")
    if query != _select(connection, "1")[0] or alone["alias"]:
        raise NotScalarError(f"it is more than one expression; {_ALLOWED}")
    if (query, alone) != _select(connection, f"({expression}\n)"):
        raise NotScalarError(f"it is not one whole expression; {_ALLOWED}")
    columns: dict[str, None] = {}
    if _walk(alone, 0, columns) > MAX_SIZE:
        raise NotScalarError(_TOO_LARGE)
    if _growth(alone) > MAX_GROWTH:
        raise NotScalarError(
            f"its text could be {MAX_GROWTH} times as long as its columns'; nest fewer of "
            "array_to_string, concat_ws, lists, and casts to text"
        )
    return tuple(columns)


def cast_truth_values(
    connection: "duckdb.DuckDBPyConnection", expression: str, find_type: Callable[[str], str]
) -> str:
    """An allowed expression with 0 and 1 in place of the truth values that it computes with;
    `find_type` returns the DuckDB type of an expression over its columns."""
    whole = _parse(connection, "CAST(1 AS BIGINT)")
    values = whole["statements"][0]["node"]["select_list"]
    (cast,) = values

    def cast_if_true_or_false(node: _Node) -> _Node:
        return {**cast, "child": node} if find_type(write(node)) == "BOOLEAN" else node

    def write(node: _Node) -> str:
        values[:] = [node]
        query = "SELECT json_deserialize_sql(?::JSON)"
        (text,) = connection.execute(query, [json.dumps(whole)]).fetchall()[0]
        return str(text).removeprefix("SELECT ")

    def change(node: _Node) -> _Node:
        if node.get("class") == "FUNCTION" and node["function_name"] in _COMPUTING:
            for argument in node["arguments"]:
                argument["expression"] = cast_if_true_or_false(argument["expression"])
        return cast_if_true_or_false(node) if node.get("class") == "COLUMN_REF" else node

    tree = _parse(connection, f"{expression}\n", change)
    return write(tree["statements"][0]["node"]["select_list"][0])


def _parse(
    connection: "duckdb.DuckDBPyConnection",
    expression: str,
    change: Callable[[_Node], Any] | None = None,
) -> Any:
    """Syntax tree of `SELECT expression`, with each node as `change` returns it."""
    query = "SELECT json_serialize_sql(?)"
    (tree,) = connection.execute(query, [f"SELECT {expression}"]).fetchall()[0]
    if len(tree) > _MAX_TREE:
        raise NotScalarError(_TOO_LARGE)
    return json.loads(tree, object_hook=change)


def _parts(tree: Any) -> Collection[Any]:
    """What a node of a syntax tree holds."""
    if isinstance(tree, dict):
        return tree.values()
    return tree if isinstance(tree, list) else ()


def _select(connection: "duckdb.DuckDBPyConnection", expression: str) -> tuple[_Node, _Node]:
    """Syntax trees of `SELECT expression`: the query without its value, and the value; without
    places in the text, so that equal expressions have equal trees."""
    from duckdb import Error

    def drop_places(node: _Node) -> _Node:
        return {name: part for name, part in node.items() if name not in _PLACES}

    try:
        parsed = _parse(connection, expression, drop_places)
    except RecursionError:
        raise NotScalarError(_TOO_DEEP) from None
    except (Error, UnicodeError) as error:
        raise NotScalarError(str(error).partition("\n")[0]) from None
    if parsed["error"]:
        raise NotScalarError(f"{parsed['error_message'].partition(chr(10))[0]}; {_ALLOWED}")
    if len(parsed["statements"]) != 1:
        raise NotScalarError(f"it is several statements; {_ALLOWED}")
    node = parsed["statements"][0].pop("node")
    values = node.pop("select_list", [])
    if len(values) != 1:
        raise NotScalarError(f"it is more than one expression; {_ALLOWED}")
    return {**node, "statement": parsed["statements"][0]}, values[0]


def _walk(tree: Any, depth: int, columns: dict[str, None]) -> int:
    """Check a tree and add the columns that it reads; returns its size as of `MAX_SIZE`."""
    if not isinstance(tree, dict) or "class" not in tree:
        return sum(_walk(part, depth, columns) for part in _parts(tree))
    if depth == MAX_NESTING:
        raise NotScalarError(_TOO_DEEP)
    _require_listed(tree)
    if tree["class"] == "COLUMN_REF":
        columns[tree["column_names"][0]] = None
    inner = sum(_walk(part, depth + 1, columns) for part in tree.values())
    if tree["class"] == "FUNCTION" and tree["function_name"].lower() in COPYING:
        inner *= 3 ** max(0, len(tree["arguments"]) - 1)
    return 1 + inner


def _growth(tree: Any) -> int:
    """How many times as long as the text of the columns the text of a tree can be, at most."""
    kind = tree.get("class") if isinstance(tree, dict) else None
    if kind == "CAST":
        name = str(tree["type_expr"]["type_name"]).upper()
        return _growth(tree["child"]) * (_QUOTES if name in _TEXTS_AND_LISTS else 1)
    if kind != "FUNCTION":
        return max(map(_growth, _parts(tree)), default=1)
    name = tree["function_name"].lower()
    arguments = [argument["expression"] for argument in tree["arguments"]]
    grown = [_growth(argument) for argument in arguments] or [1]
    if name == "array_to_string":
        # The separator may not come from a column.
        expression = arguments[1] if len(arguments) > 1 else {}
        literal = expression["literal"] if expression.get("class") == "CONSTANT" else {}
        if literal.get("kind") != "STRING":
            raise NotScalarError("the separator of array_to_string is not quoted text; write one")
        return grown[0] * (1 + len(literal["text"]))
    if name == "concat_ws":
        return grown[0] * len(grown) + sum(grown[1:])
    if name in _JOINING:
        return sum(grown)
    if name == "list_value":
        return _QUOTES * sum(grown)
    if name == "strftime":
        return _DATE_PARTS * max(grown)
    return max(grown) * (_QUOTES if name in _QUOTING else 1)


def _require_listed(node: _Node) -> None:
    """Refuse a node of a kind, type or function that is not allowed."""
    kind = node["class"]
    if kind not in _NODES:
        raise NotScalarError(f"it has a {kind.lower().replace('_', ' ')}; {_ALLOWED}")
    if kind == "OPERATOR" and node["type"] == "GROUPING_FUNCTION":
        raise NotScalarError(f"it calls 'grouping'; {_ALLOWED}")
    if kind == "TYPE" and (node["type_name"].upper() not in TYPES or _is_qualified(node)):
        raise NotScalarError(
            f"it casts to {_quote(node['type_name'])}; cast to numbers, text, BOOLEAN, UUID, JSON, "
            "dates and times, or lists of those"
        )
    if kind == "FUNCTION":
        name = node["function_name"].lower()
        if name not in FUNCTIONS or _is_qualified(node):
            raise NotScalarError(f"it calls {_quote(name)}; {_ALLOWED}")
        plain = not (node["distinct"] or node["filter"] or node["export_state"])
        if not plain or node["order_bys"]["orders"] or any(a["name"] for a in node["arguments"]):
            raise NotScalarError(f"it calls {_quote(name)} as an aggregate or with named arguments")


def _is_qualified(node: _Node) -> bool:
    return bool(node["catalog"] or node["schema"] or len(node["qualified_name"]["path"]) != 1)


def _quote(expression: object) -> str:
    quoted = repr(str(expression) if isinstance(expression, str) else expression)
    return quoted if len(quoted) <= _MAX_QUOTED else f"{quoted[: _MAX_QUOTED - 1]}…"
