"""The shipped problems: one file, one paper, on casest's public names only."""
