"""`python -m casest`: the command line, where the script `casest` is not on the path."""

from casest.cli import main

if __name__ == "__main__":
    main()
