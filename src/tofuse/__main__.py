"""``python -m tofuse``."""

import sys

from tofuse.cli import main

sys.exit(main())
