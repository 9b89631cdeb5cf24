"""``python -m tofuse``."""

import sys

from tofuse.apps.cli import console

sys.exit(console())
