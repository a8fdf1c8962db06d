"""Distributed state estimation with deep networks under event-triggered communication.

>>> import distributed_observer as do
>>> result = do.load("paper").run()  # doctest: +SKIP
>>> result.agents[0]["rmse"]  # doctest: +SKIP
0.0345...

``load`` reads a scenario and ``Scenario.run`` runs it; ``Agent`` is one agent, stepped by hand; ``train`` makes a weight
package of recorded samples; ``inspect``, ``verify``, ``sign`` and ``keygen`` are about packages, ``decode`` about frames.
All of it is the library that the command line ``host-sim`` uses, with the same bits and the same errors.
"""

from distributed_observer._errors import ObserverError, ObserverWarning
from distributed_observer._native import (
    Agent,
    Samples,
    Scenario,
    decode,
    inspect,
    keygen,
    load,
    scenarios,
    sign,
    train,
    verify,
)
from distributed_observer._result import Result

__all__ = [
    "Agent",
    "ObserverError",
    "ObserverWarning",
    "Result",
    "Samples",
    "Scenario",
    "decode",
    "inspect",
    "keygen",
    "load",
    "scenarios",
    "sign",
    "train",
    "verify",
]
