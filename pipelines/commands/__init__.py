"""The commands of `smplxpp`: one frozen dataclass a command, its fields the options, `run()` the work."""
