"""Hard trials of a whole session: faults at random, long days, malformed messages."""
