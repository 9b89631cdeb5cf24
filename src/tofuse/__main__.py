"""``python -m tofuse``."""

import sys

from tofuse.cli import console

sys.exit(console())
