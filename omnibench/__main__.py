"""``omnibench`` and ``python -m omnibench``: the command line, with Ctrl-C heard from the first import on."""

import sys


def main() -> None:
    """Run the command line."""
    try:
        from omnibench.cli import main as command_line

        command_line()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)  # noqa: T201 (nothing is loaded yet that could tell it)
        sys.exit(130)


if __name__ == "__main__":
    main()
