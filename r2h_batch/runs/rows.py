"""What readers of rows know of them: the names behind their codes, and the schemas of their tables."""

from r2h_batch.runs.columns import schema_of_kind
from r2h_batch.verdicts import ELSEWHERE, NO_LONGER, MarginKind, Outcome

MISSING = max(Outcome) + 1
"""Outcome code of a planned trial for which the method gave no prediction: it counts as a failure
of its own kind."""

OUTCOME_NAMES = (*(o.name.lower() for o in Outcome), "missing", *NO_LONGER, ELSEWHERE)
"""Name of every outcome code, in order; the last ones are of older rows, and of criteria of packages that are not installed."""

KINDS = tuple(k.name.lower() for k in MarginKind if k != MarginKind.NONE)
"""Name of every kind of margin, in order from code 1."""

(
    TRIAL_SCHEMA,
    DETAIL_SCHEMA,
    POSE_SCHEMA,
    PATH_SCHEMA,
    EPISODE_SCHEMA,
    SEES_SCHEMA,
    FAILURE_SCHEMA,
) = (
    schema_of_kind(kind)
    for kind in ("trials", "details", "poses", "paths", "episodes", "sees", "failures")
)
"""Schemas for an arm of six joints and a benchmark that asks for nothing more; `schema_of_kind` gives others."""
