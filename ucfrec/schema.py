"""Names and dtypes of log columns and of episode-store columns; defined in this module only."""

from typing import Final, Literal, TypeAlias

# Log columns, one row per impression.
USER_ID: Final = "user_id"
ITEM_ID: Final = "item_id"
TIMESTAMP: Final = "timestamp"
"""Milliseconds since the Unix epoch."""
SESSION_ID: Final = "session_id"
SessionBy: TypeAlias = Literal["session_id", "gap", "user"]
"""How rows form sessions: by a column, by a pause of the user, or one session per user."""
PROPENSITY: Final = "propensity"
IS_RANDOM: Final = "is_random"
REQUEST_ID: Final = "request_id"
"""Rows of one request are one decision; without it, those of a user at one time."""
POSITION: Final = "position"
"""Place of an item in the list of its decision, in any numbers that ascend."""
CANDIDATES: Final = "candidates"
"""What was on offer, a list of item_ids or the name of one; in a store, the number of the set."""
ACTION: Final = "action"
"""A list of floats, in logs whose actions are vectors instead of items."""
OBSERVATION: Final = "observation"
"""A list of floats: what was observed just before the action."""

SESSION_BEGAN: Final = "session_began"
"""Time (ms) at which the session of the decision began: with sessions by gap, it says more than a
pause between rows."""
EXCLUDES_SEEN: Final = "excludes_seen"
"""Whether items that the user had been shown before were not on offer."""

# Columns of exposures, one row per item shown, besides those of logs.
RUN: Final = "run"
"""Fingerprint of the run."""
RULE: Final = "rule"
"""Hash of the decision rule."""
ARM: Final = "arm"
"""Name of the run, where several share the users."""

# Episode-store columns, one row per step.
ITEM: Final = "item"
REWARD: Final = "reward"
RETURN_TO_GO: Final = "return_to_go"
PLACE: Final = "place"
"""Place of the row in its decision, from 0; stores of decisions of one row each lack it."""

# Episode-store columns, one row per episode.
USER: Final = "user"
SPLIT: Final = "split"
TERMINATED: Final = "terminated"
OFFSETS: Final = "offsets"
"""First step of each episode within its shard, and the shard's number of steps."""

STEP_DTYPES: Final = {
    ITEM: "<i4",
    ACTION: "<f4",
    OBSERVATION: "<f4",
    REWARD: "<f4",
    TIMESTAMP: "<i8",
    PROPENSITY: "<f4",
    IS_RANDOM: "|u1",
    PLACE: "<i4",
    SESSION_BEGAN: "<i8",
    EXCLUDES_SEEN: "|u1",
    CANDIDATES: "<i4",
}
EPISODE_DTYPES: Final = {USER: "<i8", SPLIT: "|u1", TERMINATED: "|u1"}

LARGEST_REWARD: Final = 1e12
"""Largest absolute reward: beyond it, squares of returns overflow float32 in training."""

SPLITS: Final = ("train", "validation", "test")
"""In chronological order; the column `split` holds the index in this tuple."""

STORE_VERSION: Final = 1
"""Version of the store format; increased whenever an older ucfrec would misread a new store."""

USER_IDS: Final = "user_id"
"""Key of `info`: (N,) int64, user of each environment's next step, numbered as in the logs."""
FORBIDDEN: Final = "forbidden"
"""Key of `info`: (N, L) int64, items not allowed at the next step; rows are padded with −1."""
OFFER: Final = "offer"
"""Key of `info`: `Offer` of the N environments' next step."""
