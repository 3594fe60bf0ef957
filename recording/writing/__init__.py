"""Items onto the disk, durable before they count."""
