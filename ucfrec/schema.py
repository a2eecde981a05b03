"""Names and dtypes of log columns and of episode-store columns; defined in this module only."""

from typing import Literal, TypeAlias

# Log columns, one row per impression.
USER_ID = "user_id"
ITEM_ID = "item_id"
TIMESTAMP = "timestamp"
"""Milliseconds since the Unix epoch."""
SESSION_ID = "session_id"
SessionBy: TypeAlias = Literal["session_id", "gap", "user"]
"""How rows form sessions: by a column, by a pause of the user, or one session per user."""
PROPENSITY = "propensity"
IS_RANDOM = "is_random"
REQUEST_ID = "request_id"
"""Rows of one request are one decision; without it, those of a user at one time."""
POSITION = "position"
"""Place of an item in the list of its decision, in any numbers that ascend."""
CANDIDATES = "candidates"
"""What was on offer, a list of item_ids or the name of one; in a store, the number of the set."""
ACTION = "action"
"""A list of floats, in logs whose actions are vectors instead of items."""
OBSERVATION = "observation"
"""A list of floats: what was observed just before the action."""

SESSION_BEGAN = "session_began"
"""Time (ms) at which the session of the decision began: it says more than a pause of the rows."""
CLOCKS_DIFFER_MS = 60_000
"""By how much the clock that said when a session began may differ from that of the rows."""
EXCLUDES_SEEN = "excludes_seen"
"""Whether items that the user had been shown before were not on offer."""

# Columns of exposures, one row per item shown, besides those of logs.
RUN = "run"
"""Fingerprint of the run."""
RULE = "rule"
"""Hash of the decision rule."""
ARM = "arm"
"""Name of the run, where several share the users."""

# Episode-store columns, one row per step.
ITEM = "item"
REWARD = "reward"
RETURN_TO_GO = "return_to_go"
PLACE = "place"
"""Place of the row in its decision, from 0; stores of decisions of one row each lack it."""

# Episode-store columns, one row per episode.
USER = "user"
SPLIT = "split"
TERMINATED = "terminated"
OFFSETS = "offsets"
"""First step of each episode within its shard, and the shard's number of steps."""

STEP_DTYPES = {
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
EPISODE_DTYPES = {USER: "<i8", SPLIT: "|u1", TERMINATED: "|u1"}

LARGEST_REWARD = 1e12
"""Largest absolute reward: beyond it, squares of returns overflow float32 in training."""

SPLITS = ("train", "validation", "test")
"""In chronological order; the column `split` holds the index in this tuple."""

STORE_VERSION = 1
"""Version of the store format; increased whenever an older ucfrec would misread a new store."""

USER_IDS = "user_id"
"""Key of `info`: (N,) int64, user of each environment's next step, numbered as in the logs."""
FORBIDDEN = "forbidden"
"""Key of `info`: (N, L) int64, items not allowed at the next step; rows are padded with −1."""
OFFER = "offer"
"""Key of `info`: `Offer` of the N environments' next step."""
