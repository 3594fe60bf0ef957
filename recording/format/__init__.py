"""What a session is on the disk: MCAP segments, messages, images, names."""
