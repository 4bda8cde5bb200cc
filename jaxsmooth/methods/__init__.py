"""Smoothing methods: frozen records that say how one step is made."""

from collections.abc import Callable
from functools import partial

from jaxsmooth.methods.base import Method, Proposal, Step
from jaxsmooth.methods.elastic.method import Elastic
from jaxsmooth.methods.laplacian import Laplacian
from jaxsmooth.methods.optimize.method import Optimize
from jaxsmooth.methods.optimize.untangle import Untangle

__all__ = ["METHODS", "Elastic", "Laplacian", "Method", "Optimize", "Proposal", "Step", "Untangle"]

METHODS: dict[str, Callable[[], Method]] = {
    "elastic": Elastic,
    "elastic-extended": partial(Elastic, extended=True),
    "laplacian": Laplacian,
    "smart-laplacian": partial(Laplacian, smart=True),
    "weighted-laplacian": partial(Laplacian, weighted=True),
    "smart-weighted-laplacian": partial(Laplacian, smart=True, weighted=True),
    "optimize": Optimize,
    "untangle": Untangle,
}
"""What makes each method, by its name on the command line."""
