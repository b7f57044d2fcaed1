"""What the commands do, behind their arguments; imported when a command runs, so that `--help` is quick."""
