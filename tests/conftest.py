"""All tests run in float64, with annotated shapes checked at run time where they can be.

Compiling is most of what the tests do, so they compile in a hurry; the notebooks run as users
run them.  It is a test of its own: results must not depend on how the compiler rounds.
"""

import os
from importlib.metadata import version

if version("jaxlib").startswith("0.10."):  # later versions know no such flag
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false"

import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)
install_import_hook("jaxsmooth", "runtime_types.check")
