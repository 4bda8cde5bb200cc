"""What an optimised mesh shall have: goals, as minimisations one after another."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import NamedTuple

__all__ = ["AVERAGE", "BALANCED", "GOALS", "UNTANGLE", "WORST", "Goal", "Stage", "When"]


class When(enum.IntEnum):
    """The mesh that a stage is for; elements without a node that may move do not count.

    Each but the last two is pulled at from the pivot of `Aggregation` that few elements exceed.
    """

    ALWAYS = 0
    INVERTED = 1  # some elements are inverted
    SOUND = 2  # none is poor
    POOR = 3  # some are: all close to being poor are pulled at
    WORSENED = 4  # the worst is worse than it was at the start: all that are worse than it are pulled at


class Stage(NamedTuple):
    """One minimisation: weights of the average and of the worst elements, and the power of the latter.

    It is left out unless the mesh is one that it is for.
    """

    average: float
    worst: float
    power: float
    when: When = When.ALWAYS


@dataclass(frozen=True)
class Goal:
    """Attributes: stages, the minimisations; they start where the one before has ended."""

    stages: tuple[Stage, ...]

    def __post_init__(self):
        if not any(stage.when in (When.ALWAYS, When.SOUND) for stage in self.stages):
            raise ValueError("a goal needs a stage that is for meshes in which nothing is poor")

    @property
    def last(self) -> Stage:
        """The stage that judges meshes."""
        return next(stage for stage in reversed(self.stages) if stage.when in (When.ALWAYS, When.SOUND))

    @property
    def averaged(self) -> bool:
        """Whether the average quality counts."""
        return any(stage.average > 0 for stage in self.stages)


UNTANGLE = Stage(0, 1, 2, When.INVERTED)
"""Unlike the mean of 1 − q, what it minimises grows without bound as an element degenerates."""

AVERAGE = Goal((Stage(1, 0.1, 4), Stage(1, 0.1, 4)))
"""The best mean quality, with a light hand on the worst elements; twice for the iterations."""

WORST = Goal((Stage(0, 1, 4), Stage(0, 1, 8), Stage(0, 1, 16)))
"""The best of the poor elements: a p-norm of 1/q that comes ever closer to the maximum."""

BALANCED = Goal(
    (
        Stage(1, 0.35, 8, When.POOR),
        Stage(1, 0.4, 24, When.POOR),
        Stage(1, 1.2, 16, When.SOUND),
        Stage(1, 30, 32, When.WORSENED),
    )
)
"""Both: the mean of 1 − q, and a penalty on elements near to being poor, or if there are none on the worst.

The weights were chosen on five meshes; benchmarks/PEERS.md says which.
"""

GOALS: dict[str, Goal] = {"average": AVERAGE, "worst": WORST, "balanced": BALANCED}
"""Their names at the command line."""
