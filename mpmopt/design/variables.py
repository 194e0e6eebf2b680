"""Design variables by name, and which of them an optimiser may choose."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpmopt.design.actuation import NONE, signal, sizes
from mpmopt.errors import DesignError
from mpmopt.scene import Scene
from mpmopt.scene.parts import Checked
from mpmopt.validation import count, number, shown


class Variables(NamedTuple):
    """Design variables by name, each within [-1, 1]; the vector x is them in this order.

    Attributes
    ----------
    phi : (D,) array
        Of the design particles.
    a, theta : (M,) arrays
        Amplitude and phase of each harmonic of each actuator, actuator by actuator.
    b : (K,) array
        Bias of the actuators.
    omega : array
        Change of frequency of those actuators that have a detuning.
    """

    phi: NDArray
    a: NDArray
    theta: NDArray
    b: NDArray
    omega: NDArray = NONE

    @classmethod
    def of(cls, x: NDArray, scene: Scene) -> Variables:
        """The parts of a vector x of a scene."""
        rest = sizes(scene)
        return cls(*np.split(x, np.cumsum((x.size - sum(rest), *rest[:-1]))))

    def signal(self, scene: Scene) -> NDArray:
        """The actuators' signals (steps, K)."""
        return signal(scene, self.a, self.theta, self.b, self.omega)


# What a start has where nothing else is said.
START: Mapping[str, Any] = {"phi": 0.0, "a": 1.0, "theta": -0.3, "b": -0.5, "omega": 0.0}


def completed(owner: str, start: Mapping[str, Any]) -> dict[str, Any]:
    """A start with what it leaves out, from `START`.

    Raises
    ------
    DesignError
        If it has another name in it.
    """
    if unknown := [name for name in start if name not in START]:
        raise DesignError(
            f"{owner}: start has {', '.join(map(str, unknown))}; its names are {', '.join(START)}"
        )
    return {**START, **start}


@dataclass(frozen=True)
class Restriction(Checked):
    """Entries of a variable that are not free within [-1, 1].

    Parameters
    ----------
    name : {"phi", "a", "theta", "b", "omega"}
    entry : int, optional
        Of its array (`Variables`); None: all. Of phi only all, for grids have others.
    """

    name: str
    entry: int | None = None

    def __post_init__(self) -> None:
        owner = type(self).__name__
        if self.name not in Variables._fields:
            raise DesignError(
                f"{owner}: name = {shown(self.name)} must be one of {', '.join(Variables._fields)}"
            )
        if self.entry is not None:
            self._set(entry=count(owner, "entry", self.entry, 0, error=DesignError))
            if self.name == "phi":
                raise DesignError(f"{owner}: phi has other entries on every grid; leave entry out")

    def _number(self, name: str) -> None:
        owner = type(self).__name__
        self._set(**{name: number(owner, name, getattr(self, name), error=DesignError)})
        if not abs(getattr(self, name)) <= 1.0:
            raise DesignError(f"{owner}: {name} = {getattr(self, name)} must be within [-1, 1]")

    @property
    def _which(self) -> str:
        return self.name if self.entry is None else f"{self.name}[{self.entry}]"


@dataclass(frozen=True)
class Frozen(Restriction):
    """Variables that stay at a value, or as they start.

    Parameters
    ----------
    name, entry
        As in `Restriction`.
    value : float, optional
        Default: that of the start.
    """

    value: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.value is not None:
            self._number("value")

    def __str__(self) -> str:
        return f"{self._which} {'as it starts' if self.value is None else f'= {self.value:g}'}"


@dataclass(frozen=True)
class Bounded(Restriction):
    """Variables within bounds.

    Parameters
    ----------
    name, entry
        As in `Restriction`.
    lower, upper : float
    """

    lower: float = -1.0
    upper: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._number("lower")
        self._number("upper")
        if not self.lower < self.upper:
            raise DesignError(
                f"Bounded: lower = {self.lower} must be below upper = {self.upper}; take Frozen "
                "for one value"
            )

    def __str__(self) -> str:
        return f"{self._which} from {self.lower:g} to {self.upper:g}"


@dataclass(frozen=True)
class Tied(Restriction):
    """Variables that follow another entry: factor * that one + shift.

    Two actuators are in anti-phase if amplitudes are opposite and phases equal:
    ``Tied("a", 1, to=0, factor=-1.0), Tied("theta", 1, to=0)``.

    Parameters
    ----------
    name, entry
        As in `Restriction`; not phi. Without an entry all others follow.
    to : int
        The entry that they follow, which follows none itself.
    factor, shift : float
        Within [-1, 1], the factor not zero. Where they would lead beyond bounds, the range of `to`
        is less.
    """

    to: int = 0
    factor: float = 1.0
    shift: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(to=count("Tied", "to", self.to, 0, error=DesignError))
        self._number("factor")
        self._number("shift")
        if self.name == "phi":
            raise DesignError("Tied: phi has other entries on every grid; take a Mirror")
        if self.factor == 0.0:
            raise DesignError("Tied: factor = 0 leaves a value; take Frozen")
        if self.to == self.entry:
            raise DesignError(f"Tied: {self._which} would follow itself")

    def __str__(self) -> str:
        factor = "" if self.factor == 1.0 else f"{self.factor:g} "
        shift = f" {self.shift:+g}" if self.shift else ""
        return f"{self._which} = {factor}{self.name}[{self.to}]{shift}"


