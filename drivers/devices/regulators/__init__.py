"""What holds the temperature: a unit on the bus, or our own law."""
