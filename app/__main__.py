"""Where the `reins` command begins: interrupted before it has begun its work, it ends without a word."""

from __future__ import annotations

import sys


def main() -> None:
    """Import the command line and run it; until that reads its words, nobody there minds an interrupt."""
    try:
        from app.cli import main as run

        run()
    except KeyboardInterrupt:
        sys.exit(130)  # `app.terminal.INTERRUPTED`, which may not be imported yet


if __name__ == "__main__":
    main()
