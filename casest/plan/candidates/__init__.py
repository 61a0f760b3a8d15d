"""What could be measured next, from a declared model: poses, attitudes, runs, rows of a table."""
