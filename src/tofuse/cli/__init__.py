"""The command line.

Exit status: 0, a result was written and every readable frame has a pose; 3, a result was written
but some readable frame has none; 2, nothing was written: one line on stderr says why. Of
`register`: 0, the pose is believed; 3, it is not, or cannot be verified.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable, Sequence


def console() -> int:
    """Run the command of this process, which ends with it, and return its exit status."""
    status = main()
    # Else all that is left is looked through for cycles once more, which takes half a second.
    gc.freeze()
    return status


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""

    def command() -> int:
        from tofuse.cli.parser import make_parser

        arguments = make_parser().parse_args(argv)
        status: int = arguments.command(arguments)
        sys.stdout.flush()
        return status

    return told(command)


def told(command: Callable[[], int]) -> int:
    """Return the exit status of a command; what stops it is said in a line."""
    from tofuse.errors import TofuseError

    try:
        return command()
    except TofuseError as error:
        print(f"tofuse: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("tofuse: interrupted; existing files are unchanged", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output went away (`tofuse ... | head`): not an error of ours.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        # What the rooms have not turned into a message of their own.
        where = f"{error.filename}: " if error.filename else ""
        print(f"tofuse: {where}{error.strerror or error}", file=sys.stderr)
        return 2
    except MemoryError:
        print(
            "tofuse: out of memory; use --every, --max-depth or a larger voxel_m", file=sys.stderr
        )
        return 2
