"""Registers ``grid.jaxsmooth``; PyVista imports this by its entry points when the name is first used."""

import pyvista

from jaxsmooth.adaptors.pyvista import Accessor

__all__: list[str] = []

pyvista.register_dataset_accessor("jaxsmooth", pyvista.DataSet)(Accessor)
