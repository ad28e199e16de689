"""`python -m lumigraph` is `lumigraph`."""

from .cli import main

raise SystemExit(main())
