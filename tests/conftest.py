"""All tests run in float64, with annotated shapes checked at run time where they can be.

Compiling is most of what the tests do, so they compile in a hurry, and processes that they start
do too.  It is a test of its own: results must not depend on how the compiler rounds.

What one worker or process has compiled the others of a run load; set JAX_COMPILATION_CACHE_DIR to
keep it for the next run.
"""

import ctypes
import os
import sys
import tempfile
from importlib.metadata import version

if "PYTEST_XDIST_WORKER" not in os.environ:  # workers have these from the process that starts them
    if version("jaxlib").startswith("0.10."):  # later versions know no such flag
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false"
    folder = tempfile.TemporaryDirectory(prefix="jaxsmooth-tests-")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", folder.name)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
    os.environ["JAXSMOOTH_CACHE"] = "off"
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # it reports kept programs as errors

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
install_import_hook("jaxsmooth", "runtime_types.check")

MOST = 1.2e9  # bytes of memory of a worker, from which on it forgets its programs within a file
LIMIT = [MOST]


def in_memory():
    """Bytes of memory that this process has now; 0 where nothing tells."""
    try:
        with open("/proc/self/statm") as numbers:
            return int(numbers.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def forget():
    """Drop all compiled programs, and give the memory back to the system where it can be told to."""
    jax.clear_caches()
    if sys.platform == "linux" and hasattr(library := ctypes.CDLL(None), "malloc_trim"):
        library.malloc_trim(0)


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """Compiled programs of one file are of no use to the next; they would fill the memory."""
    yield
    forget()


@pytest.fixture(autouse=True)
def forget_many_programs():
    """Those of some files alone would."""
    yield
    if in_memory() >= LIMIT[0]:
        forget()
        LIMIT[0] = max(MOST, in_memory() + 4e8)  # what is left is none of the programs
