"""How many new categories a prediction interval speaks about. Light: command lines import it."""

from r2h_batch.base.errors import UsageError

FEW = 6
"""Where nobody asks for another number."""
MOST = 10_000


def check_few(few: int) -> None:
    """`UsageError` for a number of new categories that nobody can bring."""
    if not 1 <= few <= MOST:
        raise UsageError(f"--categories is {few}; it must be 1 to {MOST:,}")
