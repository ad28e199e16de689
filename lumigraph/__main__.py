"""`python -m lumigraph` is `lumigraph`."""

from .system.signals import exit_code, listening, number_of


def main() -> int:
    """Run a command. Returns the exit code; signals are heard from the first moment on."""
    try:
        with listening():
            from .commands.cli import main as run

            return run()
    except KeyboardInterrupt as stopped:
        return exit_code(number_of(stopped))


if __name__ == "__main__":
    raise SystemExit(main())
