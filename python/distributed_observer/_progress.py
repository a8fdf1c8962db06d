"""Progress of long calls: a bar in notebooks, or a callable."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, Protocol


class Follower(Protocol):
    """What the native part tells how far it is."""

    def update(self, done: int, total: int) -> None: ...

    def close(self) -> None: ...


def follower(progress: bool | Callable[[int, int], object] | None) -> Follower | None:
    """Return who follows a call: by default a bar in notebooks, if tqdm is there."""
    if progress is None:
        progress = _in_notebook() and _bars() is not None
    if progress is False:
        return None
    if progress is True:
        bars = _bars()
        if bars is None:
            raise ModuleNotFoundError("progress=True needs tqdm; install it, or pass a callable")
        return _Bar(bars)
    if not callable(progress):
        raise TypeError("progress is not callable; pass True, False or a function of done and total")
    return _Callback(progress)


class _Callback:
    def __init__(self, function: Callable[[int, int], object]) -> None:
        self.function = function

    def update(self, done: int, total: int) -> None:
        self.function(done, total)

    def close(self) -> None:
        pass


class _Bar:
    def __init__(self, bars: Any) -> None:
        self.bars = bars
        self.bar: Any = None

    def update(self, done: int, total: int) -> None:
        if self.bar is None:
            self.bar = self.bars(total=total, unit_scale=True, leave=False)
        self.bar.total = total
        self.bar.update(done - self.bar.n)

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()


def _bars() -> Any:
    try:
        # Its own warning, without ipywidgets, would be given for every call.
        import warnings

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from tqdm.auto import tqdm
    except ModuleNotFoundError:
        return None
    return tqdm


def _in_notebook() -> bool:
    shell = sys.modules.get("IPython")
    found = shell.get_ipython() if shell is not None and hasattr(shell, "get_ipython") else None
    return found is not None and type(found).__name__ == "ZMQInteractiveShell"
