import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeAlias, TypedDict, final, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from distributed_observer._result import Result

__all__ = [
    "Agent",
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

_Path: TypeAlias = str | os.PathLike[str]
_Package: TypeAlias = bytes | bytearray | str | os.PathLike[str]
_Samples: TypeAlias = _Path | ArrayLike | Samples | list[_Path] | list[ArrayLike] | list[Samples]
_Progress: TypeAlias = bool | Callable[[int, int], object] | None

class _Announced(TypedDict):
    digest: int
    hold: Literal["zero-order", "rate", "model"]
    rate: NDArray[np.float32]
    directions: list[int]
    disturbances: NDArray[np.float32]

class _Frame(TypedDict):
    sender: int
    sequence: int
    tick: int
    kind: Literal["estimate", "field", "farewell"]
    estimate: NDArray[np.float32] | None
    announced: _Announced | None

class _Verified(TypedDict):
    agent: int
    epoch: int
    version: int
    signed: bool
    signature_checked: bool
    key_fingerprint: str | None
    test_vectors: int

class _KeyPair(TypedDict):
    private_key: os.PathLike[str]
    public_key: os.PathLike[str]
    fingerprint: str

@final
class Scenario:
    @staticmethod
    def from_toml(
        text: str, *, name: str = "scenario.toml", set: Mapping[str, Any] | None = None
    ) -> Scenario: ...
    def with_changes(self, set: Mapping[str, Any]) -> Scenario: ...
    def with_plant(
        self,
        function: Callable[[NDArray[np.float64], float], ArrayLike],
        *,
        state_names: Sequence[str] | None = None,
    ) -> Scenario: ...
    def package(self, agent: int, seed: int = 0) -> bytes | None: ...
    def initial_estimate(self, agent: int) -> NDArray[np.float64]: ...
    def output_matrix(self, agent: int) -> NDArray[np.float64]: ...
    def neighbours(self, agent: int) -> list[int]: ...
    @property
    def name(self) -> str: ...
    @property
    def text(self) -> str: ...
    @property
    def agents(self) -> int: ...
    @property
    def dimension(self) -> int: ...
    @property
    def state_names(self) -> list[str]: ...
    @property
    def steps(self) -> int: ...
    @property
    def step_size(self) -> float: ...
    @property
    def duration(self) -> float: ...
    def run(
        self,
        seed: int = 0,
        threads: int = 0,
        *,
        packages: Sequence[_Package] | None = None,
        learning: bool = True,
        baselines: Sequence[str] | None = None,
        progress: _Progress = None,
    ) -> Result: ...

@final
class Agent:
    def __new__(
        cls, package: _Package, *, estimate: ArrayLike | None = None, health: bool = True
    ) -> Agent: ...
    def receive(self, frame: bytes) -> None: ...
    def step(
        self, measurement: ArrayLike | None = None, *, tick: int | None = None
    ) -> bytes | None: ...
    def announcement(self) -> bytes: ...
    @property
    def estimate(self) -> NDArray[np.float32]: ...
    @property
    def derivative(self) -> NDArray[np.float32] | None: ...
    @property
    def outer_weights(self) -> NDArray[np.float32]: ...
    @property
    def health(self) -> dict[str, int]: ...
    @property
    def network_in_use(self) -> bool: ...
    @property
    def number(self) -> int: ...
    @property
    def tick(self) -> int: ...
    @property
    def package(self) -> bytes: ...

@final
class Samples:
    def __new__(
        cls,
        time: ArrayLike,
        estimates: ArrayLike,
        derivatives: ArrayLike,
        *,
        outer_weights: ArrayLike | None = None,
        agent: int | None = None,
    ) -> Samples: ...
    @property
    def time(self) -> NDArray[np.float64]: ...
    @property
    def estimates(self) -> NDArray[np.float64]: ...
    @property
    def known_inputs(self) -> NDArray[np.float64]: ...
    @property
    def derivatives(self) -> NDArray[np.float64]: ...
    @property
    def outer_weights(self) -> NDArray[np.float32] | None: ...
    @property
    def agent(self) -> int | None: ...
    def save(self, path: _Path) -> None: ...
    def __len__(self) -> int: ...

def load(path_or_name: _Path, *, set: Mapping[str, Any] | None = None) -> Scenario: ...
def scenarios() -> list[str]: ...
@overload
def train(
    samples: _Samples,
    scenario: Scenario,
    agent: int,
    *,
    recipe: str | None = None,
    seed: int = 0,
    threads: int = 0,
    base: _Package | None = None,
    version: int | None = None,
    progress: _Progress = None,
) -> bytes: ...
@overload
def train(
    samples: _Samples,
    scenario: Scenario,
    agent: Sequence[int],
    *,
    recipe: str | None = None,
    seed: int = 0,
    threads: int = 0,
    base: _Package | None = None,
    version: int | None = None,
    progress: _Progress = None,
) -> list[bytes]: ...
def inspect(package: _Package) -> dict[str, Any]: ...
def verify(
    package: _Package, key: _Path | None = None, *, in_use: _Package | None = None
) -> _Verified: ...
def sign(
    package: _Package,
    key: _Path,
    *,
    passphrase: str | None = None,
    replace_signature: bool = False,
    epoch: int | None = None,
) -> bytes: ...
def keygen(name: _Path) -> _KeyPair: ...
def decode(frame: bytes, dimension: int | None = None) -> _Frame: ...
