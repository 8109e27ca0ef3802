"""Networks and learned layers: modules alone, without losses, loops or captures."""
