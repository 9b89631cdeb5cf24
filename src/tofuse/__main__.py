"""``python -m tofuse``."""

import sys

from tofuse.apps.cli.program import console

sys.exit(console())
