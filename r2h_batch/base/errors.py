"""Errors that a user can mend: one family, raised anywhere, one line each. Imports nothing heavy.

The message says what was given, what is allowed and what to do. The command line alone turns an
error into a line on stderr and an exit code (`command_line.exit_code_of`); whoever calls the
package from Python catches a `ValueError`.
"""

import difflib
from collections.abc import Sequence


class UserError(ValueError):
    """A user can mend it: the line says what was given. A command ends with `exit_code`."""

    exit_code = 2


class FileError(UserError):
    """A refused file: one line that names it, what was found and what is allowed."""


class UsageError(UserError):
    """A refused argument, flag or sentence: one line that says what was given and what is
    allowed."""


class AnswerError(UserError):
    """What a method answered cannot be judged: one line that says what was found and what is allowed, with the method's
    name where more than one may be meant. A sweep leaves this method out, goes on with the others and ends with exit
    code 2."""


class EndedError(AnswerError):
    """A method would have ended the process in the middle of its work. A sweep does as with any answer that cannot be judged,
    and ends with exit code 1."""

    exit_code = 1


class MachineError(RuntimeError):
    """Work that this machine cannot do, whatever is given: one line. A command ends with exit
    code 1."""


def nearest(name: str, allowed: Sequence[str]) -> str:
    """`, did you mean X?` for the allowed word nearest to a misspelt one, or the only one that begins so; empty where none
    is near."""
    begun = [word for word in allowed if len(name) > 3 and word.startswith(name)]
    near = begun if len(begun) == 1 else difflib.get_close_matches(name, allowed, n=1)
    return f", did you mean {near[0]}?" if near else ""
