"""`python -m lumigraph` is `lumigraph`."""


def main() -> int:
    """Run a command. Returns the exit code; Ctrl-C is heard from the first moment on."""
    try:
        from .cli import main as run
    except KeyboardInterrupt:
        return 130
    return run()


if __name__ == "__main__":
    raise SystemExit(main())
