"""``python -m probscene.app.cli``."""

from . import main

main()
