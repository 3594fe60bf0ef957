"""What a driver and its fake may share: framing and the call of a library, without the meaning of any value."""
