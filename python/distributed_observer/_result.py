"""The result of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as _pd

    from distributed_observer._native import Samples


class Result:
    """What a run returned: the same report and data that the command line prints and writes to files."""

    #: The report, with the keys of ``host-sim run --format json``.
    report: dict[str, Any]
    #: ``time``, shape ``[k]`` in seconds; ``state``, shape ``[k, n]``; ``estimates``, shape ``[k, N, n]`` in single precision;
    #: and ``errors``, shape ``[k, N]``. Empty if the scenario records none.
    traces: dict[str, NDArray[Any]]
    #: The times of each agent's broadcasts, in seconds; empty if the scenario records none.
    events: list[NDArray[np.float64]]
    #: The trained package of each agent and learning cycle, both from 1.
    packages: dict[tuple[int, int], bytes]
    #: The training samples of each agent and learning cycle, if ``record.samples`` is set.
    samples: dict[tuple[int, int], Samples]
    #: A hash of every broadcast and of the final state of every agent: equal if two runs behaved identically.
    digest: int
    #: The names of the state's components, shape ``[n]``.
    state_names: list[str]

    def __init__(
        self,
        report: dict[str, Any],
        traces: dict[str, NDArray[Any]],
        events: list[NDArray[np.float64]],
        packages: dict[tuple[int, int], bytes],
        samples: dict[tuple[int, int], Samples],
        digest: int,
        state_names: list[str],
    ) -> None:
        self.report = report
        self.traces = traces
        self.events = events
        self.packages = packages
        self.samples = samples
        self.digest = digest
        self.state_names = state_names

    @property
    def agents(self) -> list[dict[str, Any]]:
        """A dictionary for each agent, with the keys of ``docs/json.md``."""
        agents: list[dict[str, Any]] = self.report["agents"]
        return agents

    @property
    def trainings(self) -> list[dict[str, Any]]:
        """A dictionary for each training, with the keys of ``docs/json.md``."""
        trainings: list[dict[str, Any]] = self.report["trainings"]
        return trainings

    @property
    def checks(self) -> dict[str, Any]:
        """The checks against the theory, with the keys of ``docs/json.md``."""
        checks: dict[str, Any] = self.report["checks"]
        return checks

    @property
    def warnings(self) -> list[dict[str, str]]:
        """A dictionary with ``code`` and ``text`` for each warning."""
        warnings: list[dict[str, str]] = self.report["warnings"]
        return warnings

    def agents_frame(self) -> _pd.DataFrame:
        """Return :attr:`agents` as a data frame with a row for each agent."""
        rows = [{key: value for key, value in agent.items() if key != "health"} for agent in self.agents]
        return _pandas().DataFrame(rows).set_index("agent")

    def trainings_frame(self) -> _pd.DataFrame:
        """Return :attr:`trainings` as a data frame with a row for each training."""
        return _pandas().json_normalize(self.trainings)

    def traces_frame(self) -> _pd.DataFrame:
        """Return :attr:`traces` as a data frame: the columns of ``traces.csv`` without their units, and the time as index."""
        traces, names = self.traces, self.state_names
        columns = {name: traces["state"][:, place] for place, name in enumerate(names)}
        for agent in range(traces["errors"].shape[1]):
            for place, name in enumerate(names):
                columns[f"agent{agent + 1}.{name}hat"] = traces["estimates"][:, agent, place]
            columns[f"agent{agent + 1}.error"] = traces["errors"][:, agent]
        pandas = _pandas()
        return pandas.DataFrame(columns, index=pandas.Index(traces["time"], name="time"))

    def __repr__(self) -> str:
        report = self.report
        return f"<Result of {report['scenario']}, seed {report['seed']}: {len(self.agents)} agents>"

    def _repr_html_(self) -> str | None:
        """Show the agents as a table in notebooks."""
        try:
            frame = self.agents_frame()
        except ModuleNotFoundError:
            return None
        html: str = frame.dropna(axis="columns", how="all").to_html()
        return html


def _pandas() -> Any:
    try:
        import pandas
    except ModuleNotFoundError:
        raise ModuleNotFoundError("data frames need pandas; install it, or use the lists and arrays") from None
    return pandas
