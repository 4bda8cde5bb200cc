"""All tests run in float64, with annotated shapes checked at run time where they can be."""

import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
CHECKED = ("elements", "small", "topology", "fitting", "metrics", "constraints")
install_import_hook([f"jaxsmooth.{name}" for name in CHECKED], "runtime_types.check")
