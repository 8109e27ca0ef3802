"""A conversation with an avatar in a page: it hears or reads, asks who answers, speaks and moves."""
