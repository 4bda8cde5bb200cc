"""``python -m jaxsmooth`` is the command line."""

import sys

from jaxsmooth.cli import main

sys.exit(main())
