"""What the subcommands of `more2` do. Heavy imports wait inside, so that `--help` answers at once."""