class Freedom:
    """Which variables of a scene are free, within which bounds, and how the others follow.

    With x the vector of all variables and y that of the free ones, x_j = factor_j y + shift_j of
    the one that it follows; so y_bar = x_bar of itself and factor_j x_bar_j of each follower.

    Parameters
    ----------
    scene : Scene
    size : int
        Number of all variables, n.
    restrictions : sequence of Restriction

    Attributes
    ----------
    lower, upper : (m,) arrays
        Bounds of the free variables.

    Raises
    ------
    DesignError
        If there is no such variable, or restrictions contradict each other.
    """

    def __init__(self, scene: Scene, size: int, restrictions: Iterable[Restriction]) -> None:
        named = Variables.of(np.arange(size), scene)._asdict()
        self._low, self._high = -np.ones(size), np.ones(size)
        self._free = np.ones(size, dtype=bool)
        ties: dict[int, tuple[int, float, float]] = {}
        # Followers bound those that they follow by all that bounds themselves.
        for item in sorted(restrictions, key=lambda item: isinstance(item, Tied)):
            entries = named[item.name]
            if item.entry is not None:
                entries = entries[[_existing(item, item.entry, entries)]]
            if isinstance(item, Frozen):
                self._free[entries] = False
                if item.value is not None:
                    self._narrow(item, entries, item.value, item.value)
            elif isinstance(item, Bounded):
                self._narrow(item, entries, item.lower, item.upper)
            elif isinstance(item, Tied):
                to = int(named[item.name][_existing(item, item.to, named[item.name])])
                for j in entries[entries != to].tolist():
                    if j in ties or not self._free[j]:
                        raise DesignError(f"{item}: it is tied or frozen already; leave one out")
                    ends = sorted((end - item.shift) / item.factor for end in self._ends(j))
                    self._narrow(item, np.array([to]), *ends)
                    ties[j] = to, item.factor, item.shift
        if chained := [j for j, (to, *_) in ties.items() if to in ties]:
            raise DesignError(
                f"x[{chained[0]}] is tied to x[{ties[chained[0]][0]}], which is tied itself; tie "
                "both to the same entry"
            )
        self._tied = np.array(list(ties), dtype=int)
        self._to = np.array([to for to, _, _ in ties.values()], dtype=int)
        self._factor = np.array([factor for _, factor, _ in ties.values()])
        self._shift = np.array([shift for _, _, shift in ties.values()])
        self._free[self._tied] = False
        self.lower, self.upper = self._low[self._free], self._high[self._free]

    def _ends(self, j: int) -> tuple[float, float]:
        return float(self._low[j]), float(self._high[j])

    def _narrow(
        self, item: Restriction, entries: NDArray[np.int64], lower: float, upper: float
    ) -> None:
        low = np.maximum(self._low[entries], lower)
        high = np.minimum(self._high[entries], upper)
        if np.any(low > high):
            j = int(np.argmax(low > high))
            raise DesignError(
                f"{item}: this leaves no value, from {low[j]:g} to {high[j]:g}; restrict it less"
            )
        self._low[entries], self._high[entries] = low, high
        self._free[entries[low == high]] = False

    def started(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """A start (n,) moved to where all that is restricted may be."""
        return np.clip(self._followed(np.clip(x, self._low, self._high)), self._low, self._high)

    def reduced(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """The free variables (m,) of a design (n,)."""
        return x[self._free]

    def whole(self, x: NDArray[np.float64], free: NDArray[np.float64]) -> NDArray[np.float64]:
        """The design (n,) with these free variables (m,), and what is frozen as in design x."""
        x = x.copy()
        x[self._free] = free
        return np.clip(self._followed(x), self._low, self._high)

    def _followed(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        x[self._tied] = self._factor * x[self._to] + self._shift
        return x

    def pullback(self, x_bar: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradients (..., m) by the free variables from those by all (..., n)."""
        x_bar = x_bar.copy()
        np.add.at(x_bar.T, self._to, (self._factor * x_bar[..., self._tied]).T)
        return x_bar[..., self._free]


def _existing(item: Restriction, entry: int, entries: NDArray[np.int64]) -> int:
    if entry >= entries.size:
        raise DesignError(
            f"{item}: {item.name} has {entries.size} entries, {entry} is none of them; they count "
            "from 0"
        )
    return entry
