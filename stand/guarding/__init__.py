"""What must never happen, and what is done when it does."""
