"""`python -m potserver`: the command."""

from potserver.cli import main

raise SystemExit(main())
