"""`python -m fabctl`."""

from fabctl.cli.main import main

main()
