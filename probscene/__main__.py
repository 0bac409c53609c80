"""``python -m probscene``: the command line, for an environment whose scripts are not on the path."""

from probscene.app.cli import main

if __name__ == "__main__":
    main()
