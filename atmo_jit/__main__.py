"""``python -m atmo_jit``: the same as the command ``atmo-jit``."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
