"""All tests run in float64, with annotated shapes checked at run time where they can be.

Compiling is most of what the tests do, so they compile in a hurry; the notebooks run as users
run them.  It is a test of its own: results must not depend on how the compiler rounds.
"""

import os
import tempfile
from getpass import getuser
from importlib.metadata import version
from pathlib import Path

if version("jaxlib").startswith("0.10."):  # later versions know no such flag
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false"

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)
# what one worker has compiled another need not
jax.config.update(
    "jax_compilation_cache_dir", str(Path(tempfile.gettempdir()) / f"jaxsmooth-tests-{getuser()}")
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
jax.config.update("jax_compilation_cache_max_size", 2**30)
os.environ["JAXSMOOTH_CACHE"] = "off"
install_import_hook("jaxsmooth", "runtime_types.check")


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """Compiled programs of one file are of no use to the next; they would fill the memory."""
    yield
    jax.clear_caches()
