"""The web player: its built script, pages around it, and a server on this machine alone."""
