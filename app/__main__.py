"""Where the `reins` command begins: interrupted before it has begun its work, it ends without a word."""

from __future__ import annotations

import sys


def main() -> None:
    """Import the command line and run it; importing takes long enough to be interrupted."""
    try:
        from app.cli import main as run
    except KeyboardInterrupt:
        sys.exit(130)  # `app.terminal.INTERRUPTED`, which may not be imported yet
    run()


if __name__ == "__main__":
    main()
