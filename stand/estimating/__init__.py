"""How long a plan takes, before and while it runs."""
