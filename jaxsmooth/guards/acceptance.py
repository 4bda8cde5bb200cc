"""What a smoothed mesh must keep of its input, and why a run ended."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

from jaxsmooth.metrics.summary import POOR, Statistics

__all__ = ["OPEN", "AcceptanceRule", "Status"]

_CLOSED = 0.1  # scaled Jacobian below which a corner is as good as closed
_NARROW = 0.3  # the least that solvers accept for quadrilaterals, by Verdict's manual
OPEN = 0.7  # scaled Jacobian above which it does not matter how open a corner is


class Status(enum.StrEnum):
    """Why a run ended; the value is the message."""

    CONVERGED = "converged"
    STEP_LIMIT = "step limit"
    STALLED = "stalled: no node may move without breaking the guard"
    NO_GAIN = "stopped: the next step would have made nothing better"
    MORE_INVERTED = "stopped: further steps leave more inverted elements than the input has"
    MORE_POOR = "stopped: further steps leave more poor elements than the input has"
    LOWER_MINIMUM = "stopped: further steps make the worst element worse than it was in the input"
    LOWER_CORNER = "stopped: further steps lower the least scaled Jacobian of the input"
    LOWER_AVERAGE = "stopped: further steps lower the average quality of the input"
    NOT_FINITE = "stopped: the next step was not finite; the last finite mesh is returned"
    UNSOLVED = "stopped: the linear system of the next step could not be solved"


@dataclass(frozen=True)
class AcceptanceRule:
    """When a step of `smooth` counts: otherwise the run goes back to the last one that did, or to the input.

    The guard of a method looks at patches and elements; this looks at the whole mesh.  Against the
    input there may be no more inverted elements, no more poor ones, no lower q_avg (unless a tangled mesh
    has become valid by more than rounding); q_min may not fall below 0.2, nor the least scaled Jacobian
    below 0.1, unless they were there already.  Against the last
    step that counted neither of the two may fall at all, the scaled Jacobian where it is below 0.7, unless
    inverted or poor elements have become fewer (for fewer poor ones it may fall to 0.3), and something has
    to be better.

    The attributes loosen this; ∞ takes a demand away.

    Attributes:
        inverted: how many more elements may be inverted.
        below: how many more elements may be poor.
        quality: how much further q_min may fall.
        corner: how much further the least scaled Jacobian may fall.
        average: how much q_avg may fall; the extended method, which gives some of it for the worst
            elements, asks for ∞.
    """

    inverted: float = 0
    below: float = 0
    quality: float = 0.0
    corner: float = 0.0
    average: float = 0.0

    @classmethod
    def anything(cls) -> AcceptanceRule:
        """The rule that every finite mesh meets: for methods without a guard."""
        return cls(*[math.inf] * 5)

    def objection(
        self, first: Statistics, last: Statistics, now: Statistics, rounding: float
    ) -> Status | None:
        """The first demand that a step breaks, or None.

        Args:
            first: statistics of the input.
            last: statistics of the last step that counted.
            now: statistics of the step.
            rounding: differences of qualities that mean nothing.
        """
        untangled = first.inverted > now.inverted == 0 and now.q_min > rounding
        fewer = (now.inverted, now.below) < (last.inverted, last.below)
        q, corner = min(first.q_min, POOR), min(first.scaled_jacobian_min, _CLOSED)
        if not fewer:
            q, corner = max(q, last.q_min), max(corner, min(last.scaled_jacobian_min, OPEN))
        elif now.inverted == last.inverted:
            corner = max(corner, min(first.scaled_jacobian_min, _NARROW))
        # so written, NaN breaks them
        kept = (
            (now.inverted <= last.inverted + self.inverted, Status.MORE_INVERTED),
            (now.below <= (first if fewer else last).below + self.below, Status.MORE_POOR),
            (now.q_min >= q - self.quality - rounding, Status.LOWER_MINIMUM),
            (now.scaled_jacobian_min >= corner - self.corner - rounding, Status.LOWER_CORNER),
            (untangled or now.q_avg >= first.q_avg - self.average - rounding, Status.LOWER_AVERAGE),
            (fewer or self._gains(last, now), Status.NO_GAIN),
        )
        return next((status for holds, status in kept if not holds), None)

    def _gains(self, last: Statistics, now: Statistics) -> bool:
        return (
            self == AcceptanceRule.anything()
            or now.q_min > last.q_min
            or now.q_avg > last.q_avg
            or now.scaled_jacobian_min > last.scaled_jacobian_min
        )
