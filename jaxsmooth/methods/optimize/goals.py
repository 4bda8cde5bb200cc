"""What an optimised mesh shall have: goals, as minimisations one after another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

__all__ = ["AVERAGE", "BALANCED", "GOALS", "UNTANGLE", "WORST", "Goal", "Stage"]


class Stage(NamedTuple):
    """One minimisation: weights of the average and of the worst elements, and the power of the latter.

    One that is `untangling` is left out when the mesh is valid, one that is `repairing` unless the worst
    element is worse than at the start; that element is then the pivot (see `Aggregation`).
    """

    average: float
    worst: float
    power: float
    untangling: bool = False
    repairing: bool = False


@dataclass(frozen=True)
class Goal:
    """Attributes: stages, the minimisations; they start where the one before has ended."""

    stages: tuple[Stage, ...]

    def __post_init__(self):
        if not any(not stage.repairing and not stage.untangling for stage in self.stages):
            raise ValueError("a goal needs a stage that neither repairs nor untangles")

    @property
    def last(self) -> Stage:
        """The stage that judges meshes."""
        return next(stage for stage in reversed(self.stages) if not (stage.repairing or stage.untangling))

    @property
    def averaged(self) -> bool:
        """Whether the average quality counts."""
        return any(stage.average > 0 for stage in self.stages)


UNTANGLE = Stage(0, 1, 2, untangling=True)
"""Unlike the mean of 1 − q, what it minimises grows without bound as an element degenerates."""

_REPAIR = Stage(1, 30, 32, repairing=True)

AVERAGE = Goal((Stage(1, 0.1, 4), Stage(1, 0.1, 4)))
"""The best mean quality, with a light hand on the worst elements; twice for the iterations."""

WORST = Goal((Stage(0, 1, 4), Stage(0, 1, 8), Stage(0, 1, 16)))
"""The best of the poor elements: a p-norm of 1/q that comes ever closer to the maximum."""

BALANCED = Goal((Stage(1, 1, 4), Stage(1, 2, 8), _REPAIR))
"""Both: the mean of 1 − q, and a penalty on what is worse than the pivot, then than the worst at the start.

The weights were chosen on a bracket and three meshes of other projects; benchmarks/PEERS.md says which.
"""

GOALS: dict[str, Goal] = {"average": AVERAGE, "worst": WORST, "balanced": BALANCED}
"""Their names at the command line."""
