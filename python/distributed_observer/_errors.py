"""The exception of this module, and its warnings."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from distributed_observer._result import Result


class ObserverError(Exception):
    """An error with the text of the command line.

    ``code`` is stable, and ``docs/errors.md`` lists all; ``file`` and ``line`` say where, if that is known.
    """

    code: str
    file: str | None
    line: int | None
    #: The result of a run that means nothing because the estimates grew without bound.
    result: Result | None

    def __init__(
        self, text: str, code: str = "usage", file: str | None = None, line: int | None = None
    ) -> None:
        super().__init__(text, code, file, line)
        self.code = code
        self.file = file
        self.line = line
        self.result = None

    def __str__(self) -> str:
        return str(self.args[0])


class ObserverWarning(UserWarning):
    """A warning about samples, or about a trained network."""

    code: str

    def __init__(self, text: str, code: str = "") -> None:
        super().__init__(text)
        self.code = code


def warn(text: str, code: str) -> None:
    """Warn the caller of this module's function."""
    warnings.warn(ObserverWarning(text, code), stacklevel=2)
